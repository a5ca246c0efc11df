"""Points of low discrepancy: Sobol's, and as evenly spread when they are scrambled."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.stats import qmc

pytestmark = pytest.mark.usefixtures("llvm")
COORDINATES = 10


def coordinates(seed: int, width: int) -> np.ndarray:
    """All coordinates of a pass's points, (COORDINATES, width), the stratified one left out."""
    import drjit as dr
    import mitsuba as mi

    from reslrb_cli.transport.sobol import Points

    points = Points(dr.opaque(mi.UInt32, seed), width, None)
    return np.stack([np.array(points.next_1d(), np.float64) for _ in range(COORDINATES)])


def test_points_are_sobol_s() -> None:
    """Of 2^15 points in a row all are among SciPy's, which come in another order."""
    import drjit as dr
    import mitsuba as mi

    from reslrb_cli.transport.sobol import point

    count = 2**15
    own = [dr.brev(point(dr.arange(mi.UInt32, count), c)) for c in range(COORDINATES)]
    mine = np.stack([np.array(digits, np.uint64) for digits in own], 1)
    theirs = (qmc.Sobol(COORDINATES, scramble=False, bits=32).random(count) * 2**32).astype(np.uint64)
    np.testing.assert_array_equal(mine[np.lexsort(mine.T)], theirs[np.lexsort(theirs.T)])


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("k", [3, 8])
def test_boxes_of_the_first_two_hold_one_point_each(k: int, seed: int) -> None:
    assert fills(coordinates(seed, 7 * 2**k), k)


def fills(points: np.ndarray, k: int) -> bool:
    """Whether of each 2^k points in a row each box of area 2^-k holds one, along the first two and along each alone."""
    for part in points.reshape(COORDINATES, -1, 2**k).transpose(1, 0, 2):
        boxes = [
            (part[0] * 2**a).astype(int) * 2 ** (k - a) + (part[1] * 2 ** (k - a)).astype(int) for a in range(k + 1)
        ]
        for cells in (*boxes, *(part * 2**k).astype(int)):
            if not np.array_equal(np.sort(cells), np.arange(2**k)):
                return False
    return True


def unnested(point: Any, shift: Any, key: Any) -> Any:
    """Sums carry from later digits to those before them."""
    import drjit as dr

    return dr.brev(dr.brev(point) * (key | 1) + shift)


def independent(point: Any, shift: Any, key: Any) -> Any:
    """Points have nothing to do with one another."""
    import mitsuba as mi

    return mi.sample_tea_32(point, shift)[0]


@pytest.mark.parametrize("scramble", [unnested, independent])
def test_another_scramble_is_found(scramble: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.transport import sobol

    monkeypatch.setattr(sobol, "scrambled", scramble)
    assert not fills(coordinates(1, 2**8), 8)


def test_scrambles_differ() -> None:
    """From seed to seed, and from one coordinate to the next: first digits agree as often as not."""
    same = []
    for seed in range(128):
        first = coordinates(seed, 1)[:, 0] < 0.5
        same.append(np.concatenate([first, first[1:] == first[:-1]]))
    shares = np.mean(same, 0)
    assert (np.abs(shares - 0.5) < 5 * 0.5 / 128**0.5).all()


@pytest.mark.parametrize("width", [1, 1000, 3 * 2**24 + 1])
def test_the_first_number_is_stratified(width: int) -> None:
    import drjit as dr
    import mitsuba as mi

    from reslrb_cli.transport.sobol import Net

    net, some = Net.of(width), np.unique(np.linspace(0, width - 1, 1000).astype(np.int64))
    for jitter in (0.0, 0.5, float(dr.one_minus_epsilon(mi.Float))):
        numbers = np.array(net.stratified(mi.UInt32(some), mi.Float(jitter)), np.float64)
        assert (np.abs(numbers * width - some - jitter) < 1e-3 + width * 2.0**-24).all()
        assert numbers.max() < 1
