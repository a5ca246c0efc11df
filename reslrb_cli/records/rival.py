"""What a run says of another integrator that would have been the better choice."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from typing_extensions import Self


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
