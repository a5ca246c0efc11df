"""Sources of a page: folders of runs, sweeps and maps, and files of measuring commands, recognised by content."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from reslrb_cli.errors import ConfigError, one_line
from reslrb_cli.records import metrics
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.measurement_files import Origin, Tell, read_lines, read_origin
from reslrb_cli.records.sweeps import SweepPlan, is_sweep, read_sweep, run_name

Array = np.ndarray[Any, Any]

#: Numbers that every record of a run has.
_FIGURES = ("iteration", "elapsed_s", "step_ms", "codegen_ms", "peak_mib", "spp")

#: All numbers that a record can have.
_ALL_FIGURES = [field.name for field in fields(metrics.Record) if field.type in ("int", "float", "float | None")]

#: Layers of a gradient map written by `gradcheck --images`.
MAP_LAYERS = ("gradient", "reference", "z")


@dataclass(frozen=True)
class ShownRun:
    """Run: its folder, its name on the page, its manifest, and one record per iteration.

    `current` holds the parameter values by key while the run is in progress, otherwise None. `damaged` holds the
    numbers of unreadable lines.
    """

    path: Path
    name: str
    manifest: Mapping[str, Any]
    records: Sequence[Mapping[str, Any]]
    current: Mapping[str, Array] | None = None
    damaged: Sequence[int] = ()

    @property
    def at_work(self) -> bool:
        """Whether the run was in progress when it was read."""
        return self.manifest.get("status") == "running"

    @property
    def results(self) -> Mapping[str, Any]:
        """The results so far."""
        results = self.manifest.get("results")
        return results if isinstance(results, dict) else {}

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
        about = self.results.get("parameters")
        if not isinstance(about, dict):
            return {}
        return {key: entry.get("scale") for key, entry in about.items() if isinstance(entry, dict)}


@dataclass(frozen=True)
class Measurements:
    """Objects in a file of the command `kind`: `bench`, `gradcheck` or `convergence`.

    `origins` has one entry if a single command wrote the file, and none in files of older versions.
    """

    path: Path
    name: str
    kind: str
    objects: Sequence[Mapping[str, Any]]
    damaged: Sequence[int] = ()
    origins: Sequence[Origin] = ()


@dataclass(frozen=True)
class Maps:
    """Folder of gradient maps, and the map files in it."""

    path: Path
    name: str
    files: Sequence[Path] = ()
    kind = "maps"


@dataclass(frozen=True)
class SweepRuns:
    """Sweep, and its runs that have a folder, by name."""

    path: Path
    name: str
    sweep: SweepPlan
    runs: Mapping[str, ShownRun]
    kind = "sweep"


Source = ShownRun | Measurements | Maps | SweepRuns


def read_sources(paths: Sequence[Path], tell: Tell | None = None) -> list[Source]:
    """Read the source at each path. The function calls `tell` with the reading progress.

    Raises a ConfigError that names the first path that a page cannot show.
    """
    found: list[Source] = []
    for path, name in zip(paths, _names(paths), strict=True):
        try:
            is_folder = path.is_dir()
        except (OSError, ValueError):  # a null character
            is_folder = False
        found.append(_read_folder(path, name, tell) if is_folder else _read_file(path, name, tell))
    return found


def read_run(folder: Path, name: str | None = None, tell: Tell | None = None) -> ShownRun:
    """Read the run in `folder` as far as possible. For any other folder, return an empty run."""
    try:
        lines = read_lines(folder / metrics.METRICS_FILE, tell)
        damaged = lines.damaged
        records = [record for entry in lines.objects if (record := _record(entry)) is not None]
    except ConfigError:  # there are none yet
        records, damaged = [], []
    return ShownRun(folder, name or folder.absolute().name, read_manifest(folder) or {}, records, damaged=damaged)


def read_sweep_runs(folder: Path, name: str | None = None, tell: Tell | None = None) -> SweepRuns:
    """Read the sweep in `folder`, and as many of its runs as can be read. Raises ConfigError, located in its plan."""
    sweep = read_sweep(folder)
    names = [run_name(*run) for run in sweep.runs]
    runs = {name: read_run(folder / name, name, tell) for name in names if read_manifest(folder / name) is not None}
    return SweepRuns(folder, name or folder.absolute().name, sweep, runs)


def _read_folder(path: Path, name: str, tell: Tell | None) -> Source:
    if read_manifest(path) is not None:
        return read_run(path, name, tell)
    if is_sweep(path):
        return read_sweep_runs(path, name, tell)
    from reslrb_cli.records.images import read_layer_names

    try:
        maps = [file for file in sorted(path.glob("*.exr")) if set(MAP_LAYERS) <= read_layer_names(file)]
    except OSError as error:
        raise ConfigError(path, "", f"cannot be read: {error.strerror}") from None
    if maps:
        return Maps(path, name, maps)
    reason = "is no run folder, no sweep and no folder of maps; give the folder of a run, or a file that --json wrote"
    raise ConfigError(path, "", reason)


def _read_file(path: Path, name: str, tell: Tell | None) -> Measurements:
    lines = read_lines(path, tell)
    kinds = [kind for entry in lines.objects if (kind := _kind(entry)) is not None]
    if not kinds:
        reason = (
            "holds no line that bench, gradcheck or convergence wrote; give a file that --json wrote, or a run folder"
        )
        raise ConfigError(path, f"line {lines.damaged[0]}" if lines.damaged else "", reason)
    kind = max(dict.fromkeys(kinds), key=kinds.count)
    origins = [origin for entry in lines.objects if (origin := read_origin(entry)) is not None]
    objects = [entry for entry in lines.objects if read_origin(entry) is None]
    return Measurements(path, name, kind, objects, lines.damaged, origins)


def _kind(entry: Mapping[str, Any]) -> str | None:
    """Return the command that wrote a line, or None if unknown."""
    if entry.get("kind") in ("point", "method"):
        return "convergence"
    if entry.get("kind") == "missing" or {"reference", "verdict"} <= set(entry):
        return "gradcheck"
    return "bench" if {"integrator", "status", "step_ms"} <= set(entry) else None


def _record(entry: dict[str, Any]) -> dict[str, Any] | None:
    """Return a line of `metrics.jsonl` with None in place of invalid numbers. Return None if a required number is
    missing.
    """
    if not all(is_number(entry.get(key)) for key in _FIGURES):
        return None
    errors = entry.get("parameter_errors")
    entry["parameter_errors"] = _figures(errors) if isinstance(errors, dict) else {}
    return entry | _figures({key: entry.get(key) for key in _ALL_FIGURES})


def _figures(values: Mapping[str, Any]) -> dict[str, float | None]:
    return {key: value if is_number(value) else None for key, value in values.items()}


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is a finite number."""
    return isinstance(value, float | int) and not isinstance(value, bool) and -1e300 < value < 1e300


def _names(paths: Sequence[Path]) -> list[str]:
    """Return a name for each path. The name omits the folders if it is unique without them."""
    short = [path.absolute().name for path in paths]
    return [name if short.count(name) == 1 else one_line(path, 200) for name, path in zip(short, paths, strict=True)]
