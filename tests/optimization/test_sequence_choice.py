"""`sequence: auto` in whole runs of a small scene: what is decided, what is then traced, and what is kept of it.

Times are given, so that it is decided alike on every machine; variances are those of the scene.
"""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optimization.deciding import begin, fix_times, inspected, operations
from recording.going_on import optimize
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.sampling import StepTrial
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.records.checkpoint import STATE_FILE, open_state
from reslrb_cli.records.manifest import read_manifest

pytestmark = pytest.mark.usefixtures("llvm")
SMALL = ["scene.size=[16, 16]", "run.spp=64", "run.iterations=2", "run.certainty=false", "run.measuring=1000"]
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


def is_even(problem: Problem) -> bool:
    """Whether paths have low-discrepancy numbers."""
    return problem.integrator.plan(problem.scene, problem.scene.sensors()[0]).sequence is not None


def test_on_is_evenly_spread_and_off_has_nothing_of_it(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Off, a step's kernels are, operation by operation, those of `sequence: independent`."""
    counts = []
    for even_ms, settings in ((0.1, AUTO), (1000.0, AUTO), (0.1, SMALL)):
        take_times(monkeypatch, even_ms)
        problem = made(settings)
        found = problem.sequence
        print(found)
        assert problem.guided is None
        if settings is SMALL:
            assert found is None
        else:
            assert found is not None
            assert found.low_discrepancy == (even_ms < 1)
            assert (found.low or 0) > 1 if even_ms < 1 else (found.high or 2) < 1
        assert is_even(problem) == (even_ms < 1 and settings is AUTO)
        assert not any(np.any(np.array(problem.optimizer.gradient(key))) for key in problem.selection.keys)
        counts.append(operations(problem))
        del problem
        gc.collect()  # scenes that are alive at the same time show in each other's kernels
    on, off, plain = counts
    assert off == plain
    assert on != plain


def spied(monkeypatch: pytest.MonkeyPatch, settings: list[str], guided_ms: float) -> list[tuple[str, Any, Any, bool]]:
    """Of every step that is taken: what is decided by it, which way, what its table had learned, whether it is even."""
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


@pytest.mark.parametrize("guiding", a_few(["auto, on", "auto, off", "on", "off"], ["auto, on", "on"]))
def test_it_is_measured_with_guiding_as_that_was_decided(
    guiding: str, experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both kinds of steps draw from the table that guiding was decided with, held; without that, from one of theirs."""
    asked, _, found = guiding.partition(", ")
    is_on = (found or asked) == "on"
    seen = spied(monkeypatch, [f"integrator.guiding={asked}", *AUTO], 0.1 if is_on else 1000.0)
    steps = [row for row in seen if row[0] == "sequence" and row[1] != "learn"]
    first = 0 if asked == "auto" else 2  # steps before what is learned
    assert {row[3] == row[1] for row in steps} == {True}
    assert [row[1] for row in seen if row[0] == "sequence"].count("learn") == (2 if asked == "on" else 0)
    # In place of guiding: without it, beside steps that are guided, where that was measured to be on.
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


def test_alone_it_takes_the_place_of_guiding_where_that_is_better(
    experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then nothing of guiding is left, neither in kernels nor in what memory is planned for."""
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
    # What was kept of both decisions says so again.
    told: list[str] = []
    again = made([*BOTH, budget], say=told.append, cache=PilotCache())
    assert not [line for line in told if "measuring" in line]
    assert again.guided is not None
    assert not again.guided.guided
    assert again.integrator.preparation.guiding is None
    assert is_even(again)


def test_a_table_of_its_own_for_either_is_seen(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.integrators.context import Preparation

    monkeypatch.setattr(Preparation, "draw_from", lambda self, guiding, scene: None)
    with pytest.raises(AssertionError):
        spied(monkeypatch, BOTH, 0.1)


def test_a_run_says_so_once_remembers_it_and_writes_it_down(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    take_times(monkeypatch, 0.1)
    sets = [word for text in AUTO for word in ("--set", text)]
    assert optimize("tiny.yaml", *sets) == 0
    said = capsys.readouterr().err
    found = read_manifest(RUN)["sequence"]
    assert found["low_discrepancy"]
    assert not found["cached"]
    line = f"sequence low_discrepancy: {found['gain']:.2g} times the efficiency here ("
    assert f"{line}{found['low']:.2g} to {found['high']:.2g})" in said
    assert "sequence: auto" in (RUN / "config.yaml").read_text()
    assert line in (RUN / "report.html").read_text()
    archive, values = open_state(RUN / "checkpoint" / STATE_FILE)
    archive.close()
    assert values["sequence"] == found
    told: list[str] = []
    again = made(AUTO, say=told.append, cache=PilotCache())
    assert again.sequence is not None
    assert again.sequence.to_json() == {**found, "cached": True}
    assert told[-1] == again.sequence.line()
    assert is_even(again)
    row = next(line for line in inspected(capsys, str(RUN)) if "low-discrepancy numbers" in line)
    assert row.split()[0] == "needed"
    assert f"sequence: auto, {found['gain']:.2g} times the efficiency here (" in row
    row = next(line for line in inspected(capsys, "tiny.yaml", "--set", AUTO[0]) if "low-discrepancy" in line)
    assert row.startswith("  left out")
    assert row.endswith("sequence: auto, which a run decides by measurement")


@pytest.mark.long  # the run says so too
def test_a_dry_run_measures_it_for_the_run(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    take_times(monkeypatch, 0.1)
    sets = [word for text in AUTO for word in ("--set", text)]
    assert optimize("tiny.yaml", "--dry-run", *sets) == 0
    assert "sequence low_discrepancy: " in "".join(capsys.readouterr())
    assert not RUN.exists()


def test_what_is_compared_is_named() -> None:
    """In measurements `auto` of the experiment is off, and is refused where somebody writes it."""
    config = load(Path(__file__).parents[2] / "configs" / "furnace.yaml")
    [plain, asked] = parse_cases("reslrb:stack,reslrb:gather(sequence=auto)")
    assert plain.at(config, 4, known=True).integrator.options()["sequence"] == "independent"
    with pytest.raises(ConfigError, match="compare `independent` with `low_discrepancy`"):
        asked.at(config, 4, known=True)
    [even, left] = parse_cases("reslrb:stack(sequence=low_discrepancy),reslrb:auto(sequence=auto)")
    assert even.estimator == "stack(sequence=low_discrepancy)"
    assert left.estimator == "auto"
    assert left.at(config, 4, known=False, auto=True).integrator.options()["sequence"] == "auto"


def test_a_script_is_told_that_it_has_to_say() -> None:
    from reslrb_cli.integrators.step import make_integrator

    with pytest.raises(ValueError, match="say independent or low_discrepancy"):
        make_integrator("reslrb", sequence="auto")


def test_who_says_which_has_nothing_measured(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StepTrial, "take", lambda *args: pytest.fail("measured"))
    for sequence in ("independent", "low_discrepancy"):
        problem = made([f"integrator.sequence={sequence}", *SMALL])
        assert problem.sequence is None
        assert is_even(problem) == (sequence == "low_discrepancy")
