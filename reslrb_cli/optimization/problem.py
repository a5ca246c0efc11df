"""An optimisation problem: everything that a config names, loaded and checked."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.config import Config
from reslrb_cli.integrators import OnSamples
from reslrb_cli.integrators.tracer import LightTracer
from reslrb_cli.optimization.ambiguity import check_exposures
from reslrb_cli.optimization.announced import check_announced, check_described
from reslrb_cli.optimization.budget import MemoryPlan
from reslrb_cli.optimization.choice import Cache, find_options, settle_integrator
from reslrb_cli.optimization.errors import ErrorMeter, quantity
from reslrb_cli.optimization.loading import (
    check_integrator,
    choose_sensors,
    load_configured,
    make_configured,
    pass_spp,
    samples_per_pass,
)
from reslrb_cli.optimization.moving import check_moving
from reslrb_cli.optimization.optimizers import Optimizer
from reslrb_cli.optimization.pilot_records import Allowance, Outcome
from reslrb_cli.optimization.reach import find_reached
from reslrb_cli.optimization.rendering import render_in_passes, saved_spp
from reslrb_cli.optimization.room import check_films, outlook
from reslrb_cli.optimization.scaling import Scaled
from reslrb_cli.optimization.sequence_choice import settle_sampling
from reslrb_cli.optimization.settled import Settled
from reslrb_cli.optimization.targets import make_targets
from reslrb_cli.optimization.transforms import make_transform
from reslrb_cli.optimization.views import View, expose, make_views, slope, to_tensor
from reslrb_cli.records.paid import GuidedRecord, SequenceRecord
from reslrb_cli.scene import Selection, select_parameters
from reslrb_cli.seeds import seed

Array = np.ndarray[Any, Any]


@dataclass
class Problem:
    """What `optimize` works on.

    `truth` holds the true value of every parameter for which it is known, textures in the resolution of the scene
    file, and `masks` the entries of those that light and sensor reach (boolean; (H, W) for textures, else of the
    parameter's shape).
    `quantities` are the parameters' (`errors.quantity`).
    """

    config: Config
    scene: Any
    views: list[View]
    selection: Selection
    integrator: Any
    optimizer: Optimizer
    truth: dict[str, Array] = field(default_factory=dict)
    masks: dict[str, Array] = field(default_factory=dict)
    quantities: dict[str, str] = field(default_factory=dict)
    #: The integrator's own bound on the samples of a pass.
    samples_per_pass: int | None = None
    #: What measuring before the first iteration may take, where anything was left to it, and was not known already.
    allowance: Allowance | None = None
    #: What was measured and planned before the first iteration, where it was.
    pilot: Outcome | None = None
    guided: GuidedRecord | None = None
    sequence: SequenceRecord | None = None
    memory: MemoryPlan | None = None
    sensitivities: list[Scaled] | None = None

    def apply(self, others: Mapping[str, Any] | None = None) -> None:
        """Hand the optimiser's values to the scene, or, of the keys in `others`, those."""
        values = {key: self.optimizer[key] for key in self.selection.keys}
        self.selection.hand_over({**values, **(others or {})})

    def begin_again(self, values: Mapping[str, Array]) -> None:
        """Be as before the first iteration, with these values, as `values` has them; what was learned is forgotten."""
        self.selection.set_arrays(values)
        self.optimizer = make_optimizer(self.config, self.selection)
        if isinstance(self.integrator, LightTracer):
            self.integrator = self.integrator.afresh()
            for sensor in self.sensors:  # what it finds out about the scene is no part of the first iteration
                self.integrator.plan(self.scene, self.scene.sensors()[sensor])
        self.apply()

    def gradients(self) -> dict[str, Any]:
        """The gradient of each parameter that steps have added up since it was last handed over or cleared."""
        self.selection.collect()
        return {key: self.optimizer.gradient(key) for key in self.selection.keys}

    @property
    def sensors(self) -> list[int]:
        """The index of each view's sensor."""
        return [view.sensor for view in self.views]

    @property
    def trained(self) -> list[View]:
        """The views that are not held out."""
        return [view for view in self.views if not view.held_out]

    def drawn(self, iteration: int) -> list[tuple[View, float]]:
        """The views of an iteration, by `run.views_per_iteration`, each with what its loss is to be scaled by."""
        trained, count = self.trained, self.config.run.views_per_iteration
        if count is None or count >= len(trained):
            return [(view, 1.0) for view in trained]
        rng = np.random.default_rng(seed(self.config.run.seed, iteration, 0, "views"))
        chosen = sorted(rng.choice(len(trained), count, replace=False))
        return [(trained[number], len(trained) / count) for number in chosen]

    def held_out_loss(self) -> float | None:
        """The loss of the views that are held out, the mean over them, always of the same samples; None without any."""
        views = [view for view in self.views if view.held_out]
        if not views:
            return None
        spp = saved_spp(self, between=True)
        images = (self.render(view.sensor, spp, 0, "held out") for view in views)
        losses = [float(view.compare(to_tensor(image))[0]) for view, image in zip(views, images, strict=True)]
        return float(np.mean(losses))

    def on_samples(self, view: View) -> OnSamples | None:
        """What has to see the samples of a view's step: a recovered exposure, which has its gradient from them."""
        key = view.exposure.key
        if not key:
            return None
        return functools.partial(view.exposure.add_gradient, self.optimizer[key], view.target.shape[2])

    def image_gradient(self, view: View, image: Array) -> Array:
        """The derivative dL/dI of a view's loss at an image (H, W, C), in the target's channels; finite or not."""
        return slope(view.compare, image[:, :, : view.target.shape[2]])

    def values(self) -> dict[str, Array]:
        """The parameters' current values."""
        return {key: self.selection.array(key) for key in self.selection.keys}

    def render(self, sensor: int, spp: int, iteration: int, purpose: str) -> Array:
        """Render the scene as it stands with the experiment's integrator; (H, W, C) float32."""
        config = self.config
        return render_in_passes(
            self.integrator, self.scene, sensor, spp, config.run.seed, iteration, purpose, self.samples_per_pass
        )

    def error_meter(self) -> ErrorMeter:
        """What measures the parameters against `truth`, as that and `masks` are now."""
        return ErrorMeter(self.truth, self.masks, self.quantities)


def assemble(
    config: Config,
    say: Callable[[str], None] = lambda line: None,
    cache: Cache | None = None,
    to_run: bool = False,
    settled: Settled | None = None,
) -> Problem:
    """Load and check what `config` names, make the targets, and settle the integrator; a variant must be set.

    Everything that can be checked is, before anything is rendered. `say` is told what takes long, `cache` holds what
    earlier pilots learned (None: nothing is kept). With `to_run` all that an optimisation needs is there: exposures
    are checked, and what light and sensor reach is known. With `settled` nothing is measured anew: it is the problem of
    a run that goes on, as it was before its first iteration. Raises ConfigError and UnsupportedScene.
    """
    problem = assemble_scene(config)
    if settled is not None:
        settled.begin(problem)
    options = find_options(problem)
    line = outlook(config, problem.scene, problem.sensors) if to_run else None
    if line is not None:
        say(line)
    make_targets(problem, say)
    if settled is not None:
        settled.settle(problem, options)
        settled.reach(problem)
        return problem
    settle_integrator(problem, options, say, cache)
    settle_sampling(problem, say, cache)
    if to_run:
        check_exposures(problem)
        find_reached(problem, say)
    return problem


def load_for_rendering(config: Config, initial: bool) -> tuple[Any, list[int], Any, int | None]:
    """Load the scene (with the parameters' initial values, if `initial`), and make the integrator.

    Returns both, between them the indices of the sensors in use, and the integrator's `samples_per_pass`.
    """
    if initial:
        problem = assemble_scene(config)
        return problem.scene, problem.sensors, problem.integrator, samples_per_pass(config)
    scene = load_configured(config, selects=False)
    sensors = choose_sensors(config, scene)
    check_integrator(config, config.integrator, scene, sensors)
    integrator = make_configured(config.integrator)
    return scene, sensors, integrator, samples_per_pass(config)


def assemble_scene(config: Config, scene: Any = None, values: Mapping[str, Array] | None = None) -> Problem:
    """Load and check what `config` names, targets left out.

    `scene` is used in place of `scene.file`, `values` in place of the parameters' initial ones. Raises ValueError where
    these are not one finite array for each parameter, of its shape.
    """
    check_announced(config)
    scene = load_configured(config, functools.partial(check_described, config)) if scene is None else scene
    views = make_views(config, scene)
    check_films(config, scene, [view.sensor for view in views])
    check_integrator(config, config.integrator, scene, [view.sensor for view in views])
    selection = select_parameters(scene, config.parameters, config.source)
    expose(views, scene, selection)
    if values is not None:
        _check_values(selection, values)
        selection.set_arrays(values)
    problem = Problem(
        config=config,
        scene=scene,
        views=views,
        selection=selection,
        integrator=make_configured(config.integrator),
        optimizer=make_optimizer(config, selection),
        samples_per_pass=samples_per_pass(config),
        quantities={key: _quantity(selection, key) for key in selection.keys},
    )
    if isinstance(problem.integrator, LightTracer):
        problem.integrator.expect(pass_spp(config))
    problem.apply()
    check_moving(problem)
    return problem


def make_optimizer(config: Config, selection: Selection) -> Optimizer:
    """An optimiser that has done nothing yet, of the values that the parameters have now."""
    specs = {key: selection.spec(key) for key in selection.keys}
    return Optimizer(
        config.optimizer.type,
        config.optimizer.learning_rate,
        config.optimizer.own_options(),
        values={key: selection.value(key) for key in selection.keys},
        rates={key: spec.learning_rate for key, spec in specs.items()},
        bounds={key: spec.bounds for key, spec in specs.items()},
        transforms={key: make_transform(spec.transform, spec.bounds) for key, spec in specs.items()},
    )


def _quantity(selection: Selection, key: str) -> str:
    if key in selection.factors:
        return ""
    return selection.quantity(key) or quantity(selection.params, key)


def _check_values(selection: Selection, values: Mapping[str, Array]) -> None:
    foreign = sorted(set(values) ^ set(selection.keys))
    if foreign:
        raise ValueError(f"it {'has' if foreign[0] in values else 'lacks'} `{foreign[0]}`")
    for key, value in values.items():
        shape = selection.array(key).shape
        if value.shape != shape or value.dtype.kind != "f":
            raise ValueError(f"`{key}` is {value.dtype} of shape {value.shape}, not numbers of shape {shape}")
        if not np.isfinite(value).all():
            raise ValueError(f"`{key}` holds a value that is not finite")
