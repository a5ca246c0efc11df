"""`metrics.jsonl`: one object a line, one line an iteration."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from reslrb_cli.records.atomic import write_atomically

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
    `clamped` is None where gradients are not clamped; `grad_norm` is that before. `held_out` is the loss of views that
    are held out, None without any, and of iterations that did not look.
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
    held_out: float | None = None

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
    """Appends records to `metrics.jsonl`; each line is in the file once `write` returns, and whole whatever happens."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE_NAME
        self._descriptor: int | None = None
        mend(folder)

    def write(self, record: Record) -> None:
        """Append one record. Raises OSError, with the file as it was, where there is no room or no file any more."""
        line = record.to_json().encode() + b"\n"
        if self._descriptor is None:
            if not self._path.exists():
                write_atomically(self._path, lambda file: file.write(line))  # it is never seen empty
                line = b""
            self._descriptor = os.open(self._path, os.O_WRONLY | os.O_APPEND)
        state = os.fstat(self._descriptor)
        if state.st_nlink == 0:
            raise FileNotFoundError(errno.ENOENT, "has been removed while the run went on", str(self._path))
        try:
            while line:
                line = line[os.write(self._descriptor, line) :]
        except OSError as error:
            os.ftruncate(self._descriptor, state.st_size)
            raise OSError(error.errno, error.strerror, str(self._path)) from error

    def sync(self) -> None:
        """Have all that was written on the disk, so that no loss of power takes lines that a checkpoint counts on."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):  # of a disk that cannot: the lines are written all the same
                os.fsync(self._descriptor)

    def __enter__(self) -> MetricsWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)


def mend(folder: Path) -> None:
    """Cut off a last line that a process did not come to finish. Raises OSError where that cannot be done."""
    try:
        with (folder / FILE_NAME).open("r+b") as file:
            text = file.read()
            whole = text.rfind(b"\n") + 1
            if whole < len(text):
                file.truncate(whole)
    except FileNotFoundError:
        pass


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
