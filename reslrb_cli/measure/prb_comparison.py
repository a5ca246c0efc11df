"""Whether `prb` would have been the better choice: steps of the run's own loss beside those of its integrator."""

from __future__ import annotations

from collections.abc import Callable

from reslrb_cli.integrators.step import make_integrator
from reslrb_cli.measure.references import Situation, prb_gradient
from reslrb_cli.measure.stepper import multiple_of
from reslrb_cli.optimization.autotune import race
from reslrb_cli.optimization.decisions import Allowance
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.decisions import RivalRecord

RIVAL = "prb"
#: Rounds, at most, and fewer than which say nothing.
MOST_ROUNDS, LEAST_ROUNDS = 12, 6
#: Share of a run of ITERATIONS that the rounds may cost, and that LEAST_ROUNDS may where that is more.
SHARE, MOST_SHARE = 0.05, 0.1
#: What it takes at least: kernels to compile, in those of one step of the run, and iterations' worth of work.
NEEDS = (2.0, 2.0)
#: A step of `prb` may take so many times as long as one of the run.
LONGER = 2.0


def why_not(problem: Problem) -> str | None:
    """Why `prb` has no such gradient of some parameter, or no such image of some view; None where it has all."""
    for sensor in problem.sensors:
        at = Situation.of_problem(problem, sensor)
        for key in problem.selection.scene_keys:
            reason = prb_gradient(at, key)
            if reason is not None:
                return reason
    return None


def _samples(problem: Problem, iterations: float) -> int:
    """Samples per pixel of steps, with which the rounds that there are to be take so many iterations' worth of time."""
    share = min(iterations / ((1 + LONGER) * MOST_ROUNDS), 1.0)
    return multiple_of(int(share * problem.config.run.spp), race.sets_of(problem.config))


class RivalTurns(race.Turns[RivalRecord]):
    """One decision: whether `prb` is the more efficient. What Python takes beside the kernels is left out."""

    LEAST, LOOKS = LEAST_ROUNDS, 1

    def _times(self, other: bool, images: bool) -> list[float]:
        return [step.kernel_ms for step in self._steps[other]]

    def _record(self, note: str, gain: race.Gain = race.NOTHING, *others: object) -> RivalRecord:
        found = dict(zip(("advantage", "low", "high"), gain, strict=True)) | self._found(note)
        return RivalRecord(integrator=RIVAL, **found)


def measure_rival(problem: Problem, cache: PilotCache | None, say: Callable[[str], None]) -> RivalRecord | None:
    """Measure `prb` beside the estimator that a pilot chose; None where no pilot did, or `prb` does not apply.

    `say` is told what takes long, `cache` holds what earlier runs measured. Leaves neither gradient nor change behind.
    """
    pilot, guided, sequence = problem.pilot, problem.guided, problem.sequence
    # A budget of memory is kept by passes, of which `prb` has none.
    if pilot is None or problem.samples_per_pass is not None or why_not(problem) is not None:
        return None

    def measure(allowance: Allowance) -> RivalRecord:
        left = allowance.iterations_left(NEEDS[0])
        spp, run = pilot.spp or _samples(problem, left), problem.config.run
        planned = float(run.spp * MOST_ROUNDS)  # as many samples as there are
        sizes = race.Sizes(run.spp, spp, spp, False, MOST_ROUNDS, 0.0, LONGER, planned)
        share, most = (min(each, left / race.ITERATIONS) for each in (SHARE, MOST_SHARE))
        options, clock = problem.config.integrator.options(), StepClock()
        rival = make_integrator(RIVAL, **{name: options[name] for name in ("max_depth", "rr_depth", "hide_emitters")})
        # A recording would cost more than so few steps save.
        own = problem.integrator.to_measure().with_options(samples_per_pass=None, freeze=False)

        def take(other: bool, round: int, spp: int) -> race.Step:
            return race.measured_step(problem, rival if other else own, clock, round, spp)

        return RivalTurns(take, sizes, 1.0, share, most).run()

    beside = [pilot.chosen, guided and guided.guided, sequence and sequence.low_discrepancy]
    return race.Tuner(problem, say, cache).decide(
        RivalRecord,
        of={"rival": RIVAL, "beside": beside},
        needs=[NEEDS],
        integrator=problem.integrator,
        measure=measure,
        unmeasured=lambda note: RivalRecord(integrator=RIVAL, note=note),
    )
