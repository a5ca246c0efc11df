"""The findings of a run: what it measured before its first iteration, values not finite, and what the next run reuses.

GuidedRecord, SequenceRecord   ways of drawing samples that were left to measurement: whether they pay, and how that was
                               seen
RivalRecord                    another integrator that would have been the better choice
Offender                       where a step came upon a value that is not finite
PilotCache                     what pilots learned, kept for the next run of the same scene and parameters
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from typing_extensions import Self

from reslrb_cli.records.atomic import write_atomically

#: What an image's efficiency may be with the other samples over that without, where they serve image and gradient.
LEAST_IMAGE = 0.95


@dataclass(frozen=True, kw_only=True)
class PaidRecord:
    """What is alike of all of them.

    `gain` is the efficiency 1 / (variance * time) of the gradient with the other samples over that without, between
    `low` and `high` with 95 % confidence; `image_gain` and so on are the same of the image, of the gradient's samples
    where these serve both. None where that was not measured. `note` says why it is off where the gain does not.
    `rounds` steps of each kind of `spp` samples per pixel took `measure_s` seconds (with what was learned for them),
    `share` of 200 iterations, and first steps, which compile, `compile_s`. `cached`: an earlier run measured it.
    """

    gain: float | None = None
    low: float | None = None
    high: float | None = None
    image_gain: float | None = None
    image_low: float | None = None
    image_high: float | None = None
    rounds: int = 0
    spp: int = 0
    measure_s: float = 0.0
    compile_s: float = 0.0
    share: float = 0.0
    note: str = ""
    cached: bool = False

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """The same again. Raises TypeError where `data` is nothing that `to_json` made."""
        if data.keys() != {field.name for field in fields(cls)}:
            raise TypeError("other names than those of a record")
        number = (int, float)
        kinds: dict[str, tuple[type, ...]] = {"bool": (bool,), "str": (str,), "int": (int,), "float": number}
        kinds["float | None"] = (*number, type(None))
        for field in fields(cls):
            value, kind = data[field.name], str(field.type)
            if not isinstance(value, kinds[kind]) or (isinstance(value, bool) and kind != "bool"):
                raise TypeError(f"{field.name} is {value!r}")
        return cls(**data)

    @property
    def setting(self) -> str:
        """What the option is by this."""
        raise NotImplementedError

    def decision(self) -> str:
        """What was decided on, and how, in words."""
        raise NotImplementedError

    def why(self) -> str:
        """What was measured, in words."""
        if self.gain is None or self.low is None or self.high is None:
            return self.note
        found = f"{self.gain:.2g} times the efficiency here ({self.low:.2g} to {self.high:.2g})"
        return f"{found}; {self.note}" if self.note else found

    def line(self) -> str:
        """What the user is told."""
        if not (self.cached or self.measure_s or self.compile_s):
            return f"{self.decision()}: {self.why()}"
        cost = f"measured in {self.measure_s:.1f} s and {self.compile_s:.1f} s of first steps"
        return f"{self.decision()}: {self.why()} ({'as an earlier run measured' if self.cached else cost})"


@dataclass(frozen=True, kw_only=True)
class GuidedRecord(PaidRecord):
    """Of guided emission. `guided`: gradients are; `images`: and samples that serve an image alone."""

    guided: bool
    images: bool = False

    @property
    def setting(self) -> str:
        return "on" if self.guided else "off"

    def decision(self) -> str:
        apart = self.guided and not self.images
        return "guiding on for gradients, off for images" if apart else f"guiding {self.setting}"


@dataclass(frozen=True, kw_only=True)
class SequenceRecord(PaidRecord):
    """Of low-discrepancy numbers, which gradients and images have, or neither: `low_discrepancy`.

    `alone`: they were tried in place of guided emission, which had been found to pay, and is over that what it gains.
    """

    low_discrepancy: bool
    alone: bool = False

    @property
    def setting(self) -> str:
        return "low_discrepancy" if self.low_discrepancy else "independent"

    def decision(self) -> str:
        instead = ", guiding off" if self.alone and self.low_discrepancy else ""
        return f"sequence {self.setting}{instead}"


@dataclass(frozen=True)
class RivalRecord:
    """`integrator` beside the run's own: `advantage` is its efficiency over that one's, 1 / (variance * time), of
    gradients with the run's own loss, between `low` and `high` with 95 % confidence; None where that was not measured,
    and `note` says why. `rounds` steps of `spp` samples per pixel of each took `measure_s` seconds, compilation
    (`compile_s`) apart. `cached`: an earlier run measured it.
    """

    integrator: str
    rounds: int = 0
    spp: int = 0
    advantage: float | None = None
    low: float | None = None
    high: float | None = None
    measure_s: float = 0.0
    compile_s: float = 0.0
    note: str = ""
    cached: bool = False

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Self:
        """The same again. Raises TypeError where `data` is nothing that `to_json` made."""
        return cls(**data)

    @property
    def is_better(self) -> bool:
        """Whether it is clearly the more efficient: by no accident of the samples."""
        return self.low is not None and self.low > 1

    def line(self) -> str:
        """What was measured, in a line."""
        if self.advantage is None or self.low is None or self.high is None:
            return f"{self.integrator}: not measured: {self.note}"
        cost = f"measured in {self.measure_s:.1f} s and {self.compile_s:.1f} s of first steps"
        return (
            f"{self.integrator} has {self.advantage:.2g} times the efficiency here ({self.low:.2g} to {self.high:.2g}; "
            f"{'as an earlier run measured' if self.cached else cost})"
        )


@dataclass(frozen=True)
class PathVertex:
    """A vertex of a path, and all that the path can be traced again from.

    `samples` says which of the step's samples it belongs to, `seed` is their sampler's, `path` its index among `paths`.
    `vertex` counts from the emitter, 0; `position` is in world space; `surface` is the id of the shape there.
    """

    samples: str
    seed: int
    path: int
    paths: int
    vertex: int
    position: tuple[float, float, float]
    surface: str | None


@dataclass(frozen=True)
class Offender:
    """The first value that is not finite of one view, in the order of the paths and of their vertices.

    `quantity` is what it is, `value` one number a channel, none for a derivative of the loss. `pixel`, (x, y), is where
    it reaches the film. `where` is None for a derivative of the loss; `image` and `target`, what the loss compares
    there, are None for a path.
    """

    sensor: int
    pixel: tuple[int, int] | None
    quantity: str
    value: list[float]
    where: PathVertex | None
    image: list[float] | None = None
    target: list[float] | None = None


PILOT_FILE = "pilot.json"


#: Entries kept, the newest.
MOST = 200


def cache_folder() -> Path:
    """$RESLRB_CACHE, or `reslrb` in the user's cache folder."""
    own = os.environ.get("RESLRB_CACHE")
    if own:
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "reslrb"


