"""Results of functions about workers of a cluster, as a table of cases (`said.check`)."""

from __future__ import annotations

import logging
import os
import pickle
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from golden.cases import Cases, ending

from reslrb_cli.cluster import connection
from reslrb_cli.errors import ConfigError
from reslrb_cli.records import atomic

calls = pytest.importorskip("reslrb_cli.cluster.calls", reason="pip install reslrb[cluster]", exc_type=ImportError)
engine = pytest.importorskip("reslrb_cli.cluster.engine", reason="pip install reslrb[cluster]", exc_type=ImportError)

Patch = pytest.MonkeyPatch
case = Cases()


@case
def workloads(patch: Patch) -> Any:
    """What is done before files are sent, and who is asked for permission."""
    found: list[Any] = []
    patch.setattr(engine, "check_files", lambda files, config: found.append(["check", files]))
    patch.setattr(engine, "target_arrays", lambda views: views)

    def write(name: str, text: str) -> Any:
        found.append(["write", name, text])
        Path(name).write_text(text)

    patch.setattr(engine, "write_archive", lambda path, views: write(str(path), views))
    for allows, own in ((True, True), (True, False), (False, True), (False, False)):
        problem = SimpleNamespace(config=SimpleNamespace(allows_code=allows), views="views")
        course = SimpleNamespace(problem=problem, files="files", save=lambda folder: write(engine.STATE_FILE, "state"))
        load = engine.workload_of(course, Path(), 3, own)
        found.append([allows, own, load.files, load.arguments, load.threads, load.asks_for_code])
    return found


@case
def connections(patch: Patch) -> Any:
    """What is done in turn, at both kinds of places, if all goes well, if the caller fails, and if nobody answers."""
    import dask
    import distributed

    known, done = atomic.unfinished.copy(), list[Any]()
    patch.setattr(tempfile, "tempdir", os.getcwd())

    class Client:
        def __init__(self, address: Any, **options: Any) -> None:
            own = dask.config.get("distributed.worker.memory.spill", "default") is False
            [folder] = Path().glob("reslrb-cluster-*")
            within = dask.config.get("temporary-directory") == str(folder.absolute())
            done.append(["client", str(address), sorted(options.items(), key=str), own, within])
            if "gone" in str(address):
                raise TimeoutError("nobody")

        def close(self, timeout: float) -> None:
            done.append(["close", timeout, len(list(Path().iterdir()))])

    @contextmanager
    def started(workers: int, folder: Path) -> Iterator[tuple[object, object]]:
        done.append(["start", workers, folder.parent == Path.cwd()])
        yield f"{workers} here", "own"
        done.append("stop")

    patch.setattr(distributed, "Client", Client)
    patch.setattr(connection, "_started", started)
    patch.setattr(connection, "_certificates", lambda: "certificates")
    for place in (
        connection.Cluster(3),
        connection.Cluster(address="tls://a:1"),
        connection.Cluster(address="tls://gone:1"),
    ):
        for fails in (False, True):

            def use(place: Any = place, fails: bool = fails) -> None:
                with connection.connected(place) as (client, folder):
                    done.append(["use", type(client).__name__, folder.is_dir(), folder in atomic.unfinished])
                    if fails:
                        raise ValueError("of the caller")

            done.append(ending(use))
            done.append([os.listdir(), atomic.unfinished == known])
        done.append(ending(place.check))
    levels = [logging.getLogger(name).level for name in ("distributed", "tornado", "asyncio")]
    return done, levels


@case
def threads_of_workers(patch: Patch) -> Any:
    found = []
    for cores in (1, 5, 8):
        patch.setattr(os, "sched_getaffinity", lambda process, cores=cores: set(range(cores)), raising=False)
        found.append([connection.Cluster(workers).threads for workers in (1, 2, 3, 9)])
    return [*found, connection.Cluster(address="tls://a:1").threads]


def worker_of(name: object = 1) -> Any:
    told: list[Any] = []
    return SimpleNamespace(address="tls://here:1", name=name, local_directory=os.getcwd(), plugins={}, told=told,
                           log_event=lambda topic, text: told.append([topic, text]))  # fmt: skip


def length(state: Any, *given: Any) -> Any:
    return [list(state), *given]


def long(state: Any) -> Any:
    return list(state)


class Context:
    """Context that notes the states that take it."""

    def __init__(self, name: str) -> None:
        self.name = name

    def take(self, state: list[Any]) -> None:
        state.append(self.name)
        if self.name == "bad":
            raise ValueError("bad context")


def made_state(folder: Path, threads: int | None, *given: Any) -> Any:
    return [sorted(os.listdir(folder)), threads, *given], {"long": 2.0}


