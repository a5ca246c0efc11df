"""Cache of the measurements before the first iteration, for later runs of the same scene and parameters."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path
from typing import Any

from reslrb_cli.records.atomic import write_atomically

PILOT_FILE = "pilot.json"

#: Maximum number of entries; the oldest are dropped.
MOST = 200


def cache_folder() -> Path:
    """Return $RESLRB_CACHE, or `reslrb` in the user's cache folder."""
    if own := os.environ.get("RESLRB_CACHE"):
        return Path(own)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "reslrb"


def key_of(what: dict[str, Any]) -> str:
    """Return the key of an entry, a hash of all plain values that the entry depends on."""
    return hashlib.blake2b(json.dumps(what, sort_keys=True, default=str).encode(), digest_size=16).hexdigest()


class PilotCache:
    """JSON file of entries by key.

    An unreadable file counts as empty. If writing fails, the file is unchanged and `keeps` becomes False.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._given = folder
        self.keeps = True

    def get(self, key: str) -> dict[str, Any] | None:
        """Return the entry of `key`, or None."""
        entry = self._read().get(key)
        return entry if isinstance(entry, dict) else None

    def put(self, key: str, entry: dict[str, Any]) -> None:
        """Store an entry as the newest one."""
        entries = {name: value for name, value in self._read().items() if name != key}
        entries = {**dict(list(entries.items())[1 - MOST :]), key: entry}
        text = json.dumps(entries, indent=1)
        try:
            path = self._path()
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, lambda file: file.write(text.encode() + b"\n"))
        except (OSError, RuntimeError):  # RuntimeError: no home folder
            self.keeps = False

    def _path(self) -> Path:
        return (self._given or cache_folder()) / PILOT_FILE

    def _read(self) -> dict[str, Any]:
        try:
            content = json.loads(self._path().read_text(encoding="utf-8"))
        except (OSError, ValueError, RuntimeError):
            return {}
        return content if isinstance(content, dict) else {}
