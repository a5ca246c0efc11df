"""What guided emission has learned, as a run's state has it: it comes back as it was; nothing else is taken for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from reslrb_cli.guiding.collect import Onward
from reslrb_cli.guiding.tables import Guiding, Learned
from reslrb_cli.transport.guide import make_grid
from reslrb_cli.transport.roulette import CELLS

GRID = make_grid([True] * 4, [1.0, 3.0], 9)


def learned() -> Guiding:
    """For two sensors, something each."""
    guiding, random = Guiding(), np.random.default_rng(1)
    guiding.grid = GRID
    for number in (0, 3):
        draws = random.random(GRID.cells) * 100
        said = Learned.nothing(GRID).with_more(GRID, random.random((4, GRID.cells)), draws)
        squares, light, length = random.random((4, CELLS)).astype(np.float32), random.random(), 1 + random.random()
        onward = Onward(random.random((2, 3)).cumsum(0).astype(np.float32), squares, light, length)
        guiding.learned[number] = Learned(said.sums, said.draws, 5 + number, onward)
    return guiding


def blank() -> Guiding:
    guiding = Guiding()
    guiding.grid = GRID
    return guiding


def test_what_was_learned_comes_back() -> None:
    before, after = learned(), blank()
    calls, arrays = before.state()
    assert after.restore(calls, arrays.__getitem__) is None
    assert list(after.learned) == [0, 3]
    for number, one in before.learned.items():
        assert after.learned[number].calls == one.calls
        for share in (0.0, 0.5, 1.0):
            np.testing.assert_array_equal(
                after.learned[number].density(GRID, share), one.density(GRID, share)
            )  # bit by bit
            found, known = after.learned[number].onward, one.onward
            assert found is not None
            assert known is not None
            np.testing.assert_array_equal(found.chances(share), known.chances(share))
            np.testing.assert_array_equal(found.box, known.box)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("0/sums", lambda sums: np.concatenate([sums, sums])),  # a row for each thing that was heard, as once
        ("0/sums", lambda sums: sums[:, ::2]),
        ("3/sums", lambda sums: sums[:0]),
        ("3/draws", lambda draws: draws[:-1]),
        ("0/draws", lambda draws: -draws),
        ("0/sums", lambda sums: sums * np.nan),
        ("3/draws", lambda draws: draws * np.inf),
        ("0/onward", lambda sums: sums[:3]),
        ("3/onward", lambda sums: sums[:, 1:]),
        ("0/onward", lambda sums: -sums),
        ("0/frame", lambda frame: frame[:6]),
        ("3/frame", lambda frame: frame * np.nan),
        ("3/frame", lambda frame: -frame),
    ],
)
def test_what_is_of_other_cells_is_refused_and_changes_nothing(name: str, wrong: Any) -> None:
    calls, arrays = learned().state()
    arrays[name] = wrong(arrays[name])
    after = learned()
    kept = dict(after.learned)
    assert after.restore(calls, arrays.__getitem__) == name
    assert after.learned == kept
