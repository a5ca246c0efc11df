"""Workers: processes that measure, one of several side by side, from both ends; and how a sweep's time is spent.

- `scratch_bytes`: thread-local memory of kernels, which the allocator does not see, read off the kernels themselves.
- `run`: the process of one case, in a Python of its own, started and told what to do by `processes.py` (`tasks.py`). It
  reads one JSON object a line from standard input and answers each with one on standard output. The first describes the
  case; each other one asks for a step. What else is printed goes to standard error.
- `Contestant`: one of several that are measured side by side, each in a process of its own, and how it came to its end.
- `Pace`: how the time of a sweep is spent: so much for each depth, and as many rounds there as fit.
"""

from __future__ import annotations

import json
import logging
import os
import re
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import IO, Any

from reslrb_cli.errors import BackendError, ConfigError, is_out_of_memory, mentions_memory
from reslrb_cli.measure.processes import Ended, Refused, Stopped

_BITS = {"i1": 8, "half": 16, "float": 32, "double": 64, "ptr": 64}


#: One array holds its entries for all lanes of a vector (LLVM): `alloca float, i32 112`.
_LLVM_ARRAY = re.compile(r"%arr_\w+ = alloca (\w+), i32 (\d+)")


_LLVM_LANES = re.compile(r"%index_next = add i64 %index, (\d+)")


#: ... or those of one thread (CUDA): `.local .align 4 .b32 arr_12[7];`.
_PTX_ARRAY = re.compile(r"\.local \.align \d+ \.[a-z]+(\d+) arr_\w+\[(\d+)\]")


def scratch_bytes(history: Iterable[dict[str, Any]]) -> int:
    """The most thread-local bytes that a path has in any kernel of a `dr.kernel_history()`; `dr.Local` makes them."""
    return max((_of_kernel(_text(entry["ir"])) for entry in history if entry.get("ir") is not None), default=0)


def _text(ir: Any) -> str:
    return ir if isinstance(ir, str) else str(ir.getvalue())


def _of_kernel(ir: str) -> int:
    bits = sum(int(size) * int(count) for size, count in _PTX_ARRAY.findall(ir))
    arrays = _LLVM_ARRAY.findall(ir)
    if arrays:
        lanes = _LLVM_LANES.search(ir)
        assert lanes is not None, "a kernel says how many lanes it handles at a time"
        bits += sum(_bits(kind) * int(count) for kind, count in arrays) // int(lanes[1])
    return bits // 8


def _bits(kind: str) -> int:
    return _BITS[kind] if kind in _BITS else int(kind.removeprefix("i"))


#: A case that has begun: what it says first, and what answers each question.
Begun = tuple[dict[str, Any], Callable[[dict[str, Any]], dict[str, Any]]]


#: Begins a case, by the message that describes it.
Begin = Callable[[dict[str, Any]], Begun]


def main(load: Callable[[], Begin]) -> int:
    """Answer until standard input ends, or until something fails: the last answer then says what."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    limited = False
    try:
        first = json.loads(sys.stdin.readline())
        limited = first["memory_limit"] is not None
        _serve(first, load, sys.stdin, answers)
    except Exception as error:
        _answer(answers, _failure(error, limited))
        return 1
    return 0


class Warnings(logging.Handler):
    """Keeps what is warned of: every process loads the same scene, and the one that asks says it once."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep one line."""
        self.lines.append(record.getMessage())


def _serve(first: dict[str, Any], load: Callable[[], Begin], questions: IO[str], answers: IO[str]) -> None:
    os.environ |= {
        # Where Dr.Jit keeps compiled kernels, by default and if told: a cold step is to find none.
        "HOME": first["cache"],
        "DRJIT_CACHE_DIR": first["cache"],
        "OPTIX_CACHE_PATH": first["cache"],
        "CUDA_CACHE_DISABLE": "1",
    }
    from reslrb_cli.backend.variant import set_variant

    set_variant(first["variant"])

    begin = load()
    # Only now: a library that finds no room looks like one that is not there.
    _limit(first["memory_limit"])
    warnings = Warnings()
    logging.getLogger("reslrb_cli").addHandler(warnings)
    opening, answer_to = begin(first)
    _answer(answers, opening | {"warnings": warnings.lines})
    for line in questions:
        _answer(answers, answer_to(json.loads(line)))


