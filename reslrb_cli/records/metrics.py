"""The metrics of a run, `metrics.jsonl`: one object a line, one line an iteration.

A run that is resumed goes on from a part of the file: the iterations that its checkpoint contains, and no others. The
tallies add up from the records what of a whole run was not finite, or clamped.
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

from pydantic import ConfigDict, TypeAdapter, ValidationError, ValidatorFunctionWrapHandler, WrapValidator

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import write_atomically

METRICS_FILE = "metrics.jsonl"


class Line:
    """A line of JSON: a dataclass's fields in their order, behind `kind` where the class has a `KIND`.

    Those of a `method` stand beside the others, in front. Figures that are not finite become null: JSON has none.
    """

    KIND: ClassVar[str] = ""

    def to_json(self) -> str:
        """The record as one line of JSON."""
        values = asdict(self)  # type: ignore[call-overload]  # of a dataclass derived from this
        head = {"kind": self.KIND} if self.KIND else {}
        return json.dumps(head | values.pop("method", {}) | finite(values), allow_nan=False)


def finite(value: Any, instead: Callable[[float], object] = lambda number: None) -> Any:
    """The same of mappings, lists and numbers, with None, or what is to stand `instead`, for numbers that are not
    finite: JSON has none."""
    if isinstance(value, dict):
        return {key: finite(entry, instead) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry, instead) for entry in value]
    return instead(value) if isinstance(value, float) and not math.isfinite(value) else value


def _nan_for_null(value: object, handler: ValidatorFunctionWrapHandler) -> float:
    return math.nan if value is None else handler(value)


#: A number that may be not finite, which JSON does not have.
Figure = Annotated[float, WrapValidator(_nan_for_null)]


@dataclass(frozen=True)
class Clamped:
    """What a clamp did to the gradients of an iteration: how many entries it changed; by parameter, the share that it
    took of the gradient (the sum of absolute values), and the bias that this made of the iterations so far: the share
    that it took of their sum."""

    entries: int
    share: dict[str, Figure]
    bias: dict[str, Figure]


@dataclass(frozen=True)
class Regularized:
    """What regularizers cost in an iteration, by parameter and type, weights included; no part of the loss. And by
    parameter how many heights the update left at the least thickness."""

    costs: dict[str, dict[str, Figure]]
    held: dict[str, int]


@dataclass(frozen=True)
class Record(Line):
    """What one iteration was: its step, and the parameters before its update.

    `step_ms` is the wall time of the step (image, loss and gradient of every sensor, evaluated; the optimiser's update
    left out), `codegen_ms` the part of it in which kernels were generated and compiled. `primal_ms` and `adjoint_ms`
    are None where one kernel does both. `elapsed_s` is the time since the start in steps and updates; files and
    the reading of `parameter_errors` are not in it. `peak_mib` is the allocator's high-water mark since the start.
    `nonfinite` counts the entries of loss, of its derivative by the image and of gradients that were not finite;
    `grad_norm` leaves them out. `nonfinite_by_parameter` holds those of gradients and updates, of parameters with any.
    `clamped` is None where gradients are not clamped; `grad_norm` is that before. `held_out` is the loss of views that
    are held out, None without any, and of iterations that did not look. `regularized` is None without regularizers.
    `parameter_errors` are root mean square errors by key, each in its parameter's unit, over the entries that light and
    sensor reach, of the parameters whose true value is known; `parameter_rmse` is that over the entries of all of them,
    None where they have no common unit, or no true value is known.
    """

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

    iteration: int
    loss: Figure
    step_ms: float
    primal_ms: float | None
    adjoint_ms: float | None
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
    clamped: Clamped | None = None
    held_out: float | None = None
    regularized: Regularized | None = None


class MetricsWriter:
    """Appends records to `metrics.jsonl`; each line is in the file once `write` returns, and whole whatever happens."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / METRICS_FILE
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

    def __exit__(self, *_: object) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)


def mend(folder: Path) -> None:
    """Cut off a last line that a process did not come to finish. Raises OSError where that cannot be done."""
    try:
        with (folder / METRICS_FILE).open("r+b") as file:
            text = file.read()
            whole = text.rfind(b"\n") + 1
            if whole < len(text):
                file.truncate(whole)
    except FileNotFoundError:
        pass


