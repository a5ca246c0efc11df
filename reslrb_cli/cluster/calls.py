"""Calls on the workers of a dask scheduler: the side of the run (`Workers`), and the side of a worker (`Workload`).

A worker loads a `Workload` in its first call, and computes calls. A call is a function of the state that the worker has
loaded, and of its arguments. Its value must be serialisable.

dask distributes the calls, repeats the calls of workers that end, and restarts workers. If the machine of a worker
fails, or a call takes too long, the worker ends its process. A call during which several workers end is given up
(`distributed.scheduler.allowed-failures`). So is a scheduler without workers (`no-workers-timeout`).

All messages pass through the scheduler, so no direct connection to a worker is needed.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import secrets
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from distributed import CancelledError, Client, KilledWorker, Worker, WorkerPlugin, as_completed, get_worker
from distributed.comm import CommClosedError
from distributed.scheduler import NoWorkerError

from reslrb_cli.cluster.connection import NOBODY_S
from reslrb_cli.errors import ConfigError, MachineError, ReslrbError, describe, is_machine_fault, is_out_of_memory
from reslrb_cli.records.manifest import versions

logger = logging.getLogger(__name__)


# --- on a worker ------------------------------------------------------------------------------------------------------

#: Environment variable of a worker: 1 allows users' own code there, if the experiment's user allows it, too.
ALLOW_CODE = "RESLRB_ALLOW_CODE"

#: dask's topic for the reason why a worker ends its process, and the seconds to send the reason.
TOPIC, SEND_S = "reslrb", 2.0

#: Time limit of a call, in seconds: `COLD_S` while kernels are compiled. Afterwards, `CALL_S`, plus a multiple of the
#: longest call of the same function, plus the time to load the experiment.
COLD_S, CALL_S, TIMES = 900.0, 10.0, 10.0


class _Loaded(NamedTuple):
    """The state of a worker, the time to load it, and the longest call of each function with compiled kernels."""

    state: Any
    loading_s: float
    longest: dict[str, float]


@dataclass(eq=False)
class Workload(WorkerPlugin):
    """The data from which every worker builds an equal state. dask sends it to each worker once.

    `function(folder, threads, *arguments)` builds the state from `files`, which are in `folder`. It also returns the
    seconds per call, by name, for each function with compiled kernels. If `threads` is None, a worker uses all cores
    that it may use. `asks_for_code` is true if users' own code must run and the workers do not belong to this run.
    """

    files: Mapping[str, bytes]
    function: Callable[..., tuple[Any, dict[str, float]]]
    arguments: tuple[Any, ...] = ()
    threads: int | None = None
    asks_for_code: bool = False
    versions: Mapping[str, str] = field(default_factory=versions)
    key: str = field(default_factory=lambda: secrets.token_hex(8))

    name = "reslrb"  # a new workload replaces the workers' previous one
    _loaded: _Loaded | None = field(default=None, init=False)
    _context: bytes = field(default=b"", init=False)

    def setup(self, worker: Worker) -> None:
        """Raise MachineError if this worker cannot take part."""
        here = versions()
        for name, version in self.versions.items():
            if here.get(name) != version:
                wrong = f"has {name} {here.get(name)}, but the run has {version}: install the same version"
                raise MachineError(f"{_name(worker)} {wrong}")
        if self.asks_for_code and os.environ.get(ALLOW_CODE) != "1":
            wrong = f"does not run users' own code: start it with {ALLOW_CODE}=1 in its environment"
            raise MachineError(f"{_name(worker)} {wrong}")

    def teardown(self, worker: Worker) -> None:
        """Remove the files."""
        shutil.rmtree(self._folder(worker), ignore_errors=True)

    def _folder(self, worker: Worker) -> Path:
        return Path(worker.local_directory) / f"reslrb-{self.key}"  # dask removes it with the worker

    def call(self, worker: Worker, context: bytes, function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
        """Call `function` with the state and `arguments`. `context` is a pickled object whose method `take(state)` sets
        the part of the state that changes from round to round. An empty `context` changes nothing.
        """
        loaded, name = self._loaded or self._load(worker), function.__name__
        state, loading_s, longest = loaded
        limit_s = CALL_S + TIMES * longest[name] + loading_s if name in longest else COLD_S
        begin = time.perf_counter()
        with _guarded(worker, limit_s):
            if context not in (b"", self._context):
                self._context = b""
                pickle.loads(context).take(state)
                self._context = context
            value = function(state, *arguments)
        if name in longest:
            longest[name] = max(longest[name], time.perf_counter() - begin)
        return value

    def _load(self, worker: Worker) -> _Loaded:
        self.setup(worker)
        begin = time.perf_counter()
        _take_device(worker.name)
        logging.getLogger("reslrb_cli").addHandler(logging.NullHandler())  # the run has reported it already
        try:
            with _guarded(worker, COLD_S):
                folder = self._folder(worker)
                folder.mkdir(exist_ok=True)
                for file, data in self.files.items():
                    (folder / file).write_bytes(data)
                state, longest = self.function(folder, self.threads, *self.arguments)
        except Exception as error:
            raise MachineError(f"{_name(worker)} cannot load the experiment: {describe(error)}") from None
        self._loaded = _Loaded(state, time.perf_counter() - begin, longest)
        return self._loaded


def perform(key: str, context: bytes, function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """Compute a call of the workload with this key."""
    worker = get_worker()
    workload = worker.plugins.get(Workload.name)
    if not isinstance(workload, Workload) or workload.key != key:
        raise MachineError(f"{_name(worker)} lacks the experiment; another run may use it")
    try:
        return workload.call(worker, context, function, arguments)
    except ConfigError as error:  # cannot be sent to another process
        raise ReslrbError(str(error)) from None


@contextlib.contextmanager
def _guarded(worker: Worker, seconds: float) -> Iterator[None]:
    """End this process if the block takes longer, or if the machine fails in it."""
    timer = threading.Timer(seconds, _end, (worker, f"did not finish a call within {seconds:.0f} s"))
    timer.daemon = True
    timer.start()
    try:
        yield
    except Exception as error:
        if is_out_of_memory(error) or isinstance(error, OSError) or is_machine_fault(error):
            _end(worker, f"failed: {describe(error)}")
        raise
    finally:
        timer.cancel()


def _end(worker: Worker, reason: str) -> None:
    """Report the reason, and end this process. dask's nanny starts another one."""
    worker.log_event(TOPIC, f"{_name(worker)} {reason}; it is restarted")
    time.sleep(SEND_S)
    os._exit(1)


