"""Whole runs that go on from others: more seeds, each with the time of those before it; with pretended processes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from measure.pretended_runs import CONFIG, Pretence, Stage, plan

from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.methods import RunsPlan, parse_cases
from reslrb_cli.measure.optimization_benchmark.rank import KIND, POINTS, check, method_records
from reslrb_cli.measure.optimization_benchmark.session import RunsSession
from reslrb_cli.measure.resume_store import Earlier
from reslrb_cli.records.measurement_files import read_samples, write_samples
from reslrb_cli.records.measurements import BenchStatus


def play(
    folder: Path, stage: Stage, what: RunsPlan, earlier: Earlier | None = None, after: int = 10**6
) -> tuple[RunsSession, list[str]]:
    said, answers = list[str](), iter(range(10**6))
    folder.mkdir(exist_ok=True)
    session = RunsSession(
        what, folder, lambda: next(answers) > after, said.append, stage.start, stage.clock, earlier=earlier
    )
    list(session.run())
    assert stage.alive == 0
    return session, said


def again(session: RunsSession, file: Path) -> Earlier:
    kept = session.keep()
    assert kept is not None
    write_samples(file, *kept)
    return Earlier(KIND, Path("c.jsonl"), *read_samples(file))


def test_seeds_go_on_with_the_same_target_and_the_same_time(tmp_path: Path) -> None:
    first, _ = play(tmp_path / "a", Stage(), plan(runs=2, budget_s=80.0))
    earlier = again(first, tmp_path / "c.samples.npz")
    check(plan(runs=4), earlier)
    stage = Stage()
    second, said = play(tmp_path / "b", stage, plan(runs=4, budget_s=300.0), earlier)
    assert said == ["old"]
    assert {seed for _, seed in stage.turns} == {2, 3}
    assert second.limit_s == first.limit_s
    assert [run.seed for run in second.members] == [0, 0, 1, 1, 2, 2, 3, 3]
    assert all(len(run.points) == POINTS and run.complete(second.limit_s) for run in second.members)
    for before, run in zip(first.members, second.members, strict=False):
        assert before.points == run.points
    records = method_records(second.members, second.limit_s)
    assert [record.runs for record in records] == [4, 4]
    # The cost to the first iteration is that of all four.
    assert records[0].first_s is not None
    assert records[0].first_s.median == pytest.approx(0.2 + 0.5 + 0.1)
    assert (tmp_path / "b/targets.npz").exists()


@pytest.mark.parametrize("after", [20, 700])
def test_a_seed_that_was_broken_off_is_made_anew(tmp_path: Path, after: int) -> None:
    whole, _ = play(tmp_path / "a", Stage(), plan())
    stopped, _ = play(tmp_path / "b", Stage(), plan(), after=after)
    kept = stopped.keep()
    over = sum(run.complete(stopped.limit_s) for run in stopped.members) // 2
    if over == 0:
        assert kept is None
        return
    assert over < 3
    stage = Stage()
    second, _ = play(tmp_path / "c", stage, plan(), again(stopped, tmp_path / "c.samples.npz"))
    assert {seed for _, seed in stage.turns} == set(range(over, 3))
    assert [run.points for run in second.members] == [run.points for run in whole.members]


def test_what_had_no_memory_is_not_tried_again(tmp_path: Path) -> None:
    first, _ = play(tmp_path / "a", Stage(ptracer=Pretence(ends_s=2.0)), plan(runs=1))
    stage = Stage()
    second, _ = play(tmp_path / "b", stage, plan(runs=2, budget_s=300.0), again(first, tmp_path / "c.samples.npz"))
    assert {name for name, _ in stage.turns} == {"reslrb_stack"}
    ended, sound = method_records(second.members, second.limit_s)
    assert (ended.status, ended.runs, sound.runs) == (BenchStatus.OUT_OF_MEMORY, 0, 2)


def test_a_budget_without_room_for_one_seed_says_what_it_takes(tmp_path: Path) -> None:
    first, _ = play(tmp_path / "a", Stage(), plan(runs=2, budget_s=80.0))
    earlier = again(first, tmp_path / "c.samples.npz")
    stage = Stage()
    second, said = play(tmp_path / "b", stage, plan(runs=3, budget_s=20.0), earlier)
    assert stage.now < 20
    assert len(second.members) == 4
    kept = second.keep()
    assert kept is not None
    assert kept[0]["runs"] == earlier.head["runs"]  # nothing is lost
    needed = float(said[-1].split("allow more than ")[1].split(" s")[0])
    more, _ = play(tmp_path / "c", Stage(), plan(runs=3, budget_s=needed + 1), earlier)
    assert len(more.members) == 6


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"config": loads(CONFIG, Path("x.yaml"), ["optimizer.learning_rate=0.5"])}, "optimizer.learning_rate is 0.02"),
        ({"cases": "reslrb:stack"}, "integrators is ['ptracer', 'reslrb:stack'] there, ['reslrb:stack']"),
        ({"reference": parse_cases("ptracer")[0]}, "reference is reslrb:stack there, ptracer here"),
    ],
)
def test_only_the_same_is_gone_on_from(tmp_path: Path, change: dict[str, Any], line: str) -> None:
    earlier = again(play(tmp_path / "a", Stage(), plan(runs=1))[0], tmp_path / "c.samples.npz")
    with pytest.raises(ConfigError, match=re.escape(f"--resume: c.jsonl is of another measurement: {line}")):
        check(plan(**({"runs": 2} | change)), earlier)
    with pytest.raises(ConfigError, match=r"c\.jsonl has 1 run of each already; name more with --runs"):
        check(plan(runs=1), earlier)


def test_another_loss_of_the_initial_values_is_another_scene(tmp_path: Path) -> None:
    earlier = again(play(tmp_path / "a", Stage(), plan(runs=1))[0], tmp_path / "c.samples.npz")
    earlier.head["facts"]["loss"] *= 1.01
    stage = Stage()
    with pytest.raises(ConfigError, match=r"the initial loss is 1\.01 there, 1 here: has a file of the scene changed"):
        play(tmp_path / "b", stage, plan(runs=2), earlier)
    assert stage.alive == 0
