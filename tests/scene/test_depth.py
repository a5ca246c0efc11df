"""How deep paths have to be: in a closed sphere that glows, whose light of every depth is known."""

from __future__ import annotations

import mitsuba as mi
import pytest

from reslrb_cli.scene.visibility import DEPTHS, LOST, find_depth

pytestmark = pytest.mark.usefixtures("llvm")


def inside(albedo: float) -> mi.Scene:
    """A camera in a sphere of that albedo that emits 1: paths of at most d segments show the sum of albedo^k, k < d."""
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 60, "film": {"type": "hdrfilm", "width": 8, "height": 8}},
            "sphere": {
                "type": "sphere",
                "flip_normals": True,
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 1.0}},
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}},
            },
        }
    )


@pytest.mark.parametrize(("albedo", "segments"), [(0.5, 8), (0.7, 16), (0.85, 32), (0.97, 64)])
def test_what_is_missing_is_what_longer_paths_would_add(albedo: float, segments: int) -> None:
    found = find_depth(inside(albedo), 0)
    assert found.segments == segments
    if segments == DEPTHS[-1]:
        assert found.missing is None
        return
    exact = (albedo**segments - albedo ** DEPTHS[-1]) / (1 - albedo ** DEPTHS[-1])
    assert found.missing == pytest.approx(exact, rel=0.1)
    assert albedo**segments < LOST < albedo ** (segments // 2)
