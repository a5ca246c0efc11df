"""Pairs of parameters of which the default suite runs a part: each name, and each way, but not every name every way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest


def taking_turns(name: str, names: Sequence[Any], way: str, ways: Sequence[Any]) -> pytest.MarkDecorator:
    """Parametrises with all pairs. By default each of `names` comes with one of `ways`, which take turns.

    The other pairs are for `-m long`. Where a name has an attribute `name`, that is its id. Raises ValueError where one
    of the ways would never have a turn.
    """
    if len(ways) > len(names):
        raise ValueError(f"{len(ways)} ways cannot take turns over {len(names)} names")
    pairs = [
        pytest.param(one, other, id=f"{getattr(one, 'name', one)}-{other}",
                     marks=() if number % len(ways) == turn else pytest.mark.long)
        for number, one in enumerate(names) for turn, other in enumerate(ways)
    ]  # fmt: skip
    return pytest.mark.parametrize((name, way), pairs)
