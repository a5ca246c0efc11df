"""Files of measurements, JSON with one object a line."""

from __future__ import annotations

from typing import Protocol


class Line(Protocol):
    """What is a line of JSON."""

    def to_json(self) -> str: ...
