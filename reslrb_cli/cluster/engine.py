"""Shards on workers of dask.distributed: what is sent to them, what they do with it, and the engine that sends it.

dask starts the workers, hands out tasks, tries those again that a worker has died of, and starts another in its place.
A task is a pure function of an experiment (files, by their digest), where its parameters and tables stand (`Standing`),
a shard and its dL/dI, to NumPy arrays: which worker computes it, how often, and how many there are, is nothing to it.
Optimiser, checkpoint and page stay where `optimize` runs.

Imports dask: for those that `--cluster` has asked for it.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import dask
import drjit as dr
import numpy as np
from distributed import CancelledError, Client, Future, KilledWorker, LocalCluster, as_completed
from distributed.comm import CommClosedError

from reslrb_cli.backend.variant import set_variant
from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ConfigError, MachineError, ReslrbError
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.optimization.autotune.estimators import find_options
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.shards import shard_gradient, shard_image
from reslrb_cli.optimization.state import Settled, begin_as, decide_as, guiding_of, restore_tables
from reslrb_cli.optimization.views import set_targets, target_arrays
from reslrb_cli.records.checkpoint import STATE_FILE, open_state, write_archive
from reslrb_cli.records.manifest import versions
from reslrb_cli.records.tree import Stored, like, to_array
from reslrb_cli.runs.prepare import Course, digests

logger = logging.getLogger(__name__)

Array = np.ndarray[Any, Any]
T = TypeVar("T")

#: What a worker is asked for, by name: names are sent, and no functions.
FUNCTIONS: dict[str, Callable[..., Any]] = {"image": shard_image, "gradient": shard_gradient}

TARGETS_FILE = "targets.npz"

#: How often what is lost with workers is sent, and seconds until one of them has to be there.
ATTEMPTS, WAIT = 30, 60

#: dask's settings. A task may have been on as many workers that died before it is given up; a worker that is not heard
#: of for so long is replaced, and has to come to the end of its longest compilation before.
SETTINGS = {
    "distributed.scheduler.allowed-failures": 30,
    "distributed.scheduler.worker-ttl": "30 minutes",
    "distributed.comm.timeouts.connect": "60s",
    "distributed.admin.tick.limit": "1h",
    "distributed.admin.large-graph-warning-threshold": "1TB",  # dL/dI is part of a task
    # No pages, nor anything else that answers to who is not one of them.
    "distributed.scheduler.http.routes": [],
    "distributed.worker.http.routes": [],
    # Ctrl-C goes to all processes of a terminal: the run ends after its iteration, for which it needs its workers.
    "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
}


@dataclass(frozen=True)
class Experiment:
    """What a run's workers assemble it from: the files in `folder`, by their `digest`; the `versions` that the run has,
    the threads of a worker, and whether it may run code of the user's own, as the run may."""

    folder: str
    digest: str
    versions: dict[str, str]
    threads: int
    allow_code: bool


@dataclass(frozen=True)
class Standing:
    """Where a step's parameters and tables stand: values as the optimiser has them, and what guided emission has
    learned (`Guiding.state`); `digest` is of both."""

    digest: str
    values: dict[str, Array]
    calls: dict[str, int]
    learned: dict[str, Array]

    @staticmethod
    def of(problem: Problem) -> Standing:
        """That of a problem now."""
        guiding = guiding_of(problem)
        calls, learned = ({}, {}) if guiding is None else guiding.state()
        keys = problem.optimizer.keys()
        values = {key: to_array(problem.optimizer[key]) for key in keys}
        return Standing(_digest(repr(calls), values, learned), values, dict(calls), learned)

    def take(self, problem: Problem) -> None:
        """Bring a problem there."""
        for key, value in self.values.items():
            problem.optimizer.set_value(key, like(dr.detach(problem.optimizer[key]), value))
        wrong = restore_tables(problem, self.calls, self.learned)
        if wrong is not None:
            raise MachineError(f"a worker has other tables of guided emission than the run: {wrong}")
        problem.apply()


def _digest(text: str, *mappings: Mapping[str, Array]) -> str:
    found = hashlib.blake2b(text.encode(), digest_size=16)
    for mapping in mappings:
        for key, array in mapping.items():
            found.update(f"{key} {array.dtype} {array.shape}".encode())
            found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()


# --- on a worker ------------------------------------------------------------------------------------------------------


@dataclass
class _Open:
    """The problem of the experiment that a worker is at, and where it stands."""

    experiment: Experiment
    problem: Problem
    standing: str = ""


_open: _Open | None = None


def compute(experiment: Experiment, standing: Standing, name: str, task: Any, *given: Any) -> Any:
    """What one of FUNCTIONS says of a task; its first call in a process assembles the experiment.

    Raises MachineError and ReslrbError, with what `optimize` says.
    """
    global _open
    if _open is None or _open.experiment != experiment:
        try:
            _open = _Open(experiment, _assembled(experiment))
        except ConfigError as error:
            raise ReslrbError(str(error)) from None  # which can be sent
    if _open.standing != standing.digest:
        _open.standing = ""
        standing.take(_open.problem)
        _open.standing = standing.digest
    return FUNCTIONS[name](_open.problem, task, *given)


