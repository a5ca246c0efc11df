"""Child processes (`Child`), and workers that take measurements, from outside (`Process`) and from inside (`run`).

`Process` and `run` exchange dictionaries over a connection. The first one describes the case. The worker answers when
the case is loaded. Each later one is a question. The last lines of a worker's output explain a crash. The end of a
worker is detected and reported, and does not end the measurement.
"""

from __future__ import annotations

import contextlib
import importlib
import logging.handlers
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any

from reslrb_cli.backend.doctor import of_system
from reslrb_cli.config.files import tail
from reslrb_cli.errors import BackendError, ConfigError, ReslrbError, is_out_of_memory, mentions_memory
from reslrb_cli.records.measurements import BenchStatus

POLL_SECONDS = 0.05

#: Maximum wait for the end of a killed process, which may still be writing into its folder.
ABANDON_SECONDS = 5.0

#: If a process crashes with this much of its limit in use, the limit is taken as the cause. The last reading is from
#: before the end, and memory grows from half of a limit to all of it in microseconds.
CLOSE_TO_LIMIT = 0.25

#: Signals that end a program that continues after a failed allocation.
_CRASHES = (signal.SIGSEGV, signal.SIGABRT, signal.SIGBUS)


class Ended(Exception):
    """A process ended before it answered. `status` and `reason` say how."""

    def __init__(self, status: BenchStatus | str, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = BenchStatus(status), reason


class Stopped(Exception):
    """The user wants to stop."""


class CannotStart(ReslrbError):
    """A process could not start. The reason holds for all processes."""

    def __init__(self, line: str, exit_code: int) -> None:
        super().__init__(line)
        self.exit_code = exit_code  # type: ignore[assignment]


#: Environment variables with the folders of caches, which a `fresh` process does not share.
CACHES = ("DRJIT_CACHE_DIR", "OPTIX_CACHE_PATH", "RESLRB_CACHE")


class Child:
    """A child process in its own session, so that only this process handles Ctrl-C.

    Its output goes to a file in a temporary folder. `environment` has further variables. A `fresh` process has no
    cached kernels or decisions. `options` are those of `subprocess.Popen`.
    """

    def __init__(
        self, command: Sequence[str], environment: Mapping[str, str] = {}, fresh: bool = False, **options: Any
    ) -> None:
        with _making:
            self._folder = tempfile.TemporaryDirectory(prefix="reslrb-", ignore_cleanup_errors=True)
            caches = dict.fromkeys(CACHES, self._folder.name) | {"CUDA_CACHE_DISABLE": "1"} if fresh else {}
            self._output = Path(self._folder.name, "output")
            with self._output.open("wb") as output:
                self.process = subprocess.Popen(
                    command, stdout=output, stderr=output, start_new_session=True,
                    env={**os.environ, **environment, **caches}, **options,
                )  # fmt: skip
            _at_work.append(self)

    def tail(self, most: int) -> str:
        """Return the end of the output, at most `most` bytes."""
        with self._output.open("rb") as output:
            return tail(output, most).decode(errors="replace")

    def memory(self, kind: str) -> int:
        """Return the memory of the process in bytes, or 0 if it is unknown. `kind` is as in /proc: `VmRSS` is the
        memory now, `VmHWM` the largest so far, and `VmPeak` the largest address space.
        """
        found = of_system(f"/proc/{self.process.pid}/status", kind)
        return int(found.removesuffix(" kB")) * 1024 if found else 0

    def close(self) -> None:
        """End the process and remove its files."""
        self.process.kill()
        self.process.wait()
        if self.process.stdin is not None:
            self.process.stdin.close()
        self._folder.cleanup()
        if self in _at_work:
            _at_work.remove(self)


class Process(Child):
    """One worker. `first` is the first message to the worker, including `memory_limit` (bytes, or None).

    The command gets the descriptor of the worker's connection as its last argument.
    """

    def __init__(self, first: dict[str, Any], command: list[str]) -> None:
        self.limit: int | None = first["memory_limit"]
        self.peak_bytes = 0  # of address space
        self._connection, theirs = Pipe()
        with theirs:
            place = theirs.fileno()
            super().__init__([*command, str(place)], fresh=True, stdin=subprocess.DEVNULL, pass_fds=[place])
        self.ask(first)

    def ask(self, question: dict[str, Any]) -> None:
        """Send a message. `answer` reports if the process has ended."""
        with contextlib.suppress(OSError):
            self._connection.send(question)

    def answer(self, stop: Callable[[], bool]) -> dict[str, Any]:
        """Wait for the next answer. Raises Ended or CannotStart. Raises Stopped after `stop()`."""
        while True:
            if stop():
                raise Stopped
            self.peak_bytes = max(self.peak_bytes, self.memory("VmPeak"))
            if self._connection.poll(POLL_SECONDS):
                break
        try:
            answer: dict[str, Any] = self._connection.recv()
        except (EOFError, OSError):
            raise Ended(*self._end()) from None
        if answer.get("failure") == "refused":
            raise CannotStart(answer["reason"], answer["exit_code"])
        if "failure" in answer:
            raise Ended(answer["failure"], answer["reason"])
        return answer

    def close(self) -> None:
        """End the process, and remove its files."""
        self._connection.close()
        super().close()

    def _end(self) -> tuple[BenchStatus, str]:
        code, text = self.process.wait(), self.tail(1 << 20)
        words, name = last_words(text), signal.Signals(-code).name if code < 0 else f"exit code {code}"
        reason = f"ended by {name}" + (f": {words}" if words else "")
        close = self.limit is not None and self.peak_bytes >= CLOSE_TO_LIMIT * self.limit
        if close:
            reason += f" ({self.peak_bytes >> 20} of {self.limit >> 20} MiB seen in use)"  # type: ignore[operator]
        memory = code == -signal.SIGKILL or mentions_memory(text) or (close and -code in _CRASHES)
        return (BenchStatus.OUT_OF_MEMORY if memory else BenchStatus.FAILED), reason


#: Processes that are not closed.
_at_work: list[Child] = []

#: Held while a process is created, and after `abandon_all`.
_making = threading.Lock()


def abandon_all() -> None:
    """End all processes and remove their folders when the program ends. Can be called from any thread.

    No process can be started afterwards.
    """
    _making.acquire(timeout=ABANDON_SECONDS)
    for child in list(_at_work):
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.process.kill()
            child.process.wait(timeout=ABANDON_SECONDS)
        shutil.rmtree(child._folder.name, ignore_errors=True)


def last_words(text: str) -> str:
    """Return the most informative line of a process's standard error: Dr.Jit's `>>>` line, or the last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    marked = [line for line in lines if line.startswith(">>>")]
    return (marked[-1].lstrip("> ") if marked else lines[-1] if lines else "")[:300]


# --- inside a worker ------------------------------------------------------------------------------------------------

#: A started case: its first message, and the function that answers each question.
Begun = tuple[dict[str, Any], Callable[[dict[str, Any]], dict[str, Any]]]


def _serve(first: dict[str, Any], module: str, connection: Connection) -> None:
    os.environ["HOME"] = os.environ["DRJIT_CACHE_DIR"]  # a cold step must find no compiled kernels
    from reslrb_cli.backend.variant import set_variant

    set_variant(first["variant"])

    begin = importlib.import_module(module).begin
    # Set late, because a library without memory looks like a missing one.
    _limit(first["memory_limit"])
    # All workers load the same scene, so their warnings are sent, and printed once.
    warnings = logging.handlers.BufferingHandler(10_000)
    warnings.setLevel(logging.WARNING)
    logging.getLogger("reslrb_cli").addHandler(warnings)
    opening, answer_to = begin(first)
    connection.send(opening | {"warnings": [record.getMessage() for record in warnings.buffer]})
    while True:
        try:
            question = connection.recv()
        except (EOFError, OSError):  # the other side has closed the connection
            return
        connection.send(answer_to(question))


def _limit(memory_limit: int | None) -> None:
    """Limit the address space of the whole process to `memory_limit` bytes. A lower hard limit takes precedence."""
    if memory_limit is not None:
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_AS)
        limit = memory_limit if most == resource.RLIM_INFINITY else min(memory_limit, most)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


#: The C++ library's message if a thread cannot be created, because the limit leaves no address space for its stack.
_NO_THREAD = "Resource temporarily unavailable"


def _failure(error: Exception, limited: bool) -> dict[str, Any]:
    words = " ".join(str(error).split())
    memory = is_out_of_memory(error) or mentions_memory(words)  # also as the cause of another error
    memory = memory or (limited and _NO_THREAD in words)
    refused = isinstance(error, ConfigError | BackendError) and not memory
    return {
        "failure": "refused" if refused else "out_of_memory" if memory else "failed",
        "reason": words if refused else f"{type(error).__name__}: {words}"[:400],
        "exit_code": int(getattr(error, "exit_code", 1)),
    }


def run(module: str) -> None:
    """Answer questions until the connection closes or a failure occurs, then end the process. The last answer describes
    a failure. The function `begin` of the `module` starts the case, and returns `Begun` for the first message.
    """
    connection, limited, code = Connection(int(sys.argv[-1])), False, 0
    try:
        first = connection.recv()
        limited = first["memory_limit"] is not None
        _serve(first, module, connection)
    except Exception as error:
        connection.send(_failure(error, limited))
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # the remaining cleanup may take long, or fail if memory is exhausted
