"""`guiding: auto` in whole runs of a small scene: what is decided, what is then traced, and what is kept of it.

Times are given, so that it is decided alike on every machine; variances are those of the scene, whose lamp sends one
path in twenty to where anything is seen.
"""

from __future__ import annotations

import gc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optimization.deciding import begin, fix_times, inspected, operations
from recording.going_on import begin_alone, differences, left_over, optimize, run_and_kill
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.guiding.tables import Purpose
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.optimization import assemble as assembling
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.race import Step
from reslrb_cli.optimization.autotune.sampling import StepTrial, table_bytes
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.records.checkpoint import STATE_FILE, open_state
from reslrb_cli.records.manifest import read_manifest

pytestmark = pytest.mark.usefixtures("llvm")
AUTO = ["integrator.guiding=auto", "scene.size=[32, 32]", "run.spp=64", "run.iterations=2", "run.certainty=false"]
AUTO += ["run.measuring=1000"]  # though iterations are so few
RUN = Path("runs/tiny")


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return begin(tmp_path, monkeypatch)


def take_times(monkeypatch: pytest.MonkeyPatch, guided_ms: float) -> None:
    fix_times(monkeypatch, {"guiding": guided_ms})


def decided(monkeypatch: pytest.MonkeyPatch, guided_ms: float, *settings: str, **options: Any) -> Problem:
    take_times(monkeypatch, guided_ms)
    return assemble(load("tiny.yaml", [*AUTO, *settings]), **options)


