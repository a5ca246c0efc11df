"""What a worker does: it opens an experiment, brings it to where a round of calls has it, and computes calls.

A worker is sent the experiment's files once (`Files`). Its first call makes a state of them (`Opening`), and keeps it.
A call is a function of that state, and of where it stands (`Context`), to a value that can be sent.
"""

from __future__ import annotations

import logging
import os
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from distributed import Worker, WorkerPlugin, get_worker

from reslrb_cli.cluster.bundle import unpack
from reslrb_cli.cluster.connection import cores
from reslrb_cli.errors import (
    ConfigError,
    MachineError,
    OutOfMemory,
    ReslrbError,
    describe,
    is_machine_fault,
    is_out_of_memory,
    one_line,
)
from reslrb_cli.records.manifest import versions


class Context(Protocol):
    """Where the state of all workers is to stand for a call; `digest` tells one from another."""

    @property
    def digest(self) -> str:
        """What tells it from others."""

    def take(self, state: Any) -> None:
        """Bring a worker's state there."""


@dataclass(frozen=True)
class Opening:
    """What workers work on: `function(folder, threads, *arguments)` makes the state of the files in a folder.

    `digest` is that of the files. `threads` is the number of threads of each worker; None: all cores that it may use.
    `asks_for_code`: whether users' own code is to run, on workers that the run has not started itself.
    """

    digest: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    threads: int | None = None
    asks_for_code: bool = False
    versions: Mapping[str, str] = field(default_factory=versions)


class Files(WorkerPlugin):
    """The files of an opening, which dask sends to each worker, also to those that come later."""

    def __init__(self, digest: str, files: Mapping[str, bytes]) -> None:
        self.name = f"reslrb-{secrets.token_hex(8)}"  # of this run alone, which forgets it in the end
        self._digest, self._files = digest, files

    def setup(self, worker: Worker) -> None:
        """Write them into a folder that dask removes with the worker."""
        unpack(self._files, _folder(worker, self._digest))


def _folder(worker: Worker, digest: str) -> Path:
    return Path(worker.local_directory) / f"reslrb-{digest}"


@dataclass
class _State:
    """What a worker works on, the seconds that opening it took, and the digest of where it stands."""

    opening: str
    value: Any
    seconds: float
    stands: str = ""


_state: _State | None = None
_context: Context | None = None

#: In a worker's environment: 1 where users' own code may run there, if whoever runs the experiment allows it, too.
ALLOW_CODE = "RESLRB_ALLOW_CODE"


@dataclass(frozen=True)
class Answer:
    """The value of a call, the seconds that it took to compute, and those that the worker took to open the experiment;
    `worker` is its address."""

    worker: str
    name: str
    value: Any
    seconds: float
    opening_s: float


@dataclass(frozen=True)
class Lacks:
    """What a worker says that does not have the context of a call."""

    worker: str


def keep_context(context: Context) -> None:
    """Have this worker keep the context of the calls that come next."""
    global _context
    _context = context


def perform(opening: Opening, context: str, function: Callable[..., Any], arguments: Sequence[Any]) -> Answer | Lacks:
    """Call `function` with the state, which stands at the context of that digest ("": anywhere), and `arguments`.

    Raises MachineError or OutOfMemory if the machine is at fault; the next call then opens the experiment anew.
    """
    global _state
    worker, threads = get_worker(), opening.threads or cores()
    if context and (_context is None or _context.digest != context):
        return Lacks(worker.address)
    try:
        if _state is None or _state.opening != opening.digest:
            _state = None
            _state = _open(opening, worker, threads)
        if context and _context is not None and _state.stands != context:
            _state.stands = ""
            _context.take(_state.value)
            _state.stands = context
        begin = time.perf_counter()
        value = function(_state.value, *arguments)
        return Answer(worker.address, _name(worker), value, time.perf_counter() - begin, _state.seconds)
    except Exception as error:
        if is_out_of_memory(error):
            _state = None
            raise OutOfMemory(one_line(str(error))) from None
        if isinstance(error, MachineError | OSError) or is_machine_fault(error):
            _state = None
            raise MachineError(one_line(str(error))) from None
        if isinstance(error, ConfigError):  # which cannot be pickled
            raise ReslrbError(str(error)) from None
        raise


def _open(opening: Opening, worker: Worker, threads: int) -> _State:
    begin, here, name = time.perf_counter(), versions(), _name(worker)
    for package, version in opening.versions.items():
        if here.get(package) != version:
            wrong = f"has {package} {here.get(package)}, and the run {version}: install the same"
            raise MachineError(f"{name} {wrong}")
    if opening.asks_for_code and os.environ.get(ALLOW_CODE) != "1":
        raise MachineError(f"{name} runs no code of users' own: start it with {ALLOW_CODE}=1 in its environment")
    _take_device(worker.name)
    logging.getLogger("reslrb_cli").addHandler(logging.NullHandler())  # the run has said what there is to say
    try:
        value = opening.function(_folder(worker, opening.digest), threads, *opening.arguments)
    except Exception as error:  # the run could load it: it is this machine that cannot
        if is_out_of_memory(error):
            raise
        raise MachineError(f"{name} cannot open the experiment: {describe(error)}") from None
    return _State(opening.digest, value, time.perf_counter() - begin)


def _name(worker: Worker) -> str:
    host = worker.address.rpartition(":")[0].removeprefix("tls://")
    return f"worker {worker.name} ({host})"


def _take_device(name: object) -> None:
    """Of the GPUs that this machine shows have a worker that is known by its number see one alone, in turn."""
    listed = os.environ.get("CUDA_VISIBLE_DEVICES")
    found = listed.split(",") if listed else [str(k) for k, _ in enumerate(Path("/proc/driver/nvidia/gpus").glob("*"))]
    if isinstance(name, int) and len(found) > 1:
        os.environ["CUDA_VISIBLE_DEVICES"] = found[name % len(found)]
