"""The time of workers: what of it a run keeps, and what a forecast says of it."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from runs.going_on import optimize

from reslrb_cli.cluster import forecast as model
from reslrb_cli.cluster.connection import Place
from reslrb_cli.cluster.forecast import Parts, Round, StepTime
from reslrb_cli.config.loader import load
from reslrb_cli.optimization.shards import serially
from reslrb_cli.records.clock import SharedTime, WorkerTime

engine = pytest.importorskip("reslrb_cli.cluster.engine", reason="pip install reslrb[cluster]", exc_type=ImportError)

SETS = ["run.spp=8", "run.measuring=0", "run.certainty=false", "run.shards=4", "views=[{sensor: 0}]"]
QUICK = [word for text in SETS for word in ("--set", text)]


def shared(run: str = "runs/tiny") -> SharedTime | None:
    """What the manifest of a run says."""
    told = json.loads(Path(run, "manifest.json").read_text())["shared"]
    if told is None:
        return None
    workers = {name: WorkerTime(**one) for name, one in told.pop("workers").items()}
    return SharedTime(**{**told, "places": tuple(told["places"])}, workers=workers)


class Counting:
    """Computes shards here, for a second each."""

    def __init__(self, where: str) -> None:
        self.where, self.calls = where, 0

    def __call__(self, *given: object) -> Iterator[tuple[int, object]]:
        for found in serially(*given):  # type: ignore[arg-type]
            self.calls += 1
            yield found

    def spent(self) -> SharedTime:
        workers = {f"of {self.where}": WorkerTime(self.calls, self.calls)}
        return SharedTime((self.where,), 1.25 * self.calls, self.calls, 0.0, workers)


def test_a_run_that_goes_on_elsewhere_adds_up(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rounds of four shards an iteration; also where only the state knows, as after a kill."""

    @contextmanager
    def at(course: object, place: object) -> Iterator[Counting]:
        yield Counting(str(place))

    monkeypatch.setattr(engine, "engine_at", at)
    run = ["tiny.yaml", *QUICK]
    assert optimize(*run, "--set", "run.iterations=2", "--cluster", "local:2") == 0
    assert shared() == SharedTime(("local:2",), 20.0, 16.0, 0.0, {"of local:2": WorkerTime(16, 16.0)})
    manifest = Path("runs/tiny/manifest.json")
    manifest.write_text(manifest.read_text().replace("16.0", "99.0"))
    on = ["--resume", "runs/tiny", "--set"]
    assert optimize(*on, "run.iterations=3", "--cluster", "local:3") == 0
    both = {"of local:2": WorkerTime(16, 16.0), "of local:3": WorkerTime(8, 8.0)}
    assert shared() == SharedTime(("local:2", "local:3"), 30.0, 24.0, 0.0, both)
    assert optimize(*on, "run.iterations=4") == 0
    assert shared() == SharedTime(("local:2", "local:3"), 30.0, 24.0, 0.0, both)
    assert "asked of others too" in Path("runs/tiny/report.html").read_text()


def test_a_run_by_itself_has_none(experiment: Path) -> None:
    assert optimize("tiny.yaml", *QUICK, "--set", "run.iterations=1") == 0
    assert shared() is None


@pytest.mark.long
def test_what_workers_did_is_all_there(experiment: Path) -> None:
    """Of each worker its calls, and of the iterations no more than they took."""
    run = ["tiny.yaml", *QUICK, "--cluster", "local:2"]
    assert optimize(*run, "--set", "run.iterations=4") == 0
    first = shared()
    assert optimize("--resume", "runs/tiny", "--set", "run.iterations=6", "--cluster", "local:1") == 0
    both = shared()
    assert first is not None
    assert both is not None
    assert (sum(one.calls for one in first.workers.values()), len(first.workers)) == (4 * 2 * 4, 2)
    assert sum(one.calls for one in both.workers.values()) == 6 * 2 * 4
    assert both.places == ("local:2", "local:1")
    elapsed = json.loads(Path("runs/tiny/metrics.jsonl").read_text().splitlines()[-1])["elapsed_s"]
    assert 0 < both.computing_s < both.computing_s + both.waiting_s + both.sending_s == pytest.approx(both.wall_s)
    assert both.wall_s < elapsed


# --- the forecast -----------------------------------------------------------------------------------------------------

#: 16 shards in two rounds. All bytes of a step: 2 x (4 x 1e6 + 16 x 250,000) on 4 workers.
PARTS = Parts(
    shards=16, paths=1_000_000, here_s=0.05, round_s=0.01, call_s=0.001, byte_s=1e-9,
    rounds=(Round(0.1, 0.02, 1_000_000, 50_000, 200_000), Round(0.3, 0.0, 1_000_000, 200_000, 50_000)),
)  # fmt: skip
NONE = Parts(16, 1_000_000, (Round(0.1, 0.0, 0, 0, 0),), 0.0, 0.0, 0.0, 0.0)


