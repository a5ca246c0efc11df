"""Measurement of the certainty of the values after the last iteration: gradients and curvature at the final values."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import numpy as np

from reslrb_cli.optimization.identifiability import shown_texels
from reslrb_cli.optimization.loop import learning_rate_factor
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient
from reslrb_cli.optimization.state import State
from reslrb_cli.optimization.uncertainty.curvature import (
    MOST_ENTRIES,
    LossCurvature,
    ParameterDirection,
    plan_changes,
    row_of,
)
from reslrb_cli.optimization.uncertainty.posterior import Measured
from reslrb_cli.optimization.uncertainty.verdicts import CertaintyRecord, Gradients, ParameterCertainty, weigh
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.tree import to_array
from reslrb_cli.statistics import Array, rms

_PURPOSE = "certainty"

#: Shorter runs get no verdicts, because verdicts would take a large part of their time.
LEAST_ITERATIONS = 20
#: Gradients at the final values: iterations per gradient, and the limits of their number. They have the samples of a
#: step, so they compile no kernel.
ITERATIONS_A_SAMPLE, LEAST_SAMPLES, MOST_SAMPLES = 40, 3, 16
#: Random probes for large parameters; minimum number of renderings along directions, and iterations per rendering.
PROBES, LEAST_CHANGES, ITERATIONS_A_CHANGE = 4, 20, 10
#: Divisor of a step's samples for each of the two sets that measure curvature, and samples per pixel below which all
#: are used. All are also used if noise hides the curvature of an entry.
PART, FEW = 4, 4
#: Step of the differences along directions, as a share of a parameter's scale.
STEP = 0.05
#: Last part of a run whose gradients give the noise, and for small parameters the mean gradient; maximum number of
#: iterations.
RECENT, MOST_LAST = 0.2, 200
#: Curvature that takes longer than this share of the run's iterations, and than this many of them, is left out.
SHARE, MOST_STEPS = 0.25, 50


@dataclass(frozen=True)
class Noted:
    """Iterations at which data were recorded.

    `seen` is the iteration at which squared gradients were recorded, or 0 before the recording. `keys` are the
    parameters with recorded squares, and `last` those with recorded later steps. `paces` has each parameter's movement
    per unit of gradient, recorded after some iterations.
    """

    seen: int
    keys: list[str]
    last: list[str] = field(default_factory=list)
    paces: dict[str, list[tuple[int, float]]] = field(default_factory=dict)


class Certainty:
    """Certainty of one run of `problem`. Make the `Certainty` before the first iteration, and call `measure` after the
    last iteration.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self._initial = {key: row_of(problem, key) for key in problem.selection.keys}
        #: The optimiser's squares (`Optimizer.squares`) at that time, by key.
        self._seen, self.squares = 0, dict[str, Any]()
        #: Since then, by key of a small parameter: `Measured.last`.
        self.last: dict[str, Array] = {}
        self._paces: dict[str, list[tuple[int, float]]] = {key: [] for key in problem.selection.keys}
        #: Texels (H, W) of each texture that are visible in some view and lit, once computed.
        self.shown: dict[str, Array] = {}
        #: Factors of the learning rate so far, if no formula gives them.
        self.rates: list[float] = []

    @property
    def noted(self) -> Noted:
        """Recorded data without arrays."""
        return Noted(self._seen, list(self.squares), list(self.last), self._paces)

    def restore(self, noted: Noted, squares: dict[str, Any], last: dict[str, Array]) -> None:
        """Continue from recorded data: `noted`, `squares` and `last`."""
        self._seen, self.squares, self.last = noted.seen, squares, last
        self._paces |= {key: looks for key, looks in noted.paces.items() if key in self._initial}

    def see(self, before: State, state: State) -> None:
        """Record data of the iteration that leads from `before` to `state`. This costs almost nothing."""
        planned, iterations = self.problem.config.run.iterations, state.iteration
        if state.level != before.level:
            self.squares = {}  # the running means start again
        if 0 < self._seen < iterations:
            for key, initial in self._initial.items():
                if initial.size <= MOST_ENTRIES:
                    self._add_step(key, before, state)
        if iterations == int((1 - RECENT) * planned):
            kept = {key: self.problem.optimizer.squares(key) for key in self._initial}
            self.squares = {key: each[0] for key, each in kept.items() if each is not None}
            self._seen, self.last = iterations, {}
        # Twice per doubling of the iteration's number, independent of the planned number, which may change.
        if iterations % max((1 << iterations.bit_length()) // 4, 1) == 0:
            for key, looks in self._paces.items():
                pace = self._pace(key)
                if np.isfinite(pace) and pace > 0:
                    looks.append((iterations, pace))

    def _add_step(self, key: str, before: State, state: State) -> None:
        gradient, value = (to_array(each[key]).astype(np.float64).ravel() for each in (state.gradients, before.values))
        if not np.isfinite(gradient).all():
            return
        earlier = self.last.get(key, np.zeros((0, 2, gradient.size)))
        self.last[key] = np.concatenate([earlier, [[gradient, value]]])[-MOST_LAST:]

    def _pace(self, key: str) -> float:
        """Return how far a step currently moves a parameter, per unit of gradient. The parameter's steepest entries
        dominate the value.
        """
        with np.errstate(divide="ignore"):  # of parameters that have not moved yet
            steepness = rms(1 / self.problem.optimizer.response(key))
        return 1 / max(steepness, 1e-300)

    def _recent(self, key: str, iterations: int) -> Array | None:
        """Return the mean square (N,) of the gradients after the recording of squares, or None if the optimiser stores
        no squares.
        """
        before, now = self.squares.get(key), self.problem.optimizer.squares(key)
        if before is None or now is None or iterations <= self._seen:
            return None
        first, last = (np.array(mean, dtype=np.float64).ravel() for mean in (before, now[0]))
        kept = now[1] ** (iterations - self._seen)
        squares = np.maximum(last - kept * first, 0) / max(1 - kept, 1e-300)
        return np.asarray(squares / np.maximum(self.problem.optimizer.slope(key) ** 2, 1e-300))

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
            count = min(max(iterations // ITERATIONS_A_SAMPLE, LEAST_SAMPLES), MOST_SAMPLES)
            for number in range(count):
                if stop():
                    return None
                with clock.step() as times:
                    sample_gradient(problem, problem.integrator, number, _PURPOSE, config.run.spp)
                    problem.regularize()
                    for key, row in take_gradient(problem).items():
                        rows[key].append(row.astype(np.float64))
                compiled_ms += times.codegen_ms
            gradients = {key: np.array(samples) for key, samples in rows.items()}
            go_on = _Budget(max(SHARE * elapsed_s, MOST_STEPS * elapsed_s / iterations), stop)
            with clock.step() as times:
                unit = problem.samples_per_pass or 1
                spp = max(max(config.run.spp // PART, min(config.run.spp, FEW)) // unit, 1) * unit
                curvature = LossCurvature(problem, spp)
                scales = {key: self.scale(key) for key in gradients}
                most = max(LEAST_CHANGES, iterations // ITERATIONS_A_CHANGE)
                plan = plan_changes(problem, scales, STEP, most)
                directions, H, B = curvature.along(plan, go_on)
                if spp < config.run.spp and hides(directions, H, gradients) and go_on():
                    again = LossCurvature(problem, config.run.spp)
                    found = again.along(plan, go_on)
                    if len(found[0]) == len(directions):
                        directions, H, B = found
                # By entry, if a parameter has no directions for its entries.
                seen = {direction.key for direction in directions if direction.entry is not None}
                left = any(np.any(rows) for key, rows in gradients.items() if key not in seen)
                diagonal = curvature.by_entry(PROBES, go_on) if left else {}
                of_target = curvature.by_entry_of_target(PROBES, go_on) if diagonal else {}
            compiled_ms += times.codegen_ms
            if stop():
                return None
            measured = self._measured(gradients, iterations)
            weighed = weigh(measured, directions, H, diagonal, curvature.pixels, B, of_target)
            measure_s = max(clock.elapsed_s - compiled_ms / 1e3, 0.0)
            render = config.target.render
            return CertaintyRecord(
                parameters={key: self._with_course(key, about, measured[key]) for key, about in weighed.items()},
                measure_s=measure_s,
                share=measure_s / max(elapsed_s, 1e-9),
                iterations=iterations,
                scale=config.optimizer.scale,
                learning_rate=config.optimizer.learning_rate,
                target_noise=self._target_noise(),
                target_spp=None if render is None else render.spp,
            )
        finally:
            take_gradient(problem)
            problem.apply()

    def _target_noise(self) -> str:
        """Return `target_noise` of `CertaintyRecord`, which states whether the spreads include the targets' noise."""
        read = [view.file is not None for view in self.problem.trained]
        return "left out" if all(read) else "in part" if any(read) else "measured"

    def _with_course(self, key: str, about: ParameterCertainty, own: Measured) -> ParameterCertainty:
        """Return the certainty with the distance moved, the possible distance, and the learning rate."""
        optimizer = self.problem.optimizer
        step = optimizer.first_step(key)
        reach = None if step is None else step * float(sum(own.rates))
        kept = own.touched & (True if own.seen is None else own.seen)
        moved = rms((own.value - self._initial[key])[kept]) if kept.any() else 0.0
        return replace(about, moved=moved, reach=reach, rate=optimizer.rate(key))

    def scale(self, key: str) -> float:
        """Return a parameter's scale, in the parameter's unit.

        The scale is the largest root mean square among three arrays. The arrays are the initial values, the final
        values, and the difference of both. For parameters without a unit of light, the scale is at least half of the
        range between the bounds. If all are 0, it is 1.
        """
        first, last = self._initial[key], row_of(self.problem, key)
        sizes = [rms(first), rms(last), rms(last - first)]
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

    def _measured(self, gradients: Gradients, iterations: int) -> dict[str, Measured]:
        settings, optimizer, selection = self.problem.config.optimizer, self.problem.optimizer, self.problem.selection
        planned, final = self.problem.config.run.iterations, settings.final_fraction
        rates = self.rates or [
            learning_rate_factor(settings.schedule, each, planned, final) for each in range(iterations)
        ]
        found = {}
        for key, rows in gradients.items():
            value = row_of(self.problem, key)
            found[key] = Measured(
                value=value,
                bounds=selection.specs[key].bounds or (-np.inf, np.inf),
                scale=self.scale(key),
                gradients=rows,
                response=np.nan_to_num(optimizer.response(key) * optimizer.rate(key)),
                rates=rates,
                is_small=value.size <= MOST_ENTRIES,
                recent=self._recent(key, iterations),
                seen=self._seen_entries(key, rows),
                last=self.last.get(key),
                pace=self._paces_of(key, iterations),
                start=self._initial[key],
            )
        return found

    def _paces_of(self, key: str, iterations: int) -> Array | None:
        """Return a parameter's step length in each iteration, relative to the current step length. Return None if step
        lengths were not recorded.
        """
        if not (looks := self._paces[key]):
            return None
        at, found = np.array(looks).T
        return np.asarray(np.interp(np.arange(1, iterations + 1), at, found) / found[-1])


def hides(directions: Sequence[ParameterDirection], curvature: Array, gradients: Gradients) -> bool:
    """True if noise hides all curvature along the direction of some entry with gradients. The curvature is (M, M)."""
    flat = [d for d, h in zip(directions, np.diag(curvature), strict=True) if d.entry is not None and h <= 0]
    return any(np.any(gradients[d.key][:, d.entry]) for d in flat)


class _Budget:
    """Time for more measurements. A call returns true if time is left and `stop()` is false.

    The longest time between two calls does not count, because it is assumed to include a compilation.
    """

    def __init__(self, seconds: float, stop: Callable[[], bool]) -> None:
        self._seconds, self._stop = seconds, stop
        self._last: float | None = None
        self._longest = self._spent = 0.0

    def __call__(self) -> bool:
        now = time.perf_counter()
        if self._last is not None:
            # The longest one is assumed to include a compilation.
            step = now - self._last
            self._longest, self._spent = max(self._longest, step), self._spent + step
        self._last = now
        return not self._stop() and self._spent - self._longest <= self._seconds
