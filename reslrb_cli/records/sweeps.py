"""Sweeps, runs of one experiment at several settings and seeds: the plan in `sweep.json`, and records of what they came
to.

The folder of a sweep has, beside that file, a configuration for each combination of settings in `configs/`, and the
folder of each run, which is named by its settings and its seed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import yaml
from pydantic import TypeAdapter, ValidationError

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.measurements import Band, Range
from reslrb_cli.records.metrics import Line
from reslrb_cli.version import __version__

SWEEP_FILE, PAGE_FILE, CONFIGS = "sweep.json", "sweep.html", "configs"

#: Of the file; another one is not read.
VERSION = 1

#: What a combination may be called: the name of a folder, and no way out of it.
_NAME = re.compile(r"[\w+=-][\w.+=-]*")

#: A method such as `reslrb:stack(paths=both)`: YAML would quote it in a list, though it need not.
_METHOD = re.compile(r"[A-Za-z][\w./-]*:\w[\w=().-]*")


@dataclass(frozen=True)
class Combination:
    """One combination of settings: its name, and the value of each key that is varied, as plain data."""

    name: str
    settings: dict[str, Any]


@dataclass(frozen=True)
class Failure:
    """How a run failed: the exit code of its process, negative for a signal, and what that said last."""

    code: int
    line: str


@dataclass(frozen=True)
class Sweep:
    """What a sweep consists of: every combination with every seed; and which runs failed, by name.

    `config` is the file that it was made from, `overrides` what was given to `--set`, both as the user wrote them.
    `codes` are the digests of the files of the user's own code that its runs call, by path, `files` of all others.
    """

    config: str
    overrides: list[str]
    combinations: list[Combination]
    seeds: list[int]
    failures: dict[str, Failure] = field(default_factory=dict)
    codes: dict[str, str] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    version: int = VERSION
    program: str = __version__

    @property
    def keys(self) -> list[str]:
        """The settings that are varied."""
        return list(self.combinations[0].settings) if self.combinations else []

    @property
    def runs(self) -> Iterator[tuple[Combination, int]]:
        """Combination and seed of each run, in their order: all combinations of one seed, then those of the next."""
        return ((combination, seed) for seed in self.seeds for combination in self.combinations)

    def with_failure(self, name: str, failure: Failure | None) -> Sweep:
        """The same where the run `name` failed, or None, did not."""
        others = {other: each for other, each in self.failures.items() if other != name}
        return replace(self, failures=others if failure is None else {**others, name: failure})

    def write(self, folder: Path) -> None:
        """Write `sweep.json` into `folder`, atomically. Raises OSError."""
        text = json.dumps(asdict(self), indent=1).encode() + b"\n"
        write_atomically(folder / SWEEP_FILE, lambda file: file.write(text), durable=True)


_READER = TypeAdapter(Sweep)


def in_words(value: Any) -> str:
    """A value as it is written on the command line: YAML on one line."""
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
    """By key the end of it that tells it from the others: `spp` of `run.spp`, if no other ends so."""
    found = {}
    for key in keys:
        parts = key.split(".")
        ends = [".".join(parts[-length:]) for length in range(1, len(parts) + 1)]
        others = [f".{other}" for other in keys if other != key]
        found[key] = next((end for end in ends if not any(other.endswith(f".{end}") for other in others)), key)
    return found


def label(settings: Mapping[str, Any]) -> str:
    """A combination in words, `learning_rate=0.1, spp=16`; of settings that are not varied, `as it is`."""
    short = short_keys(list(settings))
    return ", ".join(f"{short[key]}={in_words(value)}" for key, value in settings.items()) or "as it is"


def run_name(combination: Combination, seed: int) -> str:
    """The name of a run, and of its folder."""
    return f"{combination.name}-seed={seed}" if combination.name else f"seed={seed}"


def config_file(folder: Path, combination: Combination) -> Path:
    """The configuration of a combination, as resolved, in the sweep's `folder`."""
    return folder / CONFIGS / f"{combination.name or 'config'}.yaml"


def is_sweep(folder: Path) -> bool:
    """Whether `folder` is one of a sweep."""
    return (folder / SWEEP_FILE).is_file()


def read_sweep(folder: Path) -> Sweep:
    """The sweep in `folder`. Raises ConfigError, located in its file, where it is none, or damaged."""
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


# --- what they came to ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SweepRunRecord(Line):
    """What one run came to: `status` as in a manifest, or `waiting`; `message` says what it failed of.

    `loss` is that of its final image, `error` the root mean square error over all parameters whose true value is known,
    or, where these have no common unit (`relative`), the root mean square of their relative errors. `elapsed_s` are
    seconds in steps and updates, `peak_mib` what the allocator held at the most. What is not known is None.
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
        """Whether it came to its end."""
        return self.status == "finished"


@dataclass(frozen=True)
class SweepRowRecord(Line):
    """What the finished runs of one combination came to, `runs` of `of`: medians, the least and the greatest.

    `loss_ratio` and `error_ratio` are the median over that of the first combination that can be compared, with the 95 %
    interval of a bootstrap over the seeds. Combinations that differ in learning rates alone are compared at their best
    rate, which alone has a ratio. None of fewer than 5 seeds.
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
    loss_ratio: Range | None = None
    error_ratio: Range | None = None
    message: str = ""


@dataclass(frozen=True)
class SweepBestRecord(Line):
    """Which combination has the lowest median `of` what (`loss` or `error`), over `seeds` seeds that all have.

    Combinations that differ in learning rates alone are compared at their best rate. From those `tied` it is not told,
    those it `beats` it is, by Wilcoxon's test of signed ranks, in pairs of the same seed. `second` has the next median,
    `ratio` is that of the best over it, with the 95 % interval of a bootstrap over the seeds, None of fewer than 5 of
    them. `line` is the record in words.
    """

    KIND: ClassVar[str] = "sweep_best"

    of: str
    best: str
    second: str
    tied: Sequence[str]
    beats: Sequence[str]
    seeds: int
    ratio: Range | None
    line: str
