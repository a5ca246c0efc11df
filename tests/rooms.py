"""A scene of somebody else, which is not part of the project: where it is, if it is there."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_BESIDE = Path(__file__).parents[2] / "shared" / "scenes" / "grey-white-room"


def real_room() -> Path:
    """The room's file: in the folder that RESLRB_GREY_WHITE_ROOM names, or beside the repository; else skips."""
    folder = Path(os.environ.get("RESLRB_GREY_WHITE_ROOM") or _BESIDE)
    if not (folder / "scene.xml").exists():
        pytest.skip(
            f"The Grey & White Room (Wig42, CC BY 3.0) is not in {folder}; set RESLRB_GREY_WHITE_ROOM to its folder"
        )
    return folder / "scene.xml"
