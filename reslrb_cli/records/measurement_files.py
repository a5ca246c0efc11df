"""Files of measurements, JSON with one object per line.

`write_lines` writes a file that is complete at every moment, no matter how the process ends. The first line is an
`Origin`, which says where the file comes from. `read_lines` reads such files.
"""

from __future__ import annotations

import json
import logging
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError, is_machine_fault, printable
from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.manifest import now, versions
from reslrb_cli.records.metrics import Line

logger = logging.getLogger(__name__)


def read_lines(path: Path, lost: list[int] | None = None) -> list[dict[str, Any]]:
    """Return the objects in a file of JSON lines, oldest first. Numbers that are not finite become None.

    A last line without a line end is left out, because it is still being written or was interrupted. Damaged lines are
    left out if the list `lost` is given, which receives their numbers. Otherwise raises a ConfigError that names the
    file and the line.
    """
    # Numbers that are not finite are replaced during parsing, because a second pass takes twice as long.
    decoder, found = json.JSONDecoder(parse_float=_finite, parse_constant=lambda name: None), []
    for number, line in enumerate(read_file(path).splitlines(keepends=True), 1):
        if not line.strip() or not line.endswith(b"\n"):
            continue
        try:
            value = decoder.decode(line.decode())
        except (ValueError, RecursionError):
            value = None
        if isinstance(value, dict):
            found.append(value)
        elif lost is None:
            raise ConfigError(path, f"line {number}", "is damaged, or no line that reslrb wrote")
        else:
            lost.append(number)
    return found


def _finite(text: str) -> float | None:
    value = float(text)
    return value if math.isfinite(value) else None


def is_stream(path: Path) -> bool:
    """Whether `path` is a pipe or another file that is not regular."""
    return os.path.lexists(path) and not path.is_file()


def write_lines(path: Path, lines: Sequence[Line]) -> None:
    """Write a file with one object per line, atomically. A stream is written in place, and so is a file that cannot be
    replaced: a mount of its own, or a file in a folder without write permission. Raises OSError.
    """
    text = "".join(line.to_json() + "\n" for line in lines).encode()
    try:
        if not is_stream(path):  # the target of a link is replaced, not the link
            return write_atomically(Path(os.path.realpath(path)), lambda file: file.write(text))
    except OSError as error:
        if is_machine_fault(error):
            raise
    path.write_bytes(text)


def _command() -> list[str]:
    """Return the command line of this process, with the program's name instead of its path."""
    return ["reslrb", *(printable(word) for word in sys.argv[1:])]


@dataclass(frozen=True)
class Origin(Line):
    """Origin of a file of measurements: the machine, the software, and the command that repeats the measurement.

    `command` is a list of words, `versions` is as in `manifest.json`, and `written` is the time when the file was
    started. Missing entries are empty.
    """

    KIND: ClassVar[str] = "origin"

    device: str
    variant: str
    command: Sequence[str] = field(default_factory=_command)
    versions: Mapping[str, str] = field(default_factory=versions)
    platform: str = field(default_factory=platform.platform)
    written: str = field(default_factory=now)


# --- files that are rewritten while a command runs -----------------------------------------------------------------

#: Minimum seconds between two pages, and minimum interval as a multiple of the time of the last page. By default, pages
#: take at most a twentieth of a run.
PAGE_SECONDS, PAGE_SHARE = 5.0, 20.0


class LivePage:
    """Page that is rewritten from time to time, between iterations. `what` names the page or another file.

    If the page cannot be written, the run continues without it. The final write at the end of the run reports the
    reason of the failure.
    """

    def __init__(
        self, write: Callable[[], object], what: str = "the page of the run", share: float | None = None
    ) -> None:
        self._write, self._what, self._share = write, what, share
        self._next: float | None = 0.0

    def refresh(self) -> None:
        """Write the page if it is time to."""
        start = time.monotonic()
        if self._next is None or start < self._next:
            return
        try:
            self._write()
        except Exception as error:
            logger.debug("%s is not kept current: %s", self._what, error)
            self._next = None
        else:
            end = time.monotonic()
            share = PAGE_SHARE if self._share is None else self._share
            self._next = end + max(PAGE_SECONDS, share * (end - start))
