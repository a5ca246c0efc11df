"""The pilot on fabricated candidates: which it picks, what it measures, and what it leaves out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from reslrb_cli.optimization import decisions
from reslrb_cli.optimization.autotune.estimators import Candidate, Pilot
from reslrb_cli.optimization.autotune.race import GUIDING_SHARE, ITERATIONS, SHARE, Step
from reslrb_cli.optimization.decisions import Allowance
from reslrb_cli.records.decisions import EstimatorRecord

STACK, GATHER = Candidate({"estimator": "stack"}), Candidate({"estimator": "gather"})
RESERVOIR = Candidate({"estimator": "reservoir", "capacity": 1})
RESERVOIR_4 = Candidate({"estimator": "reservoir", "capacity": 4}, RESERVOIR.label)
EVENT = Candidate({"estimator": "event", "capacity": 1})
ADJOINT = Candidate({"estimator": "event", "capacity": 1, "weight": "adjoint"}, EVENT.label)
ALL = [STACK, GATHER, RESERVOIR, EVENT, RESERVOIR_4, ADJOINT]


class World:
    """Steps whose times and variances are given: `times` in ms for each sample, `selection` over the exact variance.

    The parameter `large` has a thousandfold gradient, and no estimator adds variance to it.
    """

    def __init__(self, times: dict[str, float], selection: dict[str, float], overhead: float = 1.0) -> None:
        self.times, self.selection, self.overhead = times, selection, overhead
        self.calls: list[tuple[str, int, int]] = []

    def step(self, candidate: Candidate, round: int, spp: int) -> Step:
        name = candidate.label
        self.calls.append((name, round, spp))
        paths = np.random.default_rng(round)
        small = 1 + paths.normal(size=400) / np.sqrt(spp)
        large = 1000 * (1 + 0.01 * paths.normal(size=4) / np.sqrt(spp))
        choice = np.random.default_rng([round, *name.encode()])
        small = small + choice.normal(size=400) * np.sqrt(self.selection.get(name, 0) / spp)
        kernel = self.times[name] * spp
        return Step({"small": small, "large": large}, kernel_ms=kernel, wall_ms=kernel + self.overhead)

    def run(self, candidates=ALL, spp: int = 64, share: float = SHARE) -> EstimatorRecord:
        return Pilot(candidates, self.step, spp, share=share).run()


def times(**changed: float) -> dict[str, float]:
    result = {candidate.label: 10.0 for candidate in ALL}
    return {**result, **{name.replace("_", " "): value for name, value in changed.items()}}


TABLES = {
    "exact is best": ({}, {"reservoir, capacity 1": 1.0, "event, capacity 1": 2.0}, "stack"),
    "gather is faster": ({"gather": 6.0}, {"reservoir, capacity 1": 1.0, "event, capacity 1": 2.0}, "gather"),
    "cheap selection": (
        {"event, capacity 1": 3.0, "event, capacity 1, weight adjoint": 6.0},
        {"reservoir, capacity 1": 1.0, "event, capacity 1": 0.5, "event, capacity 1, weight adjoint": 0.4},
        "event, capacity 1",
    ),
    "more slots": (
        {"reservoir, capacity 1": 5.0, "reservoir, capacity 4": 5.5},
        {"reservoir, capacity 1": 4.0, "reservoir, capacity 4": 0.2, "event, capacity 1": 9.0},
        "reservoir, capacity 4",
    ),
    "a better weight": (
        {"event, capacity 1": 5.0, "event, capacity 1, weight adjoint": 5.0},
        {"reservoir, capacity 1": 4.0, "event, capacity 1": 3.0, "event, capacity 1, weight adjoint": 0.3},
        "event, capacity 1, weight adjoint",
    ),
}  # fmt: skip


@pytest.mark.parametrize("table", TABLES)
def test_the_most_efficient_is_picked(table: str) -> None:
    changed, selection, best = TABLES[table]
    outcome = World({**times(), **changed}, selection).run()
    assert outcome.label == best
    assert outcome.advantage is not None
    assert outcome.advantage >= 1
    assert [row.estimator for row in outcome.rows] == [candidate.options["estimator"] for candidate in ALL]
    assert outcome.line().startswith(f"estimator {best}: ")


def test_what_cannot_win_is_not_measured() -> None:
    slow = {candidate.label: 12.0 for candidate in (RESERVOIR, EVENT)}
    world = World({**times(), **slow}, {RESERVOIR.label: 1.0, EVENT.label: 2.0})
    outcome = world.run()
    assert not {name for name, _, _ in world.calls} & {RESERVOIR_4.label, ADJOINT.label}
    for row in outcome.rows[4:]:
        assert row.rounds == 0
        assert row.efficiency is None
        assert row.note.startswith("not measured: at most")
    assert [row.rounds for row in outcome.rows[2:4]] == [1, 1]  # no faster than what is exact


def test_relatives_of_what_cannot_win_are_not_compiled() -> None:
    """What traces its paths twice is no faster than what traces them once; nor are its own variants."""
    twice = [replace(c, parent=EVENT.label) for c in (GATHER, RESERVOIR)]
    every = [STACK, twice[0], EVENT, twice[1], RESERVOIR_4, ADJOINT]
    slow = World({**times(), EVENT.label: 12.0}, {RESERVOIR.label: 1.0, EVENT.label: 2.0})
    outcome = slow.run(every)
    assert outcome.label == "stack"
    assert {name for name, _, _ in slow.calls} == {STACK.label, EVENT.label}
    assert sum(row.note.startswith("not measured: at most") for row in outcome.rows) == 4
    quick = World({**times(), EVENT.label: 5.0, GATHER.label: 6.0}, {RESERVOIR.label: 4.0, EVENT.label: 9.0})
    assert quick.run(every).label == "gather"
    # Without `event`, which a budget of memory may leave out, all are measured.
    alone = World(times(), {RESERVOIR.label: 1.0})
    alone.run([STACK, *twice])
    assert {name for name, _, _ in alone.calls} == {STACK.label, GATHER.label, RESERVOIR.label}


def test_nothing_more_is_compiled_where_there_is_no_time() -> None:
    changed = {EVENT.label: 3.0, ADJOINT.label: 3.0}
    world = World({**times(), **changed}, {EVENT.label: 2.0, RESERVOIR.label: 1.0})
    slow = Allowance(0.1, run_s=1e6, compile_s=1e6, iteration_s=1.0)
    outcome = Pilot(ALL, world.step, 64, allowance=slow).run()
    assert ADJOINT.label not in {name for name, _, _ in world.calls}
    assert "no more than" in outcome.rows[-1].note


def test_what_is_kept_aside_is_not_spent(monkeypatch: pytest.MonkeyPatch) -> None:
    """First steps count in what a run has time for, though their kernels are there."""
    now, world = [0.0], World(times(), {RESERVOIR.label: 0.1, EVENT.label: 0.1}, overhead=500.0)
    monkeypatch.setattr(decisions, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    def step(candidate: Candidate, round: int, spp: int) -> Step:
        taken = world.step(candidate, round, spp)
        now[0] += 1.0 if (candidate.label, spp) not in {call[::2] for call in world.calls[:-1]} else taken.wall_ms / 1e3
        return taken

    allowance = Allowance(0.1, run_s=200.0, compile_s=0.0, iteration_s=1.14)
    with allowance.spending([(2.5, 5.0)]):
        Pilot(ALL, step, 64, allowance=allowance).run()
    assert {STACK.label, EVENT.label} <= {name for name, _, _ in world.calls}
    assert allowance.affords((2.5, 4.9))  # times of steps are estimates
    assert allowance.left_s == pytest.approx(20 - allowance.spent_s)


def test_an_allowance_is_what_is_left_of_a_share_of_the_run() -> None:
    allowance = Allowance(0.1, run_s=100.0, compile_s=1.0, iteration_s=0.5)
    assert allowance.affords((4, 4), (4, 0))
    assert not allowance.affords((4, 4), (4, 1))
    assert allowance.iterations_left(4) == 12
    allowance.spent_s = 0.01
    assert allowance.left_s == pytest.approx(10 - allowance.spent_s)
    allowance.spent_s = 11.0
    assert allowance.left_s == allowance.iterations_left(0) == 0
    assert allowance.line() == "measuring took 11.0 s, 11 % of what this run is expected to take"


def test_variances_do_not_depend_on_units() -> None:
    """The parameter with the large values would hide what selection adds to the other."""
    outcome = World(times(), {RESERVOIR.label: 1.0, EVENT.label: 1.0}).run()
    stack, _, reservoir = outcome.rows[:3]
    assert reservoir.variance == pytest.approx(2 * stack.variance, rel=0.2)


@pytest.mark.parametrize("spp", [1, 4, 16, 1024])
@pytest.mark.parametrize("overhead", [0.0, 1.0, 1000.0])
@pytest.mark.parametrize("share", [SHARE, SHARE - GUIDING_SHARE])
def test_its_share_is_kept(spp: int, overhead: float, share: float) -> None:
    """Alone, and where guiding is measured next: of steps that Python makes as dear as the run's own there are five."""
    world = World(times(), {RESERVOIR.label: 0.1, EVENT.label: 0.1}, overhead)
    outcome = world.run(spp=spp, share=share)
    measured = sum(row.rounds for row in outcome.rows)
    assert measured >= 4
    assert all(row.rounds >= 1 for row in outcome.rows[:4])
    assert outcome.spp <= spp
    assert outcome.share <= share * 1.001
    assert outcome.share == pytest.approx(1e3 * outcome.measure_s / (ITERATIONS * (overhead + 10.0 * spp)), rel=1e-6)


