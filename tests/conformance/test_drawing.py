"""Ways of drawing paths change no mean, in any kind of step, and with moving light. Replays and recordings draw the
same paths.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from agreement import compare
from conformance import sequence_faults
from conformance.drawing import (
    BY_NAME,
    LOW_DISCREPANCY,
    MOVING,
    SPP,
    WAYS,
    aim_everywhere,
    aimed,
    both,
    guided,
    replayed_from,
    sample,
    samples,
    strength,
)
from conformance.guiding_faults import FAULTS as GUIDING_FAULTS
from conformance.operations import nothing_is_compiled_without
from turns import a_few

from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.guiding import tables
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.measure.gradients import Case, integrator, relative, seeds
from reslrb_cli.transport import aim, walk
from reslrb_cli.transport.aim import Aim, Blocks, Pending

pytestmark = pytest.mark.usefixtures("llvm")


@pytest.fixture(autouse=True)
def _everywhere(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Aim in every scene if the test is about aiming."""
    if "aimed" in request.node.name:
        aim_everywhere(monkeypatch)


def pairs(few: dict[str, tuple[str, ...]], every: dict[str, tuple[str, ...]]) -> list[Any]:
    """Return the parameters (way, name) of a test. By default only the names in `few` run."""
    return [
        pytest.param(way, name, id=f"{way}-{name}", marks=() if name in few[way] else pytest.mark.long)
        for way, names in every.items() for name in names
    ]  # fmt: skip


@functools.cache
def plain_samples(name: str, count: int, options: tuple[tuple[str, Any], ...]) -> np.ndarray:
    """Return samples of a case without any way, for every test that compares with them."""
    scene, _, plain = both(name, **dict(options))
    return samples(scene, plain, count, 1)


def means_hold(way: str, name: str, count: int, plant: Callable[[], None] = lambda: None) -> Any:
    """Compare gradients and images with those of plain samples, over `count` seeds each. Only the former have the
    fault that `plant` plants.
    """
    expected = plain_samples(name, count, tuple(WAYS[way].options.items()))
    plant()
    scene, ours, _ = WAYS[way].make(name, **WAYS[way].options)
    if way == "guided":
        assert strength(ours) > 2, "the table has learned nothing"
    result = compare(samples(scene, ours, count), expected, block=None)
    print(way, name, result)
    return result


@pytest.mark.parametrize(
    ("way", "name"), pairs({way: one.few for way, one in WAYS.items()}, {way: one.names for way, one in WAYS.items()})
)
def test_means_equal_those_of_plain_samples(way: str, name: str) -> None:
    assert means_hold(way, name, 32)


@pytest.mark.long
@pytest.mark.parametrize("guiding", ["off", "on"])
@pytest.mark.parametrize("name", ["texture", "two_emitters", "glass"])
def test_means_over_many_seeds_agree(name: str, guiding: str) -> None:
    """Means agree with independent numbers, and with the stock integrator that is right for the case."""
    scene, ours, plain = both(name, freeze=True)
    if guiding == "on":
        _, ours, _ = guided(name, 4, **LOW_DISCREPANCY)
    found, case = samples(scene, ours, 200), BY_NAME[name]
    against = compare(found, samples(scene, plain, 200, 1), block=None)
    stock = scene.gradients(integrator(case.source.name, **case.options), seeds(200, 2), case.spp)
    independent = compare(found[:, : stock.shape[1]], stock, block=None)
    print(name, guiding, against, independent, sep="\n")
    assert against
    assert independent


#: The kinds of steps that the default suite runs.
STEPS = {"aimed-reservoir-correlated"}


@pytest.mark.parametrize(
    ("way", "estimator", "adjoint"),
    [
        pytest.param(way, estimator, adjoint, id=f"{way}-{estimator}-{adjoint}",
                     marks=() if f"{way}-{estimator}-{adjoint}" in STEPS else pytest.mark.long)
        for way in WAYS for estimator in ESTIMATORS for adjoint in ("correlated", "independent", "batched")
    ],
)  # fmt: skip
def test_every_kind_of_step_has_the_plain_mean(way: str, estimator: str, adjoint: str) -> None:
    """The replay draws the same numbers as the trace, whatever the tables learn in between."""
    scene, ours, plain = WAYS[way].make(WAYS[way].telling, estimator=estimator, **WAYS[way].options)
    if way == "guided":
        del ours.preparation.guiding.due  # the default schedule: some steps learn
    spp = 16 if way == "sequence" else SPP
    found = [scene.gradients(each, seeds(24, block), spp, adjoint=adjoint) for block, each in enumerate((ours, plain))]
    result = compare(*found, block=None)
    print(way, estimator, adjoint, result)
    assert result


