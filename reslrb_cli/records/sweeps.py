"""Sweeps, runs of one experiment with several settings and seeds: the plan in `sweep.json`, and records of the results.

A sweep's folder holds `sweep.json` and the subfolder `configs/`, with one configuration per combination of settings.
The folder also holds one run folder per run, named by its settings and its seed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import yaml
from pydantic import TypeAdapter, ValidationError

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.measurements import Band
from reslrb_cli.records.metrics import Line
from reslrb_cli.version import __version__

SWEEP_FILE, PAGE_FILE, RESULTS_FILE, CONFIGS = "sweep.json", "sweep.html", "results.jsonl", "configs"

#: Version of the file; other versions are not read.
VERSION = 1

#: Valid names of combinations: folder names that cannot leave the folder of the sweep.
_NAME = re.compile(r"[\w+=-][\w.+=-]*")

#: A method such as `reslrb:stack(paths=both)`, which YAML would quote in a list without need.
_METHOD = re.compile(r"[A-Za-z][\w./-]*:\w[\w=().-]*")


@dataclass(frozen=True)
class Combination:
    """Combination of settings: its name and the value of each varied key, as plain data."""

    name: str
    settings: dict[str, Any]


@dataclass(frozen=True)
class Failure:
    """Failure of a run: the exit code of its process (negative for a signal) and its last output line."""

    code: int
    line: str


@dataclass(frozen=True)
class SweepSearch:
    """Search for the best combination, in `trials` combinations.

    `space` maps each varied key to its values as the user wrote them: a list, or a mapping with `low`, `high` and
    perhaps `log`.
    """

    trials: int
    space: dict[str, Any]


@dataclass(frozen=True)
class SweepPlan:
    """Plan of a sweep: every combination with every seed, and the failed runs by name.

    With a `search`, the combinations are those of the trials so far.

    `config` is the configuration file and `overrides` the values of `--set`, both as the user wrote them. `codes` holds
    the digests of the user's code files by path. `files` holds the digests of all other files.
    """

    config: str
    overrides: list[str]
    combinations: list[Combination]
    seeds: list[int]
    failures: dict[str, Failure] = field(default_factory=dict)
    codes: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    search: SweepSearch | None = None
    version: int = VERSION
    program: str = __version__

    @property
    def keys(self) -> list[str]:
        """The varied settings."""
        return list(self.search.space if self.search else self.combinations[0].settings if self.combinations else [])

    @property
    def runs(self) -> Iterator[tuple[Combination, int]]:
        """Combination and seed of each run, in order: all combinations with the first seed, then with the next. A
        search has one combination after the other.
        """
        if self.search:
            return ((combination, seed) for combination in self.combinations for seed in self.seeds)
        return ((combination, seed) for seed in self.seeds for combination in self.combinations)

    @property
    def size(self) -> int:
        """The number of runs, including those of trials that are still to be chosen."""
        return len(self.seeds) * (self.search.trials if self.search else len(self.combinations))

    def write(self, folder: Path) -> None:
        """Write `sweep.json` into `folder`, atomically. Raises OSError."""
        text = json.dumps(asdict(self), indent=1).encode() + b"\n"
        write_atomically(folder / SWEEP_FILE, lambda file: file.write(text), durable=True)


_READER = TypeAdapter(SweepPlan)


def in_words(value: Any) -> str:
    """Return a value as one line of YAML, as on the command line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key}: {in_words(each)}" for key, each in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(in_words, value)) + "]"
    if isinstance(value, float):
        return short if float(short := f"{value:g}") == value else repr(value)
    if isinstance(value, str) and _METHOD.fullmatch(value):
        return value
    text: str = yaml.safe_dump([value], default_flow_style=True, width=2**16, allow_unicode=True)
    return " ".join(text.split())[1:-1]


