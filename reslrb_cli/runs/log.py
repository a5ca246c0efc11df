"""Log file of a run, `run.log`: the lines that the user sees, with their times."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

from reslrb_cli.errors import printable
from reslrb_cli.records.manifest import now

LOG_FILE = "run.log"


class _Collector(logging.Handler):
    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(log_line(record.getMessage(), record.levelname))


def log_line(message: str, level: str = "INFO") -> str:
    """Return a line of the log file, with the current UTC time."""
    return f"{now()} {level} {printable(message)}"


@contextlib.contextmanager
def collected() -> Iterator[list[str]]:
    """Yield a list of the log lines of the block."""
    logger, handler = logging.getLogger("reslrb_cli"), _Collector()
    logger.addHandler(handler)
    try:
        yield handler.lines
    finally:
        logger.removeHandler(handler)


def append_log(folder: Path, lines: list[str]) -> None:
    """Move `lines` to the end of the log file in `folder`. An error is ignored: the folder may have gone."""
    if lines:
        with (
            contextlib.suppress(OSError),
            (folder / LOG_FILE).open("a", encoding="utf-8", errors="backslashreplace") as file,
        ):
            file.writelines(f"{line}\n" for line in lines)
        lines.clear()
