"""The workers' side: a worker loads an `Opening`, sets the `Context` of a round of calls, and executes calls.

An opening contains files, which are sent once, and a function that builds a state from them. The worker keeps this
state. A call is a function of the state and its context. Its value must be serialisable.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from distributed import get_worker

from reslrb_cli.cluster.bundle import unpack
from reslrb_cli.errors import (
    ConfigError,
    MachineError,
    ReslrbError,
    describe,
    is_machine_fault,
    is_out_of_memory,
    one_line,
)
from reslrb_cli.records.manifest import versions


class Context(Protocol):
    """The context that all workers set in their state before a call."""

    @property
    def digest(self) -> str:
        """A digest of the context."""

    def take(self, state: Any) -> None:
        """Set this context in a worker's state."""


@dataclass(frozen=True)
class Anywhere:
    """The `Context` of calls that depend only on their arguments."""

    digest: str = "anywhere"

    def take(self, state: Any) -> None:
        """Leave the state unchanged."""


@dataclass(frozen=True)
class Opening:
    """The data from which a worker builds its state. `function(folder, threads, *arguments)` builds the state from the
    files in a folder.

    The function returns the state. The function also returns the seconds per call, by name, for each function with
    compiled kernels. `digest` is the digest of the files. `asks_for_code` is true if users' own code must run and the
    workers do not belong to this run.
    """

    digest: str
    function: Callable[..., tuple[Any, dict[str, float]]]
    arguments: tuple[Any, ...] = ()
    asks_for_code: bool = False
    versions: Mapping[str, str] = field(default_factory=versions)


@dataclass
class _WorkerState:
    """The state of a worker, and the digest of its context."""

    opening: str
    value: Any
    stands: str = ""


_state: _WorkerState | None = None

#: Environment variable of a worker: 1 allows users' own code there, if the experiment's user allows it, too.
ALLOW_CODE = "RESLRB_ALLOW_CODE"


@dataclass(frozen=True)
class Reply:
    """A worker's answer; `worker` is its address."""

    worker: str


@dataclass(frozen=True)
class Answer(Reply):
    """The value of a call, and the seconds of its computation."""

    value: Any
    seconds: float


@dataclass(frozen=True)
class Lacks(Reply):
    """The data that a worker lacks: the opening's `files`, the `opening` itself, or the `context`."""

    what: str


@dataclass(frozen=True)
class Fault(Reply):
    """A failure of a worker's machine. `memory` is True if no memory is left. `stays` is True if a restart of the
    worker does not help.
    """

    text: str
    memory: bool = False
    stays: bool = False


def open_state(opening: Opening, files: Mapping[str, bytes] | None, threads: int) -> Reply:
    """Load an opening in this worker."""
    global _state
    begin, me = time.perf_counter(), get_worker().address
    here = versions()
    for name, version in opening.versions.items():
        if here.get(name) != version:
            return Fault(
                me, f"has {name} {here.get(name)}, but the run has {version}: install the same version", stays=True
            )
    if opening.asks_for_code and os.environ.get(ALLOW_CODE) != "1":
        return Fault(me, f"does not run users' own code: start it with {ALLOW_CODE}=1 in its environment", stays=True)
    folder = Path(get_worker().local_directory) / f"reslrb-{opening.digest}"  # dask removes it with the worker
    if files is None and not folder.is_dir():
        return Lacks(me, "files")
    _state = None
    _take_device(get_worker().name)
    logging.getLogger("reslrb_cli").addHandler(logging.NullHandler())  # the run has reported it already
    try:
        unpack(files or {}, folder)
        value, seconds = opening.function(folder, threads, *opening.arguments)
    except Exception as error:  # the run could load it, so the fault is on this machine
        return Fault(me, f"cannot: {describe(error)}", is_out_of_memory(error))
    _state = _WorkerState(opening.digest, value)
    return Answer(me, seconds, time.perf_counter() - begin)


def _take_device(name: object) -> None:
    """Limit a worker whose name is a number to one GPU of its machine. Consecutive numbers use the GPUs in turn."""
    listed = os.environ.get("CUDA_VISIBLE_DEVICES")
    found = listed.split(",") if listed else [str(k) for k, _ in enumerate(Path("/proc/driver/nvidia/gpus").glob("*"))]
    if isinstance(name, int) and len(found) > 1:
        os.environ["CUDA_VISIBLE_DEVICES"] = found[name % len(found)]


def stand(opening: str, context: Context) -> Reply:
    """Set the context of the state."""
    begin, me = time.perf_counter(), get_worker().address
    if _state is None or _state.opening != opening:
        return Lacks(me, "opening")
    if _state.stands != context.digest:
        _state.stands = ""
        try:
            context.take(_state.value)
        except Exception as error:
            return _fault(error)
        _state.stands = context.digest
    return Answer(me, None, time.perf_counter() - begin)


def perform(opening: str, context: str, function: Callable[..., Any], arguments: Sequence[Any]) -> Reply:
    """Set `context`, call `function` with the state and `arguments`, and return the function's value."""
    begin, me = time.perf_counter(), get_worker().address
    if _state is None or _state.opening != opening:
        return Lacks(me, "opening")
    if _state.stands != context:
        return Lacks(me, "context")
    try:
        return Answer(me, function(_state.value, *arguments), time.perf_counter() - begin)
    except Exception as error:
        return _fault(error)


def _fault(error: Exception) -> Fault:
    """Return the failure of a worker's machine. Raises other errors of a call in a form that can be sent to another
    process.
    """
    me = get_worker().address
    if is_out_of_memory(error):
        return Fault(me, one_line(str(error)), memory=True)
    if isinstance(error, MachineError | OSError) or is_machine_fault(error):
        return Fault(me, one_line(str(error)))
    if isinstance(error, ConfigError):
        raise ReslrbError(str(error)) from None
    raise error


def whereabouts() -> tuple[str, tuple[int, ...]]:
    """Return this process's machine, and the cores that it may use."""
    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(os.cpu_count() or 1)
    return os.uname().nodename, tuple(sorted(cores))
