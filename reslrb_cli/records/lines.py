"""Files of measurements, JSON with one object a line."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Protocol


class Line(Protocol):
    """What is a line of JSON."""

    def to_json(self) -> str: ...


class LineWriter:
    """Writes records to a file of their own; each line is on disk once `write` returns."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8")

    def write(self, record: Line) -> None:
        """Append one record."""
        self._file.write(record.to_json() + "\n")
        self._file.flush()

    def __enter__(self) -> LineWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
