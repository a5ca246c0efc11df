"""What a run decides and plans before its first iteration, as manifest, checkpoints and the cache have it.

Decision                a setting that was left to `auto`: its value here, and why
DecisionCache           decisions of earlier runs, for the next run of the same scene and parameters
Estimate, MemoryPlan    how a memory budget is kept
Sensitivity, Scaled     what was measured of a parameter
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError
from typing_extensions import Self

from reslrb_cli.records.atomic import write_atomically


class Jsonable:
    """Base of dataclasses that are written as JSON and read back."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        found: dict[str, Any] = asdict(self)  # type: ignore[call-overload]  # each is a dataclass
        return found

    @classmethod
    def from_json(cls, data: Any) -> Self:
        """The same again. Raises TypeError where `data` is nothing that `to_json` made."""
        try:
            # As JSON: strict of Python's values, it would take no mapping for a dataclass.
            return TypeAdapter(cls).validate_json(json.dumps(data), strict=True)
        except ValidationError as error:
            raise TypeError(f"no {cls.__name__}: {error}") from None


# --- decisions --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Decision(Jsonable):
    """A setting of the integrator that was left to `auto`: its `value` in this run, and `why`.

    `gain` is the efficiency of one way of sampling over that of another, `low` and `high` are the ends of its 95 %
    interval; `why` names the two ways. All three are None where nothing was measured. The measurement took `seconds`.
    `cached` says that an earlier run made it.
    """

    setting: str
    value: str
    why: str
    gain: float | None = None
    low: float | None = None
    high: float | None = None
    seconds: float = 0.0
    cached: bool = False

    def line(self, cost: bool = False) -> str:
        """Return the words for the user; with `cost`, add what the measurement took."""
        line = f"{self.setting} {self.value}: {self.why}"
        if not cost or not self.seconds:
            return line
        return f"{line} ({'as an earlier run measured' if self.cached else f'measured in {self.seconds:.1f} s'})"


#: The file of the cache, and how many entries it keeps, the newest.
CACHE_FILE, MOST = "decisions.json", 200


def cache_folder() -> Path:
    """$RESLRB_CACHE, or `reslrb` in the user's cache folder."""
    if own := os.environ.get("RESLRB_CACHE"):
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "reslrb"


def key_of(what: dict[str, Any]) -> str:
    """The key of an entry from all that it depends on, of plain values."""
    return hashlib.blake2b(json.dumps(what, sort_keys=True, default=str).encode(), digest_size=16).hexdigest()


class DecisionCache:
    """A JSON file of decisions by key. One that cannot be read is empty, one that cannot be written stays as it is, and
    `keeps` is False from then on."""

    def __init__(self, folder: Path | None = None) -> None:
        self._given = folder
        self.keeps = True

    def get(self, key: str) -> Decision | None:
        """Return the decision of `key`, if there is one that this version wrote."""
        try:
            return Decision.from_json(self._read().get(key))
        except TypeError:
            return None

    def put(self, key: str, decision: Decision) -> None:
        """Keep a decision, as the newest."""
        entries = {name: value for name, value in self._read().items() if name != key}
        entries = {**dict(list(entries.items())[1 - MOST :]), key: decision.to_json()}
        text = json.dumps(entries, indent=1)
        try:
            path = self._path()
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, lambda file: file.write(text.encode() + b"\n"))
        except (OSError, RuntimeError):  # RuntimeError: there is no home
            self.keeps = False

    def _path(self) -> Path:
        return (self._given or cache_folder()) / CACHE_FILE

    def _read(self) -> dict[str, Any]:
        try:
            content = json.loads(self._path().read_text(encoding="utf-8"))
        except (OSError, ValueError, RuntimeError):
            return {}
        return content if isinstance(content, dict) else {}


# --- plans and measurements of other kinds ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Estimate:
    """Bytes that a step is expected to take: what stands before it, with the targets (`fixed`), its images and
    parameters (`images`), thread-local memory (`scratch`), and what is kept of the paths of one pass (`paths`)."""

    fixed: int
    images: int
    scratch: int
    paths: int

    @property
    def total(self) -> int:
        """All of it."""
        return self.fixed + self.images + self.scratch + self.paths


@dataclass
class MemoryPlan(Jsonable):
    """How a budget is kept: the samples of a pass, what is expected, and, after the first iterations, what was used."""

    budget_bytes: int
    samples_per_pass: int
    passes: int
    expected_bytes: Estimate
    peak_mib: float | None = None
    exceeded: bool = False

    def check(self, peak: float) -> str | None:
        """Take note of the allocator's peak in MiB; the warning, the first time that it is above the budget."""
        self.peak_mib = peak
        used, before = peak * 2**20 + self.expected_bytes.scratch, self.exceeded
        self.exceeded = used > self.budget_bytes
        if not self.exceeded or before:
            return None
        allowed = f"{self.budget_bytes / 2**20:.1f} MiB"
        return f"run.memory_budget: {used / 2**20:.1f} MiB were used, more than the {allowed} that it allows"


@dataclass(frozen=True)
class Sensitivity(Jsonable):
    """What was measured of one parameter of `entries` numbers, in the scene's units.

    `value`, `gradient` and `noise` are root mean squares over the entries: of the values, of the gradient (0 where the
    samples do not tell it from noise), of the standard deviation of one sample (one step's gradient). `change` is
    relative, per unit; it, `curvature` (loss per unit²) and `length` are None where no change of the image was seen.
    """

    key: str
    entries: int
    value: float
    gradient: float
    noise: float
    change: float | None = None
    curvature: float | None = None
    length: float | None = None


@dataclass(frozen=True)
class Scaled(Sensitivity):
    """What was measured of a parameter, and what was made of it.

    `own_length` is `length` in what the optimiser moves, its variable, and `first_step`, in the scene's units, how far
    one learning rate of that moves the value where it starts; both are None where the parameter was not scaled.
    """

    own_length: float | None = None
    first_step: float | None = None