# Faults that bias the result.


def without_factor(patch: pytest.MonkeyPatch) -> None:
    """The factor of a path that is not aimed is never less than 1."""
    right = Pending.factor

    def wrong(self: Pending, *rest: Any) -> Any:
        r = right(self, *rest)
        return dr.select(self.distance > 0, r, dr.maximum(r, 1))

    patch.setattr(Pending, "factor", wrong)


def of_even_density(patch: pytest.MonkeyPatch) -> None:
    """The density is the density of a film with uniformly sampled positions."""
    right = Aim.of

    def wrong(blocks: Blocks, wanted: Any) -> Aim:
        table = right(blocks, wanted)
        return replace(table, density=type(table.density)(1) + 0 * table.density)

    patch.setattr(Aim, "of", wrong)


def behind_others(patch: pytest.MonkeyPatch) -> None:
    """An aimed path that meets another surface before its target point continues as if it had arrived."""
    patch.setattr(aim, "REACHED", 0.0)


def seen_through_others(patch: pytest.MonkeyPatch) -> None:
    """Points that the sensor does not see have the density of visible points."""
    right = Pending.factor

    def wrong(self: Pending, table: Any, sensor: Any, si: Any, ray: Any, connection: Any, visible: Any) -> Any:
        return right(self, table, sensor, si, ray, connection, connection.active)

    patch.setattr(Pending, "factor", wrong)


def with_delta_lobes(patch: pytest.MonkeyPatch) -> None:
    """The direction of a mirror counts as a direction at which paths can be aimed."""
    right = Pending.of
    faulty = staticmethod(lambda aimed, si, pdf, discrete: right(aimed, si, pdf, discrete & False))
    patch.setattr(Pending, "of", faulty)


def from_everywhere(patch: pytest.MonkeyPatch) -> None:
    """The share of aimed paths is `SHARE` everywhere, even on glass, from which no paths are aimed."""
    patch.setattr(walk, "choose", lambda *args: _with_share(aim.choose(*args)))


def _with_share(found: Any) -> Any:
    aimed, numbers = found
    return replace(aimed, share=0 * aimed.share + aim.SHARE), numbers


#: Each fault: its way, a case that shows it, and the number of seeds.
FAULTS: list[tuple[Callable[[pytest.MonkeyPatch], None], str, str, int]] = [
    (without_factor, "aimed", "roughplastic", 48),
    (of_even_density, "aimed", "roughplastic", 48),
    (behind_others, "aimed", "mesh_attribute", 96),
    (seen_through_others, "aimed", "roughdielectric", 96),
    (with_delta_lobes, "aimed", "plastic", 48),
    (from_everywhere, "aimed", "glass", 48),
    *((fault, "guided", "two_emitters", 32) for fault in GUIDING_FAULTS),
]


