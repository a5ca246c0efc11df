"""Sources of a page: folders of runs and sweeps, and files of measuring commands, recognised by content."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.errors import ConfigError, one_line
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.measurement_files import Origin, read_lines
from reslrb_cli.records.measurements import record_of
from reslrb_cli.records.metrics import METRICS_FILE, Record
from reslrb_cli.records.sweeps import SweepPlan, is_sweep, read_sweep, run_name
from reslrb_cli.report.format import count

Array = np.ndarray[Any, Any]

logger = logging.getLogger(__name__)

#: Values of a record's fields that a line may lack, and the other fields, which are numbers.
_DEFAULTS = {
    each.name: each.default_factory() if each.default_factory is not MISSING else each.default
    for each in fields(Record)
    if each.default is not MISSING or each.default_factory is not MISSING
}
_FIGURES = [each.name for each in fields(Record) if each.name not in _DEFAULTS]


@dataclass(frozen=True)
class ShownRun:
    """Run: its folder, its name on the page, its manifest, and one record per iteration.

    `current` holds the parameter values by key while the run is in progress, otherwise None.
    """

    path: Path
    name: str
    manifest: Mapping[str, Any]
    records: Sequence[Mapping[str, Any]]
    current: Mapping[str, Array] | None = None

    @property
    def at_work(self) -> bool:
        """Whether the run was in progress when it was read."""
        return self.manifest.get("status") == "running"

    @property
    def results(self) -> Mapping[str, Any]:
        """The results so far."""
        return self.manifest.get("results") or {}

    @property
    def iterations(self) -> int:
        """Number of iterations so far, including those whose lines are damaged."""
        return int(self.records[-1]["iteration"] or 0) + 1 if self.records else 0

    def column(self, name: str) -> list[float | None]:
        """Return the metric `name` of every iteration."""
        return [record[name] for record in self.records]

    def last(self, name: str) -> float | None:
        """Return the last known value of the metric `name`."""
        return next((record[name] for record in reversed(self.records) if record[name] is not None), None)

    @property
    def codegen_s(self) -> float:
        """Seconds spent on generating and compiling kernels."""
        return sum(record["codegen_ms"] for record in self.records) / 1e3

    @property
    def peak(self) -> str:
        """The peak memory in words."""
        return f"{max(record['peak_mib'] for record in self.records):.4g} MiB" if self.records else ""

    @property
    def scales(self) -> dict[str, float | None]:
        """The root mean square of each parameter's true value, by key, or None if unknown."""
        return {key: entry.get("scale") for key, entry in (self.results.get("parameters") or {}).items()}


@dataclass(frozen=True)
class Measurements:
    """Objects in a file of the command `kind`: `bench`, `gradcheck` or `convergence`.

    `origins` has one entry if a single command wrote the file, and none in files of older versions.
    """

    path: Path
    name: str
    kind: str
    objects: Sequence[Mapping[str, Any]]
    origins: Sequence[Origin] = ()


@dataclass(frozen=True)
class SweepRuns:
    """Sweep, and its runs that have a folder, by name."""

    path: Path
    name: str
    sweep: SweepPlan
    runs: Mapping[str, ShownRun]
    kind = "sweep"


Source = ShownRun | Measurements | SweepRuns


def read_sources(paths: Sequence[Path]) -> list[Source]:
    """Read the source at each path, but no link to another of the paths, such as `runs/latest` in `runs/*`.

    Raises a ConfigError that names the first path that a page cannot show.
    """
    found: list[Source] = []
    others = {os.path.realpath(path) for path in paths if not path.is_symlink()}
    paths = [path for path in paths if not (path.is_symlink() and os.path.realpath(path) in others)]
    for path, name in zip(paths, _names(paths), strict=True):
        if not os.path.isdir(path):
            found.append(_read_file(path, name))
        elif read_manifest(path) is not None:
            found.append(read_run(path, name))
        elif is_sweep(path):
            found.append(read_sweep_runs(path, name))
        else:
            reason = "is no run folder and no sweep; give the folder of a run, or a file that --json wrote"
            raise ConfigError(path, "", reason)
    return found


def read_run(folder: Path, name: str | None = None, mend: bool = True) -> ShownRun:
    """Read the run in `folder` as far as possible. For any other folder, return an empty run. `mend` is as in
    `read_manifest`. Damaged lines of the metrics are left out, with a warning.

    Raises ConfigError if the metrics cannot be read.
    """
    metrics, lost = folder / METRICS_FILE, list[int]()
    entries = read_lines(metrics, lost) if metrics.exists() else []
    records = [_DEFAULTS | entry for entry in entries if all(_is_figure(entry.get(name, "")) for name in _FIGURES)]
    if left_out := len(lost) + len(entries) - len(records):
        logger.warning("%s: %s left out, because they are damaged", metrics, count(left_out, "line"))
    return ShownRun(folder, name or folder.absolute().name, read_manifest(folder, mend) or {}, records)


def _is_figure(value: object) -> bool:
    return value is None or isinstance(value, int | float)


def read_sweep_runs(folder: Path, name: str | None = None) -> SweepRuns:
    """Read the sweep in `folder`, and as many of its runs as can be read. Raises ConfigError, located in its plan."""
    sweep = read_sweep(folder)
    names = [run_name(*run) for run in sweep.runs]
    runs = {name: read_run(folder / name, name) for name in names if read_manifest(folder / name) is not None}
    return SweepRuns(folder, name or folder.absolute().name, sweep, runs)


def _read_file(path: Path, name: str) -> Measurements:
    objects = read_lines(path)
    kind = next((kind for entry in objects if (kind := kind_of(entry)) is not None), None)
    if kind is None:
        reason = (
            "holds no line that bench, gradcheck or convergence wrote; give a file that --json wrote, or a run folder"
        )
        raise ConfigError(path, "", reason)
    heads, others = ([e for e in objects if (e.get("kind") == Origin.KIND) is own] for own in (True, False))
    origins = [origin for head in heads if (origin := record_of(Origin, head)) is not None]
    return Measurements(path, name, kind, others, origins)


def kind_of(entry: Mapping[str, Any]) -> str | None:
    """Return the command that wrote a line, or None if unknown."""
    if entry.get("kind") in ("point", "method"):
        return "convergence"
    if entry.get("kind") == "missing" or {"reference", "verdict"} <= set(entry):
        return "gradcheck"
    return "bench" if {"status", "step_ms"} <= set(entry) else None


def _names(paths: Sequence[Path]) -> list[str]:
    """Return a name for each path. The name omits the folders if it is unique without them."""
    short = [path.absolute().name for path in paths]
    return [name if short.count(name) == 1 else one_line(path, 200) for name, path in zip(short, paths, strict=True)]