@case
def calls_of_workers(patch: Patch) -> Any:
    """Workloads that are loaded, called with the same and other contexts, of another run, and removed."""
    limits: list[Any] = []
    now = iter(range(1000))
    patch.setattr(calls, "time", SimpleNamespace(perf_counter=lambda: next(now), sleep=lambda seconds: None))
    patch.setattr(calls.threading, "Timer", lambda seconds, act, given: limits.append(seconds) or SimpleNamespace(
        start=lambda: limits.append("start"), cancel=lambda: limits.append("cancel"), daemon=False))  # fmt: skip
    worker = worker_of()
    patch.setattr(calls, "get_worker", lambda: worker)
    workload = calls.Workload({"a": b"1", "b": b"2"}, made_state, ("x",), 3)
    found: list[Any] = [ending(calls.perform, workload.key, b"", length, (1,))]
    worker.plugins["reslrb"] = workload
    for name in ("first", "first", "", "second", "bad", "second", "second"):
        context = pickle.dumps(Context(name)) if name else b""
        found.append([name, ending(calls.perform, workload.key, context, long if name == "first" else length, ())])
    found.append(ending(calls.perform, "another", b"", length, ()))
    folder = workload._folder(worker)
    found.append([folder.name == f"reslrb-{workload.key}", sorted(os.listdir(folder))])
    workload.teardown(worker)
    found += [folder.exists(), limits, worker.told]

    def refused(state: Any) -> None:
        raise ConfigError("c.yaml", "key", "is wrong")

    return [*found, ending(calls.perform, workload.key, b"", refused, ())]


@case
def requirements_of_workers(patch: Patch) -> Any:
    patch.setattr(calls, "versions", lambda: {"mitsuba": "3", "drjit": "1", "other": "2"})
    found = []
    for here in ({}, {"mitsuba": "3"}, {"mitsuba": "4"}, {"gone": "1"}, {"mitsuba": "3", "drjit": "2"}):
        for asks in (False, True):
            for allowed in (None, "0", "1", "true"):
                patch.delenv(calls.ALLOW_CODE, raising=False) if allowed is None else patch.setenv(
                    calls.ALLOW_CODE, allowed
                )
                workload = calls.Workload({}, made_state, versions=here, asks_for_code=asks)
                if here in ({}, {"mitsuba": "4"}) or allowed == "1":
                    found.append([here, asks, allowed, ending(workload.setup, worker_of())])
    return found


@case
def devices_of_workers(patch: Patch) -> Any:
    found = []
    patch.setattr(calls.Path, "glob", lambda self, pattern: ["x", "y"])
    for name in (0, 1, 2, 5, "1", "tls://a:1"):
        for listed in (None, "", "3", "3,7,9"):
            patch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
            if listed is not None:
                patch.setenv("CUDA_VISIBLE_DEVICES", listed)
            calls._take_device(name)
            found.append([name, listed, os.environ.get("CUDA_VISIBLE_DEVICES")])
    return found


@case
def engines(patch: Patch) -> Any:
    """The workers of a client: how they are loaded, called and answered."""
    done: list[Any] = []

    class Future:
        def __init__(self, value: Any) -> None:
            self.value = value

        def result(self) -> Any:
            done.append(["result", self.value])
            return self.value

        def release(self) -> None:
            done.append(["release", self.value])

    def submit(function: Any, key: str, context: bytes, call: Any, given: Any, pure: bool) -> Future:
        done.append(
            [function.__name__, key == workload.key, context and pickle.loads(context), call.__name__, given, pure]
        )
        return Future(str(given))

    client: Any = SimpleNamespace(
        subscribe_topic=lambda topic, act: done.append(["topic", topic]), submit=submit, loop="loop", status="running",
        wait_for_workers=lambda *given, **more: done.append(["wait", given, more]),
        register_plugin=lambda each: done.append(["plugin", each is workload]),
        scheduler_info=lambda **more: {"workers": {"a": 1, "b": 2}},
    )  # fmt: skip
    patch.setattr(calls, "as_completed", lambda places, loop: [*reversed(places)])
    workload = calls.Workload({}, made_state)
    workers = calls.Workers(client, workload, lambda state: f"context of {state}")
    answers = [*workers("s", length, [(1,), (2, 3), ()])]
    return done, answers


@case
def standings_of_problems(patch: Patch) -> Any:
    """Parameters and tables of a problem are taken by another, which applies them last."""
    done: list[Any] = []

    class Optimizer(dict[str, Any]):
        def set_value(self, key: str, value: Any) -> None:
            done.append(["set", key, np.array(value)])

    for guiding in (None, SimpleNamespace(state=lambda: ({"calls": 3}, {"table": np.ones(2)}))):
        for wrong in (None, "other sizes"):
            patch.setattr(engine, "guiding_of", lambda problem, guiding=guiding: guiding)
            patch.setattr(
                engine, "restore_tables", lambda *given, wrong=wrong: done.append(["tables", *given[1:]]) or wrong
            )
            import mitsuba as mi

            problem: Any = SimpleNamespace(optimizer=Optimizer(a=mi.Float(1, 2), b=mi.Color3f(1, 2, 3)),
                                           apply=lambda: done.append("apply"))  # fmt: skip
            standing = engine.Standing.of(problem)
            done.append([standing.values, standing.calls, sorted(standing.learned)])
            done.append(ending(standing.take, problem))
    return done


test_cases = pytest.mark.usefixtures("llvm")(case.test())
