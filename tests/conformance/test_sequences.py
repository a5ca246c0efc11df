"""Low-discrepancy numbers are evenly distributed. test_drawing.py compares means of whole steps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from conformance import sequence_faults
from conformance.drawing import BY_NAME, LOW_DISCREPANCY, both, samples
from conformance.test_guiding import histogram
from conformance.test_kernels import steps_compile_nothing
from scipy.stats import qmc

import reslrb_cli
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.transport import sobol
from reslrb_cli.transport.sobol import Net, Points

pytestmark = pytest.mark.usefixtures("llvm")


# Low-discrepancy numbers are evenly spread. Faults that could cause bias are planted.

#: Few lanes, so that the test detects a single point that is not evenly distributed by itself.
LANES = 5


def test_noise_is_lower_if_these_numbers_determine_the_paths() -> None:
    scene, ours, plain = both("point", max_depth=2)
    variances = [samples(scene, each, 24, block).var(0, ddof=1).sum() for block, each in enumerate((ours, plain))]
    print(variances[1] / variances[0])
    assert variances[1] > 2 * variances[0]


@pytest.mark.parametrize("guiding", ["off", "on"])
def test_numbers_are_evenly_distributed(guiding: str) -> None:
    result = evenly(guiding)
    print(result)
    assert result


@pytest.mark.long
@pytest.mark.parametrize(
    "fault",
    [
        sequence_faults.never_scrambled,
        sequence_faults.scrambled_once,
        sequence_faults.not_shifted,
        sequence_faults.one_scramble_for_all,
        sequence_faults.used_twice,
        sequence_faults.half_of_the_strata,
        sequence_faults.without_jitter,
        sequence_faults.squeezed,
        sequence_faults.of_emission_again,
        sequence_faults.shared_by_passes,
    ],
)
def test_planted_biases_are_found(fault: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    fault(monkeypatch)
    result = evenly("off")
    print(fault.__name__, result)
    assert not result


def evenly(guiding: str) -> Any:
    """Compare counts of the numbers with the expected counts. The numbers come from two passes with a few lanes."""
    case = Case(BY_NAME["two_emitters"].scene(), [])
    ours = integrator("reslrb", guiding=guiding, samples_per_pass=1, **LOW_DISCREPANCY)
    rows = []
    for seed in range(80):
        job = Job(case.scene, case.scene.sensors()[0], dr.opaque(mi.UInt32, seed), 2)
        numbers: list[Any] = []
        for part in ours.passes(job):
            few = replace(part, width=LANES, net=Net.of(LANES))
            choice, place, direction = few.emission_numbers(few.sampler())
            early = [number for own in few.early_numbers() for number in (own.bsdf_2d.x, own.bsdf_2d.y, own.bsdf_1d)]
            # The first number of a lane lies in the same stratum in both passes, so it is counted once.
            first = [choice] if guiding == "off" and not numbers else []
            numbers += [*first, direction.x, direction.y, place.x, place.y, *early]
        dr.eval(numbers)
        assert len(numbers) == 20 + (guiding == "off")
        rows.append(histogram(numbers, np.ones(dr.width(numbers[0]))))
    found = np.stack(rows)
    return compare(found, np.tile(expected(len(numbers)), (2, 1)), block=None)


def expected(numbers: int) -> np.ndarray:
    """Return the expected counts for numbers that are evenly distributed, and independent of one another within
    a lane.
    """
    pairs = numbers * (numbers - 1) // 2
    return np.concatenate([np.full(8 * numbers, LANES / 8), np.full(4 * pairs, LANES / 4)])


def test_later_steps_compile_nothing() -> None:
    scene, ours, _ = both("passes")
    steps_compile_nothing(scene, lambda seed: scene.gradient(ours, seed, 64, adjoint="correlated"))


def test_the_plugin_has_the_option() -> None:
    reslrb_cli.register()
    plugin = mi.load_dict({"type": "reslrb", "max_depth": 4, **LOW_DISCREPANCY})
    scene = Case(BY_NAME["point"].scene(), [])
    assert plugin.tracer.plan(scene.scene, scene.scene.sensors()[0]).sequence is not None
    with pytest.raises(
        RuntimeError, match='"sequence" must be one of auto, independent, low_discrepancy, not "halton"'
    ):
        mi.load_dict({"type": "reslrb", "sequence": "halton"})


# Low-discrepancy points: Sobol's, which are as evenly spread after scrambling.

COORDINATES = 10


def coordinates(seed: int, width: int) -> np.ndarray:
    """Return all coordinates of a pass's points, (COORDINATES, width), without the stratified coordinate."""
    points = Points(dr.opaque(mi.UInt32, seed), width, None)
    return np.stack([np.array(points.next_1d(), np.float64) for _ in range(COORDINATES)])


