"""Steps on several processes give the same numbers as one process. Neither the number of workers nor their failures
matter.
"""

from __future__ import annotations

import contextlib
import errno
import os
import pickle
import random
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli import tiny
from kit import count_iterations, wait_for
from runs.going_on import MOTION, one_thread, optimize
from runs.hosts import hosts, make_certificates, missing

from reslrb_cli.cluster import connection
from reslrb_cli.cluster.connection import Cluster, connected
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError, MachineError, ReslrbError
from reslrb_cli.optimization.loop import iterate
from reslrb_cli.optimization.state import guiding_of
from reslrb_cli.optimization.views import set_targets, target_arrays
from reslrb_cli.records import atomic
from reslrb_cli.runs.prepare import RunProgress, prepare

calls = pytest.importorskip("reslrb_cli.cluster.calls", reason="pip install reslrb[cluster]", exc_type=ImportError)
engine = pytest.importorskip("reslrb_cli.cluster.engine", reason="pip install reslrb[cluster]", exc_type=ImportError)

SETS = ["run.iterations=3", "run.spp=8", "run.measuring=0", "run.certainty=false"]
#: Experiments by name: two rounds and one round, guided emission, views, exposures, motion, and passes.
CASES = {
    "guided, scaled": ["run.shards=4", "integrator.guiding=on", tiny.DESCENT, "run.views_per_iteration=2"],
    "views": ["run.shards=3", "run.adjoint=batched", "integrator.guiding=on"],
    "exposure": ["run.shards=6", f"parameters=[{{key: {tiny.KEY}, initial: 0.5}}]", "views.1.exposure=auto"],
    "motion": ["run.shards=6", f"parameters[2]={MOTION}"],
    "pixels": ["run.shards=2", "run.spp=16", "integrator={estimator: stack, paths: both, pixels: measured}"],
    "passes": ["run.shards=2", "integrator.samples_per_pass=1", "run.spp=6"],
}
VIEWS = "views=[{sensor: 0}, {sensor: 1, weight: 2}, {sensor: 2}]"


def make(folder: Path, *sets: str) -> RunProgress:
    views = [VIEWS] if "passes" not in sets else []
    config = load(folder / "tiny.yaml", [*SETS, *views, *sets]).with_code()
    return prepare(config, "llvm_ad_rgb", lambda line: None, lambda line: None)[0]


def both(folder: Path, *sets: str) -> tuple[dict[str, np.ndarray], RunProgress]:
    """Return the result of a course in this process, and a second course with the same targets. Targets are rendered on
    all threads, so two renderings sometimes differ in their last bits.
    """
    first = make(folder, *sets)
    targets = target_arrays(first.problem.views)
    alone = end(first)
    del first
    course = make(folder, *sets)
    set_targets(course.problem.views, targets)
    return alone, course


def end(course: RunProgress, after: Callable[[int], object] = lambda iteration: None) -> dict[str, np.ndarray]:
    """Return the parameter values after the iterations, and the learned tables."""
    with one_thread():
        for state, _ in iterate(course.problem, course.state):
            after(state.iteration)
        guiding = guiding_of(course.problem)
        return course.problem.values() | ({} if guiding is None else guiding.state()[1])


def bits(arrays: dict[str, np.ndarray]) -> dict[str, bytes]:
    return {name: array.tobytes() for name, array in arrays.items()}


def test_workers_give_the_results_of_one_process(experiment: Path) -> None:
    check(experiment, "guided, scaled", 1)


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 2, 3, 5])
@pytest.mark.parametrize("case", CASES)
def test_any_number_of_workers_gives_the_same(experiment: Path, case: str, workers: int) -> None:
    check(experiment, case, workers)


OWN = """import drjit as dr
from mitsuba.ad.integrators.prb_basic import BasicPRBIntegrator


def own(image, target):
    return dr.mean(dr.abs(image - target), axis=None)
"""

#: Workers run both the loss and the integrator. With `batched`, each shard computes dL/dI by itself.
OWN_SETS = ["run.shards=3", "run.adjoint=batched", "loss={type: custom, file: own.py:own}",
            "integrator={type: custom, file: own.py:BasicPRBIntegrator, max_depth: 3}"]  # fmt: skip


@pytest.mark.long
def test_workers_run_users_code_with_permission(experiment: Path) -> None:
    (experiment / "own.py").write_text(OWN)
    compare(experiment, OWN_SETS, 1)
    course = make(experiment, *OWN_SETS)
    (experiment / "own.py").write_text(OWN + "# another\n")
    with pytest.raises(ConfigError, match="has changed since"), engine.engine_at(course, Cluster(1), threads=1):
        pass


def check(folder: Path, case: str, workers: int) -> None:
    compare(folder, CASES[case], workers)


def compare(folder: Path, sets: list[str], workers: int) -> None:
    """Compare the results bit by bit, with one thread each."""
    alone, course = both(folder, *sets)
    with engine.engine_at(course, Cluster(workers), threads=1) as local:
        course.compute_with(local)
        together = end(course)
    assert bits(alone) == bits(together)


