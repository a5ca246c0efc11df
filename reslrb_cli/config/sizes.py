"""Amounts of memory as a user writes them."""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import BeforeValidator, WithJsonSchema

from .base import wrong

MIB = 2**20
_UNITS = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": MIB, "gib": 2**30}
_SIZE = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]+)")


def memory_bytes(value: int | float | str) -> int:
    """Bytes of a number of MiB, or of text such as "512 MiB", "2GiB", "500 MB".

    Raises ValueError where it is neither, or less than one byte.
    """
    number, unit = float("nan"), "mib"
    if isinstance(value, str):
        match = _SIZE.fullmatch(value.strip())
        if match:
            number, unit = float(match[1]), match[2].lower()
    elif not isinstance(value, bool):
        number = float(value) if abs(value) < 2**63 else float("inf")  # longer integers fit into no float
    if unit not in _UNITS or not 1 <= number * _UNITS[unit] < 2**63:
        raise ValueError(f"{value!r} is no amount of memory")
    return int(number * _UNITS[unit])


def _check(value: Any) -> Any:
    try:
        if not isinstance(value, (int, float, str)):
            raise ValueError
        memory_bytes(value)
    except ValueError:
        raise wrong("must be a number of MiB, or text such as 512 MiB or 2GiB, and more than 0") from None
    return value


#: A number of MiB, or text with a unit (B, kB, KiB, MB, MiB, GB, GiB); kept as it was written.
Memory = Annotated[
    int | float | str,
    BeforeValidator(_check),
    WithJsonSchema({"anyOf": [{"type": "number", "exclusiveMinimum": 0}, {"type": "string"}]}),
]
