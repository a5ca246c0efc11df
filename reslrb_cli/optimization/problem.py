"""Optimisation problem: everything that a configuration names, loaded and checked."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.parameters import Thickness, TransformName
from reslrb_cli.config.schema import Config
from reslrb_cli.config.views import recovered_exposure
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.integrators.step import OnSamples
from reslrb_cli.optimization.loading import BETWEEN_SPP, render_in_passes
from reslrb_cli.optimization.optimizers import Optimizer
from reslrb_cli.optimization.regularizers import Cost, Span, make_cost, spans_of
from reslrb_cli.optimization.variables import Smoother, make_transform
from reslrb_cli.optimization.views import SHARED, View, pixel_products, slope, to_tensor
from reslrb_cli.records.decisions import Decision
from reslrb_cli.records.images import luminance
from reslrb_cli.scene.catalog import COLOUR, EMISSION
from reslrb_cli.scene.deformation import Moves
from reslrb_cli.scene.parameters import Selection
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import Array, rms

#: Blur of a motion in the first iteration, relative to the shorter side of the image.
MOTION_BLUR = 1 / 16


def saved_spp(problem: Problem) -> int:
    """Return the samples per pixel of the initial and the final image: `run.final_spp`, or the next larger multiple of
    the samples per pass.
    """
    run, unit = problem.config.run, problem.samples_per_pass or 1
    return run.final_spp if unit >= run.final_spp else unit * -(-run.final_spp // unit)


def progress_spp(problem: Problem) -> int:
    """Return the samples per pixel of an image that shows progress, a multiple of `run.spp`."""
    spp = problem.config.run.spp
    return spp * -(-BETWEEN_SPP // spp)  # passes that divide a step divide this as well


class ErrorMeter:
    """Root mean square errors of parameters relative to true values, over the entries that light and sensor reach.

    `truth`, `masks` and `quantities` are the fields of a `Problem`. Each error has the unit of its parameter. Only
    errors with a common unit can be combined. Reflectance and roughness have no unit, but the intensity of a lamp is in
    W/sr, and the radiance of an area light in W/(m² sr). If units differ, errors are divided by the true values.

    Colours of textures are compared by their luminance if `monochrome`, because the image depends on nothing else.
    """

    def __init__(
        self, truth: Mapping[str, Array], masks: Mapping[str, Array], quantities: Mapping[str, str] | None = None,
        monochrome: bool = False,
    ) -> None:  # fmt: skip
        self._monochrome = monochrome
        self._masks = {key: masks[key] for key in truth if masks[key].any()}
        self._truth = {key: self._seen(truth[key])[mask] for key, mask in self._masks.items()}
        #: Root mean square of each truth over the same entries; a truth of zeros has none.
        self.scales = {key: scale for key, true in self._truth.items() if (scale := rms(true)) > 0}
        self.one_unit = len({(quantities or {}).get(key, "") for key in self._truth}) <= 1

    def errors(self, value: Callable[[str], Array]) -> dict[str, float]:
        """Return the root mean square error of each parameter with a true value. `value` returns a current value."""
        return {key: rms(self._seen(value(key))[self._masks[key]] - true) for key, true in self._truth.items()}

    def _seen(self, value: Array) -> Array:
        """Return the numbers of a value that its error counts."""
        is_colour = value.ndim == 3 and value.shape[2] == 3
        return luminance(value) if self._monochrome and is_colour else value.astype(np.float64)

    def total(self, errors: Mapping[str, float]) -> float | None:
        """Return the root mean square error over the entries of all parameters. Return None if units differ or nothing
        is known.

        The argument `errors` is the result of the method `errors`.
        """
        count = sum(self._truth[key].size for key in errors)
        if not count or not self.one_unit:
            return None
        return float(np.sqrt(sum(self._truth[key].size * error**2 for key, error in errors.items()) / count))

    def relative(self, errors: Mapping[str, float]) -> dict[str, float]:
        """Return each error divided by the root mean square of the true values. Parameters with true values of 0 are
        left out.
        """
        return {key: error / self.scales[key] for key, error in errors.items() if key in self.scales}


@dataclass(frozen=True)
class Problem:
    """Complete problem for `optimize`, made by `assemble`.

    `truth` has the known true values, in the shapes of the parameters. For the parameters in `truth`, `masks` has
    booleans. True entries are those that light and sensor reach. A mask is (H, W) for textures, and otherwise has the
    parameter's shape. `quantities` has the physical quantity of each parameter (`assemble.quantity`).
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
    #: The integrator's own limit on the samples of a pass.
    samples_per_pass: int | None = None
    #: Kinds of paths of the images: `light`, `camera`, or `both` (`loading.paths_of`).
    paths: str = "light"
    #: What the parameters move.
    moves: Moves = Moves.NOTHING
    #: Decisions on settings of the integrator that are `auto` (`autotune/sampling.py`).
    decisions: list[Decision] = field(default_factory=list)
    #: Regularizers of the values, by key and type.
    regularizers: dict[str, dict[str, Cost]] = field(default_factory=dict)
    #: Computes the shards of a step (`shards.Engine`); None: this process, one by one.
    engine: Callable[..., Any] | None = None
    #: True if an interrupt waits. Long measurements ask between two renderings (`stop_if_interrupted`).
    interrupted: Callable[[], bool] = lambda: False
    #: Numbers of non-finite entries that measurements left out since the last iteration, by image or gradient.
    left_out: Counter[str] = field(default_factory=Counter)

    def leave_out(self, name: str, values: Array) -> Array:
        """Return measured values with NaN for those that are not finite, and count these values."""
        known = np.isfinite(values)
        if count := int(np.count_nonzero(~known)):
            self.left_out[name] += count
        return np.where(known, values, np.nan)

    def stop_if_interrupted(self) -> None:
        """Raise KeyboardInterrupt if an interrupt waits."""
        if self.interrupted():
            raise KeyboardInterrupt

    def take_left_out(self) -> dict[str, int]:
        """Return the numbers of values that measurements left out, and clear them."""
        found = dict(+self.left_out)
        self.left_out.clear()
        return found

    def apply(self, others: Mapping[str, Any] | None = None) -> None:
        """Write the optimiser's values to the scene, and update the masks of moving shapes. `others` limits the
        keys.
        """
        values = {key: self.optimizer[key] for key in self.selection.keys}
        self.selection.hand_over({**values, **(others or {})})
        for view in self.views:
            view.follow(self.scene)

    def afresh(self, values: Mapping[str, Array]) -> Problem:
        """Return the problem in its state before the first iteration, with the given parameter values and without
        learned state. The argument `values` has the form that the method `values` returns.

        The original problem and the returned problem share one scene. The scene then has the given values.
        """
        self.selection.set_arrays(values)
        integrator = self.integrator
        if isinstance(integrator, LightTracer):
            integrator = integrator.afresh()
            for sensor in self.sensors:  # scene facts that it collects are not part of the first iteration
                integrator.plan(self.scene, self.scene.sensors()[sensor])
        fresh = replace(self, integrator=integrator, optimizer=make_optimizer(self.config, self.selection))
        fresh.apply()
        return fresh

    def gradients(self) -> dict[str, Any]:
        """Return each parameter's gradient, accumulated since the last clearing."""
        self.selection.collect()
        return {key: self.optimizer.gradient(key) for key in self.selection.keys}

    def regularize(self) -> dict[str, dict[str, float]]:
        """Add the gradients of regularizers, once per step. Returns their costs by key and type."""
        told, gradients = self.costs(self._heights())
        for key, gradient in gradients.items():
            value = self.optimizer[key]
            dr.accum_grad(value, _handed(value, gradient))
        return told

    def costs(self, values: Mapping[str, Array]) -> tuple[dict[str, dict[str, float]], dict[str, Array]]:
        """Return the regularizers' costs at `values`, by key and type. Also return the gradient of the summed costs, by
        key.

        `values` has all parameters with `regularizers`, by key.
        """
        told: dict[str, dict[str, float]] = {}
        gradients: dict[str, Array] = {}
        for key, costs in self.regularizers.items():
            told[key] = {}
            for name, cost in costs.items():
                told[key][name], own = cost(values[key])
                gradients[key] = gradients.get(key, 0.0) + own
        return told, gradients

    def stiffness(self, key: str, direction: Array) -> Array:
        """Return the regularizers' curvature for `key` times `direction`, as a flat array. The product is the change of
        the regularizers' gradient along `direction`.

        The result is zero if there are no regularizers for `key`.
        """
        values, size = self._heights(), float(np.abs(direction).max(initial=0.0))
        if key not in values or size == 0:
            return np.zeros_like(direction)
        value = values[key]
        step = 1e-4 * (float(np.abs(value).max(initial=0.0)) or 1.0) / size
        ends = [self.costs({**values, key: value + side * step * direction.reshape(value.shape)})[1][key].ravel()
                for side in (1, -1)]  # fmt: skip
        return np.asarray((ends[0] - ends[1]) / (2 * step))

    def _heights(self) -> dict[str, Array]:
        """Return the values of parameters with regularizers, by key."""
        return {key: np.array(dr.detach(self.optimizer[key]), dtype=np.float64) for key in self.regularizers}

    def held(self) -> dict[str, int]:
        """Return the number of heights at the minimum thickness for each heightmap that has a minimum thickness, by
        key.
        """
        counts = {}
        for key in self.regularizers:
            for each in self.selection.specs[key].regularizers:
                if isinstance(each, Thickness):
                    height = np.array(dr.detach(self.optimizer[key]))
                    counts[key] = int(np.count_nonzero(height <= np.float32(each.lowest)))
        return counts

    @property
    def measured_s(self) -> float:
        """Seconds that this run has spent on measurements that decide settings. The time of earlier runs does not
        count.
        """
        return sum(each.seconds for each in self.decisions if not each.cached)

    @property
    def limit_s(self) -> float | None:
        """Seconds that the iterations may take under `run.max_seconds`, or None without a limit."""
        limit = self.config.run.max_seconds
        return None if limit is None else limit - self.measured_s

    @property
    def sensors(self) -> list[int]:
        """Index of each view's sensor."""
        return [view.sensor for view in self.views]

    @property
    def trained(self) -> list[View]:
        """Views that are not held out."""
        return [view for view in self.views if not view.held_out]

    def drawn(self, iteration: int) -> list[tuple[View, float]]:
        """Return the views of an iteration (`run.views_per_iteration`), each with the factor of its loss."""
        trained, count = self.trained, self.config.run.views_per_iteration
        if count is None or count >= len(trained):
            return [(view, 1.0) for view in trained]
        rng = np.random.default_rng(seed(self.config.run.seed, iteration, 0, "views"))
        chosen = sorted(rng.choice(len(trained), count, replace=False))
        return [(trained[number], len(trained) / count) for number in chosen]

    def held_out_loss(self) -> float | None:
        """Return the mean loss of the held-out views, or None without held-out views. Every call uses the same
        samples.
        """
        views = [view for view in self.views if view.held_out]
        if not views:
            return None
        spp = progress_spp(self)
        losses = [float(view.compare(to_tensor(self.render(view.sensor, spp, 0, "held out")))[0]) for view in views]
        return float(np.mean(losses))

    def on_samples(self, view: View) -> OnSamples | None:
        """Return a callback that receives the samples' image and dL/dI in a view's step. A recovered exposure and a
        recovered response get their gradients from the samples of the view's step.
        """
        parts = [part for part in (view.exposure, view.response) if part is not None and part.key]
        if not parts:
            return None

        def add_gradients(image: mi.TensorXf, gradient: mi.TensorXf) -> None:
            products = pixel_products(view.target.shape[2], image, gradient)
            for part in parts:
                part.add_gradient(self.optimizer[part.key], products)

        return add_gradients

    def image_gradient(self, view: View, image: Array) -> Array:
        """Return dL/dI of a view's loss at an image (H, W, C), in the target's channels. It may contain non-finite
        values.
        """
        return slope(view.compare, image[:, :, : view.target.shape[2]])

    def values(self) -> dict[str, Array]:
        """Return the parameters' current values."""
        return {key: self.selection.array(key) for key in self.selection.keys}

    def first_blur(self, view: View) -> float:
        """Return the blur of a view in the first iteration, in pixels (`run.blur`)."""
        if self.config.run.blur != "auto":
            return self.config.run.blur
        moves = any(spec.motion is not None for spec in self.config.parameters)
        return MOTION_BLUR * min(view.target.shape[:2]) if moves else 0.0

    def render(self, sensor: int, spp: int, iteration: int, purpose: str) -> Array:
        """Render the current scene with the experiment's integrator. Returns (H, W, C) float32."""
        config = self.config
        return render_in_passes(
            self.integrator, self.scene, sensor, spp, config.run.seed, iteration, purpose, self.samples_per_pass
        )

    @functools.cached_property
    def meter(self) -> ErrorMeter:
        """Meter of the errors of parameters relative to `truth`."""
        return ErrorMeter(self.truth, self.masks, self.quantities, bool(mi.is_monochromatic))