@pytest.mark.parametrize("adjoint", a_few(["batched", "correlated", "independent"], ["batched"]))
def test_on_is_guided_and_off_has_nothing_of_it(
    adjoint: str, experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Off, a step's kernels are, operation by operation, those of `guiding: off`."""
    counts = []
    for guided_ms, settings in ((1.0, AUTO), (1000.0, AUTO), (1.0, AUTO[1:])):
        take_times(monkeypatch, guided_ms)
        problem = assemble(load("tiny.yaml", [*settings, f"run.adjoint={adjoint}"]))
        found, guiding = problem.guided, problem.integrator.preparation.guiding
        print(found)
        if settings is not AUTO:
            assert found is guiding is None
        elif guided_ms == 1:
            assert found is not None
            assert found.guided
            assert found.images
            assert guiding is not None
            assert guiding.learned == {}  # the run begins with an empty table
        else:
            assert found is not None
            assert not found.guided
            assert found.high is not None
            assert found.high < 1
            assert guiding is None
        assert not any(np.any(np.array(problem.optimizer.gradient(key))) for key in problem.selection.keys)
        counts.append(operations(problem))
        del problem, guiding
        gc.collect()  # scenes that are alive at the same time show in each other's kernels
    on, off, plain = counts
    assert off == plain
    assert on != plain


def test_the_sequence_is_the_same_with_guiding_and_without(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for guided_ms in (1.0, 1000.0):
        problem = decided(monkeypatch, guided_ms, "integrator.sequence=low_discrepancy")
        plan = problem.integrator.plan(problem.scene, problem.scene.sensors()[0])
        assert (plan.grid is None) == (guided_ms > 1)
        assert plan.sequence is not None


def test_images_that_guiding_does_not_pay_for_are_not_guided(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = StepTrial.take

    def slow(self: StepTrial, other: bool, round: int, spp: int) -> Step:
        taken = take(self, other, round, spp)
        taken.image_ms = 1000.0 if other else 1.0
        return taken

    take_times(monkeypatch, 0.5)
    monkeypatch.setattr(StepTrial, "take", slow)
    problem = assemble(load("tiny.yaml", [*AUTO, "run.adjoint=independent"]))
    assert problem.guided is not None
    assert problem.guided.guided
    assert not problem.guided.images
    guiding = problem.integrator.preparation.guiding
    assert [guiding.serves(purpose) for purpose in (Purpose.IMAGE, Purpose.GRADIENT, Purpose.BOTH)] == [
        False,
        True,
        True,
    ]
    plain = assemble(load("tiny.yaml", [*AUTO[1:], "run.adjoint=independent"]))
    images = [each.render(0, 4, 3, "test") for each in (problem, plain)]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-5)  # the same paths


def seeds_of_parts(monkeypatch: pytest.MonkeyPatch, experiment: Path) -> tuple[set[int], set[int]]:
    """The seeds of walks that a table learned from, and those of steps; whatever learned in between has failed."""
    drawn: dict[str, set[int]] = {"learn": set(), "take": set()}
    problem = assemble(load("tiny.yaml", AUTO[1:]))
    plain, guided = (problem.integrator.afresh(guided=on) for on in (False, True))
    trial, job = StepTrial(problem, "guiding", plain, guided), StepTrial._job
    part = "learn"

    def spy(self: StepTrial, view: Any, number: int, spp: int) -> Any:
        drawn[part].add(number)
        return job(self, view, number, spp)

    monkeypatch.setattr(StepTrial, "_job", spy)
    for round in range(2):
        trial.learn(round, 4)
    learned = trial._tracers[True].preparation.guiding.learned[0]
    before = learned.sums.copy(), learned.draws.copy()
    part = "take"
    for round in range(4):
        for guided in (False, True):
            trial.take(guided, round, 4)
    after = trial._tracers[True].preparation.guiding.learned[0]
    assert np.array_equal(before[0], after.sums)
    assert np.array_equal(before[1], after.draws)
    assert trial._tracers[False].preparation.guiding is None
    return drawn["learn"], drawn["take"]


def test_no_path_that_was_learned_from_is_judged_by(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learned, judged = seeds_of_parts(monkeypatch, experiment)
    assert len(learned) == 2
    assert len(judged) == 8
    assert not learned & judged


@pytest.mark.parametrize("fault", ["seeds", "held"])
def test_faults_of_that_are_seen(fault: str, experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps with the seeds of what was learned from; a table that goes on learning from what it is judged by."""
    if fault == "seeds":
        monkeypatch.setattr(StepTrial, "_seed", lambda self, round, view, what: round)
        learned, judged = seeds_of_parts(monkeypatch, experiment)
        assert learned & judged
    else:
        from reslrb_cli.guiding.tables import Guiding

        monkeypatch.setattr(Guiding, "due", lambda self, number: True)
        with pytest.raises(AssertionError):
            seeds_of_parts(monkeypatch, experiment)


def test_a_run_says_so_once_remembers_it_and_writes_it_down(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    take_times(monkeypatch, 1.0)
    sets = [word for text in AUTO for word in ("--set", text)]
    assert optimize("tiny.yaml", *sets) == 0
    said = capsys.readouterr().err
    found = read_manifest(RUN)["guided"]
    assert found["guided"]
    assert not found["cached"]
    assert f"guiding on: {found['gain']:.2g} times the efficiency here ({found['low']:.2g} to " in said
    assert "guiding: auto" in (RUN / "config.yaml").read_text()
    assert f"guiding on: {found['gain']:.2g} times" in (RUN / "report.html").read_text()
    archive, values = open_state(RUN / "checkpoint" / STATE_FILE)
    archive.close()
    assert values["guided"] == found
    assert values["guiding"]["0"] > 0
    told: list[str] = []
    again = assemble(load("tiny.yaml", AUTO), told.append, PilotCache())
    assert again.guided is not None
    assert again.guided.to_json() == {**found, "cached": True}
    assert told[-1] == again.guided.line()
    assert again.guided.line(cost=True) == f"{told[-1]} (as an earlier run measured)"
    row = next(line for line in inspected(capsys, str(RUN)) if "guided emission" in line)
    assert row.split()[0] == "needed"
    assert "65536 cells, 6.1 MiB" in row  # no more than the 16,384 paths of a batch can tell apart
    assert f"guiding: auto, {found['gain']:.2g} times the efficiency here (" in row
    row = next(line for line in inspected(capsys, "tiny.yaml", "--set", AUTO[0]) if "guided emission" in line)
    assert row.startswith("  left out")
    assert row.endswith("guiding: auto, which a run decides by measurement")


def test_it_goes_on_as_it_was_decided_bit_by_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Guided or not, and from which sequence: decided once, and restored."""
    begin_alone(tmp_path, monkeypatch)
    fix_times(monkeypatch, {"guiding": 0.2, "sequence": 0.1, "sequence alone": 1000.0})
    settings = [
        *AUTO[:3],
        "run.measuring=1000",
        "integrator.sequence=auto",
        "run.iterations=8",
        "run.checkpoint_every={iterations: 3}",
        "run.certainty=false",
    ]
    whole, left = run_and_kill(monkeypatch, 7, *(word for text in settings for word in ("--set", text)))
    monkeypatch.setattr(assembling, "settle", lambda *args: pytest.fail("measured again"))
    (tmp_path / "cache" / "pilot.json").unlink()
    assert optimize("--resume", str(left), "--quiet") == 0
    assert read_manifest(left)["guided"]["guided"]
    assert read_manifest(left)["sequence"]["low_discrepancy"]
    assert differences(whole, left) == []
    assert left_over(left) == []


def test_a_memory_budget_without_room_for_tables_leaves_it_off(
    experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    budget = "run.memory_budget={}"
    roomy = decided(monkeypatch, 1.0, budget.format(64))
    assert roomy.guided is not None
    assert roomy.guided.guided
    assert roomy.memory is not None
    plain = assemble(load("tiny.yaml", [*AUTO[1:], budget.format(64)]))
    assert plain.memory is not None
    more = roomy.memory.expected_bytes.total - plain.memory.expected_bytes.total
    assert more == pytest.approx(table_bytes(roomy), rel=0.05)
    tight = decided(monkeypatch, 1.0, budget.format(4))
    assert tight.guided is not None
    assert tight.guided.note.startswith("run.memory_budget has no room for tables of ")
    assert tight.integrator.preparation.guiding is None


def test_a_damaged_outcome_is_measured_anew(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Damaged(PilotCache):
        def get(self, key: str) -> dict[str, Any] | None:
            return {"guided": "maybe"}

    said: list[str] = []
    problem = decided(monkeypatch, 1.0, say=said.append, cache=Damaged())
    assert problem.guided is not None
    assert not problem.guided.cached
    assert any(line.startswith("measuring ") for line in said)


def test_what_is_compared_is_named() -> None:
    """In measurements `auto` of the experiment is off, and is refused where somebody writes it."""
    config = load(Path(__file__).parents[2] / "configs" / "furnace.yaml")
    [plain, asked] = parse_cases("reslrb:stack,reslrb:gather(guiding=auto)")
    assert plain.at(config, 4, known=True).integrator.options()["guiding"] == "off"
    with pytest.raises(ConfigError, match="compare `on` with `off`"):
        asked.at(config, 4, known=True)


def test_a_script_is_told_that_it_has_to_say() -> None:
    from reslrb_cli.integrators.step import make_integrator

    with pytest.raises(ValueError, match="say on or off"):
        make_integrator("reslrb", guiding="auto")


def test_who_says_on_or_off_has_nothing_measured(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StepTrial, "take", lambda *args: pytest.fail("measured"))
    for guiding in ("on", "off"):
        problem = assemble(load("tiny.yaml", [*AUTO[1:], f"integrator.guiding={guiding}"]))
        assert problem.guided is None
        assert (problem.integrator.preparation.guiding is not None) == (guiding == "on")
