"""Worker processes that take measurements, from outside (`Process`) and from inside (`run`).

`Process` and `run` exchange JSON objects, one per line, by the standard input and output of the worker. The first
object describes the case. The worker answers when the case is loaded. Each later object asks for one step. Other
output of a worker goes to standard error. The end of a worker is detected and reported, and does not end the
measurement.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import logging.handlers
import os
import re
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

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


class Process:
    """One worker. `first` is the first message to the worker, including `memory_limit` (bytes, or None)."""

    def __init__(self, first: dict[str, Any], command: list[str]) -> None:
        self.limit: int | None = first["memory_limit"]
        self.peak_bytes = 0  # of address space
        self._buffer = b""
        with _making:
            self._folder = tempfile.TemporaryDirectory(prefix="reslrb-bench-", ignore_cleanup_errors=True)
            self._words = Path(self._folder.name) / "stderr"
            with self._words.open("wb") as words:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=words,
                    start_new_session=True,  # only this process handles Ctrl-C
                )
            _at_work.append(self)
        self.ask(first | {"cache": self._folder.name})

    def ask(self, question: dict[str, Any]) -> None:
        """Send a message. `answer` reports if the process has ended."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(json.dumps(question).encode() + b"\n")
            self._process.stdin.flush()

    def answer(self, stop: Callable[[], bool]) -> dict[str, Any]:
        """Wait for the next answer. Raises Ended or CannotStart. Raises Stopped after `stop()`."""
        assert self._process.stdout is not None
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while b"\n" not in self._buffer:
                if stop():
                    raise Stopped
                self._look_at_memory()
                if selector.select(POLL_SECONDS):
                    chunk = os.read(self._process.stdout.fileno(), 1 << 16)
                    if not chunk:
                        raise Ended(*self._end())
                    self._buffer += chunk
        line, _, self._buffer = self._buffer.partition(b"\n")
        answer: dict[str, Any] = json.loads(line)
        if answer.get("failure") == "refused":
            raise CannotStart(answer["reason"], answer["exit_code"])
        if "failure" in answer:
            raise Ended(BenchStatus(answer["failure"]), answer["reason"])
        return answer

    def close(self) -> None:
        """End the process and remove its files."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            with contextlib.suppress(BrokenPipeError):
                stream.close()
        self._folder.cleanup()
        if self in _at_work:
            _at_work.remove(self)

    def _look_at_memory(self) -> None:
        try:
            text = Path(f"/proc/{self._process.pid}/status").read_text()
        except OSError:
            return
        found = re.search(r"^VmPeak:\s+(\d+) kB", text, re.MULTILINE)
        if found:
            self.peak_bytes = max(self.peak_bytes, 1024 * int(found[1]))

    def _end(self) -> tuple[BenchStatus, str]:
        code = self._process.wait()
        with self._words.open("rb") as file:
            file.seek(max(0, self._words.stat().st_size - (1 << 20)))
            text = file.read().decode(errors="replace")
        words = last_words(text)
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        reason = f"ended by {name}" + (f": {words}" if words else "")
        close = self.limit is not None and self.peak_bytes >= CLOSE_TO_LIMIT * self.limit
        if close:
            reason += f" ({self.peak_bytes >> 20} of {self.limit >> 20} MiB seen in use)"  # type: ignore[operator]
        memory = code == -signal.SIGKILL or mentions_memory(text) or (close and -code in _CRASHES)
        return (BenchStatus.OUT_OF_MEMORY if memory else BenchStatus.FAILED), reason


#: Processes that are not closed.
_at_work: list[Process] = []

#: Held while a process is created, and after `abandon_all`.
_making = threading.Lock()


def abandon_all() -> None:
    """End all processes and remove their folders when the program ends. Can be called from any thread.

    No process can be started afterwards.
    """
    _making.acquire(timeout=ABANDON_SECONDS)
    for process in list(_at_work):
        with contextlib.suppress(subprocess.TimeoutExpired):
            process._process.kill()
            process._process.wait(timeout=ABANDON_SECONDS)
        shutil.rmtree(process._folder.name, ignore_errors=True)


def last_words(text: str) -> str:
    """Return the most informative line of a process's standard error: Dr.Jit's `>>>` line, or the last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    marked = [line for line in lines if line.startswith(">>>")]
    return (marked[-1].lstrip("> ") if marked else lines[-1] if lines else "")[:300]


# --- inside a worker ------------------------------------------------------------------------------------------------

#: A started case: its first message, and the function that answers each question.
Begun = tuple[dict[str, Any], Callable[[dict[str, Any]], dict[str, Any]]]


def _serve(first: dict[str, Any], does: str, questions: IO[str], answers: IO[str]) -> None:
    os.environ |= {
        # Dr.Jit's folders for compiled kernels: a cold step must find none.
        "HOME": first["cache"],
        "DRJIT_CACHE_DIR": first["cache"],
        "OPTIX_CACHE_PATH": first["cache"],
        "CUDA_CACHE_DISABLE": "1",
    }
    from reslrb_cli.backend.variant import set_variant

    set_variant(first["variant"])

    module, _, name = does.partition(":")
    begin = getattr(importlib.import_module(module), name)
    # Set late, because a library without memory looks like a missing one.
    _limit(first["memory_limit"])
    # All workers load the same scene, so their warnings are sent, and printed once.
    warnings = logging.handlers.BufferingHandler(10_000)
    warnings.setLevel(logging.WARNING)
    logging.getLogger("reslrb_cli").addHandler(warnings)
    opening, answer_to = begin(first)
    _answer(answers, opening | {"warnings": [record.getMessage() for record in warnings.buffer]})
    for line in questions:
        _answer(answers, answer_to(json.loads(line)))


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


def _answer(answers: IO[str], message: dict[str, Any]) -> None:
    answers.write(json.dumps(message) + "\n")
    answers.flush()


def run(does: str) -> None:
    """Answer questions until standard input ends or a failure occurs, then end the process. The last answer describes a
    failure.

    `does` is the function that starts the case, as `MODULE:FUNCTION`. The function returns `Begun` for the first
    message.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    limited, code = False, 0
    try:
        first = json.loads(sys.stdin.readline())
        limited = first["memory_limit"] is not None
        _serve(first, does, sys.stdin, answers)
    except Exception as error:
        _answer(answers, _failure(error, limited))
        code = 1
    sys.stderr.flush()
    os._exit(code)  # the remaining cleanup may take long, or fail if memory is exhausted
