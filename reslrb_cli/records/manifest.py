"""The manifest of a run, `manifest.json`: what ran, on what, and how it ended.

Where the process has gone without ending the run (killed, out of memory, the machine switched off), `read_manifest`
puts right what it left.
"""

from __future__ import annotations

import contextlib
import enum
import json
import os
import platform
import sys
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from reslrb_cli.backend.variant import package_version
from reslrb_cli.config.files import read_file
from reslrb_cli.config.yaml_text import format_location
from reslrb_cli.errors import ConfigError, printable
from reslrb_cli.records import metrics
from reslrb_cli.records.atomic import remove_parts, write_atomically
from reslrb_cli.records.lock import READER_WAIT_SECONDS, FolderLock, Holder, InUse
from reslrb_cli.version import __version__

PACKAGES = ("mitsuba", "drjit", "numpy")

#: Held while a manifest is written; a process that is about to end takes it for good, after so many seconds at most.
_WRITING, LAST_WAIT_SECONDS = threading.Lock(), 5.0


def now() -> str:
    """The time as ISO 8601, in UTC, to the second."""
    return datetime.now(timezone.utc).isoformat(timespec="seconds")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that a result depends on."""
    found = {name: package_version(name) or "not installed as a package" for name in PACKAGES}
    return {"reslrb": __version__, "python": platform.python_version()} | found


class Status(str, enum.Enum):
    """How far a run has come."""

    RUNNING = "running"
    FINISHED = "finished"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


#: Why a part is missing from a folder whose process ended before it came to that part.
NOT_YET = "not written yet"


def is_complete(content: Mapping[str, Any]) -> bool:
    """Whether a manifest is that of a run that is finished, and came to the end of writing what it found."""
    return content.get("status") == Status.FINISHED and NOT_YET not in content.get("missing", {}).values()


@dataclass
class Manifest:
    """Provenance and outcome of one run.

    `process` is who works in the folder. `plan` is what a step consists of, `decisions` the settings that were left to
    `auto` (`Decision`), `incomplete` what the derivative of each parameter that moves light lacks (`MissingRecord`),
    `memory` how a memory budget is kept, `scaling` what was measured of each parameter for `scale: auto`, `shared` the
    time that workers took (`SharedTime`); each is None, or empty, where that was not asked for. `views` has, of each
    view, its share of the loss, how many of its pixels are left out, by kind, and what its images are multiplied by to
    be looked at (`shown`).
    `results` is what the run found (`iterations`, values and errors by key,
    `certainty`, `warnings`, and `seen`, errors as people see them, ...); `error` is the line that the user saw where
    the run failed. `resumed` says of each time that the run was gone on with after how many iterations, when, by what
    command, from which state, and what had changed: settings, from and to, and versions. `missing` names the parts of
    the folder that are not there (not yet, where the process ended among them), and says why.
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
    missing: dict[str, str] = field(default_factory=dict)
    plan: dict[str, Any] | None = None
    decisions: list[dict[str, Any]] = field(default_factory=list)
    memory: dict[str, Any] | None = None
    scaling: list[dict[str, Any]] | None = None
    views: list[dict[str, Any]] | None = None
    incomplete: list[dict[str, Any]] = field(default_factory=list)
    shared: dict[str, Any] | None = None
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
        """The same in a process that is about to end, by a thread beside the one that works: that writes no more."""
        _WRITING.acquire(timeout=LAST_WAIT_SECONDS)  # and never released
        self.status, self.error, self.ended = status, None, now()
        _write(folder, self.content())

    def content(self) -> dict[str, Any]:
        """What the file says once it is written."""
        return {"program": PROGRAM, **asdict(self), "status": self.status.value}


MANIFEST_FILE = "manifest.json"
PROGRAM = "reslrb"

#: Bytes of a manifest; the largest part of one is the verdicts, of some kB.
MOST_BYTES = 2**24


#: Checks the types of the fields, and of what they hold as far as `Manifest` says.
_CHECK = TypeAdapter(Manifest)


def read_content(folder: Path) -> dict[str, Any] | None:
    """Return the content of the manifest in `folder`, or None where there is none that `reslrb` wrote.

    Fields of earlier versions may be missing; those that are there have the types of `Manifest`. Raises ConfigError,
    located by the first field of another type.
    """
    try:
        text = read_file(folder / MANIFEST_FILE, MOST_BYTES)
        content = json.loads(text)
    except (ConfigError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or content.get("program") != PROGRAM:
        return None
    try:
        _CHECK.validate_json(text, strict=True)
    except ValidationError as error:
        for wrong in error.errors(include_url=False):
            if wrong["type"] != "missing" or len(wrong["loc"]) > 1:
                reason = f"is damaged: {wrong['msg'].lower()}; restore the file, or begin a new run"
                raise ConfigError(folder / MANIFEST_FILE, format_location(wrong["loc"]), reason) from None
    return content


def _write(folder: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(content, indent=2, allow_nan=False).encode() + b"\n"
    write_atomically(folder / MANIFEST_FILE, lambda file: file.write(text), durable=True)


#: What the manifest of a run gives as its error whose process has gone.
REASON = "its process ended before the run did"


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest in `folder`, or None where there is none that `reslrb` wrote. Raises ConfigError as
    `read_content` does.

    One that was left saying `running` by a process that has surely gone says `interrupted`, on the disk too from then
    on, if that can be written to; what the run never finished is removed then.
    """
    content = read_content(folder)
    if content is None or content.get("status") != Status.RUNNING:
        return content
    holder = Holder.from_json(content.get("process"))
    if holder is not None and not holder.is_gone(folder):
        return content
    ended = _last_sign(folder) or content.get("ended")
    right = content | {"status": Status.INTERRUPTED.value, "ended": ended, "error": REASON}
    with contextlib.suppress(InUse, OSError), FolderLock(folder, READER_WAIT_SECONDS):
        if read_content(folder) == content:  # nobody was faster
            metrics.mend(folder)
            remove_parts(folder)
            _write(folder, right)
    return right


def _last_sign(folder: Path) -> str | None:
    """When the run last wrote something, as far as that can be told."""
    times = []
    for name in (MANIFEST_FILE, metrics.METRICS_FILE, "checkpoint", "images", "parameters"):
        with contextlib.suppress(OSError):
            times.append(os.stat(folder / name).st_mtime)
    return datetime.fromtimestamp(max(times), timezone.utc).isoformat(timespec="seconds") if times else None
