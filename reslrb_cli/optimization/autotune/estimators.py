"""The estimator of a run, settled before its first iteration: a short pilot measures each, leaving out what cannot win.

    efficiency = 1 / (variance * time)

Variance is that of the gradient at equal samples, summed over the parameters, each divided by its own gradient's mean
square; time is that of a step's kernels. Equal seeds give all candidates equal paths, and given the paths an estimator
that selects has the exact one's gradient as its expectation, so that

    Var = Var_exact + E |g - g_exact|^2,   with m independent slots   Var_m = Var_exact + (Var_1 - Var_exact) / m,

which few seeds estimate well, and which tells what a candidate can reach at best before its kernels are compiled.

What a budget of memory allows is found before (`find_options`): which candidates, with how many samples to a pass.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from reslrb_cli.config.integrators import Reslrb as ReslrbConfig
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.integrators.reslrb import Reslrb as Tracer
from reslrb_cli.optimization.autotune import race
from reslrb_cli.optimization.decisions import Allowance, MemoryPlan
from reslrb_cli.optimization.loading import pass_spp, settled_config
from reslrb_cli.optimization.memory import check_baseline, check_memory, choose_samples, standing
from reslrb_cli.optimization.moving import ATTACHED, is_attached
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.clock import MIB, StepClock
from reslrb_cli.records.decisions import EstimatorRecord, TriedEstimator
from reslrb_cli.statistics import Array, sum_of_squares


@dataclass(frozen=True)
class Candidate:
    """An estimator with its options, and where it is ready to run its `integrator`; `memory` where there is a budget.

    `parent`: the label of a candidate than which it is no faster. Candidates of other passes trace other paths.
    """

    options: dict[str, Any]
    parent: str | None = None
    integrator: Any = None
    memory: MemoryPlan | None = None

    @property
    def label(self) -> str:
        """The estimator in words."""
        options = dict(self.options)
        return ", ".join([options.pop("estimator", ""), *(f"{key} {value}" for key, value in options.items())])

    @property
    def exact(self) -> bool:
        """Whether it uses every connection."""
        name = self.options.get("estimator")
        return name in ESTIMATORS and ESTIMATORS[name].exact

    @property
    def passes(self) -> int:
        """Passes of a step in the pilot: two where the run has more, which take as many traversals."""
        return 2 if self.memory is not None and self.memory.passes > 1 else 1


def _parent(options: dict[str, Any]) -> str | None:
    """The label of a candidate than which one with these options is no faster."""
    name, is_plain = options.get("estimator"), options.get("capacity", 1) == 1 and "weight" not in options
    if is_plain and name not in ("gather", "reservoir"):
        return None
    # Which traces its paths once, where these trace them twice.
    return Candidate({"estimator": "event" if is_plain else name, "capacity": 1}).label


def find_options(problem: Problem) -> list[Candidate]:
    """What the run may use in place of `problem.integrator`, where that is left to measurement or has to keep a budget,
    each with the samples of its passes; else nothing.

    Needs no targets. Raises ConfigError where no estimator keeps the memory budget.
    """
    config, run, budget = problem.config, problem.config.run, problem.config.run.budget_bytes
    integrator, choices = config.integrator, [dict[str, Any]()]
    if not isinstance(integrator, ReslrbConfig):
        check_baseline(problem)
        return []
    if integrator.estimator == "auto":
        # Camera paths have one, too: there is nothing among whose connections to choose.
        alone = is_attached(problem) or problem.paths == "camera"
        choices = [{"estimator": ATTACHED}] if alone else candidates(config)
    elif budget is None:
        check_memory(problem, problem.integrator)
        return []
    options, least, fixed = [], [], 0 if budget is None else standing()
    samples = run.spp // race.sets_of(config)
    for choice in choices:
        made = Tracer.of(**settled_config(integrator, choice, problem.paths).options())
        made.expect(pass_spp(config))
        check_memory(problem, made)
        memory = None
        if budget is not None:
            size, expected = choose_samples(problem, made, samples, budget, fixed)
            if size == 0:
                least.append(expected.total)
                continue
            if size < samples:
                made = made.with_options(samples_per_pass=size, freeze=made.freeze)
            memory = MemoryPlan(budget, size, samples // size, expected)
        options.append(Candidate(choice, _parent(choice), made, memory))
    if not options:
        mib = -(-min(least) // MIB)
        reason = f"one sample per pixel takes about {mib:.0f} MiB (scene, targets, images of a step, parameters, paths)"
        reason += f"; allow at least {mib:.0f} MiB, beside which Python, libraries and kernels are not counted"
        raise ConfigError(config.source, "run.memory_budget", reason)
    return options


def candidates(config: Config) -> list[dict[str, Any]]:
    """Options of all estimators that apply, those first that others are judged by."""
    found: list[dict[str, Any]] = [{"estimator": "stack"}, {"estimator": "gather"}]
    found += [{"estimator": name, "capacity": m} for m in (1, 4) for name in ("reservoir", "event")]
    if config.adjoint != "correlated":
        found += [{"estimator": "reservoir", "capacity": m, "weight": "adjoint"} for m in (1, 4)]
    return found


def settle_estimator(tuner: race.Tuner, options: Sequence[Candidate]) -> None:
    """Have the integrator of the tuner's problem be the best of the options; of several a pilot finds it.

    What moves light leaves one estimator, which needs no pilot.
    """
    if not options:
        return
    problem, chosen = tuner.problem, options[0]
    if len(options) > 1 and chosen.options:
        later = [need for option, need in race.LATER.items() if race.is_auto(problem.config, option)]

        def usual(note: str) -> EstimatorRecord:
            """It has been the best, or within a few percent of it, wherever that was measured (docs/benchmarks.md)."""
            note += "; every connection, in one traversal"
            return EstimatorRecord(chosen=chosen.options, label=chosen.label, note=note)

        pilot = tuner.decide(
            EstimatorRecord,
            of={},
            needs=(race.ESTIMATOR_NEEDS, *later),
            later=later,
            integrator=options[0].integrator,
            measure=lambda allowance: run_pilot(problem, options, allowance),
            unmeasured=usual,
            fits=lambda record: any(option.options == record.chosen for option in options),
        )
        tuner.take(pilot=pilot)
        chosen = next(option for option in options if option.options == pilot.chosen)
    tuner.take(integrator=chosen.integrator, memory=chosen.memory)
    if chosen.memory is not None:
        tuner.take(samples_per_pass=chosen.memory.samples_per_pass)


# --- the pilot --------------------------------------------------------------------------------------------------------


def run_pilot(problem: Problem, options: Sequence[Candidate], allowance: Allowance) -> EstimatorRecord:
    """Measure the options, and say which is the most efficient."""
    run, sets, clock = problem.config.run, race.sets_of(problem.config), StepClock()
    integrators = {option.label: option.integrator.to_measure() for option in options}

    def step(candidate: Candidate, round: int, spp: int) -> race.Step:
        integrator = integrators[candidate.label]
        samples = integrator.samples_per_pass if candidate.passes == 1 else spp // (sets * candidate.passes)
        # Few steps of each sample count: a recording would cost more than it saves.
        integrator = integrator.with_options(samples_per_pass=samples, freeze=False)
        return race.measured_step(problem, integrator, clock, round, spp)

    unit = sets * max(option.passes for option in options)
    if problem.samples_per_pass is not None:  # the user's own passes
        unit = sets * min(problem.samples_per_pass, run.spp // sets)
    # What is measured later has its part of what it may cost; guiding leaves some of its own for the sequence.
    later = [iterations for option, (_, iterations) in race.LATER.items() if race.is_auto(problem.config, option)]
    share = race.SHARE - max(later, default=0.0) / race.ITERATIONS
    share = min(share, allowance.iterations_left(race.ESTIMATOR_NEEDS[0]) / race.ITERATIONS)
    return Pilot(options, step, run.spp, unit, share, allowance).run()


def sample_variance(values: list[Array]) -> float:
    """Sum over the entries; the mean square where there is one sample only."""
    if len(values) < 2:
        return sum_of_squares(values[0])
    return float(np.sum(np.var(np.array(values, dtype=np.float64), axis=0, ddof=1)))


#: How much of its share the pilot plans for: a step may take longer than those before it, and a later candidate's run
#: less time.
PLANNED = 0.95
#: Steps that it plans for, the most first: the first that its share suffices for.
PLANNED_STEPS = (24, 18, 12, 9)
#: A candidate is dropped once the best is so many times as efficient, after at least so many rounds.
DROPPED = ((2, 1.5), (4, 1.25))
MOST_ROUNDS = 12
#: Share of a step's other costs that kernels may have for nothing.
FREE = 0.25
#: All the time that is wanted.
AMPLE = Allowance(1.0, run_s=math.inf, compile_s=0.0, iteration_s=0.0)


@dataclass(eq=False)
class _Entry:
    """What is known of one candidate: steps whose times count, and those whose gradients do."""

    candidate: Candidate
    steps: list[race.Step] = field(default_factory=list)
    gradients: list[race.Gradients] = field(default_factory=list)

    @property
    def time(self) -> float:
        return statistics.median(step.kernel_ms for step in self.steps)

    @property
    def wall(self) -> float:
        return statistics.median(step.wall_ms for step in self.steps)


class Pilot(race.Race):
    """One pilot. `step(candidate, round, spp)` takes a step; equal rounds have equal seeds.

    `spp` are those of the run, of which the pilot uses a multiple of `unit`, and `share` is what it may cost of one.
    Nothing is begun that `allowance` has no time for.
    """

    def __init__(
        self,
        candidates: Sequence[Candidate],
        step: Callable[[Candidate, int, int], race.Step],
        spp: int,
        unit: int = 1,
        share: float = race.SHARE,
        allowance: Allowance = AMPLE,
    ) -> None:
        super().__init__()
        labels = {candidate.label for candidate in candidates}
        # What a budget of memory left out says nothing of others.
        self._candidates = [c if c.parent in {None, *labels} else replace(c, parent=None) for c in candidates]
        self._step, self._share, self._allowance = step, share, allowance
        self._spp, self._unit, self._pilot_spp = spp, unit, unit
        self._entries: list[_Entry] = []
        self._notes: dict[str, str] = {}
        self._first_steps_count = False

    def run(self) -> EstimatorRecord:
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
            for entry in sorted(alive, key=lambda entry: round == 0 and len(entry.steps) > 0):
                if not entry.steps or self._affords(entry):
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
        first = self._spend(self._step(candidate, 0, self._pilot_spp if counts else self._unit), first=True)
        entry = _Entry(candidate, gradients=[first.gradients] if counts else [])
        self._entries.append(entry)
        return entry

    def _measure(self, entry: _Entry) -> None:
        round = len(entry.gradients)
        measured = self._step(entry.candidate, round, self._pilot_spp)
        if measured.compile_ms > measured.wall_ms:  # a first step after all, whose times say nothing
            self._spend(measured, first=True)
            measured = self._step(entry.candidate, round, self._pilot_spp)
        self._spend(measured)
        entry.steps.append(measured)
        entry.gradients.append(measured.gradients)

    def _choose_size(self, entry: _Entry) -> None:
        """Choose the samples per pixel so that the planned steps fit into the pilot's share, by a step of the first.

        Where Python takes longer than the kernels, steps are few, and nearly as dear with fewer samples. Then the first
        steps of the other candidates, which compile their kernels, count as samples of their gradients.
        """
        first = self._step(entry.candidate, 0, self._unit)
        self._spent_ms += first.wall_ms
        overhead, slope = first.beside_ms, max(first.kernel_ms, 1e-6) / self._unit
        budget = PLANNED * self._share * race.ITERATIONS * (overhead + slope * self._spp) - first.wall_ms
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
        return race.ITERATIONS * min(max(e.wall - e.time, 0.0) + e.time * scale for e in self._entries if e.steps)

    def _affords(self, entry: _Entry) -> bool:
        if self._spent_ms + entry.wall > PLANNED * self._share * self._run_ms():
            return False
        return entry.wall <= 1e3 * self._allowance.left_s

    def _affords_another(self, relative: _Entry) -> bool:
        """Whether there is time for a first step of a candidate like this one, and a step that counts."""
        allowance = self._allowance
        return self._affords(relative) and allowance.compile_s + 2e-3 * relative.wall <= allowance.left_s

    # --- judging ------------------------------------------------------------------------------------------------------

    def _exact(self, passes: int) -> list[_Entry]:
        """Those that are exact on the same paths."""
        return [e for e in self._entries if e.candidate.exact and e.candidate.passes == passes]

    def _scales(self) -> dict[str, float]:
        """Mean square norm of each parameter's gradient, where it is not 0."""
        every = [g for e in self._entries if e.candidate.exact for g in e.gradients]
        return race.scales(every or [g for e in self._entries for g in e.gradients])

    def _variance(self, entry: _Entry) -> float:
        # The exact gradient of each round on the same paths.
        references: list[race.Gradients] = max(
            (each.gradients for each in self._exact(entry.candidate.passes)), key=len, default=[]
        )
        total = 0.0
        for key, scale in self._scales().items():
            own = [g[key] for g in entry.gradients]
            exact = [g[key] for g in references]
            total += sample_variance(exact if len(exact) > 1 else own) / scale
            if exact and not entry.candidate.exact:
                pairs = list(zip(own, exact, strict=False))
                total += sum(sum_of_squares(a - b) for a, b in pairs) / (len(pairs) * scale)
        return max(total, 1e-12)  # a furnace has none at all

    def _efficiency(self, entry: _Entry) -> float:
        return 1 / (self._variance(entry) * max(entry.time, 1e-6))

    def _contenders(self, alive: list[_Entry]) -> list[_Entry]:
        """Those that may still turn out to be the best."""
        best = max(alive, key=self._efficiency)
        kept = []
        for entry in alive:
            rounds = min(len(entry.steps), len(best.steps))
            limit = min((factor for least, factor in DROPPED if rounds >= least), default=math.inf)
            exact = [other for other in self._exact(entry.candidate.passes) if other in alive]
            slower = any(other.time * race.TIMING_NOISE < entry.time for other in exact)
            # No estimator has less variance than an exact one of the same paths.
            if entry is best or not (slower or self._efficiency(entry) * limit < self._efficiency(best)):
                kept.append(entry)
        return kept

    def _promising(self) -> list[_Entry]:
        """Measure those that could be the best, by what is known of their relatives."""
        best = max(self._efficiency(entry) for entry in self._entries)
        measured = {entry.candidate.label: entry for entry in self._entries}
        parents = {candidate.label: candidate.parent for candidate in self._candidates}
        found = []
        for candidate in self._candidates:
            if candidate.parent is None:
                continue
            label = candidate.parent
            while label not in measured:  # that was left out as well: it would have been no faster than its own
                label = parents[label] or ""
            parent = measured[label]
            bound = self._bound(candidate, parent)
            if bound * race.TIMING_NOISE < best:
                self._notes[candidate.label] = f"not measured: at most {bound / best:.2f} of the best's efficiency"
            elif not self._affords_another(parent):
                self._notes[candidate.label] = (
                    f"not measured: no more than {100 * self._share:.2g} % of the run is to be spent"
                )
            else:
                entry = self._warm_up(candidate)
                self._measure(entry)
                if self._affords(entry):
                    self._measure(entry)
                found.append(entry)
                measured[candidate.label] = entry
        return found

    def _bound(self, candidate: Candidate, relative: _Entry) -> float:
        """The greatest efficiency that a candidate can have: it is no faster than its relative, and its variance is no
        less than an exact one's. Of more slots of one estimator the variance is known."""
        exact = self._exact(candidate.passes)
        if not any(entry.gradients for entry in exact) or candidate.passes != relative.candidate.passes:
            return math.inf
        least, slots = self._variance(exact[0]), candidate.options.get("capacity", 1)
        if slots > 1 and "weight" not in candidate.options and candidate.parent == relative.candidate.label:
            least += (self._variance(relative) - least) / slots
        return 1 / (least * max(relative.time, 1e-6))

    def _outcome(self) -> EstimatorRecord:
        ranked = sorted(self._entries, key=self._efficiency, reverse=True)
        best, measured = ranked[0], {entry.candidate.label: entry for entry in self._entries}
        rows = []
        for candidate in self._candidates:
            options, entry = dict(candidate.options), measured.get(candidate.label)
            found: tuple[int, float | None, float | None, float | None] = (0, None, None, None)
            if entry is not None:
                found = len(entry.steps), entry.time, self._variance(entry), self._efficiency(entry)
            rows.append(TriedEstimator(options.pop("estimator"), options, *found, self._notes.get(candidate.label, "")))
        return EstimatorRecord(
            chosen=best.candidate.options,
            label=best.candidate.label,
            rows=rows,
            spp=self._pilot_spp,
            advantage=self._efficiency(best) / self._efficiency(ranked[1]) if len(ranked) > 1 else None,
            next_label=ranked[1].candidate.label if len(ranked) > 1 else None,
            share=self._spent_ms / self._run_ms(),
            **self._cost(),
        )