def _name(worker: Worker) -> str:
    return f"worker {worker.name} ({worker.address.rpartition(':')[0].removeprefix('tls://')})"


def _take_device(name: object) -> None:
    """Limit a worker whose name is a number to one GPU of its machine. Consecutive numbers use the GPUs in turn."""
    listed = os.environ.get("CUDA_VISIBLE_DEVICES")
    found = listed.split(",") if listed else [str(k) for k, _ in enumerate(Path("/proc/driver/nvidia/gpus").glob("*"))]
    if isinstance(name, int) and len(found) > 1:
        os.environ["CUDA_VISIBLE_DEVICES"] = found[name % len(found)]


def _load(state: object) -> None:
    """Call that only lets a worker load the workload."""


# --- in the process of the run ----------------------------------------------------------------------------------------


class Workers:
    """The workers of a client, as an `Engine` of `shards.py`.

    `context_of` returns the context of the calls (`Workload.call`) for the state of this process. Raises MachineError
    if there are no workers, or if one cannot load the workload.
    """

    def __init__(
        self, client: Client, workload: Workload, context_of: Callable[[Any], Any]
    ) -> None:  # fmt: skip
        self._client, self._key, self._context_of = client, workload.key, context_of
        client.subscribe_topic(TOPIC, lambda event: logger.warning(f"--cluster: {event[1]}"))
        with self._explained():
            client.wait_for_workers(1, timeout=NOBODY_S)
            client.register_plugin(workload)
            loads = [()] * len(client.scheduler_info(n_workers=-1)["workers"])
            for _ in self._answers(_load, loads, b""):
                pass

    def __call__(
        self, state: Any, function: Callable[..., Any], work: Sequence[tuple[Any, ...]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the index and the value of each call as soon as the answer arrives.

        Raises the errors of calls. Raises MachineError if workers fail repeatedly, or if there are no workers.
        """
        context = pickle.dumps(self._context_of(state))
        with self._explained():
            yield from self._answers(function, work, context)

    def _answers(
        self, function: Callable[..., Any], work: Sequence[tuple[Any, ...]], context: bytes
    ) -> Iterator[tuple[int, Any]]:
        places = {
            self._client.submit(perform, self._key, context, function, given, pure=False): place
            for place, given in enumerate(work)
        }
        for future in as_completed(places, loop=self._client.loop):
            yield places[future], future.result()
            future.release()

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Raise failures of workers and of the scheduler as MachineError."""
        try:
            yield
        except KilledWorker as error:
            count, last = error.allowed_failures + 1, error.last_worker.address
            text = f"the same call ended {count} workers, the last one at {last}; see their warnings and memory limits"
            raise MachineError(f"--cluster: {text}") from None
        except (NoWorkerError, TimeoutError):
            raise MachineError(f"--cluster: no worker within {NOBODY_S} s") from None
        except MachineError as error:
            raise MachineError(f"--cluster: {error}") from None
        except Exception as error:
            if isinstance(error, CancelledError | CommClosedError) or self._client.status != "running":
                raise MachineError("--cluster: the scheduler has ended; --resume continues the run") from None
            raise
