"""What of a whole run was not finite, added up from its records."""

from __future__ import annotations

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
