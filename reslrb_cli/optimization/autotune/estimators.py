"""Which estimator is the most efficient here: a short pilot measures each, and leaves out what cannot win.

    efficiency = 1 / (variance * time)

Variance is that of the gradient at equal samples, summed over the parameters, each divided by its own gradient's mean
square; time is that of a step's kernels. Equal seeds give all candidates equal paths, and given the paths an estimator
that selects has the exact one's gradient as its expectation, so that

    Var = Var_exact + E |g - g_exact|^2,   with m independent slots   Var_m = Var_exact + (Var_1 - Var_exact) / m,

which few seeds estimate well, and which tells what a candidate can reach at best before its kernels are compiled.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from reslrb_cli.optimization.autotune.efficiency import (
    ITERATIONS,
    TIMING_NOISE,
    Candidate,
    Gradients,
    Measured,
    Outcome,
    Row,
    sample_variance,
    square,
)

#: Share of a run of ITERATIONS that the pilot may cost, compilation apart.
SHARE = 0.05


#: How much of that it plans for: a step may take longer than those before it, and a later candidate's run less time.
PLANNED = 0.95


#: Steps that the pilot plans for, the most first: the first that its share suffices for.
PLANNED_STEPS = (24, 18, 12, 9)


#: A candidate is dropped once the best is so many times as efficient, after at least so many rounds.
DROPPED = ((2, 1.5), (4, 1.25))


MOST_ROUNDS = 12


#: Share of a step's other costs that kernels may have for nothing.
FREE = 0.25


@dataclass
class _Entry:
    """What is known of one candidate."""

    candidate: Candidate
    kernel: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    gradients: list[Gradients] = field(default_factory=list)

    @property
    def time(self) -> float:
        return statistics.median(self.kernel)

    @property
    def overhead(self) -> float:
        return max(statistics.median(self.wall) - self.time, 0.0)


class Pilot:
    """One pilot. `step(candidate, round, spp)` takes a step; equal rounds have equal seeds.

    `spp` are those of the run, of which the pilot uses a multiple of `unit`, and `share` is what it may cost of one.
    `compiles` says whether there is time for the kernels of one more candidate.
    """

    def __init__(
        self,
        candidates: Sequence[Candidate],
        step: Callable[[Candidate, int, int], Measured],
        spp: int,
        unit: int = 1,
        share: float = SHARE,
        compiles: Callable[[], bool] = lambda: True,
    ) -> None:
        labels = {candidate.label for candidate in candidates}
        # What a budget of memory left out says nothing of others.
        self._candidates = [c if c.parent in {None, *labels} else replace(c, parent=None) for c in candidates]
        self._step, self._share, self._compiles = step, share, compiles
        self._spp, self._unit, self._pilot_spp = spp, unit, unit
        self._entries: list[_Entry] = []
        self._notes: dict[str, str] = {}
        self._spent_ms = self._compile_ms = 0.0
        self._first_steps_count = False

    def run(self) -> Outcome:
        """Measure, and choose."""
        first, *others = [c for c in self._candidates if c.parent is None]
        alive = [self._warm_up(first)]
        self._choose_size(alive[0])
        if self._first_steps_count:
            self._measure(alive[0])
        alive += [self._warm_up(candidate) for candidate in others]
        for round in range(MOST_ROUNDS):
            # Each is to be timed once. Where first steps count, the first candidate has been already, and waits for the
            # others.
            for entry in sorted(alive, key=lambda entry: round == 0 and len(entry.kernel) > 0):
                if not entry.kernel or self._affords(entry):
                    self._measure(entry)
            alive = self._contenders(alive)
            if round == 1:
                alive = self._contenders(alive + self._promising())
            if round >= 1 and (len(alive) == 1 or not any(self._affords(entry) for entry in alive)):
                break
        return self._outcome()

    # --- measuring ----------------------------------------------------------------------------------------------------

    def _warm_up(self, candidate: Candidate) -> _Entry:
        """Compile the kernels of a candidate, and keep its gradient if that counts."""
        counts = self._first_steps_count
        first = self._step(candidate, 0, self._pilot_spp if counts else self._unit)
        self._compile_ms += first.wall_ms + first.compile_ms
        entry = _Entry(candidate, gradients=[first.gradients] if counts else [])
        self._entries.append(entry)
        return entry

    def _measure(self, entry: _Entry) -> None:
        round = len(entry.gradients)
        measured = self._step(entry.candidate, round, self._pilot_spp)
        if measured.compile_ms > measured.wall_ms:  # a first step after all, whose times say nothing
            self._compile_ms += measured.wall_ms + measured.compile_ms
            measured = self._step(entry.candidate, round, self._pilot_spp)
        self._compile_ms += measured.compile_ms
        self._spent_ms += measured.wall_ms
        entry.kernel.append(measured.kernel_ms)
        entry.wall.append(measured.wall_ms)
        entry.gradients.append(measured.gradients)

    def _choose_size(self, entry: _Entry) -> None:
        """Choose the samples per pixel so that the planned steps fit into the pilot's share, by a step of the first.

        Where Python takes longer than the kernels, steps are few, and nearly as dear with fewer samples. Then the first
        steps of the other candidates, which compile their kernels, count as samples of their gradients.
        """
        first = self._step(entry.candidate, 0, self._unit)
        self._spent_ms += first.wall_ms
        overhead, slope = max(first.wall_ms - first.kernel_ms, 0.0), max(first.kernel_ms, 1e-6) / self._unit
        budget = PLANNED * self._share * ITERATIONS * (overhead + slope * self._spp) - first.wall_ms
        for steps in PLANNED_STEPS:
            fits = int((budget / steps - overhead) / slope) // self._unit * self._unit
            if fits >= self._unit:
                break
        fits = max(fits, int(FREE * overhead / slope) // self._unit * self._unit)
        self._pilot_spp = max(min(fits, self._spp // self._unit * self._unit), self._unit)
        self._first_steps_count = slope * self._pilot_spp <= overhead

    def _run_ms(self) -> float:
        """Time of a run of ITERATIONS by the fastest candidate so far."""
        scale = self._spp / self._pilot_spp
        return ITERATIONS * min(entry.overhead + entry.time * scale for entry in self._entries if entry.kernel)

    def _affords(self, entry: _Entry) -> bool:
        return self._spent_ms + statistics.median(entry.wall) <= PLANNED * self._share * self._run_ms()

    # --- judging ------------------------------------------------------------------------------------------------------

    def _references(self, passes: int) -> list[Gradients]:
        """The exact gradient of each round on the same paths."""
        exact = [e.gradients for e in self._entries if e.candidate.exact and e.candidate.passes == passes]
        return max(exact, key=len, default=[])

    def _scales(self) -> dict[str, float]:
        """Mean square norm of each parameter's gradient."""
        every = [g for e in self._entries if e.candidate.exact for g in e.gradients]
        every = every or [g for e in self._entries for g in e.gradients]
        return {key: float(np.mean([square(g[key]) for g in every])) for key in every[0]}

    def _variance(self, entry: _Entry) -> float:
        scales = {key: scale for key, scale in self._scales().items() if scale > 0}
        references = self._references(entry.candidate.passes)
        total = 0.0
        for key, scale in scales.items():
            own = [g[key] for g in entry.gradients]
            exact = [g[key] for g in references]
            total += sample_variance(exact if len(exact) > 1 else own) / scale
            if exact and not entry.candidate.exact:
                pairs = list(zip(own, exact, strict=False))
                total += sum(square(a - b) for a, b in pairs) / (len(pairs) * scale)
        return max(total, 1e-12)  # a furnace has none at all

    def _efficiency(self, entry: _Entry) -> float:
        return 1 / (self._variance(entry) * max(entry.time, 1e-6))

    def _contenders(self, alive: list[_Entry]) -> list[_Entry]:
        """Those that may still turn out to be the best."""
        best = max(alive, key=self._efficiency)
        kept = []
        for entry in alive:
            rounds = min(len(entry.kernel), len(best.kernel))
            limit = min((factor for least, factor in DROPPED if rounds >= least), default=math.inf)
            slower = any(
                other.candidate.exact
                and other.candidate.passes == entry.candidate.passes
                and other.time * TIMING_NOISE < entry.time
                for other in alive
            )
            # No estimator has less variance than an exact one of the same paths.
            if entry is best or not (slower or self._efficiency(entry) * limit < self._efficiency(best)):
                kept.append(entry)
        return kept

    def _promising(self) -> list[_Entry]:
        """Measure those that could be the best, by what is known of their relatives."""
        best = max(self._efficiency(entry) for entry in self._entries)
        labels: dict[str | None, _Entry] = {entry.candidate.label: entry for entry in self._entries}
        found = []
        for candidate in self._candidates:
            if candidate.parent is None:
                continue
            relative = candidate
            parent = labels.get(candidate.parent)
            while parent is None:  # that was left out as well: it would have been no faster than its own
                [relative] = [c for c in self._candidates if c.label == relative.parent]
                parent = labels.get(relative.label)
            bound = self._bound(candidate, parent)
            if bound * TIMING_NOISE < best:
                self._notes[candidate.label] = f"not measured: at most {bound / best:.2f} of the best's efficiency"
            elif not (self._affords(parent) and self._compiles()):
                self._notes[candidate.label] = (
                    f"not measured: no more than {100 * self._share:.2g} % of the run is to be spent"
                )
            else:
                entry = self._warm_up(candidate)
                self._measure(entry)
                if self._affords(entry):
                    self._measure(entry)
                found.append(entry)
                labels[candidate.label] = entry
        return found

    def _bound(self, candidate: Candidate, relative: _Entry) -> float:
        """The greatest efficiency that a candidate can have: it is no faster than its relative, and its variance is no
        less than an exact one's. Of more slots of one estimator the variance is known."""
        if not self._references(candidate.passes) or candidate.passes != relative.candidate.passes:
            return math.inf
        exact = next(e for e in self._entries if e.candidate.exact and e.candidate.passes == candidate.passes)
        least = self._variance(exact)
        if candidate.parent == relative.candidate.label and candidate.varies_slots:
            least += (self._variance(relative) - least) / candidate.options["capacity"]
        return 1 / (least * max(relative.time, 1e-6))

    def _outcome(self) -> Outcome:
        ranked = sorted(self._entries, key=self._efficiency, reverse=True)
        best = ranked[0]
        measured = {entry.candidate.label: entry for entry in self._entries}
        rows = []
        for candidate in self._candidates:
            entry = measured.get(candidate.label)
            options = {key: value for key, value in candidate.options.items() if key != "estimator"}
            row = Row(candidate.options["estimator"], options, 0, note=self._notes.get(candidate.label, ""))
            if entry is not None:
                row.rounds, row.kernel_ms = len(entry.kernel), entry.time
                row.variance, row.efficiency = self._variance(entry), self._efficiency(entry)
            rows.append(row)
        outcome = Outcome(best.candidate.options, best.candidate.label, rows, self._pilot_spp)
        if len(ranked) > 1:
            outcome.advantage = self._efficiency(best) / self._efficiency(ranked[1])
            outcome.next_label = ranked[1].candidate.label
        outcome.measure_s, outcome.compile_s = self._spent_ms / 1e3, self._compile_ms / 1e3
        outcome.share = self._spent_ms / self._run_ms()
        return outcome
