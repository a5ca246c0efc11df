"""Code that runs inside a worker process. `processes.py` starts and controls the workers, which take measurements.

A worker (`run`) reads one JSON object per line from standard input, and answers each with one line on standard output.
The first JSON object describes the case. Each later object asks for one step. Other output goes to standard error.
"""

from __future__ import annotations

import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable
from typing import IO, Any

from reslrb_cli.errors import BackendError, ConfigError, is_out_of_memory, mentions_memory

_BITS = {"i1": 8, "half": 16, "float": 32, "double": 64, "ptr": 64}

#: One array of its entries for all lanes of a vector (LLVM): `alloca float, i32 112`.
_LLVM_ARRAY = re.compile(r"%arr_\w+ = alloca (\w+), i32 (\d+)")
_LLVM_LANES = re.compile(r"%index_next = add i64 %index, (\d+)")

#: ... or for one thread (CUDA): `.local .align 4 .b32 arr_12[7];`.
_PTX_ARRAY = re.compile(r"\.local \.align \d+ \.[a-z]+(\d+) arr_\w+\[(\d+)\]")


def scratch_bytes(history: Iterable[dict[str, Any]]) -> int:
    """Return the largest thread-local memory of a path in bytes, over all kernels of a `dr.kernel_history()`."""
    texts = [entry["ir"] for entry in history if entry.get("ir") is not None]
    return max((_of_kernel(text if isinstance(text, str) else str(text.getvalue())) for text in texts), default=0)


def _of_kernel(ir: str) -> int:
    bits = sum(int(size) * int(count) for size, count in _PTX_ARRAY.findall(ir))
    arrays = _LLVM_ARRAY.findall(ir)
    if arrays:
        lanes = _LLVM_LANES.search(ir)
        assert lanes is not None, "a kernel says how many lanes it handles at a time"
        sizes = [_BITS.get(kind) or int(kind.removeprefix("i")) for kind, _ in arrays]
        bits += sum(size * int(count) for size, (_, count) in zip(sizes, arrays, strict=True)) // int(lanes[1])
    return bits // 8


#: A started case: its first message, and the function that answers each question.
Begun = tuple[dict[str, Any], Callable[[dict[str, Any]], dict[str, Any]]]

#: Starts a case from the message that describes it.
Begin = Callable[[dict[str, Any]], Begun]


class Warnings(logging.Handler):
    """Collects warnings. All processes load the same scene, and the controlling process prints each warning once."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Store one line."""
        self.lines.append(record.getMessage())


def _serve(first: dict[str, Any], load: Callable[[], Begin], questions: IO[str], answers: IO[str]) -> None:
    os.environ |= {
        # Dr.Jit's folders for compiled kernels: a cold step must find none.
        "HOME": first["cache"],
        "DRJIT_CACHE_DIR": first["cache"],
        "OPTIX_CACHE_PATH": first["cache"],
        "CUDA_CACHE_DISABLE": "1",
    }
    from reslrb_cli.backend.variant import set_variant

    set_variant(first["variant"])

    begin = load()
    # Set late, because a library without memory looks like a missing one.
    _limit(first["memory_limit"])
    warnings = Warnings()
    logging.getLogger("reslrb_cli").addHandler(warnings)
    opening, answer_to = begin(first)
    _answer(answers, opening | {"warnings": warnings.lines})
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


def run(load: Callable[[], Begin]) -> None:
    """Answer questions until standard input ends or a failure occurs, then end the process. The last answer describes a
    failure.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    limited, code = False, 0
    try:
        first = json.loads(sys.stdin.readline())
        limited = first["memory_limit"] is not None
        _serve(first, load, sys.stdin, answers)
    except Exception as error:
        _answer(answers, _failure(error, limited))
        code = 1
    sys.stderr.flush()
    os._exit(code)  # the remaining cleanup may take long, or fail if memory is exhausted
