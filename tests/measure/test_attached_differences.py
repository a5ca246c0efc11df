"""Derivatives of what moves light against finite differences: a few scenes by default, all with `-m long`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np
import pytest
from measure.differenced import Differenced, compare_with_differences
from measure.moving_light import ROOMS_SCENES as ROOMS
from measure.moving_light import SCENES

from reslrb_cli.measure.scenes.moving import Displacement, Move, smooth_fields, vertices
from reslrb_cli.transport import bsdf, connection
from reslrb_cli.transport.walk import Segment

#: Of the root mean square of the derivatives.
ERROR, STANDARD_ERROR = 5e-3, 1e-3


@pytest.fixture(autouse=True)
def _quiet(llvm: str) -> None:
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)


def test_enough():
    assert len(SCENES) >= 16


#: Rooms in which light bounces are too noisy for that; `test_attached_sampling.py` has them.
STEADY = [name for name in SCENES if name not in {room.name for room in ROOMS}]


@pytest.mark.long
@pytest.mark.parametrize("name", STEADY)
def test_every_scene(name: str):
    found = compare_with_differences(SCENES[name])
    print(name, found)
    assert found.error < ERROR, found
    assert found.standard_error < STANDARD_ERROR, found


def beam(only: tuple[float, float, float], seeds: int = 2) -> Differenced:
    """A slab in parallel light, of which some coordinates move, by a few directions."""

    def moves(scene: Any) -> list[Move]:
        return [Displacement("top.vertex_positions", smooth_fields(vertices(scene, "top"), 3, 1.0) * np.array(only))]

    return compare_with_differences(replace(SCENES["slab_beam"], moves=moves), count=seeds)


def test_a_slab_whose_surface_bends():
    found = beam((0, 1, 0), 4)
    assert found.error < ERROR, found
    assert found.standard_error < STANDARD_ERROR, found


def test_a_receiver_that_moves():
    found = compare_with_differences(replace(SCENES["moved_receiver"], spp=16), count=3)
    assert found.error < ERROR, found
    assert found.standard_error < STANDARD_ERROR, found


def test_slopes_of_the_shading_correction_without_its_jumps(monkeypatch: pytest.MonkeyPatch):
    """Faces that slide through the light: within each the correction has a slope, at their edges it jumps back."""
    right = bsdf.shading_correction

    def tracked(plan: Any, *rest: Any) -> Any:
        return right(replace(plan, attached_normalization=False), *rest)

    slides = (1, 0, 1)
    assert beam(slides).error < ERROR
    for module in (bsdf, connection):
        monkeypatch.setattr(module, "shading_correction", tracked)
    assert beam(slides).error > 2 * ERROR


def test_a_ray_that_does_not_follow_its_surface(monkeypatch: pytest.MonkeyPatch):
    right = Segment.next_ray
    monkeypatch.setattr(Segment, "next_ray", lambda self, attached=False: dr.detach(right(self, attached)))
    assert beam((0, 1, 0)).error > 10 * ERROR
