"""An optimisation problem: everything that a config names, loaded and checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import Config, Integrator, Reslrb
from reslrb_cli.errors import ConfigError, UnsupportedScene
from reslrb_cli.integrators import first_channels, make_integrator
from reslrb_cli.optimization.budget import MemoryPlan
from reslrb_cli.optimization.choice import Cache, find_options, settle_integrator
from reslrb_cli.optimization.errors import ErrorMeter, comparison_grid, quantity
from reslrb_cli.optimization.losses import Loss, make_loss
from reslrb_cli.optimization.moving import check_moving
from reslrb_cli.optimization.optimizers import Optimizer
from reslrb_cli.optimization.pilot_records import Outcome
from reslrb_cli.optimization.rendering import render_in_passes
from reslrb_cli.optimization.scaling import Scaled
from reslrb_cli.optimization.transforms import make_transform
from reslrb_cli.scene import (
    Selection,
    check_camera_paths,
    check_supported,
    load_scene,
    read_image,
    select_parameters,
    set_values,
)

Array = np.ndarray[Any, Any]

#: Types of integrators that trace from the light, and so cannot render every scene.
LIGHT_TRACERS = ("reslrb", "ptracer", "walk_ad", "trajectory")
#: Weights of linear sRGB in luminance, as Mitsuba has them.
LUMINANCE = np.array([0.212671, 0.715160, 0.072169], dtype=np.float32)


@dataclass
class Problem:
    """What `optimize` works on.

    `targets` are (H, W, C) tensors, one for each entry of `sensors`, without alpha. `truth` holds the
    true value of every parameter for which it is known, textures in the resolution of the scene file, and `masks` the
    entries of those that light and sensor reach (boolean; (H, W) for textures, else of the parameter's shape).
    `quantities` are the parameters' (`errors.quantity`).
    """

    config: Config
    scene: Any
    sensors: list[int]
    selection: Selection
    integrator: Any
    loss: Loss
    optimizer: Optimizer
    targets: list[Any] = field(default_factory=list)
    truth: dict[str, Array] = field(default_factory=dict)
    masks: dict[str, Array] = field(default_factory=dict)
    quantities: dict[str, str] = field(default_factory=dict)
    #: The integrator's own bound on the samples of a pass.
    samples_per_pass: int | None = None
    #: What was measured and planned before the first iteration, where it was.
    pilot: Outcome | None = None
    memory: MemoryPlan | None = None
    sensitivities: list[Scaled] | None = None

    def apply(self, others: Mapping[str, Any] | None = None) -> None:
        """Hand the optimiser's values to the scene, or, of the keys in `others`, those."""
        values = {key: self.optimizer[key] for key in self.selection.keys}
        self.selection.hand_over({**values, **(others or {})})

    def gradients(self) -> dict[str, Any]:
        """The gradient of each parameter that steps have added up since it was last handed over or cleared."""
        self.selection.collect()
        return {key: self.optimizer.gradient(key) for key in self.selection.keys}

    def compare(self, image: Any, target: Any) -> Any:
        """The loss of an (H, W, C) image, attached; alpha is left out."""
        return self.loss(first_channels(image, target.shape[2]), target)

    def image_gradient(self, image: Array, target: Any) -> Array:
        """The derivative dL/dI of one view's loss at an image (H, W, C), in the target's channels; finite or not."""
        leaf = mi.TensorXf(np.ascontiguousarray(image[:, :, : target.shape[2]], dtype=np.float32))
        dr.enable_grad(leaf)
        dr.backward(self.compare(leaf, target))
        return np.array(dr.grad(leaf))

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


def samples_per_pass(config: Config) -> int | None:
    """The integrator's own bound on the samples of a pass."""
    value = config.integrator.options().get("samples_per_pass")
    return None if value is None else int(value)


def make_configured(integrator: Integrator) -> Any:
    """The integrator that a configuration describes; all estimators have the same image, so for `auto` any will do."""
    if isinstance(integrator, Reslrb) and integrator.estimator == "auto":
        integrator = integrator.chosen(estimator="reservoir")
    return make_integrator(integrator.type, **integrator.options())


def assemble(config: Config, say: Callable[[str], None] = lambda line: None, cache: Cache | None = None) -> Problem:
    """Load and check what `config` names, make the targets, and settle the integrator; a variant must be set.

    Everything that can be checked is, before anything is rendered. `say` is told what takes long, `cache` holds what
    earlier pilots learned (None: nothing is kept). Raises ConfigError and UnsupportedScene.
    """
    problem = assemble_scene(config)
    options = find_options(problem)
    make_targets(problem, say)
    settle_integrator(problem, options, say, cache)
    return problem


def make_targets(problem: Problem, say: Callable[[str], None]) -> None:
    """Read or render the targets, with what is known of the parameters then; `say` is told what takes long."""
    config = problem.config
    render = config.target.render
    if render is None:
        problem.targets = [
            _target(problem, read_target(config, problem, index), sensor)
            for index, sensor in enumerate(problem.sensors)
        ]
        return
    true_scene = load_configured(config)
    true_values = set_true_values(config, true_scene)
    for key in problem.selection.keys:
        problem.truth[key] = true_values.array(key)
        grid = comparison_grid(problem.selection.array(key).shape, problem.truth[key].shape)
        if grid is not None:
            say(f"{key} has another resolution than its true value: compared, resampled, at {grid[1]}x{grid[0]}")
    chosen = render.integrator or config.integrator
    _check_supported(config, chosen.type, chosen.hide_emitters, true_scene, problem.sensors)
    integrator = make_configured(chosen)
    multiple = chosen.options().get("samples_per_pass")
    for sensor in problem.sensors:
        say(f"rendering the target of sensor {sensor}: {render.spp} spp")
        image = render_in_passes(integrator, true_scene, sensor, render.spp, render.seed, 0, "target", multiple)
        problem.targets.append(_target(problem, image, sensor))


def load_configured(config: Config) -> mi.Scene:
    """Load the scene that `config` names. Raises ConfigError."""
    return load_scene(config.scene.file, config.scene.options, config.scene.strict, config.scene.size)


def load_for_rendering(config: Config, initial: bool) -> tuple[Any, list[int], Any, int | None]:
    """Load the scene (with the parameters' initial values, if `initial`), and make the integrator.

    Returns both, between them the indices of the sensors in use, and the integrator's `samples_per_pass`.
    """
    if initial:
        problem = assemble_scene(config)
        return problem.scene, problem.sensors, problem.integrator, samples_per_pass(config)
    scene = load_configured(config)
    sensors = choose_sensors(config, scene)
    _check_supported(config, config.integrator.type, config.integrator.hide_emitters, scene, sensors)
    integrator = make_configured(config.integrator)
    return scene, sensors, integrator, samples_per_pass(config)


def assemble_scene(config: Config, scene: Any = None, values: Mapping[str, Array] | None = None) -> Problem:
    """Load and check what `config` names, targets left out.

    `scene` is used in place of `scene.file`, `values` in place of the parameters' initial ones. Raises ValueError where
    these are not one finite array for each parameter, of its shape.
    """
    scene = load_configured(config) if scene is None else scene
    sensors = choose_sensors(config, scene)
    _check_supported(config, config.integrator.type, config.integrator.hide_emitters, scene, sensors)
    selection = select_parameters(scene, config.parameters, config.source)
    if values is not None:
        _check_values(selection, values)
        selection.set_arrays(values)
    specs = {key: selection.spec(key) for key in selection.keys}
    optimizer = Optimizer(
        config.optimizer.type,
        config.optimizer.learning_rate,
        config.optimizer.own_options(),
        values={key: selection.value(key) for key in selection.keys},
        rates={key: spec.learning_rate for key, spec in specs.items()},
        bounds={key: spec.bounds for key, spec in specs.items()},
        transforms={key: make_transform(spec.transform, spec.bounds) for key, spec in specs.items()},
    )
    problem = Problem(
        config=config,
        scene=scene,
        sensors=sensors,
        selection=selection,
        integrator=make_configured(config.integrator),
        loss=make_loss(config.loss.type, **config.loss.options()),
        optimizer=optimizer,
        samples_per_pass=samples_per_pass(config),
        quantities={key: selection.quantity(key) or quantity(selection.params, key) for key in selection.keys},
    )
    problem.apply()
    check_moving(problem)
    return problem


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


def choose_sensors(config: Config, scene: Any) -> list[int]:
    """Return the indices of the sensors that `scene.sensors` names. Raises ConfigError for one that is not there."""
    count = len(scene.sensors())
    if config.scene.sensors == "all":
        return list(range(count))
    for place, sensor in enumerate(config.scene.sensors):
        if sensor >= count:
            has = "one sensor, index 0" if count == 1 else f"{count} sensors, indices 0 to {count - 1}"
            raise ConfigError(config.source, f"scene.sensors[{place}]", f"is {sensor}, but the scene has {has}")
    return list(config.scene.sensors)


def set_true_values(config: Config, scene: Any) -> Selection:
    """Set the values of `target.render.parameters` in `scene`; return them, selected.

    They are checked like initial values are; an error is located in the target.
    """
    render = config.target.render
    assert render is not None, "called for rendered targets only"
    return set_values(scene, config.parameters, render.parameters, config.source, "target.render.parameters")


def read_target(config: Config, problem: Problem, index: int) -> Array:
    """Read the target image of the `index`-th sensor that is used. Raises ConfigError."""
    files = config.target.file
    assert files is not None, "called for target files only"
    key = "target.file" if len(files) == 1 else f"target.file[{index}]"
    if len(files) != len(problem.sensors):
        raise ConfigError(
            config.source,
            "target.file",
            f"must name one image for each sensor; images: {len(files)}, sensors: {len(problem.sensors)}",
        )
    width, height = problem.scene.sensors()[problem.sensors[index]].film().crop_size()
    try:
        return read_image(files[index], config.target.color_space, (int(width), int(height)))
    except ConfigError as error:
        raise ConfigError(config.source, key, error.message) from None


def _target(problem: Problem, image: Array, sensor: int) -> Any:
    """`image` as a tensor with as many channels as the film of `sensor` has without its alpha."""
    colors = color_channels(problem.scene.sensors()[sensor].film())
    if colors == 1 and image.shape[2] >= 3:
        image = image[:, :, :3] @ LUMINANCE[:, None]
    target = mi.TensorXf(np.ascontiguousarray(image[:, :, :colors], dtype=np.float32))
    dr.make_opaque(target)
    return target


def color_channels(film: mi.Film) -> int:
    """How many channels an image of `film` has without alpha."""
    return 1 if int(film.base_channels_count()) <= 2 else 3


def _check_supported(config: Config, type: str, hide_emitters: bool, scene: Any, sensors: list[int]) -> None:
    try:
        if type in LIGHT_TRACERS:
            for sensor in sensors:
                check_supported(scene, scene.sensors()[sensor], hide_emitters)
        elif type == "prb":
            check_camera_paths(scene)
    except UnsupportedScene as error:
        raise ConfigError(config.source, "scene.file", str(error)) from error
