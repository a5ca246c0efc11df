"""The metrics of a run, `metrics.jsonl`: one JSON object per line, one line per iteration.

The file is a log. A run resumes from its checkpoint alone, and keeps the lines of the iterations that the checkpoint
contains. All later lines are dropped. The tallies sum up non-finite values and regularizers over a whole run.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import ConfigDict, ValidatorFunctionWrapHandler, WrapValidator

from reslrb_cli.config.files import read_file
from reslrb_cli.records.atomic import write_atomically

METRICS_FILE = "metrics.jsonl"


class Line:
    """Base class of dataclasses that become a line of JSON.

    The line starts with `kind` if the class has a `KIND`. Then come the fields of `method` and the other fields, in
    their order. Numbers that are not finite become null.
    """

    KIND: ClassVar[str] = ""

    def to_json(self) -> str:
        """Return the record as one line of JSON."""
        values = asdict(self)  # type: ignore[call-overload]  # of a dataclass derived from this
        head = {"kind": self.KIND} if self.KIND else {}
        return json.dumps(head | values.pop("method", {}) | finite(values), allow_nan=False)


def finite(value: Any, instead: Callable[[float], object] = lambda number: None) -> Any:
    """Return `value` for JSON. None, or the result of `instead`, replaces numbers that are not finite.

    `value` can be a number or nested mappings and lists of numbers.
    """
    if isinstance(value, dict):
        return {key: finite(entry, instead) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry, instead) for entry in value]
    return instead(value) if isinstance(value, float) and not math.isfinite(value) else value


def _nan_for_null(value: object, handler: ValidatorFunctionWrapHandler) -> float:
    return math.nan if value is None else handler(value)


#: Number that may not be finite; null in JSON is read as NaN.
Figure = Annotated[float, WrapValidator(_nan_for_null)]


@dataclass(frozen=True)
class Regularized:
    """Weighted regularizer costs of an iteration, by parameter and type. The loss does not include these costs.

    For each parameter, `held` is the number of heights at the minimum thickness after the update.
    """

    costs: dict[str, dict[str, Figure]]
    held: dict[str, int]


@dataclass(frozen=True)
class Record(Line):
    """Record of one iteration: its step, and the parameters before its update.

    - `step_ms` is the wall time of the step: image, loss and gradient of every sensor, without the optimiser's update.
    - `codegen_ms` is the part of `step_ms` for generating and compiling kernels.
    - `curvature_s` is the time in which `auto` measured curvature in this iteration, with new kernels.
    - `elapsed_s` is the time in steps and updates since the start. Writing files and computing `parameter_errors` do
        not count.
    - `peak_mib` is the peak memory of the allocator since the start.
    - `nonfinite` is the number of non-finite entries in the loss, in dL/dI, in the gradients, and in the images and
        gradients that measure something.
    - `nonfinite_by_parameter` is the number of non-finite entries in gradients and updates, for each parameter with
        such entries.
    - `grad_norm` is the norm of the gradient without non-finite entries.
    - `held_out` is the loss of the held-out views. `held_out` is None without held-out views, or if the iteration did
        not compute the loss.
    - `regularized` is None without regularizers.
    - `parameter_errors` has the root mean square error of each parameter with a known true value. Each error has the
        parameter's unit and covers the entries that light and sensor reach.
    - `parameter_rmse` is the error over all parameters in `parameter_errors`. The error is None if these parameters
        have no common unit, or if no true value is known.
    """

    __pydantic_config__ = ConfigDict(strict=True, allow_inf_nan=False)

    iteration: int
    loss: Figure
    step_ms: float
    codegen_ms: float
    elapsed_s: float
    peak_mib: float
    spp: int
    lr: float
    grad_norm: Figure
    nonfinite: int
    parameter_rmse: float | None
    parameter_errors: dict[str, Figure] = field(default_factory=dict)
    nonfinite_by_parameter: dict[str, int] = field(default_factory=dict)
    held_out: float | None = None
    regularized: Regularized | None = None
    curvature_s: float = 0.0


class MetricsWriter:
    """Writer that appends records to `metrics.jsonl`. When `write` returns, the file contains the complete line."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / METRICS_FILE
        self._descriptor: int | None = None
        mend(folder)

    def write(self, record: Record) -> None:
        """Append one record. Raises OSError if the disk is full or the file was removed. The file is then unchanged."""
        line = record.to_json().encode() + b"\n"
        if self._descriptor is None:
            if not self._path.exists():
                write_atomically(self._path, lambda file: file.write(line))  # readers never see an empty file
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
        """Flush the lines to the disk, so that after a loss of power the log is not behind the checkpoint."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):  # not all file systems support it; the lines are written anyway
                os.fsync(self._descriptor)

    def __enter__(self) -> MetricsWriter:
        return self

    def __exit__(self, *_: object) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)


def mend(folder: Path) -> None:
    """Remove an incomplete last line. Raises OSError if that is impossible."""
    try:
        with (folder / METRICS_FILE).open("r+b") as file:
            text = file.read()
            whole = text.rfind(b"\n") + 1
            if whole < len(text):
                file.truncate(whole)
    except FileNotFoundError:
        pass


def cut_back(folder: Path, count: int) -> int:
    """Keep the lines of the first `count` iterations in the metrics file of `folder`, and drop all other lines. Returns
    the number of missing lines. Raises OSError.
    """
    path, kept, following = folder / METRICS_FILE, list[bytes](), 0
    content = read_file(path) if os.path.lexists(path) else b""
    for line in content.splitlines(keepends=True):
        number = _iteration_of(line)
        if following <= number < count:
            kept.append(line)
            following = number + 1
    text = b"".join(kept)
    if not text:
        path.unlink(missing_ok=True)
    elif content.startswith(text):
        os.truncate(path, len(text))
    else:
        write_atomically(path, lambda file: file.write(text))
    return count - len(kept)


def _iteration_of(line: bytes) -> int:
    """Return the iteration of a complete line, or -1 if the line is damaged."""
    try:
        number = json.loads(line)["iteration"] if line.endswith(b"\n") else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return -1
    return number if isinstance(number, int) else -1


class _Tally:
    """Sum over the records of a run."""

    def to_json(self) -> dict[str, Any]:
        """Return the tally for the manifest."""
        found: dict[str, Any] = finite(asdict(self))  # type: ignore[call-overload]  # of a dataclass derived from this
        return found


@dataclass
class NonFiniteTally(_Tally):
    """Number of iterations with non-finite values, and the number of non-finite values, in total and by parameter."""

    iterations: int = 0
    values: int = 0
    by_parameter: dict[str, int] = field(default_factory=dict)

    def add(self, record: Record) -> None:
        """Count one iteration."""
        self.iterations += record.nonfinite > 0
        self.values += record.nonfinite
        for key, count in record.nonfinite_by_parameter.items():
            self.by_parameter[key] = self.by_parameter.get(key, 0) + count

    def __str__(self) -> str:
        """Return the words for the last line of a run with values that were not finite."""
        parameters = ", ".join(f"{key} {count}" for key, count in self.by_parameter.items())
        where = f" ({parameters})" if parameters else ""
        return f"{self.values} values not finite{where} in {self.iterations} iterations"


@dataclass
class RegularizedTally(_Tally):
    """Regularizer costs of the last iteration, by parameter and type, and heights held at the minimum thickness.

    `held_iterations` counts the iterations that held heights. `held` is the number of held heights after the last
    iteration.
    """

    iterations: int = 0
    costs: dict[str, dict[str, Figure]] = field(default_factory=dict)
    held_iterations: int = 0
    held: dict[str, int] = field(default_factory=dict)

    def add(self, record: Record) -> None:
        """Count one iteration."""
        if record.regularized is not None:
            self.iterations += 1
            self.costs, self.held = record.regularized.costs, record.regularized.held
            self.held_iterations += any(self.held.values())

    def __str__(self) -> str:
        """Return the words for the last line of a run. The result is empty if nothing is regularized."""
        told = [f"{name} of {key} {value:.3g}" for key, costs in self.costs.items() for name, value in costs.items()
                if value]  # fmt: skip
        if self.held_iterations:
            heights = sum(self.held.values())
            told.append(f"heights held at the least thickness in {self.held_iterations} iterations ({heights} at last)")
        return f"beside the loss: {', '.join(told)}" if told else ""