def test_a_step_is_the_sum_of_its_parts() -> None:
    time = model.step_time(PARTS, 4, 1e9)
    sending = 16_000_000 * (1e-9 + 8e-9)
    assert time == StepTime(pytest.approx(4 * 0.4 + 0.02), pytest.approx(sending), pytest.approx(2 * 0.03), 0.05)
    assert time.whole == pytest.approx(1.62 + 0.144 + 0.06 + 0.05)
    assert model.efficiency(PARTS, 4, 1e9) == pytest.approx((16 * 0.4 + 0.05) / (4 * time.whole))
    assert model.step_time(PARTS, 5).computing == pytest.approx(4 * 0.4 + 0.02)  # one of five has four of them
    assert model.step_time(PARTS, 16).computing == model.step_time(PARTS, 32).computing


def test_what_costs_nothing_beside_is_worth_it_as_far_as_there_are_shards() -> None:
    assert [model.efficiency(NONE, workers) for workers in model.WORKERS] == [pytest.approx(1.0)] * 5
    assert model.not_worth(NONE, 1e9) is None
    assert model.enough_paths(NONE, 8, 0.85, 1e9) == 0
    assert model.not_worth(replace(NONE, shards=4), 1e9) == 8
    assert model.not_worth(replace(NONE, here_s=10.0), 1e9) == 2


@pytest.mark.parametrize("link", model.LINKS.values())
def test_that_many_paths_are_enough(link: float) -> None:
    """A step of so many, each shard as much longer, has just that efficiency; of one that has it already, fewer do."""
    for parts in (PARTS, replace(PARTS, rounds=tuple(replace(each, shard_s=50.0) for each in PARTS.rounds))):
        paths = model.enough_paths(parts, 8, 0.85, link)
        assert paths is not None
        assert (paths > parts.paths) is (model.efficiency(parts, 8, link) < 0.85)
        times = paths / parts.paths
        scaled = replace(parts, rounds=tuple(replace(one, shard_s=times * one.shard_s) for one in parts.rounds))
        assert model.efficiency(scaled, 8, link) == pytest.approx(0.85)
    assert model.enough_paths(replace(PARTS, shards=9), 8, 0.85, link) is None


def test_links_that_say_the_same_are_told_together() -> None:
    [(links, first, paths)] = model.verdicts(NONE)
    assert (links, first, paths) == (list(model.LINKS), None, 0)
    sent = replace(NONE, rounds=(Round(0.1, 0.0, 10**8, 0, 0),))
    told = model.verdicts(sent)
    assert [links for links, _, _ in told] == [[link] for link in model.LINKS]
    assert [first for _, first, _ in told] == [2, 8, 16]


def test_a_dry_run_says_what_a_step_takes_on_so_many(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(os.listdir(experiment))
    assert optimize("tiny.yaml", *QUICK, "--dry-run", "--cluster", "local:1") == 0
    printed = capsys.readouterr().out
    assert sorted({*os.listdir(experiment)} - {"cache"}) == sorted(before)
    assert "a step on workers, such as those of local:1, of 4 shards and 512 light paths, in two rounds" in printed
    assert re.search(r"^measured on 1 worker: \S+ m?s a step; by these parts it is \S+ m?s$", printed, re.MULTILINE)
    rows = re.findall(r"^ +(\d+)((?: +\S+ (?:ms|s) +\d\.\d\d){3})$", printed, re.MULTILINE)
    assert [int(workers) for workers, _ in rows] == list(model.WORKERS)
    assert "with no batch, for 4 shards cannot be shared out so well: raise run.shards" in printed
    assert "not worth it from" in printed


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 2])
def test_what_the_model_says_is_what_steps_take(experiment: Path, workers: int) -> None:
    """Of steps of a second and more, whose parts were measured by themselves; within a factor, as machines are busy."""
    config = load(experiment / "tiny.yaml", [*SETS, "run.spp=65536", "run.shards=8"])
    found = model.measure(config, "llvm_ad_rgb", Place(workers), lambda line: None)
    assert found.workers == workers
    assert found.step_s > 0.5
    assert 0.5 < found.expected_s / found.step_s < 1.5
    assert all(each.stand > 300 and each.call > 100 and each.answer > 400 for each in found.parts.rounds)
    assert len(found.parts.rounds) == 2
    image, gradient = found.parts.rounds
    assert image.answer > 8 * 8 * 3 * 4 > image.call
    assert gradient.call > 8 * 8 * 3 * 4
