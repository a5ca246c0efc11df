"""`manifest.json`: what ran, on what, and how it ended."""

from __future__ import annotations

import enum
import json
import platform
import sys
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from reslrb_cli import __version__
from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError, printable
from reslrb_cli.records.atomic import write_atomically

FILE_NAME = "manifest.json"
PROGRAM = "reslrb"
#: Bytes of a manifest; the largest part of one is a pilot's table, of some kB.
MOST_BYTES = 2**24
PACKAGES = ("mitsuba", "drjit", "numpy")


class Status(str, enum.Enum):
    """How far a run has come."""

    RUNNING = "running"
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


def now() -> str:
    """The time as ISO 8601, in UTC, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
    found = {"reslrb": __version__, "python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


@dataclass
class Manifest:
    """Provenance and outcome of one run.

    `pilot` is the table by which an estimator was chosen, `memory` how a memory budget is kept, `scaling` what was
    measured of each parameter for `scale: auto`; each is None where that was not asked for. `results` holds what the
    run found (`iterations`, values and errors by key, `warnings`, ...); `error` is the line that the user saw where the
    run failed.
    """

    variant: str
    device: str
    seed: int
    config: str
    status: Status = Status.RUNNING
    command_line: list[str] = field(default_factory=lambda: [printable(word) for word in sys.argv])
    versions: dict[str, str] = field(default_factory=versions)
    platform: str = field(default_factory=platform.platform)
    started: str = field(default_factory=now)
    ended: str | None = None
    error: str | None = None
    pilot: dict[str, Any] | None = None
    memory: dict[str, Any] | None = None
    scaling: list[dict[str, Any]] | None = None
    results: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Write `manifest.json` into `folder`, atomically."""
        text = json.dumps({"program": PROGRAM, **asdict(self)}, indent=2, allow_nan=False)
        write_atomically(folder / FILE_NAME, lambda file: file.write(text.encode() + b"\n"))

    def end(self, folder: Path, status: Status, error: str | None = None) -> None:
        """Set the final status and the time, and write the file."""
        self.status, self.error, self.ended = status, error, now()
        self.write(folder)


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest in `folder`, or None where there is none that `reslrb` wrote."""
    try:
        content = json.loads(read_file(folder / FILE_NAME, MOST_BYTES))
    except (ConfigError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and content.get("program") == PROGRAM else None
