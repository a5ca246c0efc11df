"""What a run says of ways of drawing samples that were left to measurement: whether they pay, and how that was seen."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

from typing_extensions import Self

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
