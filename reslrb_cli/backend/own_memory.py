"""Arrays of NumPy's in Dr.Jit's own memory.

Dr.Jit takes up NumPy's memory as it lies, and compiles and records for its alignment, which is random: the next array
of the same size may lie otherwise, and then all is compiled and recorded once more.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np


def own_memory(kind: type[Any], array: np.ndarray[Any, Any]) -> Any:
    """`array` (n,) as a flat array of type `kind`, bit by bit, evaluated."""
    given = kind(np.ascontiguousarray(array))
    copy = dr.empty(kind, dr.width(given))
    # Gathered in its own order, an array would be returned as it is.
    dr.scatter(copy, given, dr.arange(dr.uint32_array_t(kind), dr.width(given)))
    dr.eval(copy)
    return copy
