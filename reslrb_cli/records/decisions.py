"""Decisions and measurements from before the first iteration, as manifest, checkpoints and cache store them.

Decision                setting that was `auto`: its value, and why
DecisionCache           decisions of earlier runs, for the next run of the same scene and parameters
Scaled                  measured scale of a parameter
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from typing_extensions import Self

from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.lock import FolderLock, InUse


class Jsonable:
    """Base class of dataclasses that are written as JSON and read back."""

    def to_json(self) -> dict[str, Any]:
        """Return the record as a mapping for JSON."""
        found: dict[str, Any] = asdict(self)  # type: ignore[call-overload]  # each is a dataclass
        return found

    @classmethod
    def from_json(cls, data: Any) -> Self:
        """Return the record from the result of `to_json`. Raises TypeError for any other data."""
        try:
            # Validated as JSON, because strict validation of Python values rejects a mapping for a dataclass.
            return TypeAdapter(cls).validate_json(json.dumps(data), strict=True)
        except ValidationError as error:
            raise TypeError(f"no {cls.__name__}: {error}") from None


# --- decisions --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Decision(Jsonable):
    """Setting of the integrator that was `auto`, with its `value` in this run.

    `why` is the reason in words. If a measurement decided, `gain` is the efficiency of one way of sampling divided by
    the efficiency of another. The efficiency is 1 / (variance * time). `low` and `high` are the ends of the gain's 95 %
    interval. Without a measurement, all three are None. The measurement took `seconds`. `cached` is true if an earlier
    run made it.
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
        """Return the line for the user, with the time of the measurement if `cost` is set."""
        line = f"{self.setting} {self.value}: {self.why}"
        if not cost or not self.seconds:
            return line
        return f"{line} ({'as an earlier run measured' if self.cached else f'measured in {self.seconds:.1f} s'})"


#: The file of the cache, and the maximum number of entries; the oldest are dropped.
CACHE_FILE, MOST = "decisions.json", 200


def cache_folder() -> Path:
    """Return $RESLRB_CACHE, or `reslrb` in the user's cache folder."""
    if own := os.environ.get("RESLRB_CACHE"):
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "reslrb"


def key_of(what: dict[str, Any]) -> str:
    """Return the key of an entry, a hash of all plain values that the entry depends on."""
    return hashlib.blake2b(json.dumps(what, sort_keys=True, default=str).encode(), digest_size=16).hexdigest()


class DecisionCache:
    """JSON file of decisions by key.

    An unreadable file counts as empty. If writing fails, the file is unchanged.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._given = folder

    def get(self, key: str) -> Decision | None:
        """Return the decision of `key`, or None if there is none that this version can read."""
        try:
            return Decision.from_json(self._read().get(key))
        except TypeError:
            return None

    def put(self, key: str, decision: Decision) -> None:
        """Store a decision as the newest entry."""
        with contextlib.suppress(OSError, RuntimeError, InUse):  # RuntimeError: no home folder
            path = self._path()
            path.parent.mkdir(parents=True, exist_ok=True)
            with FolderLock(Path(os.path.realpath(path.parent))):  # other runs store theirs, too
                entries = {name: value for name, value in self._read().items() if name != key}
                entries = {**dict(list(entries.items())[1 - MOST :]), key: decision.to_json()}
                text = json.dumps(entries, indent=1)
                write_atomically(path, lambda file: file.write(text.encode() + b"\n"))

    def _path(self) -> Path:
        return (self._given or cache_folder()) / CACHE_FILE

    def _read(self) -> dict[str, Any]:
        try:
            content = json.loads(self._path().read_text(encoding="utf-8"))
        except (OSError, ValueError, RuntimeError):
            return {}
        return content if isinstance(content, dict) else {}


# --- scales -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scaled(Jsonable):
    """Measured scale of a parameter with `entries` numbers, for `scale: curvature`.

    `value` and `gradient` are root mean squares over the entries. `curvature` is the largest curvature of the loss in
    the optimiser's variable. `first_step` is how far one learning rate initially moves the value, in the scene's units.
    Both are None if the parameter was not scaled.
    """

    key: str
    entries: int
    value: float
    gradient: float
    curvature: float | None = None
    first_step: float | None = None
