"""What `gradcheck --missing` finds of one parameter."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass

#: Standard errors within which a share counts as none.
NOTHING = 3
#: A share that single precision may have made.
LEAST = 1e-4


@dataclass(frozen=True)
class MissingRecord:
    """The share of a parameter's derivative that is not in the attached gradient, relative to finite differences.

    `share` and `standard_error` are None where the derivative itself is lost in its noise.
    """

    case: str
    parameter: str
    share: float | None
    standard_error: float | None
    directions: int
    seeds: int
    kind: str = "missing"

    def to_json(self) -> str:
        """The record as one line of JSON."""
        values = asdict(self)
        return json.dumps({k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()})

    def line(self) -> str:
        """What it says, in one line."""
        if self.share is None or self.standard_error is None:
            return f"{self.parameter}: the derivative itself is less than what {self.seeds} seeds could see"
        figures = f"{_percent(self.share)} +- {_percent(self.standard_error)}"
        if self.share <= max(NOTHING * self.standard_error, LEAST):
            return f"{self.parameter}: nothing is missing that {self.seeds} seeds could see ({figures})"
        return (
            f"{self.parameter}: {figures} of the derivative is missing (silhouettes, edges of shadows, light that "
            "leaves the film)"
        )


def _percent(share: float) -> str:
    return f"{share:.1%}" if share < 0.0995 else f"{share:.0%}"
