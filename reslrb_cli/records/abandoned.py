"""Run folders whose process has gone without ending the run: killed, out of memory, the machine switched off."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from reslrb_cli.records import metrics
from reslrb_cli.records.atomic import remove_parts
from reslrb_cli.records.lock import READER_WAIT_SECONDS, FolderLock, Holder, InUse
from reslrb_cli.records.manifest_file import FILE_NAME, Status, read_content, write_content

#: What the manifest of such a run gives as its error.
REASON = "its process ended before the run did"


def is_abandoned(folder: Path, content: Mapping[str, Any]) -> bool:
    """Whether the manifest in `folder`, `content`, says `running` and the process that wrote it has surely gone."""
    if content.get("status") != Status.RUNNING:
        return False
    holder = Holder.from_json(content.get("process"))
    return holder is None or holder.is_gone(folder)


def put_right(folder: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """What the manifest of an abandoned run should say; written into `folder` too, if that can be.

    What the run never finished is removed then.
    """
    right = dict(content) | {
        "status": Status.INTERRUPTED.value,
        "ended": _last_sign(folder) or content.get("ended"),
        "error": REASON,
    }
    with contextlib.suppress(InUse, OSError), FolderLock(folder, READER_WAIT_SECONDS):
        if read_content(folder) == content:  # nobody was faster
            metrics.mend(folder)
            remove_parts(folder)
            write_content(folder, right)
    return right


def _last_sign(folder: Path) -> str | None:
    """When the run last wrote something, as far as that can be told."""
    times = []
    for name in (FILE_NAME, metrics.FILE_NAME, "checkpoint", "images", "parameters"):
        with contextlib.suppress(OSError):
            times.append(os.stat(folder / name).st_mtime)
    return datetime.fromtimestamp(max(times), timezone.utc).isoformat(timespec="seconds") if times else None
