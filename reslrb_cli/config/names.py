"""Names of runs, which are names of folders too."""

from __future__ import annotations

import re

from .base import wrong
from .limits import NAME_BYTES

#: Names that Windows takes for devices, whatever suffix they have: a folder that is called so cannot be copied there.
_RESERVED = re.compile(r"(con|prn|aux|nul|(com|lpt)[0-9])(\..*)?", re.IGNORECASE)

#: What begins at a root or at a home, or has `.` or `..` for a part. A slash between words is none of that.
_PATH = re.compile(r"^([/\\~]|[A-Za-z]:[/\\])|(^|[/\\])\.\.?($|[/\\])")


def folder_name(name: str) -> str:
    """A run's name as the name of a folder: what is no letter, digit, `.`, `_`, `+`, `=` becomes `-`."""
    return re.sub(r"[^\w.+=]+", "-", name).strip("-.")


def check_name(name: str) -> str:
    """`name`, where it can name a run; else raises an error that says what is wrong with it."""
    folder = folder_name(name)
    if _PATH.search(name.strip()):
        raise wrong("must be a name and not a path; run.output says where the run's folder is")
    if not folder:
        raise wrong("must hold a letter or a digit")
    if _RESERVED.fullmatch(folder):
        raise wrong(f"must be another name: {folder} is a device on Windows, and not a folder's name there")
    if len(folder.encode()) > NAME_BYTES:
        raise wrong(f"must have at most {NAME_BYTES} bytes in UTF-8, not {len(folder.encode())}")
    return name
