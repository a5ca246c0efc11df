"""Tests of scattering that is aimed at points that the sensor sees, and of guided emission in scenes with moving light.
The means do not change.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from agreement import compare
from conformance import attached_cases, moving_lamps
from conformance.test_guiding import SPP, guided, sample, samples, seeds
from conformance.test_survival import by_harsh_table, replayed_from, replays_agree
from turns import a_few

from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.guiding import tables as guiding
from reslrb_cli.guiding.tables import NOW, Learned, Purpose
from reslrb_cli.integrators import context
from reslrb_cli.integrators.step import make_integrator
from reslrb_cli.measure.gradients import Case, relative
from reslrb_cli.measure.gradients import seeds as seeds_guiding_moving
from reslrb_cli.transport import aim
from reslrb_cli.transport.aim import AIM_SLOTS, AIM_UNIFORM, Aim, Pending
from reslrb_cli.transport.film import BLOCKS, Blocks

pytestmark = pytest.mark.usefixtures("llvm")


# Scattering that is aimed at what the sensor sees: means are unchanged for every view and every aim.

NAMES = (
    *("roughconductor", "roughplastic", "plastic", "blend", "roughdielectric", "principled"),
    *(
        "texture",
        "crop",
        "gaussian",
        "passes",
        "roulette",
        "envmap",
        "glass",
        "mask",
        "plastic_beside_mask",
        "twosided",
    ),
)
FEW = ["roughplastic", "crop", "plastic_beside_mask"]


@pytest.fixture
def everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Aiming also in scenes without glossy surfaces."""
    monkeypatch.setattr(context, "worthwhile", lambda needs, max_depth: max_depth > 2)


def aimed(name: str, **options: Any) -> tuple[Case, Any, Any]:
    """Return a case, a guided integrator, and an integrator that is not guided. The guided integrator has learned from
    one gradient. A table of large contrasts, which has nothing to do with the scene, aims its paths.
    """
    scene, ours, plain = guided(name, 1, **options)
    askew(scene, ours)
    return scene, ours, plain


def askew(scene: Case, ours: Any, factor: float = 1.5) -> None:
    """Aim the samples of the first sensor by a random table of large contrasts."""
    tables = ours.preparation.guiding
    areas = tables.films[0].areas()
    loud = np.random.default_rng(1).lognormal(0, factor, len(areas)) * areas
    learned = tables.learned.get(0) or Learned.nothing(tables.grid)
    tables.learned[0] = replace(learned, film=np.square([loud, loud], dtype=np.float32))
    tables._tables.clear()


@pytest.mark.usefixtures("everywhere")
@pytest.mark.parametrize("name", a_few(NAMES, FEW))
def test_means_equal_those_of_unguided_samples(name: str) -> None:
    assert means_hold(name, 32)


def means_hold(name: str, count: int) -> Any:
    scene, ours, plain = aimed(name)
    result = compare(samples(scene, ours, count), samples(scene, plain, count, 1), block=None)
    print(name, result)
    return result


@pytest.mark.usefixtures("everywhere")
@pytest.mark.parametrize("estimator", a_few(ESTIMATORS, ["reservoir", "gather"]))
@pytest.mark.parametrize("adjoint", a_few(["correlated", "independent", "batched"], ["batched"]))
def test_every_kind_of_step_has_the_unguided_mean(estimator: str, adjoint: str) -> None:
    scene, ours, plain = aimed("roughplastic", estimator=estimator)
    found = [scene.gradients(each, seeds(24, block), SPP, adjoint=adjoint) for block, each in enumerate((ours, plain))]
    result = compare(*found, block=None)
    print(estimator, adjoint, result)
    assert result


@pytest.mark.usefixtures("everywhere")
def test_low_discrepancy_sequences_have_the_same_means() -> None:
    scene, ours, plain = aimed("roughplastic", sequence="low_discrepancy")
    assert compare(samples(scene, ours, 32), samples(scene, plain, 32, 1), block=None)


def without_factor(patch: pytest.MonkeyPatch) -> None:
    """The factor of a path that is not aimed is never less than 1."""
    right = Pending.factor

    def wrong(self: Pending, *rest: Any) -> Any:
        import drjit as dr

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
    from reslrb_cli.transport.aim import Pending

    right = Pending.of
    faulty = staticmethod(lambda aimed, si, pdf, discrete: right(aimed, si, pdf, discrete & False))
    patch.setattr(Pending, "of", faulty)


def from_everywhere(patch: pytest.MonkeyPatch) -> None:
    """The share of aimed paths is `SHARE` everywhere, even on glass, from which no paths are aimed."""
    from reslrb_cli.transport import walk

    patch.setattr(walk, "choose", lambda *args: _with_share(aim.choose(*args)))


def _with_share(found: Any) -> Any:
    aimed, numbers = found
    return replace(aimed, share=0 * aimed.share + aim.SHARE), numbers


