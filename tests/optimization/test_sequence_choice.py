"""`sequence: auto`, decided on fabricated steps and in whole runs of a small scene."""

from __future__ import annotations

import gc
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from optimization.deciding import SIZES, SMALL, World, begin, fix_times, is_even, operations
from runs.going_on import optimize
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.race import (
    GUIDING_SHARE,
    ITERATIONS,
    LEARNINGS,
    LEAST_ROUNDS,
    LOOKS,
    PLANNED,
    SEQUENCE_SHARE,
    SHARE,
    Sizes,
)
from reslrb_cli.optimization.autotune.sampling import SEQUENCE_LONGER, SequencePilot, StepTrial, planned, share_left
from reslrb_cli.optimization.decisions import Allowance
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.records.decisions import GuidedRecord

# `sequence: auto` in whole runs of a small scene: the decision, the sequence that is then traced, and the part that is
# kept.  Step times are given, so every machine decides alike. Variances are those of the scene.

AUTO = ["integrator.sequence=auto", *SMALL]
BOTH = ["integrator.guiding=auto", *AUTO]
RUN = Path("runs/tiny")


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return begin(tmp_path, monkeypatch)


def take_times(
    monkeypatch: pytest.MonkeyPatch, even_ms: float, guided_ms: float = 1.0, alone_ms: float = 1000.0
) -> None:
    fix_times(monkeypatch, {"guiding": guided_ms, "sequence": even_ms, "sequence alone": alone_ms})


def made(settings: list[str], **options: Any) -> Problem:
    return assemble(load("tiny.yaml", settings), **options)


