"""The process of one case: `run`, in a Python of its own, started and told what to do by `processes.py` (`tasks.py`).

It reads one JSON object a line from standard input and answers each with one on standard output. The first describes
the case; each other one asks for a step. What else is printed goes to standard error.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Callable
from typing import IO, Any

from reslrb_cli.errors import BackendError, ConfigError, is_out_of_memory, mentions_memory

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
