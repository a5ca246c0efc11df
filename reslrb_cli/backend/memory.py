"""Flat arrays of Dr.Jit: all entries of an array, and copies of NumPy arrays in Dr.Jit's own memory.

Without a copy, Dr.Jit uses NumPy's memory. Dr.Jit's kernels then depend on the alignment of NumPy's memory. NumPy may
align the next array of the same size differently. Dr.Jit would then compile and record everything again.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np


def own_memory(kind: type[Any], array: Any) -> Any:
    """Return `array` (n,), of NumPy or torch, as an evaluated flat array of type `kind` with the same bits."""
    given = kind(np.ascontiguousarray(array) if isinstance(array, np.ndarray) else array)
    copy = dr.empty(kind, dr.width(given))
    # A gather in index order would return the array itself.
    dr.scatter(copy, given, dr.arange(dr.uint32_array_t(kind), dr.width(given)))
    dr.eval(copy)
    return copy


def flat(value: Any) -> Any:
    """Return all entries of a tensor or a (nested) array as a flat array."""
    return value.array if dr.is_tensor_v(value) else dr.ravel(value)