def make_optimizer(config: Config, selection: Selection) -> Optimizer:
    """Return a new optimiser for the current values of the parameters."""
    specs = {key: selection.specs[key] for key in selection.keys}
    optimizer = Optimizer(
        config.optimizer.type,
        config.optimizer.learning_rate,
        config.optimizer.own_options(),
        values={key: selection.value(key) for key in selection.keys},
        rates={key: spec.learning_rate for key, spec in specs.items()},
        bounds={key: spec.bounds for key, spec in specs.items()},
        transforms={key: make_transform(_transform(config, selection, key), specs[key].bounds) for key in specs},
        smoothers={
            key: Smoother(selection.array(key).shape, spec.smoothing)
            for key, spec in specs.items()
            if spec.smoothing is not None
        },
        small=list(selection.factors),
    )
    optimizer.displace(selection.deformation.extents)
    # Images with an exposure of their own would fix the colours. Steps of `sgd` are short where gradients are small, so
    # they do not cross the valley.
    is_shared = recovered_exposure(config.target.exposure)[0] == "auto" and all(
        view.exposure is None for view in config.views or ()
    )
    if is_shared and SHARED in selection.factors and config.optimizer.type != "sgd":
        optimizer.balance(SHARED, [key for key in selection.keys if COLOUR.search(key)])
    return optimizer


