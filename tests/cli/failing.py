"""What goes wrong while a tiny run is at work, and what it then says."""

from __future__ import annotations

import errno
from pathlib import Path

from reslrb_cli.runs import prepare
from reslrb_cli.runs import recorder as recording

RUN = Path("runs/tiny")


def full(*args, **options):
    raise OSError(errno.ENOSPC, "No space left on device", "runs/tiny/x")


def lines(text):
    """The lines of standard error that are no progress."""
    return [
        line for line in text.splitlines() if not line.startswith(("variant ", "rendering ", "finding ", *"123456789"))
    ]


def failing_last(monkeypatch, name, failure=full, calls=1):
    """Have `recording.<name>`, or what keeps the state, fail, but for its first `calls` calls."""
    holder = prepare if name == "save_checkpoint" else recording
    real, seen = getattr(holder, name), []

    def sometimes(*args, **options):
        seen.append(args)
        return real(*args, **options) if len(seen) <= calls else failure()

    monkeypatch.setattr(holder, name, sometimes)
