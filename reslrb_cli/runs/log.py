"""Log file of a run, `run.log`: the lines that the user sees, with their times."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator

from reslrb_cli.errors import printable
from reslrb_cli.records.manifest import now
from reslrb_cli.records.run_folder import RunFolder

LOG_FILE = "run.log"


class _Collector(logging.Handler):
    def __init__(self, last: logging.Handler | None) -> None:
        super().__init__()
        self._last, self.lines = last, list[str]()

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(log_line(record.getMessage(), record.levelname))
        if self._last is not None and record.levelno >= self._last.level:
            self._last.handle(record)


def log_line(message: str, level: str = "INFO") -> str:
    """Return a line of the log file, with the current UTC time."""
    return f"{now()} {level} {printable(message)}"


@contextlib.contextmanager
def collected() -> Iterator[list[str]]:
    """Yield a list of the log lines of the block."""
    logger = logging.getLogger("reslrb_cli")
    # Python prints warnings only if there is no handler at all, as in a script that sets up no logging.
    handler = _Collector(None if logger.hasHandlers() else logging.lastResort)
    logger.addHandler(handler)
    try:
        yield handler.lines
    finally:
        logger.removeHandler(handler)


def append_log(folder: RunFolder, lines: list[str]) -> None:
    """Append `lines` to the log file in `folder`. Does nothing if the folder has gone or cannot be written to."""
    if lines and folder.is_there:
        path = folder.path / LOG_FILE
        with contextlib.suppress(OSError), path.open("a", encoding="utf-8", errors="backslashreplace") as file:
            file.writelines(f"{line}\n" for line in lines)