def _assembled(experiment: Experiment) -> Problem:
    """The problem as the run has it, with its targets and what it has settled, from the experiment's files."""
    here = versions()
    for name, version in experiment.versions.items():
        if here.get(name) != version:
            raise MachineError(f"a worker has {name} {here.get(name)}, the run {version}; take the same")
    logging.getLogger("reslrb_cli").addHandler(logging.NullHandler())  # the run has said what there is to say
    folder = Path(experiment.folder)
    if files_digest(folder) != experiment.digest:
        raise MachineError(f"{folder}: is another experiment than the run's")
    archive, values = open_state(folder / STATE_FILE)
    with contextlib.closing(archive), np.load(folder / TARGETS_FILE) as targets:
        stored = Stored(archive, values)
        settled = stored.read(Settled)
        set_variant(settled.variant)
        config = loads(settled.config, folder / "config.yaml").with_code(experiment.allow_code)
        here = digests(config)
        for key in config.codes:
            if here.get(key) != settled.files.get(key):
                raise ConfigError(config.source, key, "has changed since the run began; put it back, or begin anew")
        problem = assemble_scene(config)
        begin_as(problem, stored)
        problem = decide_as(problem, stored, find_options(problem))
        set_targets(problem.views, dict(targets))
    dr.sync_thread()
    dr.set_thread_count(experiment.threads)
    return problem


# --- where `optimize` runs --------------------------------------------------------------------------------------------


def files_digest(folder: Path) -> str:
    """The digest of an experiment's files."""
    found = hashlib.blake2b(digest_size=16)
    for name in (STATE_FILE, TARGETS_FILE):
        found.update((folder / name).read_bytes())
    return found.hexdigest()


def write_experiment(course: Course, folder: Path, threads: int) -> Experiment:
    """Put what workers need of a run into `folder`. Raises OSError."""
    course.save(folder)
    write_archive(folder / TARGETS_FILE, target_arrays(course.problem.views))
    return Experiment(str(folder), files_digest(folder), versions(), threads, course.problem.config.allows_code)


class Engine:
    """Computes shards on the workers of a client (`shards.Engine`)."""

    def __init__(self, client: Client, experiment: Experiment) -> None:
        self._client, self._experiment = client, experiment
        self._now: tuple[str, Future] | None = None

    def __call__(
        self, problem: Problem, function: Callable[..., Any], work: Sequence[tuple[Any, ...]]
    ) -> Iterator[tuple[int, Any]]:
        """Yields place and result of each task as they come, and raises what a task raised.

        What has died with a worker, and is nowhere else, is sent again. Raises MachineError where that goes on.
        """
        name = next(name for name, each in FUNCTIONS.items() if each is function)
        standing, left = Standing.of(problem), dict(enumerate(work))
        for attempt in range(ATTEMPTS):
            time.sleep(min(0.1 * attempt, 2.0))  # until it is noticed which workers have ended
            futures = self._submit(name, standing, left)
            for future in as_completed(list(futures)):
                found, result = _result_of(future)
                if found:
                    del left[futures[future]]
                    yield futures[future], result
            if not left:
                return
            self._now = None
        raise MachineError(f"--cluster: worker after worker ended; shards without a result: {len(left)}")

    def _submit(self, name: str, standing: Standing, left: Mapping[int, tuple[Any, ...]]) -> dict[Future, int]:
        """Send the tasks; returns the place of each one's future.

        All that they need is part of a task: what is only put on a worker (`Client.scatter`) is gone when that ends,
        and to put it on one that is just ending may wait for ever.
        """
        try:
            self._client.wait_for_workers(1, timeout=WAIT)
        except TimeoutError:
            raise MachineError(f"--cluster: no worker was there for {WAIT} seconds") from None
        if self._now is None or self._now[0] != standing.digest:
            self._now = standing.digest, self._client.submit(_given, standing, pure=False)
        # In turns: by itself dask would send all to the worker that has `standing`.
        workers = sorted(self._client.nthreads())
        sent = [self._experiment, self._now[1], name]
        return {
            self._client.submit(
                compute, *sent, *given, pure=False, workers=workers[place % len(workers)] if workers else None,
                allow_other_workers=bool(workers),
            ): place
            for place, given in left.items()
        }  # fmt: skip


def _given(value: T) -> T:
    """What is sent to one worker, for the others to have it from there, or from whichever is sent it again."""
    return value


def _result_of(future: Future) -> tuple[bool, Any]:
    """Whether there is a result, and what it is. Raises what the task did."""
    try:
        return True, future.result()
    except (KilledWorker, CancelledError, CommClosedError):
        return False, None
    finally:
        future.release()


@contextlib.contextmanager
def local_engine(course: Course, workers: int, threads: int | None = None) -> Iterator[Engine]:
    """Workers in processes of their own on this machine, each with so many threads, its share of the cores by default.

    Nobody else can connect: certificates are made for this run alone. Raises MachineError where none can be started.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="reslrb-cluster-")))
        experiment = write_experiment(course, folder, threads or max(cores // workers, 1))
        stack.enter_context(dask.config.set(SETTINGS))
        try:
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, security=True, protocol="tls://",
                dashboard_address="127.0.0.1:0", scheduler_kwargs={"dashboard": False},
                silence_logs=logging.CRITICAL, local_directory=str(folder),
            )  # fmt: skip
            stack.enter_context(cluster)
            client = stack.enter_context(Client(cluster))
        except (OSError, RuntimeError, TimeoutError) as error:
            raise MachineError(f"--cluster: no workers could be started: {error}") from None
        logger.info(f"{workers} workers, {experiment.threads} threads each")
        yield Engine(client, experiment)
