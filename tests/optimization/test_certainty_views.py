"""How certain values are beside an exposure and under a mask: what a mask takes away is missed, and named."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from optimization.judged import WALL, Toy, run, write_scene

EXPOSURE = "exposure"
COLOR = {WALL: "initial: 0.5, bounds: [0, 1]"}
SETTINGS = ("run.spp=64", "target.exposure=auto")
#: What it takes to tell them apart by what little is known in view.
ENOUGH = ("run.spp=512", "run.iterations=200", "optimizer.schedule=cosine", "target.exposure=auto")
SUBPIXELS = 4


def write_mask(folder: Path) -> None:
    """Leave out every pixel that sees anything but the wall."""
    scene = mi.load_file(str(folder / "scene.xml"), optimize=False)
    sensor, (width, height) = scene.sensors()[0], scene.sensors()[0].film().size()
    x, y = np.meshgrid(*(np.arange(SUBPIXELS * size) + 0.5 for size in (width, height)))
    position = mi.Point2f(x.ravel() / (SUBPIXELS * width), y.ravel() / (SUBPIXELS * height))
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    back = next(shape for shape in scene.shapes() if shape.id() == "back")
    hit = np.array(scene.ray_intersect(ray).shape == mi.ShapePtr(back)).reshape(height, SUBPIXELS, width, SUBPIXELS)
    weights = hit.all(axis=(1, 3)).astype(np.float32)
    assert 20 < weights.sum() < 0.9 * weights.size
    mi.Bitmap(weights[:, :, None]).write(str(folder / "mask.exr"))


@pytest.fixture(scope="module")
def folder(llvm: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("views")
    write_scene(path)
    write_mask(path)
    return path


@pytest.mark.long
def test_a_known_poster_in_view_tells_exposure_from_colour(folder: Path) -> None:
    found = run(folder, Toy("seen", COLOR, {}, ENOUGH))
    verdicts = {key: about.verdict for key, about in found.certainty.parameters.items()}
    assert verdicts == {WALL: "settled", EXPOSURE: "settled"}, found.certainty
    for key, about in found.certainty.parameters.items():
        spread = np.array(about.spread, dtype=float)
        assert np.all(np.abs(np.ravel(found.errors[key])) < 4 * spread), key


def test_where_a_mask_leaves_out_what_is_known_one_makes_up_for_the_other(folder: Path) -> None:
    found = run(folder, Toy("masked", COLOR, {}, (*SETTINGS, "target.mask=mask.exr")))
    wall, exposure = (found.certainty.parameters[key] for key in (WALL, EXPOSURE))
    assert wall.verdict == exposure.verdict == "not determined", found.certainty
    assert (wall.partner, exposure.partner) == (EXPOSURE, WALL)
