"""The working time of workers, as recorded by a run."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from runs.going_on import optimize

from reslrb_cli.optimization.shards import serially
from reslrb_cli.records.clock import SharedTime, WorkerTime

engine = pytest.importorskip("reslrb_cli.cluster.engine", reason="pip install reslrb[cluster]", exc_type=ImportError)

SETS = ["run.spp=8", "run.measuring=0", "run.certainty=false", "run.shards=4", "views=[{sensor: 0}]"]
QUICK = [word for text in SETS for word in ("--set", text)]


def shared(run: str = "runs/tiny") -> SharedTime | None:
    """Return the workers' time in the manifest of a run."""
    told = json.loads(Path(run, "manifest.json").read_text())["shared"]
    if told is None:
        return None
    workers = {name: WorkerTime(**one) for name, one in told.pop("workers").items()}
    return SharedTime(**{**told, "places": tuple(told["places"])}, workers=workers)


class Counting:
    """Engine that computes shards here and counts one second for each."""

    def __init__(self, where: str) -> None:
        self.where, self.calls = where, 0

    def __call__(self, *given: object) -> Iterator[tuple[int, object]]:
        for found in serially(*given):  # type: ignore[arg-type]
            self.calls += 1
            yield found

    def spent(self) -> SharedTime:
        workers = {f"of {self.where}": WorkerTime(self.calls, self.calls)}
        return SharedTime((self.where,), 1.25 * self.calls, self.calls, 0.0, workers)


def test_times_of_a_resumed_run_add_up(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each iteration has two rounds of four shards. The times also add up if only the state holds them, as after a
    kill.
    """

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
    assert "of local:3" in Path("runs/tiny/report.html").read_text()


def test_a_local_run_has_no_cluster_time(experiment: Path) -> None:
    assert optimize("tiny.yaml", *QUICK, "--set", "run.iterations=1") == 0
    assert shared() is None


@pytest.mark.long
def test_all_work_of_workers_is_counted(experiment: Path) -> None:
    """The calls of all workers are counted. The recorded time of the iterations is not longer than the run."""
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
