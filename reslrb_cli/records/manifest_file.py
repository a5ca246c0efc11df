"""`manifest.json` on the disk: written whole, readable whatever happens, and with an end that fits on a full disk."""

from __future__ import annotations

import enum
import errno
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import write_atomically

FILE_NAME = "manifest.json"
PROGRAM = "reslrb"
#: Bytes of a manifest; the largest part of one is a pilot's table, of some kB.
MOST_BYTES = 2**24
#: Bytes of white space behind a manifest that is not the last one, at least: room for how the run ends.
ROOM = 1024
#: What file systems allocate at once, or a multiple of it.
_BLOCK = 4096
#: What is kept of an error's line where there is no room for more.
_SHORT = 300


class Status(str, enum.Enum):
    """How far a run has come."""

    RUNNING = "running"
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


def read_content(folder: Path) -> dict[str, Any] | None:
    """What the manifest in `folder` says; None where there is none that `reslrb` wrote."""
    try:
        content = json.loads(read_file(folder / FILE_NAME, MOST_BYTES))
    except (ConfigError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and content.get("program") == PROGRAM else None


def write_content(folder: Path, content: Mapping[str, Any]) -> None:
    """Write a manifest into `folder`, atomically; on a full disk over the one that is there. Raises OSError."""
    text = _text(content)
    if content["status"] == Status.RUNNING or content.get("missing"):
        text = _padded(text, -(-(len(text) + ROOM) // _BLOCK) * _BLOCK)
    try:
        write_atomically(folder / FILE_NAME, lambda file: file.write(text), durable=True)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT) or not _overwrite(folder / FILE_NAME, content):
            raise


def _overwrite(path: Path, content: Mapping[str, Any]) -> bool:
    """Write a manifest into the blocks of the one at `path`; return whether that went well.

    One that is too large for them leaves what is there, and changes how the run ended.
    """
    end = {key: content.get(key) for key in ("status", "ended", "missing", "error")}
    shortest = end | {"missing": {}, "error": (content.get("error") or "")[:_SHORT] or None}
    try:
        with path.open("r+b") as file:
            before = file.read()
            there = json.loads(before)
            for changed in (content, there | end, there | shortest):
                text = _text(changed)
                if len(text) <= len(before):
                    file.seek(0)
                    file.write(_padded(text, len(before)))
                    file.flush()
                    os.fsync(file.fileno())
                    return True
    except (OSError, ValueError):
        pass
    return False


def _text(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content, indent=2, allow_nan=False).encode() + b"\n"


def _padded(text: bytes, size: int) -> bytes:
    return text[:-1].ljust(size - 1) + b"\n"
