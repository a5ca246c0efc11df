"""Parameters of which the default suite runs only a part, parts of the long tests, and a scene of another author, if
available.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

# Parameters of which the default suite runs only a part. Of many names, a few run. Of pairs, each name and each way
# runs.


def name_of(one: Any) -> str:
    """Return the name of a test's parameter."""
    return str(getattr(one, "name", one))


def a_few(names: Iterable[Any], few: Collection[str]) -> list[Any]:
    """Return the parameters of a test. By default only the names in `few` run, and all others need `-m long`.

    If a name has an attribute `name`, this attribute is the id. Raises ValueError if an entry of `few` is not among the
    names.
    """
    names = list(names)
    if unknown := set(few) - {name_of(one) for one in names}:
        raise ValueError(f"not among the names: {', '.join(sorted(unknown))}")
    return [pytest.param(one, id=name_of(one), marks=() if name_of(one) in few else pytest.mark.long) for one in names]


def taking_turns(
    name: str, names: Sequence[Any], way: str, ways: Sequence[Any], few: Collection[str] | None = None
) -> pytest.MarkDecorator:
    """Parametrise a test with all pairs of `names` and `ways`. By default each name comes with one way, and the ways
    take turns.

    The other pairs need `-m long`. If `few` is given, all pairs of names outside `few` also need `-m long`. If a name
    has an attribute `name`, this attribute is the id. Raises ValueError if one of the ways would never have a turn.
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


def common_setup(config: pytest.Config) -> Any:
    """Return the module tests/conftest.py, as pytest has loaded it."""
    file = str(Path(__file__).with_name("conftest.py"))
    return next(plugin for plugin in config.pluginmanager.get_plugins() if getattr(plugin, "__file__", "") == file)


# A scene by another author, which is not part of the project: its place, if it exists.

_BESIDE = Path(__file__).parents[2] / "shared" / "scenes" / "grey-white-room"


def real_room() -> Path:
    """Return the room's file in the folder that RESLRB_GREY_WHITE_ROOM names, or beside the repository. Skip the test
    if there is no file.
    """
    folder = Path(os.environ.get("RESLRB_GREY_WHITE_ROOM") or _BESIDE)
    if not (folder / "scene.xml").exists():
        pytest.skip(
            f"The Grey & White Room (Wig42, CC BY 3.0) is not in {folder}; set RESLRB_GREY_WHITE_ROOM to its folder"
        )
    return folder / "scene.xml"


# Parts of the long tests, with equal numbers of tests of each file (`--part K/N`).


def read_part(text: str) -> tuple[int, int]:
    """Return the numbers in `K/N`. Raises ValueError."""
    part, parts = map(int, text.split("/"))
    if not 1 <= part <= parts:
        raise ValueError(f"{text}: the first number must be between 1 and the second")
    return part, parts


def in_part(items: Sequence[pytest.Item], part: int, parts: int) -> list[pytest.Item]:
    """Return the items in a part. Neighbours in a file stay together, because they share fixtures and kernels."""
    chosen: list[pytest.Item] = []
    for n, (_, group) in enumerate(itertools.groupby(items, lambda item: item.path)):
        inside, at = list(group), (part - 1 + n) % parts  # the extra items of small files fall into different parts
        chosen += inside[at * len(inside) // parts : (at + 1) * len(inside) // parts]
    return chosen