#: Each fault with a case that shows it, and the number of steps.
FAULTS = {
    "without_factor": (without_factor, "roughplastic", 48),
    "of_even_density": (of_even_density, "roughplastic", 48),
    "behind_others": (behind_others, "mesh_attribute", 96),
    "seen_through_others": (seen_through_others, "roughdielectric", 96),
    "with_delta_lobes": (with_delta_lobes, "plastic", 48),
    "from_everywhere": (from_everywhere, "glass", 48),
}


@pytest.mark.usefixtures("everywhere")
@pytest.mark.parametrize("name", a_few(FAULTS, ["without_factor", "of_even_density"]))
def test_planted_biases_are_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fault, case, count = FAULTS[name]
    fault(monkeypatch)
    assert not means_hold(case, count)


@pytest.mark.usefixtures("everywhere")
@pytest.mark.parametrize("fault", [False, True])
@pytest.mark.parametrize("name", a_few(["roughplastic", "plastic", "mask_texture_in_view"], ["plastic"]))
def test_a_replay_follows_the_traced_paths(name: str, fault: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if fault:
        replayed_from(monkeypatch, lambda table: replace(table, aim=replace(table.aim, slots=0 * table.aim.slots)))
    monkeypatch.setattr(guiding, "NOW", 0.0)  # a known dL/dI is compared with one that is not known
    assert replays_agree(lambda kind: aimed(name, estimator=kind)[:2]) is not fault


@pytest.mark.usefixtures("everywhere")
def test_a_recorded_step_equals_the_step() -> None:
    """A recording uses the current table, not the table with which it was made."""
    (scene, ours, _), (_, frozen, _) = (guided("roughplastic", 0, freeze=freeze) for freeze in (False, True))
    for factor in (0.0, 1.0, 2.0):
        for each in (ours, frozen):
            sample(scene, each, 4)  # this fixes the grid
            askew(scene, each, factor)
        assert relative(*(sample(scene, each, 5) for each in (ours, frozen))) < 1e-4
    assert frozen.preparation.recordings.counts()["fused"] > 0


@pytest.mark.usefixtures("everywhere")
@pytest.mark.parametrize("size", [(1, 1), (9, 7), (160, 90), (1000, 3), (1920, 1080)])
def test_blocks_partition_the_film_with_the_densities_of_their_slots(size: tuple[int, int]) -> None:
    import mitsuba as mi

    film, random = Blocks.of(size), np.random.default_rng(3)
    areas = film.areas()
    wanted = random.lognormal(0, 2, film.count) * areas
    assert len(areas) == film.rows * film.columns == film.count <= BLOCKS
    assert areas.sum() == size[0] * size[1]
    across, down = np.meshgrid(*(np.arange(n, dtype=np.float32) + np.float32(0.5) for n in size))
    blocks = np.array(film.block(mi.Point2f(across.ravel(), down.ravel())))
    assert (np.bincount(blocks, minlength=film.count) == areas).all()
    own = np.flatnonzero(blocks == blocks[size[1] // 2 * size[0] + size[0] // 2])
    assert np.ptp(across.ravel()[own]) < film.side > np.ptp(down.ravel()[own])
    table = Aim.of(film, wanted)
    counts = np.bincount(np.array(table.slots), minlength=len(areas))
    density = np.array(table.density, np.float64)
    even = areas / areas.sum()
    assert counts.sum() == AIM_SLOTS
    assert counts.min() > 0
    assert np.allclose(density * even, counts / AIM_SLOTS, rtol=1e-5)
    assert (density > 0.85 * AIM_UNIFORM).all()
    assert np.abs(density * even - AIM_UNIFORM * even - (1 - AIM_UNIFORM) * wanted / wanted.sum()).sum() < 0.3
    nothing = np.array(Aim.of(film, 0 * wanted).density)
    assert nothing.min() > 0.4
    assert nothing.max() < 2.5


@pytest.mark.usefixtures("everywhere")
def test_paths_are_aimed_at_recorded_contributions() -> None:
    _, ours, _ = guided("roughplastic", 2)
    tables = ours.preparation.guiding
    said = np.sqrt(tables.learned[0].film)
    assert said.shape == (2, tables.films[0].count)
    for purpose, row in ((Purpose.GRADIENT, said[0]), (Purpose.IMAGE, said[1])):
        density = np.array(tables.table(0, purpose).aim.density, np.float64)
        assert np.corrcoef(density, row)[0, 1] > 0.99


@pytest.mark.usefixtures("everywhere")
@pytest.mark.parametrize("purpose", Purpose)
def test_paths_of_a_gradient_are_aimed_at_its_dl_di(purpose: Purpose) -> None:
    import mitsuba as mi

    _, ours, _ = guided("roughplastic", 2)
    tables = ours.preparation.guiding
    film = tables.films[0]
    delta = np.random.default_rng(5).normal(0, 1e-6, (film.height, film.width, 3)).astype(np.float32)
    delta[3, 2] = 1.0  # one pixel of an image was far too bright
    known = np.array(tables.table(0, purpose, mi.TensorXf(delta)).aim.density, np.float64)
    before = np.array(tables.table(0, purpose).aim.density, np.float64)
    expected = (1 - purpose.value * NOW * (1 - AIM_UNIFORM)) * before
    expected[3 * film.width + 2] += purpose.value * NOW * (1 - AIM_UNIFORM) * film.count
    # The even share of the density is unchanged. A share of the rest goes to the bright pixel.
    assert np.isclose(known[3 * film.width + 2], expected[3 * film.width + 2], rtol=0.05)
    assert known.min() > 0.85 * AIM_UNIFORM


@pytest.mark.usefixtures("everywhere")
@pytest.mark.parametrize("size", [(9, 7), (1000, 30)])
def test_means_of_blocks(size: tuple[int, int]) -> None:
    import mitsuba as mi

    film = Blocks.of(size)
    image = np.random.default_rng(3).normal(size=(size[1], size[0], 3)).astype(np.float32)
    across, down = np.meshgrid(*(np.arange(n, dtype=np.float32) + np.float32(0.5) for n in size))
    blocks = np.array(film.block(mi.Point2f(across.ravel(), down.ravel())))
    sums = np.bincount(blocks, np.square(image, dtype=np.float64).sum(2).ravel(), film.count)
    means = film.areas() * np.sqrt(sums / film.areas())
    for scale in (1.0, 1e-30, 1e30):
        found = film.root_means(mi.TensorXf(image * np.float32(scale)))
        assert np.allclose(found, means / np.abs(image).max(), rtol=1e-5)
    image[2, 3, 1] = np.nan
    image[4, 5] = -np.inf
    assert (np.isfinite(film.root_means(mi.TensorXf(image)))).all()
    assert (film.root_means(mi.TensorXf(0 * np.ones_like(image))) == 0).all()


@pytest.mark.usefixtures("everywhere")
def test_only_scenes_with_glossy_surfaces_use_aiming(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(context, "worthwhile", aim.worthwhile)
    for name, expected in (("roughplastic", True), ("texture", False), ("thin_lens", False), ("bumpmap", False)):
        scene, ours, _ = guided(name, 1)
        assert ours.preparation.plan(scene.scene, scene.scene.sensors()[0], scene.params).aimed is expected
        assert (ours.preparation.guiding.table(0, Purpose.BOTH).aim is not None) is expected


# Guided emission with moving light: the random numbers of the emission are held, so that its weight is a constant.

MOVING = {case.name: case for case in (*attached_cases.CASES, *moving_lamps.CASES)}


@pytest.mark.parametrize("name", a_few(["latents", "spot", "mesh", "bounces_4"], ["spot"]))
def test_means_of_moving_scenes_equal_those_of_unguided_samples(name: str) -> None:
    means_of_motion_hold(name, "stack")


@pytest.mark.long
@pytest.mark.parametrize("name", ["latents", "mesh", "bounces_4"])
def test_means_by_reservoir_equal_those_of_unguided_samples(name: str) -> None:
    means_of_motion_hold(name, "reservoir")


@pytest.mark.parametrize("name", a_few(["latents", "mesh", "bounces_4"], ["bounces_4"]))
@pytest.mark.parametrize("estimator", a_few(["stack", "reservoir"], ["stack"]))
def test_means_hold_with_learned_roulette(name: str, estimator: str) -> None:
    means_of_motion_hold(name, estimator, harsh=True)


def means_of_motion_hold(name: str, estimator: str, harsh: bool = False) -> None:
    moving = MOVING[name].moving()
    found = {}
    for block, guided_by in enumerate(("on", "off")):
        ours = make_integrator("reslrb", max_depth=5, rr_depth=1000, estimator=estimator, guiding=guided_by)
        if guided_by == "on":
            learn(moving, ours)
            if harsh:
                by_harsh_table(ours.preparation.guiding)
        rows = [moving.gradient(ours, seed, 16) for seed in seeds_guiding_moving(32, block)]
        found[guided_by] = np.stack([np.concatenate(list(row.values())) for row in rows])
    result = compare(found["on"], found["off"], block=None)
    print(name, estimator, result)
    assert np.abs(found["on"]).max() > 0
    assert result


def learn(moving: Any, ours: Any) -> None:
    """Run four steps from which the tables learn, and then stop the learning."""
    for seed in range(4):
        moving.gradient(ours, 9000 + seed, 16)
    guiding = ours.preparation.guiding
    assert [learned.calls for learned in guiding.learned.values()] == [4]
    guiding.due = lambda number: False
