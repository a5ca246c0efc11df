"""Thread-local memory of kernels, which the allocator does not see, read off the kernels themselves."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

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
