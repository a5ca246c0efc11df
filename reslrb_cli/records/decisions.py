"""The findings of a run: what it measured before its first iteration, as manifest, checkpoints and the cache have it.

PathsRecord                    from which side paths are traced
GuidedRecord, SequenceRecord   ways of drawing samples that were left to measurement: whether they pay
PixelsRecord                   whether camera paths are shared out over the pixels
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError
from typing_extensions import Self

#: What an image's efficiency may be with the other samples over that without, where they serve image and gradient.
LEAST_IMAGE = 0.95


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


@dataclass(frozen=True, kw_only=True)
class Finding(Jsonable):
    """What is alike of all decisions by measurement.

    Steps of `spp` samples per pixel took `measure_s` seconds, with what was learned for them, and first steps, which
    compile, `compile_s`. `note` says why nothing was measured, or what the figures do not. `cached`: an earlier run
    measured it.
    """

    spp: int = 0
    measure_s: float = 0.0
    compile_s: float = 0.0
    note: str = ""
    cached: bool = False

    def decision(self) -> str:
        """What was decided on, and how, in words."""
        raise NotImplementedError

    def why(self) -> str:
        """What was measured, in words."""
        raise NotImplementedError

    def line(self, cost: bool = False) -> str:
        """What the user is told; with what it took to measure that, if `cost`."""
        line = f"{self.decision()}: {self.why()}"
        if not cost or not (self.cached or self.measure_s or self.compile_s):
            return line
        took = f"measured in {self.measure_s:.1f} s and {self.compile_s:.1f} s of first steps"
        return f"{line} ({'as an earlier run measured' if self.cached else took})"


def _times(gain: float | None, low: float | None, high: float | None, note: str) -> str:
    """An efficiency over another's with its interval; the note alone where it was not measured."""
    if gain is None or low is None or high is None:
        return note
    found = f"{gain:.2g} times the efficiency here ({low:.2g} to {high:.2g})"
    return f"{found}; {note}" if note else found


@dataclass(frozen=True, kw_only=True)
class PaidRecord(Finding):
    """Of another way of drawing samples.

    `gain` is the efficiency 1 / (variance * time) of the gradient with the other samples over that without, between
    `low` and `high` with 95 % confidence; `image_gain` and so on are the same of the image, of the gradient's samples
    where these serve both. None where that was not measured. `note` says why it is off where the gain does not.
    `rounds` steps of each kind took `share` of 200 iterations.
    """

    gain: float | None = None
    low: float | None = None
    high: float | None = None
    image_gain: float | None = None
    image_low: float | None = None
    image_high: float | None = None
    rounds: int = 0
    share: float = 0.0

    @property
    def setting(self) -> str:
        """What the option is by this."""
        raise NotImplementedError

    def why(self) -> str:
        return _times(self.gain, self.low, self.high, self.note)


@dataclass(frozen=True, kw_only=True)
class PathsRecord(PaidRecord):
    """Of where paths begin: `paths` (light, camera, both), of which `light_share` are light paths where both are.

    The gain is that over the best share that was tried before, or of the next that was found no better, as `note` says.
    """

    paths: str
    light_share: float = 0.5

    @property
    def setting(self) -> str:
        return self.paths

    def decision(self) -> str:
        share = f", {100 * self.light_share:.3g} % light paths" if self.paths == "both" else ""
        return f"paths {self.paths}{share}"


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


@dataclass(frozen=True, kw_only=True)
class PixelsRecord(Finding):
    """Of how camera paths are shared out over the pixels: as was `measured` that these need them, or evenly; `note`
    says why."""

    measured: bool

    @property
    def setting(self) -> str:
        """What the option is by this."""
        return "measured" if self.measured else "even"

    def decision(self) -> str:
        return f"pixels {self.setting}"

    def why(self) -> str:
        return self.note
