"""Files that the measuring commands write with `--json`: what measured, then one object a line."""

from __future__ import annotations

from reslrb_cli.backend.device import device_name
from reslrb_cli.records.origin import Origin


def origin_of(variant: str) -> Origin:
    """What this process measures on, under `variant`."""
    return Origin(device_name(variant), variant)
