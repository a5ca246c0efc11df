"""Faces of lenses and mirrors, checked with rays from an independent tracer (`tracer.py`). Impossible faces are
refused.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from lens.pictures import Gradient, sharp, smooth
from lens.tracer import bent, caustic
from skimage.metrics import structural_similarity
from turns import a_few

from reslrb_cli.errors import ConfigError
from reslrb_cli.lens import transport
from reslrb_cli.lens.surface import Rays, Setting, shape_surface

LENS = Setting()
UP = np.array([0.0, 0.0, 1.0])
MIRROR = replace(LENS, kind="mirror", incidence=30.0)
SETTINGS = {
    "lens": LENS,
    "lens, point light": replace(LENS, light_distance=300.0, thickness=40.0),
    "lens, oblique light": replace(LENS, incidence=25.0),
    "lens, tilted receiver": replace(LENS, tilt=(20.0, 15.0)),
    "lens, round": replace(LENS, outline="round"),
    "lens, deep": replace(LENS, distance=80.0, picture_size=(80.0, 80.0), thickness=30.0),
    "lens, wide": replace(LENS, size=(100.0, 60.0), picture_size=(80.0, 80.0)),
    "mirror": MIRROR,
    "mirror, point light": replace(MIRROR, light_distance=500.0),
    "mirror, tilted receiver": replace(MIRROR, tilt=(-15.0, 20.0)),
}
FEW = {"lens, round"}


def test_a_picture_that_needs_no_floor_is_solved_once(monkeypatch: pytest.MonkeyPatch) -> None:
    trials: list[tuple[object, ...]] = []

    def least_floor(*arguments: object) -> float:
        trials.append(arguments)
        return 0.0

    monkeypatch.setattr(transport, "least_floor", least_floor)
    assert shape_surface(smooth(16), LENS, 16).floor == 0
    assert len(trials) == 1


@pytest.mark.parametrize("name", a_few(SETTINGS, FEW))
def test_light_through_the_face_forms_the_picture(name: str) -> None:
    cells = 96 if name == "lens, round" else 128
    picture = smooth(cells)
    made = shape_surface(picture, SETTINGS[name], cells, floor=0.05)
    seen, far = caustic(made, picture.shape), caustic(made, picture.shape, wider=3.0)
    seen, wanted, inside = seen / seen.mean(), picture / picture.mean(), seen.sum() / far.sum()
    assert structural_similarity(seen, wanted, data_range=wanted.max()) > 0.95
    assert np.abs(seen - wanted).mean() < 0.035
    assert inside > 0.99


def test_a_face_is_half_as_deep_at_twice_the_distance() -> None:
    near = shape_surface(smooth(64), LENS, 64, floor=0.05)
    far = shape_surface(smooth(64), replace(LENS, distance=400.0), 64, floor=0.05)
    assert far.relief == pytest.approx(near.relief / 2, rel=0.05)
    assert f"{near.relief:.3g} mm deep; nothing darker than 5 %" in near.summary()


def test_rays_of_a_point_light_thin_out_through_the_glass() -> None:
    distance, thickness, ior = 120.0, 30.0, 1.49
    rays = Rays(replace(LENS, light_distance=distance, thickness=thickness))
    r = np.linspace(0.01, 55.0, 20_001)  # radii where rays enter
    direction, enters = bent(
        np.stack([r, 0 * r, 0 * r + distance]) / np.hypot(r, distance), UP[:, None] + 0 * r, 1 / ior
    )
    _, leaves = bent(direction, UP[:, None] + 0 * r, ior)
    radius = r + thickness * direction[0] / direction[2]  # radii where rays meet the face
    solid_angle = distance / np.hypot(r, distance) ** 3 * r
    light = solid_angle / np.gradient(radius, r) / radius * enters * leaves
    at = radius < 50
    zero = np.zeros(int(at.sum()))
    found = rays.arriving(radius[at], zero, zero, zero, zero)
    np.testing.assert_allclose(found / found[0], light[at] / light[0], rtol=1e-4)


def test_a_face_tilted_towards_oblique_light_gets_more_light() -> None:
    rays, zero = Rays(MIRROR), np.zeros(())
    level = rays.arriving(zero, zero, zero, zero, zero)
    leaning = rays.arriving(zero, zero, zero, zero + 0.2, zero)
    assert leaning / level == pytest.approx(1 + 0.2 * np.tan(np.radians(30)))


@pytest.mark.parametrize(("kind", "ior", "factor"), [("lens", 1.49, 0.49), ("lens", 1.8, 0.8), ("mirror", 1.49, -2.0)])
def test_distant_heights_match_the_paraxial_formula(kind: Literal["lens", "mirror"], ior: float, factor: float) -> None:
    distance = 50_000.0
    setting = replace(LENS, kind=kind, ior=ior, distance=distance, incidence=0.2 if kind == "mirror" else 0.0)
    found = shape_surface(smooth(64), setting, 64, floor=0.05).heights
    x, y = transport.grid((64, 64), LENS.size)
    start = np.array([0, 0, 0, 0.5, 0, 0.5])
    even = Gradient(np.ones((2, 2)), LENS.size)
    phi = transport.solve(even, smooth(64)[::-1, ::-1], LENS.size, LENS.picture_size, (64, 64), start).h
    expected = (phi - (x * x + y * y) / 2) / (factor * distance)
    np.testing.assert_allclose(found - found.mean(), expected - expected.mean(), atol=0.01 * np.ptp(expected))


@pytest.mark.parametrize(
    ("changed", "key", "words"),
    [
        ({"ior": 1.0}, "ior", "glass and plastics"),
        ({"distance": 0.0}, "distance", "above 0"),
        ({"distance": np.nan}, "distance", "above 0"),
        ({"distance": 60.0, "picture_size": (300.0, 300.0)}, "distance", "by at most 48 degrees.*would do"),
        ({"thickness": 2.0}, "thickness", "thickness must be above .* or distance larger"),
        ({"kind": "mirror", "incidence": 30.0, "thickness": 0.01}, "thickness", "into the mirror; thickness must"),
        ({"incidence": 90.0}, "incidence", "between"),
        ({"tilt": (85.0, 0.0)}, "tilt", "between"),
        ({"kind": "mirror"}, "incidence", "blocks the mirror's light; 30 degrees suffice"),
        ({"size": (0.0, 1.0)}, "size", "above 0"),
    ],
)  # fmt: skip
def test_impossible_designs_are_refused(changed: dict[str, object], key: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as raised:
        shape_surface(smooth(32), replace(LENS, **changed), 32, floor=0.1)  # type: ignore[arg-type]
    assert raised.value.key == key


@pytest.mark.parametrize("picture", [np.ones((8, 8)), np.zeros((8, 8)), np.ones((1, 1)), np.full((8, 8), np.nan)])
def test_empty_pictures_are_refused(picture: np.ndarray) -> None:
    with pytest.raises(ConfigError) as raised:
        shape_surface(picture, LENS)
    assert raised.value.key == "picture"


def test_lines_that_are_too_fine_for_a_floor_end_before_the_last_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last grid takes most of the time, and would fail, too."""
    monkeypatch.setattr(transport, "least_floor", lambda *_: 0.01)
    stages: list[str] = []
    made = shape_surface(sharp(64), Setting(), 48, tell=stages.append)
    assert made.floor == transport.FOR_LINES
    assert made.heights.shape == (48, 48)
    assert stages.count("grid of 24x24") == 2
    assert stages.count("grid of 48x48") == 1
