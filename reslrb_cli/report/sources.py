"""What a page is made of: folders of runs and sweeps, files of measuring commands, told apart by what is in them."""

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
from reslrb_cli.records.sweeps import Sweep, is_sweep, read_sweep, run_name

Array = np.ndarray[Any, Any]

#: Figures that a record of a run has, or it is none.
_FIGURES = ("iteration", "elapsed_s", "step_ms", "codegen_ms", "peak_mib", "spp")

#: All that a record may have.
_ALL_FIGURES = [field.name for field in fields(metrics.Record) if field.type in ("int", "float", "float | None")]

#: Layers of a map of a gradient, as `gradcheck --images` writes them.
MAP_LAYERS = ("gradient", "reference", "z")


@dataclass(frozen=True)
class Run:
    """A run: its folder, its name on the page, what its manifest says, and its metrics, an iteration each.

    `current` are the parameters' values by key while it is at work, else None. `damaged` are lines that could not be
    read.
    """

    path: Path
    name: str
    manifest: Mapping[str, Any]
    records: Sequence[Mapping[str, Any]]
    current: Mapping[str, Array] | None = None
    damaged: Sequence[int] = ()

    @property
    def at_work(self) -> bool:
        """Whether it had no end when this was taken down."""
        return self.manifest.get("status") == "running"

    @property
    def results(self) -> Mapping[str, Any]:
        """What it came to, so far."""
        results = self.manifest.get("results")
        return results if isinstance(results, dict) else {}

    def last(self, name: str) -> float | None:
        """The last figure of that name that is known."""
        return next((record[name] for record in reversed(self.records) if record[name] is not None), None)

    @property
    def codegen_s(self) -> float:
        """Seconds of these in which kernels were generated and compiled."""
        return sum(record["codegen_ms"] for record in self.records) / 1e3

    @property
    def peak(self) -> str:
        """The most memory that it took, in words."""
        return f"{max(record['peak_mib'] for record in self.records):.4g} MiB" if self.records else ""

    @property
    def scales(self) -> dict[str, float | None]:
        """The root mean square of each parameter's true value, by key; None where it is not known."""
        about = self.results.get("parameters")
        if not isinstance(about, dict):
            return {}
        return {key: entry.get("scale") for key, entry in about.items() if isinstance(entry, dict)}


@dataclass(frozen=True)
class Measurements:
    """The objects in a file of `bench`, `gradcheck` or `convergence`, which `kind` is the name of.

    `origins` are those that the file names, one where a single command wrote it: none in files of older versions.
    """

    path: Path
    name: str
    kind: str
    objects: Sequence[Mapping[str, Any]]
    damaged: Sequence[int] = ()
    origins: Sequence[Origin] = ()


@dataclass(frozen=True)
class Maps:
    """A folder of maps of gradients, and the files in it that are such."""

    path: Path
    name: str
    files: Sequence[Path] = ()
    kind = "maps"


@dataclass(frozen=True)
class SweepRuns:
    """A sweep, and those of its runs that have a folder, by their names."""

    path: Path
    name: str
    sweep: Sweep
    runs: Mapping[str, Run]
    kind = "sweep"


Source = Run | Measurements | Maps | SweepRuns


def read_sources(paths: Sequence[Path], tell: Tell | None = None) -> list[Source]:
    """What lies at each path; `tell` hears how far reading has come.

    Raises ConfigError, located in the first that is nothing of what a page can show.
    """
    found: list[Source] = []
    for path, name in zip(paths, _names(paths), strict=True):
        try:
            is_folder = path.is_dir()
        except (OSError, ValueError):  # a null character
            is_folder = False
        found.append(_read_folder(path, name, tell) if is_folder else _read_file(path, name, tell))
    return found


def read_run(folder: Path, name: str | None = None, tell: Tell | None = None) -> Run:
    """The run in `folder`, as far as it can be read; of another folder, one that says nothing."""
    try:
        lines = read_lines(folder / metrics.METRICS_FILE, tell)
        damaged = lines.damaged
        records = [record for entry in lines.objects if (record := _record(entry)) is not None]
    except ConfigError:  # there are none yet
        records, damaged = [], []
    return Run(folder, name or folder.absolute().name, read_manifest(folder) or {}, records, damaged=damaged)


def read_sweep_runs(folder: Path, name: str | None = None, tell: Tell | None = None) -> SweepRuns:
    """The sweep in `folder`, and its runs as far as they can be read. Raises ConfigError, located in its plan."""
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
    """Which command wrote a line; None where that cannot be told."""
    if entry.get("kind") in ("point", "method"):
        return "convergence"
    if entry.get("kind") == "missing" or {"reference", "verdict"} <= set(entry):
        return "gradcheck"
    return "bench" if {"integrator", "status", "step_ms"} <= set(entry) else None


def _record(entry: dict[str, Any]) -> dict[str, Any] | None:
    """A line of `metrics.jsonl`, changed so that its figures are figures; None where what each has is missing."""
    if not all(is_number(entry.get(key)) for key in _FIGURES):
        return None
    errors = entry.get("parameter_errors")
    entry["parameter_errors"] = _figures(errors) if isinstance(errors, dict) else {}
    return entry | _figures({key: entry.get(key) for key in _ALL_FIGURES})


def _figures(values: Mapping[str, Any]) -> dict[str, float | None]:
    return {key: value if is_number(value) else None for key, value in values.items()}


def is_number(value: object) -> TypeGuard[float]:
    """Whether it is a finite number."""
    return isinstance(value, float | int) and not isinstance(value, bool) and -1e300 < value < 1e300


def _names(paths: Sequence[Path]) -> list[str]:
    """A name of each, without its folders where that tells them apart."""
    short = [path.absolute().name for path in paths]
    return [name if short.count(name) == 1 else one_line(path, 200) for name, path in zip(short, paths, strict=True)]
