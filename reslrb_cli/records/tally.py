"""What of a whole run was not finite, or clamped, added up from its records."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from reslrb_cli.records.metrics import Record


@dataclass
class NonFiniteTally:
    """Iterations with values that were not finite, the number of these values, and those of each parameter."""

    iterations: int = 0
    values: int = 0
    by_parameter: Counter[str] = field(default_factory=Counter)

    def add(self, record: Record) -> None:
        """Count one iteration."""
        self.iterations += record.nonfinite > 0
        self.values += record.nonfinite
        self.by_parameter.update(record.nonfinite_by_parameter)

    def to_json(self) -> dict[str, Any]:
        """For the manifest."""
        return {"iterations": self.iterations, "values": self.values, "by_parameter": dict(self.by_parameter)}

    def __str__(self) -> str:
        """For the last line of a run; empty where all was finite."""
        if not self.iterations:
            return ""
        parameters = ", ".join(f"{key} {count}" for key, count in self.by_parameter.items())
        where = f" ({parameters})" if parameters else ""
        return f"{self.values} values not finite{where} in {self.iterations} iterations"


@dataclass
class ClampTally:
    """Iterations in which gradients were clamped, the number of entries, and the bias over the run by parameter."""

    iterations: int = 0
    entries: int = 0
    bias: dict[str, float] = field(default_factory=dict)

    def add(self, record: Record) -> None:
        """Count one iteration."""
        if record.clamped is not None:
            self.iterations += record.clamped.entries > 0
            self.entries += record.clamped.entries
            self.bias |= record.clamped.bias

    def to_json(self) -> dict[str, Any]:
        """For the manifest."""
        bias = {key: value if math.isfinite(value) else None for key, value in self.bias.items()}
        return {"iterations": self.iterations, "entries": self.entries, "bias": bias}

    def __str__(self) -> str:
        """For the last line of a run; empty where nothing was clamped."""
        if not self.iterations:
            return ""
        shares = ", ".join(f"{100 * value:.2g} % of that of {key}" for key, value in self.bias.items())
        return f"{self.entries} entries of gradients clamped in {self.iterations} iterations: a bias of {shares}"