def test_points_match_sobol() -> None:
    """The first 2^15 points are the same as SciPy's first 2^15 points, in another order."""
    from reslrb_cli.transport.sobol import point

    count = 2**15
    own = [dr.brev(point(dr.arange(mi.UInt32, count), c)) for c in range(COORDINATES)]
    mine = np.stack([np.array(digits, np.uint64) for digits in own], 1)
    theirs = (qmc.Sobol(COORDINATES, scramble=False, bits=32).random(count) * 2**32).astype(np.uint64)
    np.testing.assert_array_equal(mine[np.lexsort(mine.T)], theirs[np.lexsort(theirs.T)])


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("k", [3, 8])
def test_boxes_of_the_first_two_dimensions_hold_one_point_each(k: int, seed: int) -> None:
    assert fills(coordinates(seed, 7 * 2**k), k)


def fills(points: np.ndarray, k: int) -> bool:
    """Return True if, of each 2^k points in a row, each box of area 2^-k holds one. Boxes cover the first two
    coordinates together, and each coordinate alone.
    """
    for part in points.reshape(COORDINATES, -1, 2**k).transpose(1, 0, 2):
        boxes = [
            (part[0] * 2**a).astype(int) * 2 ** (k - a) + (part[1] * 2 ** (k - a)).astype(int) for a in range(k + 1)
        ]
        for cells in (*boxes, *(part * 2**k).astype(int)):
            if not np.array_equal(np.sort(cells), np.arange(2**k)):
                return False
    return True


def unnested(point: Any, shift: Any, key: Any) -> Any:
    """Return a scramble in which sums carry from later digits to earlier digits."""
    return dr.brev(dr.brev(point) * (key | 1) + shift)


def independent(point: Any, shift: Any, key: Any) -> Any:
    """Return points that are unrelated to one another."""
    return mi.sample_tea_32(point, shift)[0]


@pytest.mark.parametrize("scramble", [unnested, independent])
def test_another_scramble_is_found(scramble: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sobol, "scrambled", scramble)
    assert not fills(coordinates(1, 2**8), 8)


def test_scrambles_differ() -> None:
    """Scrambles differ between seeds and between neighbouring coordinates. First digits agree in half of the cases."""
    same = []
    for seed in range(128):
        first = coordinates(seed, 1)[:, 0] < 0.5
        same.append(np.concatenate([first, first[1:] == first[:-1]]))
    shares = np.mean(same, 0)
    assert (np.abs(shares - 0.5) < 5 * 0.5 / 128**0.5).all()


@pytest.mark.parametrize("width", [1, 1000, 3 * 2**24 + 1])
def test_the_first_number_is_stratified(width: int) -> None:
    net, some = Net.of(width), np.unique(np.linspace(0, width - 1, 1000).astype(np.int64))
    for jitter in (0.0, 0.5, float(dr.one_minus_epsilon(mi.Float))):
        numbers = np.array(net.stratified(mi.UInt32(some), mi.Float(jitter)), np.float64)
        assert (np.abs(numbers * width - some - jitter) < 1e-3 + width * 2.0**-24).all()
        assert numbers.max() < 1