def key_of(what: dict[str, Any]) -> str:
    """The key of an entry from all that it depends on, of plain values."""
    return hashlib.blake2b(json.dumps(what, sort_keys=True, default=str).encode(), digest_size=16).hexdigest()


class PilotCache:
    """A JSON file of entries by key. One that cannot be read is empty, one that cannot be written stays as it is, and
    `keeps` is False from then on."""

    def __init__(self, folder: Path | None = None) -> None:
        self._given = folder
        self.keeps = True

    def get(self, key: str) -> dict[str, Any] | None:
        """The entry of `key`, if there is one."""
        entry = self._read().get(key)
        return entry if isinstance(entry, dict) else None

    def put(self, key: str, entry: dict[str, Any]) -> None:
        """Keep an entry, as the newest."""
        entries = {name: value for name, value in self._read().items() if name != key}
        entries = {**dict(list(entries.items())[1 - MOST :]), key: entry}
        text = json.dumps(entries, indent=1)
        try:
            path = self._path()
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, lambda file: file.write(text.encode() + b"\n"))
        except (OSError, RuntimeError):  # RuntimeError: there is no home
            self.keeps = False

    def _path(self) -> Path:
        return (self._given or cache_folder()) / PILOT_FILE

    def _read(self) -> dict[str, Any]:
        try:
            content = json.loads(self._path().read_text(encoding="utf-8"))
        except (OSError, ValueError, RuntimeError):
            return {}
        return content if isinstance(content, dict) else {}
