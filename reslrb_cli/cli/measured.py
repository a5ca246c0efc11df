"""Files that the measuring commands write with `--json`: what measured, then one object a line."""

from __future__ import annotations

from pathlib import Path

from reslrb_cli.backend.device import device_name
from reslrb_cli.records.lines import LineWriter
from reslrb_cli.records.origin import Origin


def measured_lines(json_file: Path, variant: str) -> LineWriter:
    """A writer of `json_file`, which so far says what this process is, under `variant`. Raises OSError."""
    writer = LineWriter(json_file)
    writer.write(origin_of(variant))
    return writer


def origin_of(variant: str) -> Origin:
    """What this process measures on, under `variant`."""
    return Origin(device_name(variant), variant)