def _transform(config: Config, selection: Selection, key: str) -> TransformName:
    """Return the transform of a parameter. `auto` moves the emission of a lamp by its logarithm if the emission is
    positive and has no upper bound, because a lamp makes up for colours by a factor.
    """
    spec = selection.specs[key]
    if spec.transform != "none" or config.optimizer.type != "auto" or not EMISSION.search(key):
        return spec.transform
    is_open = spec.bounds is None or spec.bounds[1] == math.inf
    return "log" if is_open and (selection.array(key) > 0).all() else "none"


def _handed(value: Any, array: Array) -> Any:
    """Return `array` as a Dr.Jit array of the type of `value`. The function adds 0 to the Dr.Jit array, because kernels
    depend on the alignment of NumPy's memory.
    """
    return type(value)(np.ascontiguousarray(array, dtype=np.float32)) + dr.opaque(mi.Float, 0)


def make_regularizers(selection: Selection) -> dict[str, dict[str, Cost]]:
    """Return the regularizers of `selection`, by key and type."""
    found: dict[str, dict[str, Cost]] = {}
    for key in selection.keys:
        for each in selection.specs[key].regularizers:
            flat = selection.kind(key) == "bitmap"
            spans = (Span(), Span()) if flat else spans_of(*selection.deformation.laid_over(key))
            found.setdefault(key, {})[each.type] = make_cost(each, spans)
    return found
