"""`metrics.jsonl`: one object a line, one line an iteration."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

FILE_NAME = "metrics.jsonl"


@dataclass(frozen=True)
class Clamped:
    """What a clamp did to the gradients of an iteration: how many entries it changed; by parameter, the share that it
    took of the gradient (the sum of absolute values), and the bias that this made of the iterations so far: the share
    that it took of their sum."""

    entries: int
    share: dict[str, float]
    bias: dict[str, float]


@dataclass(frozen=True)
class Record:
    """What one iteration was: its step, and the parameters before its update.

    `step_ms` is the wall time of the step (image, loss and gradient of every sensor, evaluated; the optimiser's update
    left out), `codegen_ms` the part of it in which kernels were generated and compiled. `primal_ms` and `adjoint_ms`
    are None where one kernel does both. `elapsed_s` is the time since the start in steps and updates; files and
    the reading of `parameter_errors` are not in it. `peak_mib` is the allocator's high-water mark since the start.
    `nonfinite` counts the entries of loss, of its derivative by the image and of gradients that were not finite;
    `grad_norm` leaves them out. `nonfinite_by_parameter` holds those of gradients and updates, of parameters with any.
    `clamped` is None where gradients are not clamped; `grad_norm` is that before.
    `parameter_errors` are root mean square errors by key, each in its parameter's unit, over the entries that light and
    sensor reach, of the parameters whose true value is known; `parameter_rmse` is that over the entries of all of them,
    None where they have no common unit, or no true value is known.
    """

    iteration: int
    loss: float
    step_ms: float
    primal_ms: float | None
    adjoint_ms: float | None
    codegen_ms: float
    elapsed_s: float
    peak_mib: float
    spp: int
    lr: float
    grad_norm: float
    nonfinite: int
    parameter_rmse: float | None
    parameter_errors: dict[str, float] = field(default_factory=dict)
    nonfinite_by_parameter: dict[str, int] = field(default_factory=dict)
    clamped: Clamped | None = None

    def to_json(self) -> str:
        """The record as one line of JSON, non-finite numbers as null (JSON has none)."""
        return json.dumps(finite(asdict(self)), allow_nan=False)


def finite(value: Any) -> Any:
    """The same of mappings, lists and numbers, with None for numbers that are not finite: JSON has none."""
    if isinstance(value, dict):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


class MetricsWriter:
    """Appends records to `metrics.jsonl`; each line is on disk once `write` returns."""

    def __init__(self, folder: Path) -> None:
        self._file = (folder / FILE_NAME).open("a", encoding="utf-8")

    def write(self, record: Record) -> None:
        """Append one record."""
        self._file.write(record.to_json() + "\n")
        self._file.flush()

    def __enter__(self) -> MetricsWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Return the records in `folder`, oldest first; a last line that a crash cut short is left out."""
    try:
        lines = (folder / FILE_NAME).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return []
    records = []
    for number, line in enumerate(lines):
        try:
            records.append(json.loads(line))
        except ValueError:
            if number + 1 < len(lines):
                raise
    return records
