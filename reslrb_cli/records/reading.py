"""Files of one JSON object a line that someone names: read as far as they are whole."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from reslrb_cli.config.files import read_file
from reslrb_cli.records.metrics import finite

#: Bytes of such a file. A million iterations of a run with ten parameters take as much.
MOST_BYTES = 2**30


@dataclass(frozen=True)
class Lines:
    """The objects in a file, oldest first, and the numbers of the lines, from 1, that are none.

    What is not finite, which JSON does not have and Python writes all the same, is None.
    """

    objects: list[dict[str, Any]] = field(default_factory=list)
    damaged: list[int] = field(default_factory=list)


def read_lines(path: Path) -> Lines:
    """Read a file of JSON lines. Raises ConfigError, located in it, where it cannot be read at all.

    A last line that lacks its end is one that a process did not come to finish, or is about to: it is left out, and not
    counted as damaged.
    """
    found = Lines()
    content = read_file(path, MOST_BYTES)
    lines = content.split(b"\n")
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            value = finite(json.loads(line))
        except (ValueError, RecursionError):
            value = None
        if isinstance(value, dict):
            found.objects.append(value)
        elif number < len(lines):
            found.damaged.append(number)
    return found