def read_records(folder: Path, count: int, last: Record | None) -> tuple[list[Record], int]:
    """The first `count` records in `folder`, and the bytes that they take; the rest was not kept by a checkpoint.

    A full disk may have taken the line of the last one, which the checkpoint has too: `last`. Raises ConfigError,
    located in the file and the line, where others are missing or are not what a run writes.
    """
    path = folder / METRICS_FILE
    content = read_file(path) if count and os.path.lexists(path) else b""
    whole = [line for line in content.splitlines(keepends=True)[:count] if line.endswith(b"\n")]
    records = [_record(line, number, path) for number, line in enumerate(whole)]
    if len(records) == count - 1 and last is not None and last.iteration == count - 1:
        records.append(last)
    if len(records) < count:
        held = f"holds {len(records)} of the {count} iterations of the checkpoint"
        raise ConfigError(path, "", f"{held}; put it back, or begin anew from `initial: {{run: ...}}`")
    return records, sum(map(len, whole))


def cut_back(folder: Path, records: list[Record], size: int) -> None:
    """Leave `records` alone in `folder`, of which the first `size` bytes hold all but the last one or none."""
    path = folder / METRICS_FILE
    if not records:
        path.unlink(missing_ok=True)
        return
    content = read_file(path)[:size] if size else b""
    if content.count(b"\n") < len(records):
        content += records[-1].to_json().encode() + b"\n"
    write_atomically(path, lambda file: file.write(content), durable=True)


_RECORD: TypeAdapter[Record] = TypeAdapter(Record)


def _record(line: bytes, number: int, path: Path) -> Record:
    """The record of iteration `number`. Raises ConfigError."""
    try:
        record = _RECORD.validate_json(line)
        if record.iteration == number:
            return record
        reason = "another iteration"
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        reason = ": ".join([*map(str, first["loc"]), first["msg"]])
    raise ConfigError(path, f"line {number + 1}", f"is not what a run writes ({reason})")


class _Tally:
    """What of a whole run is added up from its records."""

    def to_json(self) -> dict[str, Any]:
        """For the manifest."""
        found: dict[str, Any] = finite(asdict(self))  # type: ignore[call-overload]  # of a dataclass derived from this
        return found


@dataclass
class NonFiniteTally(_Tally):
    """Iterations with values that were not finite, the number of these values, and those of each parameter."""

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
        """For the last line of a run; empty where all was finite."""
        if not self.iterations:
            return ""
        parameters = ", ".join(f"{key} {count}" for key, count in self.by_parameter.items())
        where = f" ({parameters})" if parameters else ""
        return f"{self.values} values not finite{where} in {self.iterations} iterations"


@dataclass
class ClampTally(_Tally):
    """Iterations in which gradients were clamped, the number of entries, and the bias over the run by parameter."""

    iterations: int = 0
    entries: int = 0
    bias: dict[str, float] = field(default_factory=dict)

    def add(self, record: Record) -> None:
        """Count one iteration."""
        if record.clamped is not None:
            self.iterations += record.clamped.entries > 0
            self.entries += record.clamped.entries
            self.bias |= record.clamped.bias

    def __str__(self) -> str:
        """For the last line of a run; empty where nothing was clamped."""
        if not self.iterations:
            return ""
        shares = ", ".join(f"{100 * value:.2g} % of that of {key}" for key, value in self.bias.items())
        return f"{self.entries} entries of gradients clamped in {self.iterations} iterations: a bias of {shares}"


@dataclass
class RegularizedTally(_Tally):
    """What regularizers cost in the last iteration, by parameter and type, and the iterations after which heights were
    held at the least thickness, and how many heights after the last."""

    iterations: int = 0
    costs: dict[str, dict[str, float]] = field(default_factory=dict)
    held_iterations: int = 0
    held: dict[str, int] = field(default_factory=dict)

    def add(self, record: Record) -> None:
        """Count one iteration."""
        if record.regularized is not None:
            self.iterations += 1
            self.costs, self.held = record.regularized.costs, record.regularized.held
            self.held_iterations += any(self.held.values())

    def __str__(self) -> str:
        """For the last line of a run; empty where nothing is regularized."""
        told = [f"{name} of {key} {value:.3g}" for key, costs in self.costs.items() for name, value in costs.items()
                if value]  # fmt: skip
        if self.held_iterations:
            heights = sum(self.held.values())
            told.append(f"heights held at the least thickness in {self.held_iterations} iterations ({heights} at last)")
        return f"beside the loss: {', '.join(told)}" if told else ""