def spied(monkeypatch: pytest.MonkeyPatch, settings: list[str], guided_ms: float) -> list[tuple[str, Any, Any, bool]]:
    """Return for each measured step: the decision, the option, the learned content of its table, and whether its
    numbers are low-discrepancy.
    """
    seen: list[tuple[str, Any, Any, bool]] = []
    take_times(monkeypatch, 0.1, guided_ms)
    take, learn = StepTrial.take, StepTrial.learn

    def spy(self: StepTrial, other: bool, round: int, spp: int) -> Any:
        taken = take(self, other, round, spp)
        tracer = self._tracers[other]
        problem = self._problem
        plan = tracer.plan(problem.scene, problem.scene.sensors()[0])
        guiding = tracer.preparation.guiding
        learned = None if guiding is None else {n: (one.sums.copy(), one.calls) for n, one in guiding.learned.items()}
        assert guiding is None or guiding is self.table
        seen.append((self._what, other, learned, plan.sequence is not None))
        return taken

    def counted(self: StepTrial, round: int, spp: int) -> Any:
        seen.append((self._what, "learn", None, False))
        return learn(self, round, spp)

    monkeypatch.setattr(StepTrial, "take", spy)
    monkeypatch.setattr(StepTrial, "learn", counted)
    problem = made(settings)
    guiding = problem.integrator.preparation.guiding
    assert guiding is None or guiding.learned == {}  # the run begins with an empty table
    assert is_even(problem)
    return seen


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("guiding", a_few(["auto, on", "auto, off", "on", "off"], ["auto, on", "on"]))
def test_it_is_measured_with_the_decision_on_guiding(
    guiding: str, experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both kinds of steps draw from the fixed table of the decision on guiding. Without that decision, both kinds draw
    from one table of their own.
    """
    asked, _, found = guiding.partition(", ")
    is_on = (found or asked) == "on"
    seen = spied(monkeypatch, [f"integrator.guiding={asked}", *AUTO], 0.1 if is_on else 1000.0)
    steps = [row for row in seen if row[0] == "sequence" and row[1] != "learn"]
    first = 0 if asked == "auto" else 2  # steps before the first learning
    assert {row[3] == row[1] for row in steps} == {True}
    assert [row[1] for row in seen if row[0] == "sequence"].count("learn") == (2 if asked == "on" else 0)
    # If guiding was measured to be on, low-discrepancy steps without guiding also compete with guided steps.
    alone = [row for row in seen if row[0] == "sequence alone"]
    assert bool(alone) == (guiding == "auto, on")
    assert all((row[2] is None) == row[1] == row[3] for row in alone)
    tables = [row[2] for row in steps[first:]]
    if not is_on:
        assert tables == [None] * len(tables)
        return
    held = [row[2] for row in seen if row[0] == "guiding" and row[2]][-1] if asked == "auto" else tables[0]
    assert list(held) == [0]
    for table in tables:
        assert np.array_equal(table[0][0], held[0][0])
        assert table[0][1] == held[0][1]


@pytest.mark.usefixtures("llvm")
def test_without_guiding_it_replaces_guiding_if_it_is_better(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After the replacement, neither the kernels nor the memory plan contains any part of guiding."""
    take_times(monkeypatch, 0.1, 0.1, alone_ms=0.001)
    budget = "run.memory_budget=64"
    counts, plans = [], []
    for settings in (BOTH, ["integrator.sequence=low_discrepancy", *SMALL]):
        problem = made([*settings, budget], cache=PilotCache())
        counts.append(operations(problem))
        assert problem.memory is not None
        plans.append(problem.memory.expected_bytes)
        assert is_even(problem)
        assert problem.integrator.preparation.guiding is None
        if settings is BOTH:
            assert problem.guided is not None
            assert problem.sequence is not None
            assert not problem.guided.guided
            assert "; low-discrepancy numbers without it have " in problem.guided.line()
            assert problem.sequence.line().startswith("sequence low_discrepancy, guiding off: ")
        del problem
        gc.collect()
    assert counts[0] == counts[1]
    assert plans[0].total == pytest.approx(plans[1].total, rel=0.01)
    # The kept outcomes of both decisions give the same result again.
    told: list[str] = []
    again = made([*BOTH, budget], say=told.append, cache=PilotCache())
    assert not [line for line in told if "measuring" in line]
    assert again.guided is not None
    assert not again.guided.guided
    assert again.integrator.preparation.guiding is None
    assert is_even(again)


@pytest.mark.usefixtures("llvm")
def test_separate_tables_for_both_are_found(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.integrators.context import Preparation

    monkeypatch.setattr(Preparation, "draw_from", lambda self, guiding, scene: None)
    with pytest.raises(AssertionError):
        spied(monkeypatch, BOTH, 0.1)


@pytest.mark.usefixtures("llvm")
@pytest.mark.long  # the run reports it as well
def test_a_dry_run_measures_it_for_the_run(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    take_times(monkeypatch, 0.1)
    sets = [word for text in AUTO for word in ("--set", text)]
    assert optimize("tiny.yaml", "--dry-run", *sets) == 0
    assert "sequence low_discrepancy: " in "".join(capsys.readouterr())
    assert not RUN.exists()


@pytest.mark.usefixtures("llvm")
def test_compared_options_are_named() -> None:
    config = load(Path(__file__).parents[2] / "configs" / "furnace.yaml")
    [even, left] = parse_cases("reslrb:stack(sequence=low_discrepancy),reslrb:auto(sequence=auto)")
    assert even.estimator == "stack(sequence=low_discrepancy)"
    assert left.estimator == "auto"
    assert left.at(config, 4, known=False, auto=True).integrator.options()["sequence"] == "auto"


# Decisions on fabricated steps about whether low-discrepancy numbers pay, and the share of a run's time that measuring
# may take.


def world(variance: float, time: float, **options: Any) -> World:
    """Return a world in which nothing is learned, unless `options` enable learning."""
    return World(variance, time, **{"learns": False, "pilot": SequencePilot, **options})


def sizes(share: float, step: int = 64) -> Sizes:
    return replace(SIZES, step=step, call=step, part=step, longer=SEQUENCE_LONGER, planned=planned(share))


@pytest.mark.parametrize(
    ("options", "on"),
    [
        ({"variance": 0.05, "time": 1.1}, True),
        ({"variance": 0.6, "time": 1.1}, True),
        ({"variance": 1.0, "time": 1.0}, False),
        ({"variance": 0.95, "time": 1.1}, False),
        ({"variance": 2.0, "time": 1.1}, False),
        ({"variance": 0.05, "time": 1.1, "image": 3.0}, False),  # the image would get worse
        ({"variance": 0.05, "time": 1.1, "image": 0.9}, True),
        ({"variance": 0.05, "time": 1.1, "image": 3.0, "alone": True}, False),  # one switch controls both
        ({"variance": 0.05, "time": 1.1, "image": 0.9, "alone": True}, True),
        ({"variance": 0.05, "time": 1.1, "sparse": True}, True),
    ],
)
def test_it_is_on_if_it_pays(options: dict[str, Any], on: bool) -> None:
    one = world(**options)
    record = one.run(sizes(0.02), 0.02)
    assert record.low_discrepancy == on
    assert record.setting == ("low_discrepancy" if on else "independent")
    assert record.low < 1 / (one.variance * (1.1 if one.time > 1 else 1.0)) < record.high or one.alone
    assert record.line().startswith(f"sequence {record.setting}: {record.gain:.2g} times the efficiency here (")
    assert (record.note != "") == (not on and record.low > 1)
    assert all(call[0] != "learn" for call in one.calls)


def on_by_accident(**options: Any) -> int:
    """Return in how many of 100 worlds low-discrepancy numbers are on."""
    return sum(world(**options, seed=seed).run(sizes(0.05), 0.05).low_discrepancy for seed in range(100))


def test_it_is_rarely_on_without_a_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    # Without the tolerance for times, 2.5 worlds are expected on this side. The looks before the last add one more.
    assert on_by_accident(variance=0.9, time=1 / 0.9) <= 9
    # This check finds a fault that uses the gain itself as the gain's lower bound.
    gain = SequencePilot._gain
    monkeypatch.setattr(SequencePilot, "_gain", lambda *args: (lambda g: (g[0], g[0], g[2]))(gain(*args)))
    assert on_by_accident(variance=0.9, time=1 / 0.9) > 30


def test_an_untrained_table_learns_before_all_counted_steps() -> None:
    one = world(0.1, 1.1, learns=True)
    record = one.run(sizes(0.05), 0.05)
    assert record.low_discrepancy
    kinds = [call[0] for call in one.calls]
    assert kinds[:4] == [False, False, "learn", "learn"]
    assert kinds.count("learn") == LEARNINGS
    assert kinds[4:] == [True, *[False, True] * record.rounds]
    # Both sides keep learning, so the time for learning is no part of the gain.
    assert record.gain == pytest.approx(1 / (0.1 * 1.1), rel=0.2)


@pytest.mark.parametrize("share", [0.0, SEQUENCE_SHARE, 0.01, 0.02, SHARE])
@pytest.mark.parametrize("step", [8, 64, 1024])
@pytest.mark.parametrize("overhead", [0.0, 0.1, 10.0])
@pytest.mark.parametrize("time", [0.9, 1.1, 3.0])
def test_its_share_of_the_time_is_kept(share: float, step: int, overhead: float, time: float) -> None:
    one = world(0.1, time, overhead=overhead)
    used = sizes(share, step)
    record = one.run(used, share)
    if record.gain is None:
        dear = re.fullmatch(r"measuring it would take more than [\d.e+-]+ iterations?", record.note)
        assert dear or "too few to decide" in record.note
        assert not record.low_discrepancy
        # One step is always needed to measure the duration of a step.
        assert record.share * ITERATIONS * (step + overhead) <= max(
            used.trial + overhead, 1.3 * share * ITERATIONS * (step + overhead)
        )
    else:
        assert LEAST_ROUNDS <= record.rounds <= LOOKS * used.rounds
        assert record.share <= share * 1.3


def test_more_remaining_time_gives_longer_steps() -> None:
    trials = [sizes(share, 1024).trial for share in (0.0, SEQUENCE_SHARE, 0.01, 0.02, 0.05)]
    assert trials == sorted(trials)
    assert trials[0] == 1
    assert 30 < trials[1] < trials[2] < trials[3]
    assert sizes(0.05, 1024).planned == PLANNED
    assert world(0.1, 1.1).run(sizes(SEQUENCE_SHARE, 1024), SEQUENCE_SHARE).low_discrepancy


class Spent:
    """Problem of a run in which measurements took the given shares so far."""

    def __init__(self, paths: float | None, guided: float | None) -> None:
        self.sides = None if paths is None else SimpleNamespace(share=paths)
        self.guided = None if guided is None else GuidedRecord(guided=True, share=guided)


@pytest.mark.parametrize("paths", [None, 0.02, SHARE - GUIDING_SHARE])
def test_all_measurements_share_one_limit(paths: float | None) -> None:
    """The decision on guiding leaves the sequence its part. Both decisions stay within the share of all decisions."""
    ample = Allowance(1.0, 1e9, 0.0, 1.0)
    for_guiding = share_left(Spent(paths, None), ample, SEQUENCE_SHARE)  # type: ignore[arg-type]
    assert for_guiding == pytest.approx(SHARE - SEQUENCE_SHARE - (paths or 0))
    assert for_guiding >= GUIDING_SHARE - SEQUENCE_SHARE - 1e-12
    left = share_left(Spent(paths, for_guiding), ample)  # type: ignore[arg-type]
    assert left == pytest.approx(SEQUENCE_SHARE)
    assert share_left(Spent(paths, 0.5), ample) == 0  # type: ignore[arg-type]
