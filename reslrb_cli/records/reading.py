"""Files of one JSON object a line that someone names: read as far as they are whole."""

from __future__ import annotations

import gc
import json
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reslrb_cli.config.files import in_words, open_file
from reslrb_cli.errors import ConfigError

#: Bytes of such a file. A million iterations of a run with ten parameters take as much.
MOST_BYTES = 2**30
#: Lines after which it is told how far reading has come.
_LINES = 4096

#: What is told of a file that is being read: it, the bytes that are done, and those that it has.
Tell = Callable[[Path, int, int], None]


@dataclass(frozen=True)
class Lines:
    """The objects in a file, oldest first, and the numbers of the lines, from 1, that are none.

    What is not finite, which JSON does not have and Python writes all the same, is None.
    """

    objects: list[dict[str, Any]] = field(default_factory=list)
    damaged: list[int] = field(default_factory=list)


def read_lines(path: Path, tell: Tell | None = None) -> Lines:
    """Read a file of JSON lines. Raises ConfigError, located in it, where it cannot be read at all.

    A last line that lacks its end is one that a process did not come to finish, or is about to: it is left out, and not
    counted as damaged.
    """
    found, done = Lines(), 0
    # Numbers that are not finite are found as they are parsed: to go through all that was parsed takes twice as long.
    decoder = json.JSONDecoder(parse_float=_finite, parse_constant=lambda name: None)
    with open_file(path, MOST_BYTES) as file, _without_collecting():
        size = os.fstat(file.fileno()).st_size
        try:
            for number, line in enumerate(file, 1):
                done += len(line)
                if done > MOST_BYTES:
                    raise ConfigError(path, "", f"has more than {in_words(MOST_BYTES)}")
                if tell is not None and number % _LINES == 0:
                    tell(path, done, max(done, size))
                if not line.strip():
                    continue
                try:
                    value = decoder.decode(line.decode("utf-8-sig" if number == 1 else "utf-8", "surrogatepass"))
                except (ValueError, RecursionError):
                    value = None
                if isinstance(value, dict):
                    found.objects.append(value)
                elif line.endswith(b"\n"):
                    found.damaged.append(number)
        except OSError as error:
            raise ConfigError(path, "", f"cannot be read: {error.strerror}") from None
    return found


def _finite(text: str) -> float | None:
    value = float(text)
    return value if math.isfinite(value) else None


@contextmanager
def _without_collecting() -> Iterator[None]:
    """Python's search for cycles left out: it would go through millions of objects that have none, again and again."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()