@pytest.mark.long
@pytest.mark.parametrize(
    ("fault", "way", "case", "count"), [pytest.param(*row, id=f"{row[1]}-{row[0].__name__}") for row in FAULTS]
)
def test_planted_biases_are_found(
    fault: Callable[[pytest.MonkeyPatch], None], way: str, case: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not means_hold(way, case, count, lambda: fault(monkeypatch))


# Replays and recordings.


def worst_of_replays(make: Callable[..., tuple[Case, Any, Any]], name: str, **options: Any) -> float:
    """Return the distance of the correlated gradient of `gather`, which traces twice, from the gradient of `stack` in
    one traversal.

    All use the same seed. The function also asserts that `stack` with two traversals has the same gradient, unless
    `gather` differs.
    """
    found = {}
    for kind in ("gather", "stack"):
        scene, ours, _ = make(name, estimator=kind, **options)
        found[kind] = scene.gradient(ours, 5, SPP, adjoint="correlated")
    known = sample(scene, ours, 5)[: len(found["gather"])]  # by `stack`, in one traversal
    distances = {kind: relative(gradient, known) for kind, gradient in found.items()}
    assert distances["stack"] < 1e-4 or distances["gather"] >= 1e-4
    return distances["gather"]


#: For each way: the function that makes its tracers, its cases, the cases of the default suite, and a fault of replays.
REPLAYS: dict[str, tuple[Any, tuple[str, ...], tuple[str, ...], Callable[[pytest.MonkeyPatch], None]]] = {
    "aimed": (aimed, ("roughplastic", "plastic", "mask_texture_in_view"), ("plastic",),
              lambda patch: replayed_from(patch, lambda table: replace(table, aim=replace(
                  table.aim, slots=0 * table.aim.slots)))),
    "sequence": (both, ("two_emitters", "glass", "mask_texture_in_view"), ("glass",),
                 sequence_faults.swapped_in_replays),
}  # fmt: skip


@pytest.mark.parametrize("fault", [False, pytest.param(True, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("way", "name"),
    pairs({way: few for way, (_, _, few, _) in REPLAYS.items()}, {way: all for way, (_, all, _, _) in REPLAYS.items()}),
)
def test_a_replay_follows_the_traced_paths(way: str, name: str, fault: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    make, *_, plant = REPLAYS[way]
    if fault:
        plant(monkeypatch)
    monkeypatch.setattr(tables, "NOW", 0.0)  # a known dL/dI is compared with one that is not known
    assert (worst_of_replays(make, name) < 1e-4) is not fault


@pytest.mark.parametrize("name", a_few(["two_emitters", "mask_texture_in_view"], ()))
def test_exact_estimators_agree_at_equal_seeds_with_learned_tables(name: str) -> None:
    """Estimators would disagree if a replay drew other cells than the trace, or used another weight."""
    scene, ours, _ = guided(name, 2)
    learned = ours.preparation.guiding.learned
    others = [guided(name, 0, estimator="gather"), guided(name, 0, stack_size=2)]
    reference = scene.gradient(ours, 5, SPP, adjoint="correlated")
    for _, other, _ in others:
        other.expect(SPP)
        other.plan(scene.scene, scene.scene.sensors()[0], scene.params)
        other.preparation.guiding.learned = dict(learned)
        assert relative(scene.gradient(other, 5, SPP, adjoint="correlated"), reference) < 1e-4


@pytest.mark.parametrize("way", [way for way in WAYS if way != "aimed_sequence"])
def test_a_recorded_step_equals_the_step(way: str) -> None:
    """A recording uses the current table, not the table with which it was made."""
    make = both if way == "sequence" else lambda name, **options: guided(name, 0, **options)
    name = "roughplastic" if way == "aimed" else "envmap"
    (scene, ours, _), (_, frozen, _) = (make(name, freeze=freeze) for freeze in (False, True))
    for number in range(3):
        for each in (ours, frozen):
            WAYS[way].change(scene, each, number)
            if way == "guided":
                each.preparation.guiding.due = lambda number: False
        assert relative(*(sample(scene, each, 5 + number) for each in (ours, frozen))) < 1e-4
    assert frozen.preparation.recordings.counts()["fused"] > 0


@pytest.mark.parametrize("way", ["guided", "sequence"])
def test_without_a_way_its_code_is_not_compiled(way: str) -> None:
    made = guided("two_emitters", 0) if way == "guided" else both("two_emitters")
    nothing_is_compiled_without("grid" if way == "guided" else "sequence", *made)


# Moving light: the random numbers of the emission are held, so that the weight of guided emission is a constant.

MOTIONS = ("latents", "spot", "mesh", "bounces_4")


@pytest.mark.long
@pytest.mark.parametrize("estimator", ["stack", "reservoir"])
@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("way", ["guided", "sequence"])
def test_means_with_moving_light_are_those_of_plain_samples(way: str, name: str, estimator: str) -> None:
    moving, found = MOVING[name].moving(), []
    own = {"sequence": "low_discrepancy"} if way == "sequence" else {"guiding": "on"}
    for block, options in enumerate((own, {})):
        ours = make_integrator("reslrb", max_depth=5, rr_depth=1000, estimator=estimator, **options)
        if "guiding" in options:
            learn_from_four(moving, ours)
        rows = [moving.gradient(ours, seed, 16) for seed in seeds(32, block)]
        found.append(np.stack([np.concatenate(list(row.values())) for row in rows]))
    result = compare(*found, block=None)
    print(way, name, estimator, result)
    assert np.abs(found[0]).max() > 0
    assert result


def learn_from_four(moving: Any, ours: Any) -> None:
    """Run four steps from which the tables learn, and then stop the learning."""
    for seed in range(4):
        moving.gradient(ours, 9000 + seed, 16)
    guiding = ours.preparation.guiding
    assert [learned.calls for learned in guiding.learned.values()] == [4]
    guiding.due = lambda number: False
