"""The part of `metrics.jsonl` that a run goes on from: the iterations that its checkpoint contains, and no others."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.metrics import FILE_NAME, Clamped, Record
from reslrb_cli.records.reading import MOST_BYTES

_NULL_IS_NAN = {"loss", "grad_norm"}  # numbers that may be not finite, which JSON does not have
_NAMES = {field.name: field for field in fields(Record)}


def read_records(folder: Path, count: int, last: Mapping[str, Any] | None) -> tuple[list[Record], int]:
    """The first `count` records in `folder`, and the bytes that they take; the rest was not kept by a checkpoint.

    A full disk may have taken the line of the last one, which the checkpoint has too: `last`. Raises ConfigError,
    located in the file and the line, where others are missing or are not what a run writes.
    """
    path = folder / FILE_NAME
    content = read_file(path, MOST_BYTES) if count and os.path.lexists(path) else b""
    records: list[Record] = []
    size = 0
    for number, line in enumerate(content.splitlines(keepends=True)[:count]):
        if line.endswith(b"\n"):
            records.append(_record(line, number, path))
            size += len(line)
    if len(records) == count - 1 and last is not None:
        records.append(_record(json.dumps(last).encode(), count - 1, path))
    if len(records) < count:
        raise ConfigError(
            path,
            "",
            f"holds {len(records)} of the {count} iterations of the checkpoint; put it back, or begin anew from "
            "`initial: {run: ...}`",
        )
    return records, size


def cut_back(folder: Path, records: list[Record], size: int) -> None:
    """Leave `records` alone in `folder`, of which the first `size` bytes hold all but the last one or none."""
    path = folder / FILE_NAME
    if not records:
        path.unlink(missing_ok=True)
        return
    if size == 0:  # of a run of one iteration, whose line was lost: it is never seen empty
        write_atomically(path, lambda file: file.write(records[-1].to_json().encode() + b"\n"), durable=True)
        return
    with path.open("r+b") as file:
        file.truncate(size)
        file.seek(0)
        written = sum(1 for _ in file)
        if written < len(records):
            file.write(records[-1].to_json().encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def _record(line: bytes, number: int, path: Path) -> Record:
    """The record of iteration `number`. Raises ConfigError."""
    try:
        found = json.loads(line)
        if not isinstance(found, dict) or found.get("iteration") != number:
            raise ValueError("another iteration, or none")
        absent = {name for name, field in _NAMES.items() if name not in found and field.default is MISSING}
        if absent - {"parameter_errors", "nonfinite_by_parameter"} or set(found) - set(_NAMES):
            raise ValueError("other names")
        values: dict[str, Any] = {name: _value(name, value) for name, value in found.items()}
        return Record(**values)
    except (ValueError, TypeError, RecursionError) as error:
        reason = f"is not what a run writes ({error or type(error).__name__})"
        raise ConfigError(path, f"line {number + 1}", reason) from None


def _value(name: str, value: Any) -> Any:
    if name == "clamped" and value is not None:
        shares = {each: _numbers(value[each]) for each in ("share", "bias")}
        return Clamped(int(_number(value["entries"])), **shares)
    if name in ("parameter_errors", "nonfinite_by_parameter"):
        return _numbers(value, int if name.startswith("nonfinite") else float)
    if value is None:
        return math.nan if name in _NULL_IS_NAN else None
    return _number(value)


def _numbers(value: Any, kind: type = float) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("a mapping is missing")
    return {str(key): math.nan if each is None else kind(_number(each)) for key, each in value.items()}


def _number(value: Any) -> float | int:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e308:
        raise ValueError("a number is missing")
    return value