def short_keys(keys: Sequence[str]) -> dict[str, str]:
    """Return the shortest unique ending of each key, such as `spp` for `run.spp`."""
    found = {}
    for key in keys:
        parts = key.split(".")
        ends = [".".join(parts[-length:]) for length in range(1, len(parts))]
        others = [f".{other}" for other in keys if other != key]
        found[key] = next((end for end in ends if not any(other.endswith(f".{end}") for other in others)), key)
    return found


def label(settings: Mapping[str, Any]) -> str:
    """Return a combination in words, `learning_rate=0.1, spp=16`, or `as it is` if nothing is varied."""
    short = short_keys(list(settings))
    return ", ".join(f"{short[key]}={in_words(value)}" for key, value in settings.items()) or "as it is"


def run_name(combination: Combination, seed: int) -> str:
    """Return the name of a run and of its folder."""
    return f"{combination.name}-seed={seed}" if combination.name else f"seed={seed}"


def config_file(folder: Path, combination: Combination) -> Path:
    """Return the path of a combination's resolved configuration in the sweep's `folder`."""
    return folder / CONFIGS / f"{combination.name or 'config'}.yaml"


def is_sweep(folder: Path) -> bool:
    """Whether `folder` is the folder of a sweep."""
    return (folder / SWEEP_FILE).is_file()


def read_sweep(folder: Path) -> SweepPlan:
    """Read the sweep in `folder`. Raises a ConfigError that names the sweep's file if the file is missing or
    damaged.
    """
    path = folder / SWEEP_FILE
    if folder.is_dir() and not path.exists():
        raise ConfigError(folder, "", f"is no sweep's folder: it has no {SWEEP_FILE}")
    try:
        sweep = _READER.validate_json(read_file(path))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        raise ConfigError(path, key, f"is damaged, or not what `reslrb sweep` writes ({first['msg']})") from None
    names = [run_name(*run) for run in sweep.runs]
    if sweep.version != VERSION:
        raise ConfigError(path, "version", f"was written by another version, {sweep.program}")
    if len({name.casefold() for name in names}) < len(names) or not all(map(_NAME.fullmatch, names)):
        raise ConfigError(path, "combinations", "have names that are no names of folders, or twice the same")
    return sweep


# --- results ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SweepRunRecord(Line):
    """Result of one run.

    - `status` is as in a manifest, or `waiting`. `message` is the error if the run failed.
    - `loss` is the loss of the final image.
    - `error` is the root mean square error over all parameters with a known true value. If the parameters have no
        common unit (`relative`), `error` is the root mean square of their relative errors.
    - `elapsed_s` are the seconds in steps and updates.
    - `peak_mib` is the peak memory of the allocator.

    Unknown values are None.
    """

    KIND: ClassVar[str] = "sweep_run"

    name: str
    settings: Mapping[str, Any]
    seed: int
    status: str
    iterations: int = 0
    loss: float | None = None
    error: float | None = None
    relative: bool = False
    elapsed_s: float | None = None
    peak_mib: float | None = None
    message: str = ""

    @property
    def is_done(self) -> bool:
        """Whether the run is finished."""
        return self.status == "finished"


@dataclass(frozen=True)
class SweepRowRecord(Line):
    """Result of one combination: median, minimum and maximum over its finished runs. `runs` of its `of` runs are
    finished.
    """

    KIND: ClassVar[str] = "sweep_row"

    name: str
    settings: Mapping[str, Any]
    runs: int
    of: int
    failed: int
    iterations: Band | None
    loss: Band | None
    error: Band | None
    elapsed_s: Band | None
    peak_mib: Band | None
    message: str = ""


@dataclass(frozen=True)
class SweepBestRecord(Line):
    """Combination with the lowest median of the quantity `of`, which is `loss` or `error`. The median is over the
    `seeds` seeds that all combinations have.

    `second` has the next median. `lower` is the number of seeds with a lower value than that of `second`.
    """

    KIND: ClassVar[str] = "sweep_best"

    of: str
    best: str
    second: str
    seeds: int
    lower: int
