"""Records of the settings that a run chose by measurement. Manifest, checkpoints and cache contain the records.

PathsRecord     light paths, camera paths or both
GuidedRecord    guided or unguided emission
SequenceRecord  low-discrepancy or independent numbers
PixelsRecord    camera paths distributed over the pixels by measurement or evenly
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError
from typing_extensions import Self

#: Minimum relative efficiency of the image for a sampling method that serves both image and gradient.
LEAST_IMAGE = 0.95


class Jsonable:
    """Base class of dataclasses that are written as JSON and read back."""

    __pydantic_config__ = ConfigDict(extra="forbid")

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


@dataclass(frozen=True, kw_only=True)
class Finding(Jsonable):
    """Base class of all decisions by measurement.

    The measured steps have `spp` samples per pixel and took `measure_s` seconds, including training. The first steps,
    which compile, took `compile_s` seconds. `note` says why nothing was measured, or adds to the figures. `cached` is
    true if an earlier run made the measurement.
    """

    spp: int = 0
    measure_s: float = 0.0
    compile_s: float = 0.0
    note: str = ""
    cached: bool = False

    def decision(self) -> str:
        """Return the decision in words."""
        raise NotImplementedError

    def why(self) -> str:
        """Return the measurement in words."""
        raise NotImplementedError

    def line(self, cost: bool = False) -> str:
        """Return the line for the user, with the time of the measurement if `cost` is set."""
        line = f"{self.decision()}: {self.why()}"
        if not cost or not (self.cached or self.measure_s or self.compile_s):
            return line
        took = f"measured in {self.measure_s:.1f} s and {self.compile_s:.1f} s of first steps"
        return f"{line} ({'as an earlier run measured' if self.cached else took})"


def _times(gain: float | None, low: float | None, high: float | None, note: str) -> str:
    """Return a ratio of efficiencies and its interval in words. Return only the note if the ratio was not measured."""
    if gain is None or low is None or high is None:
        return note
    found = f"{gain:.2g} times the efficiency here ({low:.2g} to {high:.2g})"
    return f"{found}; {note}" if note else found


@dataclass(frozen=True, kw_only=True)
class PaidRecord(Finding):
    """Measured gain of an alternative sampling method.

    The gradient's efficiency is 1 / (variance * time). `gain` is the efficiency with the method divided by the
    efficiency without the method. `low` and `high` are the ends of the 95 % interval of `gain`. `image_gain`,
    `image_low` and `image_high` are the corresponding values for the image. If images have their own samples, these
    samples give the values. Values that were not measured are None. If the method is off despite its gain, `note` gives
    the reason. `rounds` is the number of measured steps of each kind. `share` is the cost of measuring, relative to the
    time of 200 iterations.
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
        """The chosen value of the option."""
        raise NotImplementedError

    def why(self) -> str:
        return _times(self.gain, self.low, self.high, self.note)


@dataclass(frozen=True, kw_only=True)
class PathsRecord(PaidRecord):
    """Choice of `paths` (light, camera, both). If `paths` is `both`, `light_share` is the share of light paths.

    If a tried share was better, `gain` compares the chosen share with the best share before it. Otherwise, `gain`
    compares the share that was tried last with the chosen share. `note` names the other share, or gives a reason.
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
    """Choice of guided emission, for gradients (`guided`) and for samples used only for an image (`images`)."""

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
    """Choice of low-discrepancy numbers, for both gradients and images.

    `alone` is true if low-discrepancy numbers were measured as a replacement for guided emission. If `alone` is true,
    an earlier decision had chosen guided emission. If `alone` is true, `gain` is relative to guided emission.
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
    """Choice of the distribution of camera paths over the pixels: by measured need (`measured`) or evenly.

    `note` gives the reason.
    """

    measured: bool

    @property
    def setting(self) -> str:
        """The chosen value of the option."""
        return "measured" if self.measured else "even"

    def decision(self) -> str:
        return f"pixels {self.setting}"

    def why(self) -> str:
        return self.note