def _limit(memory_limit: int | None) -> None:
    """Bound the address space, what is in use already included."""
    if memory_limit is not None:
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_AS)
        limit = memory_limit if most == resource.RLIM_INFINITY else min(memory_limit, most)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


#: What the C++ library says of a thread that cannot be made: under a limit, for want of address space for its stack.
_NO_THREAD = "Resource temporarily unavailable"


def _failure(error: Exception, limited: bool) -> dict[str, Any]:
    words = " ".join(str(error).split())
    memory = is_out_of_memory(error) or mentions_memory(words)  # also as the reason of another error
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


def run(load: Callable[[], Begin]) -> None:
    """Answer, and end the process."""
    code = main(load)
    sys.stderr.flush()
    os._exit(code)  # what is left to tidy up may take long, or fail where memory is out


@dataclass
class Contestant:
    """A process under way (`processes.Process`); whoever may not refuse ends the whole where it does."""

    process: Any
    may_refuse: bool
    end: Ended | None = None
    refusal: Refused | None = None
    late: bool = False

    @property
    def alive(self) -> bool:
        """Whether it can be asked for more."""
        return self.end is None and self.refusal is None and not self.late

    def ask(
        self, question: dict[str, Any], stop: Callable[[], bool], over: Callable[[], bool] = lambda: False
    ) -> dict[str, Any] | None:
        """One answer; None where the process ended over it, or time was up. Raises Stopped once `stop()`."""
        self.process.ask(question)
        return self.answer(stop, over)

    def answer(self, stop: Callable[[], bool], over: Callable[[], bool] = lambda: False) -> dict[str, Any] | None:
        """The next answer, as of `ask`; the first is what a process says without being asked."""
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
        self.process.close()  # what it held is for the others
        return None


MIN_ROUNDS = 3


MAX_ROUNDS = 25


#: How much more of the time is for the next depth, whose kernels take longer to compile and to run.
GROWTH = 1.3


#: What is said of what a budget did not suffice for.
NO_TIME = "the budget was spent; allow more with --budget"


class Pace:
    """Divides the time among depths, each of which gets GROWTH times as much as the one before it.

    What a depth leaves is for the others. None gets fewer than MIN_ROUNDS rounds while there is time at all, whatever
    its own share, nor more than `most`. With `rounds` time does not count. Rounds of earlier sessions count.
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
        self._start = self._rounds_start = self._depth_start = self._depth_end = now()
        self._before = 0

    @property
    def spent_s(self) -> float:
        """Seconds since the beginning."""
        return self._now() - self._start

    @property
    def depth_s(self) -> float:
        """Seconds since the depth began."""
        return self._now() - self._depth_start

    def over(self) -> bool:
        """Whether the time is up."""
        return self._rounds is None and self._now() >= self._end

    def fits(self, seconds: float) -> bool:
        """Whether there is so much time left."""
        return self._rounds is not None or self._now() + seconds <= self._end

    def begin_depth(self) -> None:
        """A depth begins."""
        now = self._depth_start = self._now()
        self._depth_end = now + (self._end - now) / sum(GROWTH**k for k in range(self._left))
        self._left -= 1

    def begin_rounds(self, before: int = 0) -> None:
        """Its processes are warm; `before` rounds were done by earlier sessions."""
        self._rounds_start, self._before = self._now(), before

    def another(self, done: int) -> bool:
        """Whether there is time for another round after `done` of them in this session."""
        if self._rounds is not None:
            return self._before + done < self._rounds
        if self._before + done >= self._most:
            return False
        if done == 0:
            return True
        now = self._now()
        return now + (now - self._rounds_start) / done <= (self._end if done < MIN_ROUNDS else self._depth_end)