# --- the side of a worker ---------------------------------------------------------------------------------------------


@pytest.fixture
def me(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """This process in the role of a worker. The worker does not end, but raises SystemExit."""

    def end(code: int) -> None:
        raise SystemExit(code)

    reasons: list[str] = []
    waits: list[float] = []
    made = SimpleNamespace(address="tls://here:1", local_directory=str(tmp_path), name=1, plugins={}, reasons=reasons,
                           waits=waits, log_event=lambda topic, text: reasons.append(text))  # fmt: skip
    monkeypatch.setattr(calls, "get_worker", lambda: made)
    monkeypatch.setattr(calls.os, "_exit", end)
    monkeypatch.setattr(calls, "time", SimpleNamespace(sleep=waits.append, perf_counter=time.perf_counter))
    return made


def reads(folder: Path, threads: int | None) -> tuple[str, dict[str, float]]:
    return (folder / "a").read_text(), {}


def uppercase(me: SimpleNamespace, workload: object) -> object:
    """Give a worker a workload, and call `str.upper` of the state."""
    me.plugins["reslrb"] = workload
    return calls.perform(workload.key, b"", str.upper, ())


def test_a_worker_reports_missing_requirements(me: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason is a different version, users' own code without permission, a faulty file, or another run."""
    files = {"a": b"one"}
    other = calls.Workload(files, reads, versions={"mitsuba": "0.1"})
    with pytest.raises(MachineError, match=r"^worker 1 \(here\) has mitsuba .*, but the run has 0.1: install the same"):
        other.setup(me)
    asking = calls.Workload(files, reads, asks_for_code=True)
    for use in (asking.setup, lambda me: uppercase(me, asking)):
        with pytest.raises(MachineError, match="does not run users' own code"):
            use(me)
    monkeypatch.setenv(calls.ALLOW_CODE, "1")
    assert uppercase(me, asking) == "ONE"
    with pytest.raises(MachineError, match="lacks the experiment; another run may use it"):
        calls.perform("another", b"", str.upper, ())
    with pytest.raises(MachineError, match=r"^worker 1 \(here\) cannot load the experiment: UnicodeDecodeError"):
        uppercase(me, calls.Workload({"a": b"\xff"}, reads))
    assert me.reasons == []


def test_a_worker_ends_if_its_machine_fails(me: SimpleNamespace) -> None:
    """It leaves dask a second at least to send the reason. Its exit code is not 0, so that dask starts another one."""
    with pytest.raises(SystemExit) as ended:
        uppercase(me, calls.Workload({}, reads))
    assert (ended.value.code, [seconds >= 1 for seconds in me.waits]) == (1, [True])
    workload = calls.Workload({"a": b"one"}, reads)
    assert uppercase(me, workload) == "ONE"
    with pytest.raises(SystemExit):
        calls.perform(workload.key, b"", fail, ())
    assert [text.partition(" failed: ")[0] for text in me.reasons] == ["worker 1 (here)"] * 2
    assert me.reasons[1].endswith("No space left on device; it is restarted")
    with pytest.raises(SystemExit):
        calls.perform(workload.key, b"", exhaust, ())
    assert me.reasons[2].startswith("worker 1 (here) failed: out of memory (host)")


def exhaust(state: object) -> None:
    raise MemoryError


def test_a_call_has_a_limit(me: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[SimpleNamespace] = []

    def timer(seconds: float, act: Callable[..., None], given: tuple[Any, ...]) -> SimpleNamespace:
        made.append(SimpleNamespace(seconds=seconds, act=lambda: act(*given), done=[], daemon=False))
        made[-1].start = lambda: made[-1].done.append("start")
        made[-1].cancel = lambda: made[-1].done.append("cancel")
        return made[-1]

    monkeypatch.setattr(calls, "threading", SimpleNamespace(Timer=timer))
    for failure in (None, ValueError("the user's")):
        with suppress(ValueError), calls._guarded(me, 7.4):
            assert (made[-1].seconds, made[-1].daemon, made[-1].done) == (7.4, True, ["start"])
            if failure:
                raise failure
        assert (made[-1].done, me.reasons) == (["start", "cancel"], [])
    with pytest.raises(SystemExit):
        made[-1].act()
    assert me.reasons == ["worker 1 (here) did not finish a call within 7 s; it is restarted"]


def test_failures_of_workers_are_explained() -> None:
    from distributed import CancelledError, KilledWorker
    from distributed.comm import CommClosedError
    from distributed.scheduler import NoWorkerError

    workers = calls.Workers.__new__(calls.Workers)
    killed = KilledWorker("a", SimpleNamespace(address="tls://here:1"), 3)
    ended = "the scheduler has ended; --resume continues the run"
    for status, error, text in (
        ("running", killed, "the same call ended 4 workers, the last one at tls://here:1; see their warnings"),
        ("running", TimeoutError(), f"no worker within {calls.NOBODY_S} s"),
        ("running", NoWorkerError(None, 3), f"no worker within {calls.NOBODY_S} s"),
        ("running", MachineError("worker 1 fails"), "worker 1 fails"), ("running", CancelledError(), ended),
        ("running", CommClosedError(), ended), ("closed", ValueError(), ended),
    ):  # fmt: skip
        workers._client = SimpleNamespace(status=status)
        with pytest.raises(MachineError, match=f"^--cluster: {text}"), workers._explained():
            raise error
    workers._client.status = "running"
    with pytest.raises(ValueError, match="of the user"), workers._explained():
        raise ValueError("of the user")


def test_failures_of_connections_are_explained(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The folder is removed then, too."""
    import distributed

    given: dict[str, Any] = {}

    def refuse(*_: object, **options: Any) -> None:
        given.update(options)
        raise OSError("Timed out") from ValueError("bad certificate")

    place = made(tmp_path / "temporary")
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    monkeypatch.setattr(distributed, "Client", refuse)
    monkeypatch.setattr(distributed, "LocalCluster", refuse)
    monkeypatch.setattr(connection, "_certificates", lambda: None)
    monkeypatch.setattr("reslrb_cli.backend.doctor.free_bytes", lambda variant: 12 * 2**30)
    refused = "the scheduler at tls://a:1 cannot be reached, or refuses this certificate: bad certificate"
    for cluster, text in ((Cluster(3), "no workers could be started: Timed out"),
                          (Cluster(address="tls://a:1"), refused)):  # fmt: skip
        with pytest.raises(MachineError, match=f"^--cluster: {text}$"), connected(cluster):
            pass
        assert list(place.iterdir()) == []
    asked = {"n_workers": 3, "threads_per_worker": 1, "processes": True, "security": None, "protocol": "tls://",
             "memory_limit": 4 * 2**30, "direct_to_workers": False, "set_as_default": False}  # fmt: skip
    assert {name: given[name] for name in asked} == asked


@pytest.mark.parametrize("error", [OSError, RuntimeError, TimeoutError])
def test_closing_ends_soon_and_without_errors(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Any) -> None:
    """Closing must neither hang nor hide the error of the run."""
    import distributed

    limits: list[float] = []

    def close(timeout: float) -> None:
        limits.append(timeout)
        raise error

    connection._close(SimpleNamespace(close=close))  # type: ignore[arg-type]
    monkeypatch.setattr(distributed, "LocalCluster", lambda **options: SimpleNamespace(security="s", close=close))
    with pytest.raises(ValueError, match="of the run s"), connection._started(1, tmp_path) as (_, security):
        raise ValueError(f"of the run {security}")
    assert [0 < limit <= 10 for limit in limits] == [True, True]


def test_calls_have_more_time_than_the_longest_one(me: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[float] = []

    @contextmanager
    def guarded(worker: object, seconds: float) -> Iterator[None]:
        limits.append(seconds)
        yield

    monkeypatch.setattr(calls, "_guarded", guarded)
    me.plugins["reslrb"] = workload = calls.Workload({}, lambda folder, threads: ("one", {"upper": 2.0}))
    for function in (str.upper, str.lower, str.upper):  # both calls last less than the longest one
        calls.perform(workload.key, b"", function, ())
    loading_s, known_s, cold_s, again_s = limits
    assert (loading_s, cold_s) == (calls.COLD_S, calls.COLD_S)
    assert calls.CALL_S + 10 * 2.0 <= known_s == again_s < calls.CALL_S + 10 * 2.0 + 5


@pytest.mark.parametrize(("allowed", "own", "asks"), [(True, False, True), (True, True, False), (False, False, False)])
def test_workers_of_others_are_asked_for_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, allowed: bool, own: bool, asks: bool
) -> None:
    monkeypatch.setattr(engine, "check_files", lambda files, config: None)
    course = SimpleNamespace(
        problem=SimpleNamespace(config=SimpleNamespace(allows_code=allowed), views=[]), files={},
        save=lambda folder: (folder / "state.npz").write_bytes(b"state"),
    )  # fmt: skip
    workload = engine.workload_of(course, tmp_path, 2, own)
    assert (workload.arguments, workload.asks_for_code, workload.threads) == ((allowed,), asks, 2)
    assert (workload.files["state.npz"], set(workload.files)) == (b"state", {"state.npz", "targets.npz"})


@pytest.mark.parametrize("in_rounds", [True, False])
def test_a_worker_compiles_the_calls_of_a_step(monkeypatch: pytest.MonkeyPatch, in_rounds: bool) -> None:
    """The third call of a function is the first one that only replays its kernels, so its time counts."""
    done: list[tuple[Any, ...]] = []

    def shard_image(problem: object, task: str) -> np.ndarray:
        done.append((task,))
        return np.ones((2, 2))

    def shard_gradient(problem: object, task: str, delta: np.ndarray | None = None) -> None:
        done.append((task, None if delta is None else delta.tolist()))

    clock = iter([0.0, 9.0, 10.0, 15.0, 20.0, 21.0] * 2)
    monkeypatch.setattr(engine, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    monkeypatch.setattr(engine, "shard_image", shard_image)
    monkeypatch.setattr(engine, "shard_gradient", shard_gradient)
    monkeypatch.setattr(engine, "make_tasks", lambda problem, iteration: [iteration, "another"])
    found = engine._warmed(SimpleNamespace(config=SimpleNamespace(in_rounds=in_rounds)))
    if in_rounds:
        assert found == {"shard_image": 1.0, "shard_gradient": 1.0}
        assert done == [(0,)] * 4 + [(0, [[0, 0], [0, 0]])] * 3
    else:
        assert (found, done) == ({"shard_gradient": 1.0}, [(0, None)] * 3)


def test_another_workload_is_refused(me: SimpleNamespace) -> None:
    for other in ({}, {"reslrb": object()}, {"reslrb": calls.Workload({}, lambda folder, threads: ("", {}), key="b")}):
        me.plugins.clear()
        me.plugins.update(other)
        with pytest.raises(MachineError, match="lacks the experiment; another run may use it"):
            calls.perform("a", b"", str.upper, ())


def test_places_have_bounds() -> None:
    assert Cluster.parse("tls://there:65535") == Cluster(address="tls://there:65535")
    assert Cluster.parse(f"local:{connection.MOST_WORKERS}") == Cluster(connection.MOST_WORKERS)
    for text in ("tls://there:65536", "tls://there:0", f"local:{connection.MOST_WORKERS + 1}", "local:0", "local:-1",
                 "local:" + 5000 * "9"):  # fmt: skip
        with pytest.raises(ConfigError, match="--cluster: must be local:N"):
            Cluster.parse(text)


@pytest.mark.parametrize(("workers", "threads"), [(1, 6), (4, 1), (7, 1)])
def test_workers_share_the_cores(workers: int, threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(6)))
    assert Cluster(workers).threads == threads
    assert Cluster(address="tls://there:1").threads is None


class _Broken:
    """Context of calls that cannot be taken."""

    def take(self, state: object) -> None:
        raise ValueError("broken")


def test_a_context_that_was_not_taken_is_taken_again(me: SimpleNamespace) -> None:
    me.plugins["reslrb"] = workload = calls.Workload({"a": b"one"}, reads)
    for _ in range(2):
        with pytest.raises(ValueError, match="broken"):
            calls.perform(workload.key, pickle.dumps(_Broken()), str.upper, ())


def test_an_error_of_the_user_reaches_the_run_as_text(me: SimpleNamespace) -> None:
    """A ConfigError cannot be sent to another process."""

    def fail(state: object) -> None:
        raise ConfigError("a.yaml", "run.spp", "is wrong")

    me.plugins["reslrb"] = workload = calls.Workload({"a": b"one"}, reads)
    with pytest.raises(ReslrbError, match=r"a\.yaml: run\.spp: is wrong") as raised:
        calls.perform(workload.key, b"", fail, ())
    assert type(pickle.loads(pickle.dumps(raised.value))) is ReslrbError


def test_a_worker_removes_the_files_of_its_workload(me: SimpleNamespace) -> None:
    workload = calls.Workload({"a": b"one"}, reads, key="k")
    assert uppercase(me, workload) == "ONE"
    folder = Path(me.local_directory) / "reslrb-k"
    assert [path.name for path in folder.iterdir()] == ["a"]
    for _ in range(2):  # dask may have removed the folder
        workload.teardown(me)
        assert not folder.exists()


def test_a_workload_is_loaded_once(me: SimpleNamespace) -> None:
    """It gets its arguments, and the folder of its files."""
    loaded: list[Any] = []

    def load(folder: Path, threads: int | None, *arguments: Any) -> tuple[str, dict[str, float]]:
        loaded.append((sorted(path.name for path in folder.iterdir()), threads, arguments))
        return "state", {}

    me.plugins["reslrb"] = workload = calls.Workload({"a": b"1", "b": b"2"}, load, (True, 7), 3)
    for function, given, value in ((str.upper, (), "STATE"), (str.replace, ("s", "p"), "ptate")):
        assert calls.perform(workload.key, b"", function, given) == value
    assert loaded == [(["a", "b"], 3, (True, 7))]
    assert calls.perform(workload.key, b"", calls._load, ()) is None


@dataclass(eq=False)
class _Future:
    """Answer to a call."""

    value: object
    release: Callable[[], None]

    def result(self) -> object:
        return self.value


class _Client:
    """Client of one worker that computes in this process. Answers arrive in the reverse order."""

    loop, status = None, "running"

    def __init__(self, workers: int = 2) -> None:
        self.told: list[Any] = []
        self.workers = workers

    def subscribe_topic(self, topic: str, tell: Callable[[Any], None]) -> None:
        self.told.append(topic)
        self.tell = tell

    def wait_for_workers(self, count: int, timeout: int) -> None:
        self.told.append((count, timeout))

    def register_plugin(self, plugin: Any) -> None:
        self.told.append(plugin.key)

    def scheduler_info(self, n_workers: int) -> dict[str, Any]:
        assert n_workers == -1  # all of them
        return {"workers": dict.fromkeys(range(self.workers))}

    def submit(self, function: object, *given: Any, pure: bool) -> _Future:
        assert not pure  # equal calls are computed again
        assert function is calls.perform
        key, context, work, arguments = given
        value = key, context and pickle.loads(context), work.__name__, arguments
        return _Future(value, lambda: self.told.append("released"))


def test_the_calls_of_a_run(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """Each worker loads the workload first. Answers have the places of their calls."""
    monkeypatch.setattr(calls, "as_completed", lambda futures, loop: reversed(list(futures)))
    client: Any = _Client()
    workload = SimpleNamespace(key="k")
    workers = calls.Workers(client, workload, lambda state: f"context of {state}")  # type: ignore[arg-type]
    assert client.told == ["reslrb", (1, connection.NOBODY_S), "k", "released", "released"]
    found = list(workers("s", str.upper, [("a",), ("b",)]))
    assert found == [(1, ("k", "context of s", "upper", ("b",))), (0, ("k", "context of s", "upper", ("a",)))]
    client.tell(("time", "worker 1 is restarted"))
    assert caplog.messages == ["--cluster: worker 1 is restarted"]


@pytest.mark.parametrize("threads", [None, 3])
def test_the_order_of_assembling(monkeypatch: pytest.MonkeyPatch, threads: int | None) -> None:
    """Files are compared first, and the memory of a step is checked before the run's decisions."""
    done: list[Any] = []

    def note(name: str, result: Any = None) -> Callable[..., Any]:
        return lambda *given: (done.append(name), result)[1]

    config = SimpleNamespace(with_code=lambda allowed: ("config", allowed))
    settled = SimpleNamespace(config="text", files={}, variant="llvm_ad_rgb")
    stored = SimpleNamespace(path=Path("state.npz"), read=lambda kind: settled)
    monkeypatch.setattr(engine, "Stored", lambda path: stored)
    monkeypatch.setattr(engine, "loads", lambda text, path: config)
    monkeypatch.setattr(engine.np, "load", lambda path: contextlib.nullcontext({"0": path.name}))
    decided = SimpleNamespace(views=["view"])
    for name, result in (("check_files", None), ("set_variant", None), ("begin_as", None), ("check_step", None),
                         ("decide_as", decided)):  # fmt: skip
        monkeypatch.setattr(engine, name, note(name, result))
    monkeypatch.setattr(engine, "assemble_scene", lambda config: done.append(config))
    monkeypatch.setattr(engine, "set_targets", lambda views, targets: done.append((views, targets)))
    monkeypatch.setattr(engine, "_warmed", lambda problem: {"found": 1.0})
    monkeypatch.setattr(engine.dr, "sync_thread", note("sync"))
    monkeypatch.setattr(engine.dr, "set_thread_count", done.append)
    assert engine.assembled(Path("folder"), threads, True) == (decided, {"found": 1.0})
    assert done == [
        "check_files", "set_variant", ("config", True), "begin_as", "check_step", "decide_as",
        (["view"], {"0": "targets.npz"}), *(["sync", 3] if threads else []),
    ]  # fmt: skip


def test_the_standing_of_a_step_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers get the values of the optimiser and the learned tables, then apply them to the scene."""
    done: list[Any] = []
    guiding = SimpleNamespace(state=lambda: ({"0": 3}, {"0/a": np.ones(2)}))
    problem: Any = SimpleNamespace(optimizer={"a": np.float32([1, 2])}, apply=lambda: done.append("apply"))
    monkeypatch.setattr(engine, "guiding_of", lambda problem: guiding)
    standing = engine.Standing.of(problem)
    assert (standing.values["a"].tolist(), standing.calls, list(standing.learned)) == ([1, 2], {"0": 3}, ["0/a"])
    monkeypatch.setattr(engine, "guiding_of", lambda problem: None)
    assert (engine.Standing.of(problem).calls, engine.Standing.of(problem).learned) == ({}, {})

    class Optimizer(dict[str, Any]):
        def set_value(self, key: str, value: Any) -> None:
            done.append((key, value))

    problem.optimizer = Optimizer(a=0)
    monkeypatch.setattr(engine.dr, "detach", lambda value: value)
    monkeypatch.setattr(engine, "like", lambda known, value: (known, value.tolist()))
    monkeypatch.setattr(engine, "restore_tables", lambda problem, calls, learned: done.append((calls, list(learned))))
    standing.take(problem)
    assert done == [("a", (0, [1, 2])), ({"0": 3}, ["0/a"]), "apply"]


def test_a_worker_with_other_tables_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "restore_tables", lambda *given: "wall: 3 cells, not 4")
    with pytest.raises(MachineError, match="a worker has other guiding tables than the run: wall: 3 cells, not 4"):
        engine.Standing({}, {}, {}).take(SimpleNamespace())


class _Noted:
    """Context that notes when it is taken."""

    def take(self, state: object) -> None:
        taken.append(state)


taken: list[object] = []


def test_a_context_is_taken_again_after_one_that_failed(me: SimpleNamespace) -> None:
    """The failed context may have changed a part of the state."""
    me.plugins["reslrb"] = workload = calls.Workload({"a": b"one"}, reads)
    taken.clear()
    for context, number in ((_Noted(), 1), (_Noted(), 1), (_Broken(), 1), (_Noted(), 2)):
        with suppress(ValueError):
            calls.perform(workload.key, pickle.dumps(context), str.upper, ())
        assert len(taken) == number


@pytest.mark.parametrize(("shown", "seen"), [("3,5", "5"), ("7", "7"), ("0,1,2", "1")])
def test_each_worker_sees_one_gpu(me: SimpleNamespace, monkeypatch: pytest.MonkeyPatch, shown: str, seen: str) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", shown)
    uppercase(me, calls.Workload({"a": b""}, reads))
    assert os.environ["CUDA_VISIBLE_DEVICES"] == seen


# --- what becomes of workers that fail --------------------------------------------------------------------------------


@contextmanager
def beside(folder: Path, workers: int, iterations: int, *sets: str):
    """Yield a course with `workers` workers and their client, and compare its result with one process."""
    sets = ("run.shards=4", f"run.iterations={iterations}", "views=[{sensor: 0}]", *sets)
    alone, course = both(folder, *sets)
    with engine.engine_at(course, Cluster(workers), threads=1) as local:
        course.compute_with(local)
        yield course, local._client
        together = end(course)
    assert bits(alone) == bits(together)


def hang(dask_worker: Any) -> None:
    """Make the worker that runs this function stop answering."""
    spoil(dask_worker, lambda: threading.Event().wait())


def run_full(dask_worker: Any) -> None:
    """Make the worker's next call fail as on a full disk."""
    spoil(dask_worker, lambda: fail(None))


def take_memory(dask_worker: Any) -> None:
    """Make the worker's next call take 3 GiB, 1.5 times the memory that the worker may use."""

    def fill() -> None:
        taken = [np.ones(2**27) for _ in range(3)]
        time.sleep(60)
        del taken

    spoil(dask_worker, fill)


def spoil(dask_worker: Any, act: Callable[[], object]) -> None:
    class Spoilt:
        def __getattr__(self, name: str) -> None:
            act()

    workload = dask_worker.plugins["reslrb"]
    workload._loaded = workload._loaded._replace(state=Spoilt())


@pytest.mark.long
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("fault", [hang, run_full, take_memory])
def test_failing_workers_are_restarted(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, fault: Callable[[Any], None], workers: int
) -> None:
    """One worker fails in the middle of a run. The run ends with the same result, and no iteration takes longer than a
    minute.
    """
    monkeypatch.setattr("reslrb_cli.backend.doctor.free_bytes", lambda variant: workers * 2 * 2**30)
    longest, before = 0.0, time.monotonic()

    with beside(experiment, workers, 8) as (course, client):
        for state, _ in iterate(course.problem, course.state):
            longest, before = max(longest, time.monotonic() - before), time.monotonic()
            course.state = state
            if state.iteration == 2:
                before_fault = {*client.run(os.getpid).values()}
                client.run(fault, workers=[*client.scheduler_info()["workers"]][:1])
            if state.iteration == 6:
                assert not before_fault <= {*client.run(os.getpid, on_error="ignore").values()}
                break
    assert longest < 60


def fail(state: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


class Unchanged:
    """Context that sets nothing in a worker's state."""

    def take(self, state: object) -> None:
        pass


@pytest.mark.long
@pytest.mark.usefixtures("llvm")
def test_a_call_that_ends_every_worker_ends_the_run(caplog: pytest.LogCaptureFixture) -> None:
    ended = pytest.raises(MachineError, match="--cluster: the same call ended 4 workers, the last one at tls://")
    workload = calls.Workload({"a": b"one"}, reads)
    with connected(Cluster(1)) as (client, _), ended:
        list(calls.Workers(client, workload, lambda state: Unchanged())(None, fail, [()]))
    warnings = [record.message for record in caplog.records if record.name == "reslrb_cli.cluster.calls"]
    assert warnings  # a busy machine may lose some
    assert all("No space left on device; it is restarted" in warning for warning in warnings)


@pytest.mark.long
def test_thirty_kills_lose_nothing(experiment: Path) -> None:
    """Random workers are killed at random moments of 200 iterations."""
    rng = random.Random(1)
    moments = sorted(rng.sample(range(2, 199), 30))
    killed: list[int] = []

    def kill(pids: list[int], wait: float) -> None:
        time.sleep(wait)
        for pid in pids:  # a process may have just been replaced
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)
                return

    with beside(experiment, 3, 200) as (course, client):
        for state, _ in iterate(course.problem, course.state):
            course.state = state
            if state.iteration in moments:
                pids = sorted(client.run(os.getpid, on_error="ignore").values())
                threading.Thread(target=kill, args=(rng.sample(pids, len(pids)), rng.uniform(0, 0.1))).start()
            if state.iteration == 199:
                break
    assert len(killed) == 30
    assert not [pid for pid in killed if Path(f"/proc/{pid}/cmdline").exists() and _is_worker(pid)]


def _is_worker(pid: int) -> bool:
    return b"distributed" in Path(f"/proc/{pid}/cmdline").read_bytes()


@pytest.mark.long
def test_memory_does_not_grow(experiment: Path) -> None:
    """The memory of the run and its workers is compared at iterations 200 and 2,000."""
    import psutil

    sizes: dict[int, list[int]] = {}
    course = make(experiment, "run.shards=4", "run.iterations=2001", "views=[{sensor: 0}]")
    with engine.engine_at(course, Cluster(2), threads=1) as local:
        course.compute_with(local)
        with one_thread():
            for state, _ in iterate(course.problem, course.state):
                if state.iteration in (200, 2000):
                    pids = [os.getpid(), *sorted(local._client.run(os.getpid).values())]
                    sizes[state.iteration] = [psutil.Process(pid).memory_info().rss for pid in pids]
    growth = [late / early for early, late in zip(sizes[200], sizes[2000], strict=True)]
    assert max(growth) < 1.05, growth


# --- hosts that reach nobody but the scheduler ------------------------------------------------------------------------


@pytest.fixture
def net(experiment: Path, tmp_path: Path):
    if reason := missing():
        pytest.skip(reason)
    with hosts(4, tmp_path) as made:
        yield made


RUN = ["optimize", "tiny.yaml", *tiny.settings(*SETS, "run.shards=4", "views=[{sensor: 0}]")]


def reslrb(net, host: int, *words: object, **variables: str):
    """Start a command on one core: renderings of a target on several threads sometimes differ in their last bits."""
    return net.start(host, [sys.executable, "-m", "reslrb_cli", *words], core=0, **variables)


def values(folder: Path) -> dict[str, bytes]:
    with np.load(folder / "parameters" / "parameters.npz") as found:
        return {name: found[name].tobytes() for name in found.files}


def said(net, process) -> str:
    """Return the output of a command that has ended."""
    number = net.running.index(process)
    (log,) = net.folder.glob(f"log-{number}-*.txt")
    return log.read_text()


@pytest.mark.long
def test_isolated_hosts_give_the_same(net, tmp_path: Path) -> None:
    """One host is disconnected for 20 seconds in the middle of a run. A host with a foreign certificate is refused."""
    more = tiny.settings("run.iterations=40", "run.spp=64")
    local = reslrb(net, 2, *RUN, *more, "--cluster", "local:2", "--set", "run.name=local")
    assert local.wait(300) == 0, said(net, local)
    net.scheduler()
    for host in range(2):
        net.worker(host, host)
    remote = reslrb(net, 2, *RUN, *more, "--cluster", net.address(2), "--set", "run.name=remote")
    wait_for(lambda: count_iterations(tmp_path / "runs" / "remote") > 4, 120)
    net.cut(0)
    time.sleep(20)
    net.cut(0, False)
    assert remote.wait(300) == 0, said(net, remote)
    assert values(tmp_path / "runs" / "remote") == values(tmp_path / "runs" / "local")

    other = make_certificates(made(tmp_path / "other"))
    stranger = reslrb(net, 3, *RUN, "--cluster", net.address(3), "--set", "run.name=stranger", **other)
    assert stranger.wait(120) == 6
    assert "cannot be reached, or refuses this certificate" in said(net, stranger).splitlines()[-1]


@pytest.mark.long
@pytest.mark.parametrize("whom", ["scheduler", "coordinator"])
def test_a_run_survives_five_kills_of_scheduler_or_coordinator(net, tmp_path: Path, whom: str) -> None:
    """If the scheduler is killed, one line appears within a minute. `--resume` gives the same parameters."""
    more = tiny.settings("run.iterations=60", "run.spp=64", "run.checkpoint_every={iterations: 5}")
    local = reslrb(net, 2, *RUN, *more, "--cluster", "local:2", "--set", "run.name=local")
    assert local.wait(300) == 0, said(net, local)
    folder = tmp_path / "runs" / "tiny"
    words, rng, scheduler = [*RUN, *more], random.Random(2), None
    workers = []
    for kill in range(6):
        if scheduler is None or scheduler.poll() is not None:
            for worker in workers:
                os.killpg(worker.pid, signal.SIGKILL)
                worker.wait()
            scheduler = net.scheduler()
            workers = [net.worker(host, host) for host in range(2)]
        run = reslrb(net, 2, *words, "--cluster", net.address(2))
        words = ["optimize", "--resume", "runs/tiny"]
        if kill == 5:
            assert run.wait(300) == 0, said(net, run)
            break
        least = 10 * (kill + 1) - rng.randrange(5)
        wait_for(lambda least=least: count_iterations(folder) >= least, 120)
        time.sleep(rng.uniform(0, 0.3))
        os.killpg((scheduler if whom == "scheduler" else run).pid, signal.SIGKILL)
        if whom == "scheduler":
            scheduler.wait()
            assert run.wait(60) == 6, said(net, run)
            assert "--cluster: the scheduler has ended" in said(net, run).splitlines()[-1]
        else:
            run.wait()
    assert values(folder) == values(tmp_path / "runs" / "local")


def made(folder: Path) -> Path:
    folder.mkdir()
    return folder


BAD = [
    (["--cluster", "2"], "--cluster: must be local:N"),
    (["--cluster", "tcp://here:8786"], "--cluster: must be local:N"),
    (["--cluster", "tls://here"], "--cluster: must be local:N"),
    (["--cluster", "local:0"], "--cluster: must be local:N"),
    (["--cluster", "tls://127.0.0.1:9", "--set", "run.shards=4"], "distributed.comm.tls.ca-file: is not set"),
    (["--cluster", "local:2"], "run.shards: --cluster needs more than one shard"),
    (["--cluster", "local:2", "--dry-run"], "--dry-run measures only this process"),
]


@pytest.mark.long  # in this process: test_a_cluster_has_one_folder_and_one_memory
def test_two_signals_leave_no_files(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second signal ends the process at once. The workers then end by themselves."""
    place = made(experiment / "temporary")
    monkeypatch.setenv("TMPDIR", str(place))
    words = ["--cluster", "local:2", *tiny.settings("run.iterations=100000", "run.shards=2", "run.spp=8")]
    with (experiment / "err").open("w") as err:
        run = tiny.start(experiment, *words, stderr=err, stdout=err)
        wait_for(lambda: count_iterations(experiment / "runs/tiny") > 0 or run.poll() is not None, 120)
        assert any(place.iterdir())
        for number in (signal.SIGTERM, signal.SIGINT):
            run.send_signal(number)
    assert run.wait(30) == 130, (experiment / "err").read_text()
    assert list(place.iterdir()) == []


def settings_of_a_worker(dask_worker: Any) -> tuple[list[object], list[object], object]:
    """Return when a worker writes tasks to disk or waits, the pages that it serves, and its reaction to Ctrl-C."""
    import dask

    memory = dask_worker.memory_manager
    limits = [memory.memory_target_fraction, memory.memory_spill_fraction, memory.memory_pause_fraction]
    return limits, dask.config.get("distributed.worker.http.routes"), signal.getsignal(signal.SIGINT)


def test_a_cluster_has_one_folder_and_one_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that ends at once removes this folder. The workers share the free memory of this machine."""
    place = made(tmp_path / "temporary")
    monkeypatch.setattr(tempfile, "tempdir", str(place))
    monkeypatch.setattr("reslrb_cli.backend.doctor.free_bytes", lambda variant: 12 * 2**30)
    with connected(Cluster(2)) as (client, folder):
        client.wait_for_workers(2, timeout=60)
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        assert [worker["memory_limit"] for worker in workers] == [6 * 2**30] * 2
        assert [*client.run(settings_of_a_worker).values()] == [([False] * 3, [], signal.SIG_IGN)] * 2
        scheduler: Any = client.cluster.scheduler
        assert scheduler.http_application.applications == []  # no pages
        assert list(place.iterdir()) == [folder]
        assert folder in atomic.unfinished
    assert folder not in atomic.unfinished
    assert list(place.iterdir()) == []


def test_a_worker_compares_the_files(experiment: Path) -> None:
    """The folder of a worker on another machine may hold another version of a file."""
    place, scene = made(experiment / "worker"), experiment / "scene.xml"
    for name, data in engine.workload_of(make(experiment), place, None, own=False).files.items():
        (place / name).write_bytes(data)
    scene.write_text(scene.read_text() + " ")
    with pytest.raises(ConfigError, match=r"scene\.file: .*scene\.xml has changed since the run began"):
        engine.assembled(place, None, False)


def test_connections_are_encrypted(tmp_path: Path) -> None:
    """Also if dask's settings do not require it. A scheduler without TLS could send any code."""
    import dask

    files = {name: str(tmp_path / name) for name in ("ca.pem", "cert.pem", "key.pem")}
    for file in files.values():
        Path(file).write_text("")
    tls = "distributed.comm.tls"
    settings = {f"{tls}.ca-file": files["ca.pem"], f"{tls}.client.cert": files["cert.pem"],
                f"{tls}.client.key": files["key.pem"], "distributed.comm.require-encryption": False}  # fmt: skip
    with dask.config.set(settings):
        security: Any = connection._certificates()
    assert security.require_encryption
    assert security.tls_client_key == files["key.pem"]
    with dask.config.set({**settings, f"{tls}.client.key": "-----BEGIN KEY-----\nabc\n"}):  # not a file
        assert connection._certificates().tls_client_key.startswith("-----BEGIN")  # type: ignore[attr-defined]
    for wrong, why in (("", "is not set; give the file, for example by DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT=FILE"),
                       ("gone.pem", "gone.pem cannot be read")):  # fmt: skip
        with (
            dask.config.set({**settings, f"{tls}.client.cert": wrong}),
            pytest.raises(ConfigError, match=rf"--cluster: {tls}\.client\.cert: {why}"),
        ):
            connection._certificates()


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_undistributable_work_is_refused(experiment: Path, capsys, arguments, message) -> None:
    assert optimize("tiny.yaml", *arguments) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_without_dask_the_installation_is_explained(experiment: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert optimize("tiny.yaml", "--cluster", "local:2", "--set", "run.shards=4") == 2
    assert "pip install reslrb[cluster]" in capsys.readouterr().err
