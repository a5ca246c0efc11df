"""`manifest.json`: what ran, on what, and how it ended."""

from __future__ import annotations

import platform
import sys
import threading
from dataclasses import asdict, dataclass, field
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

from reslrb_cli import __version__
from reslrb_cli.errors import printable
from reslrb_cli.records.abandoned import is_abandoned, put_right
from reslrb_cli.records.lock import Holder
from reslrb_cli.records.manifest_file import FILE_NAME, PROGRAM, Status, read_content, write_content

__all__ = ["FILE_NAME", "Manifest", "Status", "now", "read_manifest", "versions"]

PACKAGES = ("mitsuba", "drjit", "numpy")
#: Held while a manifest is written; a process that is about to end takes it for good, after so many seconds at most.
_WRITING, LAST_WAIT_SECONDS = threading.Lock(), 5.0


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

    `process` is who works in the folder. `plan` is what a step consists of, `pilot` the table by which an estimator was
    chosen, `guided` whether guided emission paid, `sequence` whether low-discrepancy numbers did, `rival` how `prb` did
    beside that, `memory` how a memory budget is kept, `scaling` what was measured of each parameter for `scale: auto`,
    `correlated_bias` what of the bias of `adjoint: correlated`; each is None where that was not asked for. `views` has,
    of each view, its share of the loss, how many of its pixels are left out, by kind, and what its images are
    multiplied by to be looked at (`shown`). `results` is what the run found (`iterations`, values and errors by key,
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
    pilot: dict[str, Any] | None = None
    guided: dict[str, Any] | None = None
    sequence: dict[str, Any] | None = None
    memory: dict[str, Any] | None = None
    scaling: list[dict[str, Any]] | None = None
    correlated_bias: dict[str, Any] | None = None
    views: list[dict[str, Any]] | None = None
    rival: dict[str, Any] | None = None
    resumed: list[dict[str, Any]] = field(default_factory=list)
    results: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> None:
        """Write `manifest.json` into `folder`, atomically where the disk has room. Raises OSError."""
        with _WRITING:
            write_content(folder, self.content())

    def end(self, folder: Path, status: Status, error: str | None = None) -> None:
        """Set the final status and the time, and write the file. Raises OSError."""
        self.status, self.error, self.ended = status, error, now()
        self.write(folder)

    def end_for_good(self, folder: Path, status: Status) -> None:
        """The same in a process that is about to end, by a thread beside the one that works: that writes no more."""
        _WRITING.acquire(timeout=LAST_WAIT_SECONDS)  # and never released
        self.status, self.error, self.ended = status, None, now()
        write_content(folder, self.content())

    def content(self) -> dict[str, Any]:
        """What the file says once it is written."""
        return {"program": PROGRAM, **asdict(self), "status": self.status.value}


def read_manifest(folder: Path) -> dict[str, Any] | None:
    """Return the manifest in `folder`, or None where there is none that `reslrb` wrote.

    One that was left saying `running` by a process that has gone says `interrupted`, on the disk too from then on, if
    that can be written to.
    """
    content = read_content(folder)
    return put_right(folder, content) if content is not None and is_abandoned(folder, content) else content
