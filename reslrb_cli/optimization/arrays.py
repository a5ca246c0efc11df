"""Values of the optimisation as NumPy arrays, and back, bit by bit."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

Array = np.ndarray[Any, Any]


def to_array(value: Any) -> Array:
    """A Dr.Jit value, of any type, without derivatives; a number for one that is one."""
    return np.array(dr.detach(value) if dr.is_array_v(value) else value)


def like(value: Any, array: Array) -> Any:
    """`array` as a value of the type of `value`, in Dr.Jit's own memory.

    `value` and `array` have one shape (`to_array`). Kernels depend on the alignment of NumPy's memory; and a number
    that was part of a kernel's code (a literal, as Adam's count of steps) is so again, so that the same kernel results.
    """
    kind = type(value)
    if not dr.is_array_v(value):
        return kind(array)
    if dr.depth_v(kind) == 1 and not dr.is_tensor_v(kind):
        if value.state == dr.VarState.Literal:
            return kind(array.ravel()[0].item())
        return _own(kind, array)
    if dr.is_tensor_v(kind):
        return kind(_own(dr.array_t(kind), array.ravel()), tuple(array.shape))
    parts = [like(part, np.ascontiguousarray(each)) for part, each in zip(value, array, strict=True)]
    return kind(*parts)


def _own(kind: Any, array: Array) -> Any:
    # The sum makes the copy: of all entries in their order `dr.gather` returns what it was given.
    copy = kind(np.ascontiguousarray(array)) + dr.opaque(kind, 0)
    dr.eval(copy)
    return copy
