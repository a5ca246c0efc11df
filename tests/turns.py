"""Parameters of which the default suite runs a part, and a scene of somebody else, if it is there."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

# Parameters of which the default suite runs a part: a few of many names; of pairs each name and each way.


def name_of(one: Any) -> str:
    """What a parameter of a test is called."""
    return str(getattr(one, "name", one))


def a_few(names: Iterable[Any], few: Collection[str]) -> list[Any]:
    """Parameters of a test: of `names` those in `few` by default, all others for `-m long`.

    Where a name has an attribute `name`, that is its id. Raises ValueError where one of the few is not among the names.
    """
    names = list(names)
    if unknown := set(few) - {name_of(one) for one in names}:
        raise ValueError(f"not among the names: {', '.join(sorted(unknown))}")
    return [pytest.param(one, id=name_of(one), marks=() if name_of(one) in few else pytest.mark.long) for one in names]


def taking_turns(
    name: str, names: Sequence[Any], way: str, ways: Sequence[Any], few: Collection[str] | None = None
) -> pytest.MarkDecorator:
    """Parametrises with all pairs. By default each of `names` comes with one of `ways`, which take turns.

    The other pairs are for `-m long`, and so are all of names that are not in `few`, if given. Where a name has an
    attribute `name`, that is its id. Raises ValueError where one of the ways would never have a turn.
    """
    turns = [name_of(one) for one in names if few is None or name_of(one) in few]
    if len(ways) > len(turns):
        raise ValueError(f"{len(ways)} ways cannot take turns over {len(turns)} names")
    default = {(one, number % len(ways)) for number, one in enumerate(turns)}
    pairs = [
        pytest.param(one, other, id=f"{name_of(one)}-{other}",
                     marks=() if (name_of(one), turn) in default else pytest.mark.long)
        for one in names for turn, other in enumerate(ways)
    ]  # fmt: skip
    return pytest.mark.parametrize((name, way), pairs)


# A scene of somebody else, which is not part of the project: where it is, if it is there.

_BESIDE = Path(__file__).parents[2] / "shared" / "scenes" / "grey-white-room"


def real_room() -> Path:
    """The room's file: in the folder that RESLRB_GREY_WHITE_ROOM names, or beside the repository; else skips."""
    folder = Path(os.environ.get("RESLRB_GREY_WHITE_ROOM") or _BESIDE)
    if not (folder / "scene.xml").exists():
        pytest.skip(
            f"The Grey & White Room (Wig42, CC BY 3.0) is not in {folder}; set RESLRB_GREY_WHITE_ROOM to its folder"
        )
    return folder / "scene.xml"
