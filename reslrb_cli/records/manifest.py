"""The manifest of a run, `manifest.json`: what ran, on which machine, and how it ended.

If the process ended without completing the manifest, `read_manifest` corrects the manifest. Causes are a killed
process, exhausted memory or a machine switched off.
"""

from __future__ import annotations

import contextlib
import enum
import json
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from reslrb_cli.backend.variant import package_version
from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError, printable
from reslrb_cli.records import metrics
from reslrb_cli.records.atomic import remove_parts, write_atomically
from reslrb_cli.records.lock import READER_WAIT_SECONDS, FolderLock, Holder, InUse
from reslrb_cli.version import __version__

PACKAGES = ("mitsuba", "drjit", "numpy")

#: Lock for writing a manifest. A process about to exit waits at most LAST_WAIT_SECONDS for it and never releases it.
_WRITING, LAST_WAIT_SECONDS = threading.Lock(), 5.0


def now() -> str:
    """Return the current UTC time as ISO 8601, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on."""
    found = {name: package_version(name) or "not installed as a package" for name in PACKAGES}
    return {"reslrb": __version__, "python": platform.python_version()} | found


def commit_of(folder: Path) -> str | None:
    """Return the commit that is checked out in the git repository around `folder`, or None if there is none.

    The question runs no code of the repository, whose settings could name programs.
    """
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), "rev-parse", "--verify", "HEAD"],
            capture_output=True, text=True, timeout=10, check=False,
        )  # fmt: skip
    except (OSError, ValueError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


class Status(str, enum.Enum):
    """Status of a run."""

    RUNNING = "running"
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass
class Manifest:
    """Provenance and outcome of one run.

    - `process`: the process that uses the folder.
    - `commit`: the commit of the git repository that the configuration lies in.
    - `plan`: the parts of a step.
    - `decisions`: settings of the integrator that were `auto` (`Decision`).
    - `incomplete`: the missing share of the derivative, for each parameter that moves light (`MissingRecord`).
    - `scaling`: the measurements of each parameter for `scale: curvature`.
    - `views`: for each view, the share of the loss, the excluded pixels of each kind, and the factor for viewing
        (`shown`). With a white balance, the illuminant of the scene (`white`). For a film with its own responses, the
        names of its `channels`.
    - `results`: `iterations`, values and errors by key, `certainty`, `warnings`, perceptual errors (`seen`), ...
    - `error`: the line that the user saw if the run failed.
    - `resumed`: for each resumption, the iteration, the time, the command, the state, and the changed settings and
        versions.

    Entries that do not apply are None or empty.
    """

    variant: str
    device: str
    seed: int
    config: str
    status: Status = Status.RUNNING
    command_line: list[str] = field(default_factory=lambda: [printable(word) for word in sys.argv])
    versions: dict[str, str] = field(default_factory=versions)
    platform: str = field(default_factory=platform.platform)
    process: Holder = field(default_factory=lambda: Holder.here(locked=False))
    started: str = field(default_factory=now)
    ended: str | None = None
    error: str | None = None
    commit: str | None = None
    plan: dict[str, Any] | None = None
    decisions: list[dict[str, Any]] = field(default_factory=list)
    scaling: list[dict[str, Any]] | None = None
    views: list[dict[str, Any]] | None = None
    incomplete: list[dict[str, Any]] = field(default_factory=list)
    resumed: list[dict[str, Any]] = field(default_factory=list)
    results: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Write `manifest.json` into `folder`, atomically. Raises OSError."""
        with _WRITING:
            _write(folder, self.content())

    def end(self, folder: Path, status: Status, error: str | None = None) -> None:
        """Set the final status and the time, and write the file. Raises OSError."""
        self.status, self.error, self.ended = status, error, now()
        self.write(folder)

    def end_for_good(self, folder: Path, status: Status) -> None:
        """Do the same as `end` from another thread of a process that is about to exit. Also block all later writes."""
        _WRITING.acquire(timeout=LAST_WAIT_SECONDS)  # and never released
        self.status, self.error, self.ended = status, None, now()
        _write(folder, self.content())

    def content(self) -> dict[str, Any]:
        """Return the content of the file."""
        return {"program": PROGRAM, **asdict(self), "status": self.status.value}


MANIFEST_FILE = "manifest.json"
PROGRAM = "reslrb"


def read_content(folder: Path) -> dict[str, Any] | None:
    """Return the content of the manifest in `folder`, or None if there is none written by `reslrb`."""
    try:
        content = json.loads(read_file(folder / MANIFEST_FILE))
    except (ConfigError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and content.get("program") == PROGRAM else None


def _write(folder: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, indent=2, allow_nan=False).encode() + b"\n"
    write_atomically(folder / MANIFEST_FILE, lambda file: file.write(text), durable=True)


#: Error in the manifest of a run whose process has ended unexpectedly.
REASON = "its process ended before the run did"


def read_manifest(folder: Path, mend: bool = True) -> dict[str, Any] | None:
    """Return the manifest in `folder`, or None if there is none written by `reslrb`.

    If the status is `running` but the process has certainly ended, the status becomes `interrupted`. With `mend`, and
    if the folder is writable, the correction is saved and unfinished files are removed.
    """
    content = read_content(folder)
    if content is None or content.get("status") != Status.RUNNING:
        return content
    holder = Holder.from_json(content.get("process"))
    if holder is not None and not holder.is_gone(folder):
        return content
    ended = _last_sign(folder) or content.get("ended")
    right = content | {"status": Status.INTERRUPTED.value, "ended": ended, "error": REASON}
    if not mend:
        return right
    with contextlib.suppress(InUse, OSError), FolderLock(folder, READER_WAIT_SECONDS):
        if read_content(folder) == content:  # unchanged by any other process
            metrics.mend(folder)
            remove_parts(folder)
            _write(folder, right)
    return right


def _last_sign(folder: Path) -> str | None:
    """Return the time at which the run last wrote a file, if known."""
    times = []
    for name in (MANIFEST_FILE, metrics.METRICS_FILE, "checkpoint", "images", "parameters"):
        with contextlib.suppress(OSError):
            times.append(os.stat(folder / name).st_mtime)
    return datetime.fromtimestamp(max(times), timezone.utc).isoformat(timespec="seconds") if times else None
