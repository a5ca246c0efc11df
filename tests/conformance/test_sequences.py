"""Low-discrepancy numbers are evenly distributed, and unbiased in every kind of step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from agreement import compare
from conformance import attached_cases, moving_lamps, sequence_faults
from conformance.gradient_cases import CASES
from conformance.operations import nothing_is_compiled_without
from conformance.test_guiding import guided, sample, samples
from conformance.test_kernels import steps_compile_nothing
from scipy.stats import qmc
from turns import a_few

import reslrb_cli
from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.integrators.step import make_integrator
from reslrb_cli.measure.gradients import Case, integrator, relative, seeds

pytestmark = pytest.mark.usefixtures("llvm")


# Low-discrepancy numbers: evenly spread, and unbiased in every kind of step. Faults that could cause bias are planted.

BY_NAME = {case.name: case for case in CASES}
MOVING = {case.name: case for case in (*attached_cases.CASES, *moving_lamps.CASES)}
NAMES = ("texture", "two_emitters", "envmap", "roulette", "passes", "area_texture", "glass", "mask", "point", "plastic")
ON: dict[str, Any] = {"sequence": "low_discrepancy"}
#: Few lanes, so that the test detects a single point that is not evenly distributed by itself.
LANES = 5


def both(name: str, **options: Any) -> tuple[Case, Any, Any]:
    """Return a case, an integrator with low-discrepancy numbers, and an integrator with independent numbers."""
    case = BY_NAME[name]
    own = {"estimator": "stack"} | case.options | case.both | options
    return Case(case.scene(), case.keys), integrator("reslrb", **own, **ON), integrator("reslrb", **own)


@pytest.mark.parametrize("name", a_few(NAMES, ["glass"]))
def test_means_equal_those_of_independent_numbers(name: str) -> None:
    scene, ours, plain = both(name, freeze=True)
    result = compare(samples(scene, ours, 32), samples(scene, plain, 32, 1), block=None)
    print(name, result)
    assert result


@pytest.mark.long
@pytest.mark.parametrize("guiding", ["off", "on"])
@pytest.mark.parametrize("name", ["texture", "two_emitters", "glass"])
def test_means_over_many_seeds_agree(name: str, guiding: str) -> None:
    """Means agree with independent numbers, and with the stock integrator that is right for the case."""
    scene, ours, plain = both(name, freeze=True)
    if guiding == "on":
        _, ours, _ = guided(name, 4, **ON)
    found, case = samples(scene, ours, 200), BY_NAME[name]
    against = compare(found, samples(scene, plain, 200, 1), block=None)
    stock = scene.gradients(integrator(case.reference, **case.both), seeds(200, 2), case.spp)
    independent = compare(found[:, : stock.shape[1]], stock, block=None)
    print(name, guiding, against, independent, sep="\n")
    assert against
    assert independent


@pytest.mark.parametrize("estimator", a_few(ESTIMATORS, ["reservoir"]))
@pytest.mark.parametrize("adjoint", a_few(["correlated", "independent", "batched"], ["batched"]))
def test_every_kind_of_step_has_the_same_mean(estimator: str, adjoint: str) -> None:
    scene, ours, plain = both("texture", estimator=estimator, freeze=True)
    found = [scene.gradients(each, seeds(24, block), 16, adjoint=adjoint) for block, each in enumerate((ours, plain))]
    result = compare(*found, block=None)
    print(estimator, adjoint, result)
    assert result


@pytest.mark.parametrize("name", a_few(["latents", "spot", "mesh", "bounces_4"], ["spot"]))
@pytest.mark.parametrize("estimator", a_few(["stack", "reservoir"], ["stack"]))
def test_means_hold_with_followed_light(name: str, estimator: str) -> None:
    moving, found = MOVING[name].moving(), []
    for block, sequence in enumerate(("low_discrepancy", "independent")):
        ours = make_integrator("reslrb", max_depth=5, rr_depth=1000, estimator=estimator, sequence=sequence)
        rows = [moving.gradient(ours, seed, 16) for seed in seeds(32, block)]
        found.append(np.stack([np.concatenate(list(row.values())) for row in rows]))
    result = compare(*found, block=None)
    print(name, estimator, result)
    assert np.abs(found[0]).max() > 0
    assert result


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
    import drjit as dr
    import mitsuba as mi

    from reslrb_cli.integrators.protocol import Job
    from reslrb_cli.transport.sobol import Net

    case = Case(BY_NAME["two_emitters"].scene(), [])
    ours = integrator("reslrb", guiding=guiding, samples_per_pass=1, **ON)
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
        rows.append(counts(numbers))
    found = np.stack(rows)
    return compare(found, np.tile(expected(len(numbers)), (2, 1)), block=None)


def counts(numbers: list[Any]) -> np.ndarray:
    """Return how many numbers are in each eighth, and how many pairs of numbers are in each quarter of the square."""
    values = np.stack([np.array(number, np.float64) for number in numbers])
    assert values.min() >= 0
    assert values.max() < 1
    halves = (values * 2).astype(int)
    single = [np.bincount((row * 8).astype(int), minlength=8) for row in values]
    return np.concatenate([*single, *(np.bincount(2 * a + b, minlength=4) for a, b in combinations(halves, 2))])


def expected(numbers: int) -> np.ndarray:
    """Return the expected counts for numbers that are evenly distributed, and independent of one another within
    a lane.
    """
    pairs = numbers * (numbers - 1) // 2
    return np.concatenate([np.full(8 * numbers, LANES / 8), np.full(4 * pairs, LANES / 4)])


@pytest.mark.parametrize("name", a_few(["two_emitters", "glass", "mask_texture_in_view", "passes"], ["glass"]))
def test_exact_estimators_agree_at_equal_seeds(name: str) -> None:
    """Estimators would disagree if a replay drew other numbers than the trace."""
    assert worst_of_replays(name) < 1e-4


def test_a_replay_with_other_numbers_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence_faults.swapped_in_replays(monkeypatch)
    assert worst_of_replays("glass", ["correlated"]) > 1e-2


def worst_of_replays(name: str, ways: Sequence[str] = ("correlated", "independent")) -> float:
    """Return the largest distance between gradients of `gather`, which traces twice, and gradients of `stack`."""
    scene, ours, _ = both(name)
    _, other, _ = both(name, estimator="gather")
    return max(relative(*(scene.gradient(each, 5, 64, adjoint=way) for each in (other, ours))) for way in ways)


def test_a_recorded_step_equals_the_step() -> None:
    scene, ours, _ = both("two_emitters")
    _, frozen, _ = both("two_emitters", freeze=True)
    for seed in (5, 6):
        assert relative(*(sample(scene, each, seed) for each in (ours, frozen))) < 1e-4
    assert frozen.preparation.recordings.counts()["fused"] > 0


def test_with_independent_numbers_the_sequence_is_not_compiled() -> None:
    nothing_is_compiled_without("sequence", *both("two_emitters"))


def test_later_steps_compile_nothing() -> None:
    scene, ours, _ = both("passes")
    steps_compile_nothing(scene, lambda seed: scene.gradient(ours, seed, 64, adjoint="correlated"))


def test_the_plugin_has_the_option() -> None:
    import mitsuba as mi

    reslrb_cli.register()
    plugin = mi.load_dict({"type": "reslrb", "max_depth": 4, **ON})
    scene = Case(BY_NAME["point"].scene(), [])
    assert plugin.tracer.plan(scene.scene, scene.scene.sensors()[0]).sequence is not None
    with pytest.raises(RuntimeError, match='"sequence" must be one of independent, low_discrepancy, not "halton"'):
        mi.load_dict({"type": "reslrb", "sequence": "halton"})


# Low-discrepancy points: Sobol's, which are as evenly spread after scrambling.

COORDINATES = 10


def coordinates(seed: int, width: int) -> np.ndarray:
    """Return all coordinates of a pass's points, (COORDINATES, width), without the stratified coordinate."""
    import drjit as dr
    import mitsuba as mi

    from reslrb_cli.transport.sobol import Points

    points = Points(dr.opaque(mi.UInt32, seed), width, None)
    return np.stack([np.array(points.next_1d(), np.float64) for _ in range(COORDINATES)])


def test_points_match_sobol() -> None:
    """The first 2^15 points are the same as SciPy's first 2^15 points, in another order."""
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
    import drjit as dr

    return dr.brev(dr.brev(point) * (key | 1) + shift)


def independent(point: Any, shift: Any, key: Any) -> Any:
    """Return points that are unrelated to one another."""
    import mitsuba as mi

    return mi.sample_tea_32(point, shift)[0]


@pytest.mark.parametrize("scramble", [unnested, independent])
def test_another_scramble_is_found(scramble: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.transport import sobol

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
    import drjit as dr
    import mitsuba as mi

    from reslrb_cli.transport.sobol import Net

    net, some = Net.of(width), np.unique(np.linspace(0, width - 1, 1000).astype(np.int64))
    for jitter in (0.0, 0.5, float(dr.one_minus_epsilon(mi.Float))):
        numbers = np.array(net.stratified(mi.UInt32(some), mi.Float(jitter)), np.float64)
        assert (np.abs(numbers * width - some - jitter) < 1e-3 + width * 2.0**-24).all()
        assert numbers.max() < 1
