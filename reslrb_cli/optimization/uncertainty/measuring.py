"""Measurement of the certainty of the values after the last iteration: gradients and curvature at the final values."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import numpy as np

from reslrb_cli.errors import describe
from reslrb_cli.optimization.identifiability import shown_texels
from reslrb_cli.optimization.nonfinite import fill_gaps
from reslrb_cli.optimization.optimizers import SMALL
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient
from reslrb_cli.optimization.state import State
from reslrb_cli.optimization.uncertainty.coupling import Maps, followed, measure_maps, with_followed
from reslrb_cli.optimization.uncertainty.curvature import (
    EntryCurvature,
    LossCurvature,
    ParameterChange,
    ParameterDirection,
    plan_changes,
    row_of,
)
from reslrb_cli.optimization.uncertainty.fit import FitRecord, measure_fit
from reslrb_cli.optimization.uncertainty.posterior import Measured
from reslrb_cli.optimization.uncertainty.verdicts import (
    CertaintyRecord,
    Gradients,
    ParameterCertainty,
    weigh,
    with_misfit,
)
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.tree import to_array
from reslrb_cli.scene.dispersion import bends_light
from reslrb_cli.statistics import Array, rms

logger = logging.getLogger(__name__)

_PURPOSE = "certainty"

#: Shorter runs get no verdicts, because verdicts would take a large part of their time.
LEAST_ITERATIONS = 20
#: Gradients at the final values: iterations per gradient, and the limits of their number. They have the samples of a
#: step, so they compile no kernel.
ITERATIONS_A_SAMPLE, LEAST_SAMPLES, MOST_SAMPLES = 40, 4, 16
#: Random probes for large parameters, and iterations per rendering along directions.
PROBES, ITERATIONS_A_CHANGE = 4, 10
#: Divisor of a step's samples for each of the two sets that measure curvature, and samples per pixel below which all
#: are used. If noise hides the curvature of entries, more samples are used, up to a multiple of a step's.
PART, FEW, MOST_MULTIPLE = 4, 4, 16
#: Noise hides the curvature of an entry if less than this share of it remains without its standard error.
LEAST_SURE = 0.5
#: Step of the differences along directions, as a share of a parameter's scale.
STEP = 0.05
#: Maximum number of the last iterations, at most half of all, whose gradients and values are used; maximum number of
#: entries of a texture whose brightness is recorded.
MOST_LAST, MOST_RECORDED = 200, 2**22
#: Maximum number of entries of a texture whose gradients and values are recorded. In larger textures, the gradients at
#: the final values determine the mean square of the offsets as well, because there are so many entries.
MOST_ROWS = 2**10
#: If all large parameters together have at most this many entries, and are textures or heightmaps, each entry has its
#: own direction. There may always be this many renderings along directions.
MOST_ENTRIES = 64
#: Curvature that takes longer than this share of the run's iterations, this many of them, and this many seconds is left
#: out.
SHARE, MOST_STEPS, LEAST_SECONDS = 0.25, 50, 20.0
#: Time for the test of fit: a share of the run's iterations, and at least this many seconds.
SHARE_OF_FIT, LEAST_SECONDS_OF_FIT = 0.1, 10.0
#: Largest misfit that the values may have made up for, as a multiple of the one that is left, for a settled value. In a
#: second minimum, errors were 3.6 times the spreads for a multiple of 1.
HIDDEN = 4


class Certainty:
    """Certainty of one run of `problem`. Make the `Certainty` before the first iteration, and call `measure` after the
    last iteration.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._initial = {key: row_of(problem, key) for key in problem.selection.keys}
        #: Gradients and values of the last iterations, by key of a small parameter or a texture: `Measured.last`.
        self.last: dict[str, Array] = {}
        #: Texels (H, W) of each texture that are visible in some view and lit, once computed.
        self.shown: dict[str, Array] = {}
        #: Maps (H, W, 1) of a significant misfit by sensor, once measured (`fit.misfit_map`).
        self.misfits: dict[int, Array] = {}
        #: The schedule's factor for each iteration.
        self.rates: list[float] = []

    def see(self, before: State, state: State) -> None:
        """Record data of the iteration that leads from `before` to `state`. This costs almost nothing. Gradients of
        blurred images are left out, because their curvature is another one.
        """
        if any(view.blur for view in self.problem.trained):
            return
        for key, initial in self._initial.items():
            shape, is_small = self.problem.selection.array(key).shape, self.problem.optimizer.is_small(key)
            if not is_small and (len(shape) != 3 or initial.size > MOST_RECORDED):
                continue
            both = (state.gradients, before.values)
            gradient, value = (to_array(each[key]).astype(np.float64).ravel() for each in both)
            if not is_small and initial.size > MOST_ROWS:
                gradient, value = brightness(gradient, value, shape[2])
            if np.isfinite(gradient).all():
                earlier = self.last.get(key, np.zeros((0, 2, gradient.size)))
                self.last[key] = np.concatenate([earlier, [[gradient, value]]])[-MOST_LAST:]

    def measure(self, iterations: int, elapsed_s: float, stop: Callable[[], bool]) -> CertaintyRecord | None:
        """Measure after `iterations` iterations of `elapsed_s` seconds. Returns None after fewer than
        `LEAST_ITERATIONS` iterations, or if `stop()` returns true.

        Parameters and optimiser are not changed.
        """
        if iterations < LEAST_ITERATIONS:
            return None
        problem, config, clock, compiled_ms = self.problem, self.problem.config, StepClock(), 0.0
        try:
            problem.apply()
            rows: dict[str, list[Array]] = {key: [] for key in problem.selection.keys}
            for number in range(gradient_count(iterations)):
                if stop():
                    return None
                with clock.step() as times:
                    sample_gradient(problem, problem.integrator, number, _PURPOSE, config.run.spp)
                    problem.regularize()
                    for key, row in problem.gradients().items():
                        rows[key].append(np.array(row, dtype=np.float64).ravel())
                    take_gradient(problem)
                compiled_ms += times.codegen_ms
            gradients = {key: fill_gaps(np.array(samples)) for key, samples in rows.items()}
            go_on = Budget(max(SHARE * elapsed_s, MOST_STEPS * elapsed_s / iterations, LEAST_SECONDS), stop)
            with clock.step() as times:
                tiny = self._tiny()
                measured = self._measured(gradients, iterations, tiny)
                scales = {key: self.scale(key) for key in gradients}
                most = max(MOST_ENTRIES, iterations // ITERATIONS_A_CHANGE)
                plan = plan_changes(problem, scales, STEP, most, tiny)
                found = _measure_curvature(problem, plan, measured, go_on)
            compiled_ms += times.codegen_ms
            if stop():
                return None
            weighed = found.weighed(measured)
            with clock.step() as times:
                fit = self._test_fit(found, max(SHARE_OF_FIT * elapsed_s, LEAST_SECONDS_OF_FIT), stop)
            compiled_ms += times.codegen_ms
            fit = fit and fit.without(found.energy_of_textures(weighed))
            if fit is None or not fit.is_significant:
                self.misfits = {}
            else:
                wider, widest = (found.with_misfit(factor**2 * fit.energy).weighed(measured) for factor in (1, HIDDEN))
                weighed = with_misfit(weighed, wider, widest)
            measure_s = max(clock.elapsed_s - compiled_ms / 1e3, 0.0)
            render = config.target.render
            return CertaintyRecord(
                parameters={key: self._with_course(about, measured[key], key) for key, about in weighed.items()},
                measure_s=measure_s,
                share=measure_s / max(elapsed_s, 1e-9),
                iterations=iterations,
                learning_rate=config.optimizer.learning_rate,
                target_noise=self._target_noise(),
                target_spp=None if render is None else render.spp,
                is_biased=found.is_biased,
                fit=fit,
            )
        finally:
            take_gradient(problem)
            problem.apply()

    def _test_fit(self, found: Curvatures, seconds: float, stop: Callable[[], bool]) -> FitRecord | None:
        """Test whether the model fits the targets, and name parameters in the `seconds` that images leave, at least
        half. An error does not lose the verdicts: the result is then None.
        """
        from reslrb_cli.optimization.uncertainty.candidates import judge_fit  # late, because it imports SciPy

        try:
            go_on = Budget(seconds, stop)
            fit = measure_fit(self.problem, found.first, Budget(seconds / 2, stop))
            self.misfits = dict(zip((view.sensor for view in self.problem.trained), fit.maps, strict=False))
            return judge_fit(self.problem, fit, found.first, go_on)
        except Exception as error:
            logger.warning(f"the fit of the model was not tested: {describe(error)}")
            return None

    def _target_noise(self) -> str:
        """Return `target_noise` of `CertaintyRecord`, which states whether the spreads include the targets' noise."""
        read = [view.file is not None for view in self.problem.trained]
        return "left out" if all(read) else "in part" if any(read) else "measured"

    def _with_course(self, about: ParameterCertainty, own: Measured, key: str) -> ParameterCertainty:
        """Return the certainty with the distance moved, the possible distance, and the learning rate."""
        optimizer = self.problem.optimizer
        step = optimizer.first_step(key)
        reach = None if step is None else step * float(sum(self.rates))
        kept = own.touched & (True if own.seen is None else own.seen)
        moved = rms((own.value - own.start)[kept]) if kept.any() else 0.0
        return replace(
            about, moved=moved, reach=reach, rate=None if optimizer.measures_curvature else optimizer.rate(key)
        )

    def scale(self, key: str) -> float:
        """Return a parameter's scale, in the parameter's unit.

        The scale is the largest root mean square among three arrays. The arrays are the initial values, the final
        values, and the difference of both. For parameters without a unit of light, the scale is at least half of the
        range between the bounds, and for motions half of their extent. For the index of a glass, only the difference
        counts. The bounds of a heightmap are far larger than its values, so they do not count. If all are 0, it is 1.
        """
        first, last = self._initial[key], row_of(self.problem, key)
        sizes = [rms(first), rms(last), rms(last - first)]
        if bends_light(self.problem.selection.params, key):
            return sizes[-1] or 1.0  # a share of an index would move the light out of the picture
        if key in self.problem.selection.deformation.quantities and self.problem.selection.array(key).ndim == 3:
            return max(sizes) or 1.0
        if key in self.problem.optimizer.extents:
            sizes.append(0.5 * self.problem.optimizer.extent(key))
        low, high = self.problem.selection.specs[key].bounds or (-np.inf, np.inf)
        emits = self.problem.quantities.get(key, "") in ("radiance", "irradiance", "intensity")
        if np.isfinite(high - low) and (not emits or not any(sizes)):
            sizes.append(0.5 * (high - low))
        return max(sizes) or 1.0

    def _seen_entries(self, key: str, gradients: Array) -> Array | None:
        """Return the entries of a texture that some view shows, in the layout of flat gradients. For other parameters,
        return None.
        """
        shown = shown_texels(self.problem, key)
        if shown is None:
            return None
        halo = dr.shape(self.problem.optimizer[key])[1] - shown.shape[1]  # of an environment map
        channels = self.problem.selection.array(key).shape[2]
        touched = np.any(gradients, axis=0).reshape(shown.shape[0], -1, channels).any(axis=2)
        self.shown[key] = shown & touched[:, halo // 2 : halo // 2 + shown.shape[1]]
        wide = np.pad(shown, ((0, 0), (halo // 2, halo - halo // 2)), mode="wrap")
        return np.repeat(wide.ravel(), channels)

    def _tiny(self) -> set[str]:
        """Return the large parameters whose entries have a direction each (`MOST_ENTRIES`)."""
        large = [key for key in self.problem.selection.keys if not self.problem.optimizer.is_small(key)]
        arrays = [self.problem.selection.array(key) for key in large]
        entries = sum(row_of(self.problem, key).size for key in large)
        has_halo = entries > sum(array.size for array in arrays)
        if entries > MOST_ENTRIES or has_halo or any(array.ndim != 3 for array in arrays):
            return set()
        return set(large)

    def _measured(self, gradients: Gradients, iterations: int, tiny: Collection[str]) -> dict[str, Measured]:
        optimizer, found = self.problem.optimizer, {}
        for key, rows in gradients.items():
            value, last, own = row_of(self.problem, key), self.last.get(key), None
            last = None if last is None else last[-(iterations // 2) :]
            is_small = optimizer.is_small(key) or key in tiny
            if last is not None and not is_small and value.size <= MOST_ROWS:
                channels = self.problem.selection.array(key).shape[2]
                own, last = last, np.array([brightness(g, x, channels) for g, x in last])
            found[key] = Measured(
                value=value,
                bounds=self.problem.selection.specs[key].bounds or (-np.inf, np.inf),
                scale=self.scale(key),
                gradients=rows,
                step=np.nan_to_num(optimizer.response(key) * optimizer.rate(key) * self.rates[-1]),
                is_small=is_small,
                start=self._initial[key],
                last=last,
                rows=own,
                seen=self._seen_entries(key, rows),
                is_map=is_small and value.size > SMALL and key not in self.problem.selection.factors,
            )
        return found


@dataclass(frozen=True)
class Curvatures:
    """Measured curvature at the final values: H and B (M, M) along `directions`, and `alone` (M,) along each direction
    if no texture follows; the curvature of each entry of large parameters; and the maps of one shape. `is_biased` is
    true if noise of the images biases the gradients of the loss. `first` is the first measurement along all directions.
    """

    directions: list[ParameterDirection]
    H: Array
    B: Array
    alone: Array
    by_entry: dict[str, EntryCurvature]
    maps: list[Maps]
    is_biased: bool
    first: LossCurvature

    def weighed(self, measured: Mapping[str, Measured]) -> dict[str, ParameterCertainty]:
        """Return the certainty of each parameter."""
        return weigh(measured, self.directions, self.H, self.B, self.by_entry, self.alone, self.maps)

    def energy_of_textures(self, weighed: Mapping[str, ParameterCertainty]) -> float:
        """Return twice the loss of the offsets that large parameters still have. Their entries are not among the
        directions of the test of fit.
        """
        entries, total = {each.key for each in self.directions if each.entry is not None}, 0.0
        for key in set(self.by_entry) - entries:
            squares = sum((part[0] or 0.0) ** 2 for part in (weighed[key].to_go, weighed[key].of_target) if part)
            total += squares * float(np.maximum(self.by_entry[key].diagonal, 0.0).sum())
        return total

    def with_misfit(self, energy: float) -> Curvatures:
        """Return the curvatures with a misfit of this energy (`fit.py`) in B and in its diagonal by entry. The offset
        of each direction, and that of all entries of a texture together, may have made up for a misfit of this size.
        """
        by_entry = {}
        for key, own in self.by_entry.items():
            added = energy * np.maximum(own.diagonal, 0.0) / max(int(np.count_nonzero(own.diagonal)), 1)
            by_entry[key] = replace(own, of_target=added if own.of_target is None else own.of_target + added)
        return replace(self, B=self.B + energy * self.H, by_entry=by_entry)


def _measure_curvature(
    problem: Problem, plan: Sequence[ParameterChange], measured: Mapping[str, Measured], go_on: Budget
) -> Curvatures:
    """Measure the curvature along the changes of `plan`, and by entry, until `go_on` returns false."""
    run, unit = problem.config.run, problem.samples_per_pass or 1
    spp = max(max(run.spp // PART, min(run.spp, FEW)) // unit, 1) * unit
    curvature = source = LossCurvature(problem, spp)
    found = curvature.along(plan, go_on)
    free = {key: own.is_free for key, own in measured.items() if not own.is_small}
    maps, unknown = measure_maps(curvature, free, STEP, MOST_MULTIPLE * run.spp, go_on)
    count, extra = len(found[0]), followed(curvature, plan, free, go_on)
    if extra:
        again = curvature.repeated(1)
        together = again.along([*plan, *extra], go_on)
        if len(together[0]) >= count:
            source, found = again, together
    gradients = {key: own.gradients for key, own in measured.items()}
    while hides(found[0][:count], found[1], source.sure, gradients) and spp < MOST_MULTIPLE * run.spp:
        if not go_on.affords(PART * go_on.spent):
            break
        spp *= PART
        latest = LossCurvature(problem, spp, round=2)
        together = latest.along([*plan, *extra], go_on)
        if len(together[0]) < len(found[0]):
            break
        source, found = latest, together
    directions, H, B = found
    # By entry, if a parameter has no directions for its entries.
    seen = {direction.key for direction in directions if direction.entry is not None}
    left = any(np.any(rows) for key, rows in gradients.items() if key not in seen)
    by_entry = curvature.by_entry(PROBES, go_on) if left else {}
    kept, chosen = _complete(directions[:count], measured), with_followed(directions, H, count)
    places = [chosen[place] for place in kept]
    judged = [directions[place] for place in places]
    return Curvatures(
        directions=judged,
        H=source.for_verdicts(judged, places),
        B=B[np.ix_(places, places)],
        alone=np.diag(H)[kept],
        by_entry={key: entries for key, entries in by_entry.items() if key not in unknown},
        maps=maps,
        is_biased=bool(curvature.biases),
        first=curvature,
    )


def _complete(directions: Sequence[ParameterDirection], measured: Mapping[str, Measured]) -> list[int]:
    """Return the places of all directions, except for small parameters of which only a part was measured in time."""
    counts = Counter(each.key for each in directions)
    return [place for place, each in enumerate(directions)
            if each.entry is None or counts[each.key] == measured[each.key].value.size]  # fmt: skip


def gradient_count(iterations: int) -> int:
    """Return the number of gradients at the final values."""
    return min(max(iterations // ITERATIONS_A_SAMPLE, LEAST_SAMPLES), MOST_SAMPLES)


def brightness(gradient: Array, value: Array, channels: int) -> tuple[Array, Array]:
    """Return the derivative by the logarithm of the brightness of each channel of a texture, and that logarithm.

    `gradient` and `value` are flat arrays with the channels last. The brightness is the square root of the sum of
    squares.
    """
    g, x = (each.reshape(-1, channels) for each in (gradient, value))
    return np.einsum("ic,ic->c", g, x), np.log(np.maximum(np.linalg.norm(x, axis=0), 1e-300))


def hides(directions: Sequence[ParameterDirection], curvature: Array, sure: Array, gradients: Gradients) -> bool:
    """True if noise hides the curvature (M, M) along some combination of entries with gradients. The curvature is then
    zero or negative, or its standard error takes most of it. `sure` (M,) is the share without the standard error.
    """
    at = [place for place, each in enumerate(directions)
          if each.entry is not None and np.any(gradients[each.key][:, each.entry])]  # fmt: skip
    chosen = curvature[np.ix_(at, at)]
    size = np.diag(chosen)
    if not at or np.any(size <= 0) or np.any(sure[at] < LEAST_SURE):
        return bool(at)
    return bool(np.linalg.eigvalsh(chosen / np.sqrt(np.outer(size, size)))[0] <= 0)


class Budget:
    """Time for more measurements. A call returns true if time is left and `stop()` is false.

    The longest time between two calls does not count, because it is assumed to include a compilation.
    """

    def __init__(self, seconds: float, stop: Callable[[], bool]) -> None:
        self._seconds, self._stop = seconds, stop
        self._last: float | None = None
        self._longest = self._spent = 0.0

    @property
    def spent(self) -> float:
        """The seconds so far."""
        return self._spent - self._longest

    def affords(self, seconds: float) -> bool:
        """Return whether that many more seconds are left."""
        return self() and self.spent + seconds <= self._seconds

    def __call__(self) -> bool:
        now = time.perf_counter()
        if self._last is not None:
            # The longest one is assumed to include a compilation.
            step = now - self._last
            self._longest, self._spent = max(self._longest, step), self._spent + step
        self._last = now
        return not self._stop() and self.spent <= self._seconds
