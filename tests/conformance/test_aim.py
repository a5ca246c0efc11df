"""Scattering that is aimed at points that the sensor sees: its tables, and the scenes that use it."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from conformance.drawing import aim_everywhere, guided

from reslrb_cli.guiding.tables import NOW, Purpose
from reslrb_cli.integrators import context
from reslrb_cli.transport import aim
from reslrb_cli.transport.aim import AIM_SLOTS, AIM_UNIFORM, BLOCKS, Aim, Blocks

pytestmark = pytest.mark.usefixtures("llvm")


# test_drawing.py compares means of whole steps.


@pytest.fixture(autouse=True)
def _everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Aiming also in scenes without glossy surfaces."""
    aim_everywhere(monkeypatch)


@pytest.mark.parametrize("size", [(1, 1), (9, 7), (160, 90), (1000, 3), (1920, 1080)])
def test_blocks_partition_the_film_with_the_densities_of_their_slots(size: tuple[int, int]) -> None:
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


def test_paths_are_aimed_at_recorded_contributions() -> None:
    _, ours, _ = guided("roughplastic", 2)
    tables = ours.preparation.guiding
    film = np.sqrt(tables.learned[0].film)
    assert film.shape == (2, tables.films[0].count)
    for purpose, row in ((Purpose.GRADIENT, film[0]), (Purpose.IMAGE, film[1])):
        density = np.array(tables.table(0, purpose).aim.density, np.float64)
        assert np.corrcoef(density, row)[0, 1] > 0.99


@pytest.mark.parametrize("purpose", Purpose)
def test_paths_of_a_gradient_are_aimed_at_its_dl_di(purpose: Purpose) -> None:
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


@pytest.mark.parametrize("size", [(9, 7), (1000, 30)])
def test_means_of_blocks(size: tuple[int, int]) -> None:
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


def test_only_scenes_with_glossy_surfaces_use_aiming(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(context, "worthwhile", aim.worthwhile)
    for name, expected in (("roughplastic", True), ("texture", False), ("thin_lens", False), ("bumpmap", False)):
        scene, ours, _ = guided(name, 1)
        assert ours.preparation.plan(scene.scene, scene.scene.sensors()[0], scene.params).aimed is expected
        assert (ours.preparation.guiding.table(0, Purpose.BOTH).aim is not None) is expected
