"""Worker processes as seen from outside. The end of a worker is detected and reported, and does not end the
measurement.

- `Process` is one worker, which exchanges lines of JSON with `workers.py`.
- `Contestant` is one of several compared workers, and records how the worker ended. `Stepping` is a contestant that
    takes steps.
- `Pace` divides the time of a sweep among depths and rounds.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import selectors
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reslrb_cli.errors import ReslrbError, mentions_memory
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


class Refused(ReslrbError):
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
        """Wait for the next answer. Raises Ended or Refused. Raises Stopped after `stop()`."""
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
            raise Refused(answer["reason"], answer["exit_code"])
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


@dataclass(kw_only=True)
class Contestant:
    """One of several workers that are compared. `process` is None if no worker runs. `peak_mib` is the worker's peak
    memory in MiB.

    A refusal (`Refused`) ends the measurement, unless `may_refuse` is True.
    """

    process: Any
    may_refuse: bool
    end: Ended | None = None
    refusal: Refused | None = None
    late: bool = False
    peak_mib: float = 0.0

    @property
    def alive(self) -> bool:
        """True if the process can answer more questions."""
        return self.process is not None and self.end is None and self.refusal is None and not self.late

    def ask(
        self, question: dict[str, Any], stop: Callable[[], bool], over: Callable[[], bool] = lambda: False
    ) -> dict[str, Any] | None:
        """Ask and wait for one answer. Returns None if the process ended or the time was up. Raises Stopped after
        `stop()`.
        """
        self.process.ask(question)
        return self.answer(stop, over)

    def answer(self, stop: Callable[[], bool], over: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        """Wait for the next answer, as `ask` does. After its start, a process sends its first answer without waiting
        for a question.
        """
        try:
            result: dict[str, Any] = self.process.answer(lambda: stop() or over())
            return result
        except Ended as end:
            self.end = end
        except Refused as refusal:
            if not self.may_refuse:
                raise
            self.refusal = refusal
        except Stopped:
            if stop():
                raise
            self.late = True
        self.close()  # releases its resources for the others
        return None

    def close(self) -> None:
        """End the process, if one is running."""
        if self.process is not None:
            self.process.close()
            self.process = None


#: Maximum number of steps after the cold one until no new kernel is compiled.
MAX_WARM_UPS = 4


@dataclass(kw_only=True)
class Stepping(Contestant):
    """A contestant that takes steps in rounds after its warm-up. `cold` is the first step, which includes
    compilation.
    """

    cold: dict[str, Any] | None = None

    def question(self, round: int | None) -> dict[str, Any]:
        """Return the question for a round's steps. For None, the step is not counted."""
        raise NotImplementedError

    def keep(self, round: int, answer: dict[str, Any]) -> None:
        """Store the steps of a round."""
        raise NotImplementedError

    def warm_up(self, tight: Callable[[], bool], stop: Callable[[], bool], over: Callable[[], bool]) -> dict | None:
        """Take a cold step, then more steps until nothing is compiled. Returns the last answer, or None if the process
        ended.
        """
        answer = self.ask(self.question(None) | {"cold": True, "release": False}, stop, over)
        if answer is not None:
            self.cold, self.peak_mib = answer, answer["peak_mib"]
        for _ in range(MAX_WARM_UPS):
            if answer is not None:
                answer = self.ask(self.question(None) | {"cold": False, "release": tight()}, stop, over)
            if answer is None or not answer["new_kernels"]:
                break
        return answer

    def turn(self, round: int, release: bool, stop: Callable[[], bool]) -> None:
        """Take the steps of a round. Then free memory if `release` is True. Raises Stopped."""
        answer = self.ask(self.question(round) | {"cold": False, "release": release}, stop)
        if answer is not None:
            self.keep(round, answer)


MIN_ROUNDS = 3
MAX_ROUNDS = 25

#: Factor on the time for the next depth, whose kernels take longer to compile and to run.
GROWTH = 1.3

#: Message about measurements that exceed the budget.
NO_TIME = "the budget was spent; allow more with --budget"


class Pace:
    """Divides the time among depths. Each depth gets GROWTH times as much time as the previous depth.

    Time that one depth leaves unused goes to the remaining depths. While there is time, each depth gets at least
    MIN_ROUNDS rounds. The maximum is `most` rounds. With `rounds`, time does not count. Rounds of earlier sessions
    count.
    """

    def __init__(
        self,
        budget_s: float,
        depths: int,
        rounds: int | None = None,
        now: Callable[[], float] = time.monotonic,
        most: int = MAX_ROUNDS,
    ) -> None:
        self._now, self._end, self._left, self._rounds, self._most = now, now() + budget_s, depths, rounds, most
        self._rounds_start = self._depth_start = now()
        self._depth_end = self._end
        self._before = 0

    @property
    def depth_s(self) -> float:
        """Seconds since the start of the depth."""
        return self._now() - self._depth_start

    def over(self) -> bool:
        """Whether the time is up."""
        return self._rounds is None and self._now() >= self._end

    def fits(self, seconds: float) -> bool:
        """Whether this many seconds are left."""
        return self._rounds is not None or self._now() + seconds <= self._end

    def begin_depth(self) -> None:
        """Start a depth."""
        now = self._depth_start = self._now()
        self._depth_end = now + (self._end - now) / sum(GROWTH**k for k in range(self._left))
        self._left -= 1

    def begin_rounds(self, before: int = 0) -> None:
        """Start the rounds after the warm-up. Earlier sessions have done `before` rounds."""
        self._rounds_start, self._before = self._now(), before

    def another(self, done: int) -> bool:
        """Whether there is time for another round after `done` rounds of this session."""
        if self._rounds is not None:
            return self._before + done < self._rounds
        if self._before + done >= self._most:
            return False
        if done == 0:
            return True
        now = self._now()
        return now + (now - self._rounds_start) / done <= (self._end if done < MIN_ROUNDS else self._depth_end)