def test_equal_rounds_are_measured_with_equal_seeds_from_the_first() -> None:
    world = World({**times(), RESERVOIR.label: 8.0}, {RESERVOIR.label: 0.1, EVENT.label: 0.1})
    world.run()
    for name in {name for name, _, _ in world.calls}:
        rounds = [round for other, round, _ in world.calls if other == name]
        assert rounds[0] == 0  # the first step, which compiles
        assert sorted(set(rounds)) == list(range(max(rounds) + 1))


def test_no_noise_at_all_is_no_division_by_zero() -> None:
    def step(candidate: Candidate, round: int, spp: int) -> Step:
        return Step({"a": np.zeros(3)}, kernel_ms=1.0 if candidate is GATHER else 2.0, wall_ms=3.0)

    assert Pilot(ALL, step, 16).run().label == "gather"


def test_an_outcome_survives_json() -> None:
    outcome = World(times(), {RESERVOIR.label: 1.0, EVENT.label: 1.0}).run()
    assert EstimatorRecord.from_json(outcome.to_json()) == outcome


def test_few_steps_that_python_makes_dear_are_all_used() -> None:
    """One parameter, and kernels of no account beside Python: an estimator of half the time and 5 % more variance."""
    right, steps = 0, []
    for world in range(100):

        def step(candidate: Candidate, round: int, spp: int, world: int = world) -> Step:
            steps.append(candidate)
            path, choice = (np.random.default_rng([world, round, k]).normal() for k in (0, len(candidate.label)))
            value = (path + (0.2 * choice if candidate is EVENT else 0)) / np.sqrt(spp)
            kernel = (0.1 if candidate is EVENT else 0.2) * spp
            return Step({"a": np.array([10 + value])}, kernel_ms=kernel, wall_ms=10.0 + 0.2 * spp)

        right += Pilot([STACK, EVENT], step, 16).run().chosen == EVENT.options
    assert right >= 95
    assert len(steps) < 100 * (SHARE * ITERATIONS + 3)
