"""Attached derivatives where something is at its edge: light that is reflected whole, that grazes, that meets nothing
or black, glass that is none, meshes that are flat and begin to bend."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from conformance.moving import WHITE, Moving, Place, beam, camera, enclosed, flat, sheet, under_glass

from reslrb_cli.measure.gradients import integrator, relative
from reslrb_cli.measure.scenes.small import bitmap, diffuse, rgb, transform

pytestmark = pytest.mark.usefixtures("llvm")

#: What is left of derivatives that cancel; those of rippled glass are a million times as large.
NOTHING = 1e-4
SLAB = {"slab.vertex_positions": None}


@dataclass(frozen=True)
class Edge:
    """As `Moving` takes it; with `dark` no light arrives, and every derivative is zero."""

    scene: Callable[[], dict[str, Any]]
    start: dict[str, Any] = field(default_factory=lambda: dict(SLAB))
    place: Place | None = None
    depth: int = 5
    dark: bool = False
    limit: float = 1e-4


def slanted(degrees: float) -> dict[str, Any]:
    """Parallel light that comes at this angle from the vertical."""
    angle = np.deg2rad(degrees)
    origin = [1.2 * float(np.sin(angle)), 2.0 + 1.2 * float(np.cos(angle)), 0.0]
    to_world = mi.ScalarTransform4f().look_at(origin, [0, 2, 0], [0, 0, 1]) @ mi.ScalarTransform4f().scale(0.3)
    return beam() | {"to_world": to_world}


def glass(index: float) -> dict[str, Any]:
    """Smooth glass."""
    return {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}


def lit_from_within(bsdf: dict[str, Any], intensity: float = 5.0) -> dict[str, Any]:
    """A point between the slab's two sides: most of its light is reflected whole."""
    light = {"type": "point", "position": [0.05, 2.1, 0], "intensity": rgb(*[intensity] * 3)}
    return enclosed(bsdf, lamp=light)


EDGES = {
    "total_internal_reflection": Edge(lambda: lit_from_within(glass(1.5)), depth=8, limit=5e-4),
    "index_3": Edge(lambda: lit_from_within(glass(3.0)), depth=8, limit=5e-4),
    "index_1": Edge(lambda: under_glass(glass(1.0))),
    "rough_index_1.001": Edge(lambda: enclosed({"type": "roughdielectric", "alpha": 0.1, "int_ior": 1.001}),
                              limit=5e-4),
    "grazing": Edge(lambda: enclosed(top=None, lamp=slanted(85)), limit=5e-4),
    "along_the_surface": Edge(lambda: enclosed(top=None, lamp=slanted(89.99)), limit=5e-3),
    "meets_nothing": Edge(lambda: under_glass(lamp=beam() | {"to_world": transform(translate=[0, 5, 0],
                                                             rotate=([1, 0, 0], -90))}), dark=True),
    "black_receiver": Edge(lambda: under_glass(receiver=flat(diffuse(0, 0, 0))), dark=True),
    "black_texel_before": Edge(lambda: enclosed(receiver=flat({"type": "diffuse", "reflectance": bitmap(
        np.array([[[0, 0.5, 0.3], [0.6, 0, 0]], [[0.4, 0.4, 0.4], [0, 0, 0]]]))}),
        other=flat(WHITE, -0.5)), SLAB | {"receiver.bsdf.reflectance.data": None}),
    "absorbing_glass": Edge(lambda: under_glass(glass(1.5) | {"specular_transmittance": rgb(0, 0.5, 1)})),
    "camera_at_the_origin": Edge(lambda: under_glass(receiver=flat(WHITE, -1), camera=camera() | {
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, -1, 0], [0, 0, -1])})),
    "flat_and_parallel": Edge(lambda: under_glass(slab=sheet("slab", glass(1.5), 2.0, ripples=0.0))),
    "a_rectangle_of_glass": Edge(lambda: under_glass(slab=flat(glass(1.5), 2.0)), {"y": 2.0},
                                     lambda params, latents: _lift(params, latents), limit=1e-3),
}  # fmt: skip


def _lift(params: mi.SceneParameters, latents: dict[str, Any]) -> None:
    up = mi.AffineTransform4f().translate(mi.Vector3f(0.3 * latents["y"], latents["y"], 0))
    params["slab.to_world"] = up @ mi.AffineTransform4f(transform(rotate=([1, 0, 0], -90)).matrix)


QUICK = ("meets_nothing",)


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.long) for n in EDGES])
def test_at_the_edge(name: str):
    edge = EDGES[name]
    moving = Moving(edge.scene(), edge.start, edge.place)
    options = {"hide_emitters": True}
    ours = moving.gradient(integrator("reslrb", edge.depth, estimator="stack", attached_sampling="follow", **options))
    naive = moving.gradient(integrator("walk_ad", edge.depth, attached=True, **options))
    for key, value in ours.items():
        assert np.isfinite(value).all(), key
        if edge.dark:
            assert not value.any()
        elif np.abs(naive[key]).max() > NOTHING:
            print(name, key, relative(value, naive[key]))
            assert relative(value, naive[key]) < edge.limit, key
        else:
            assert np.abs(value).max() < NOTHING
    assert edge.dark or any(value.any() for value in naive.values())


# ---- Meshes that bend after the plan was made ----


def bending(bsdf: dict[str, Any]) -> Moving:
    """A flat mesh that reflects parallel light from the side, and bends by `size` times the ripples."""
    flat_, rippled = (sheet("slab", bsdf, 2.0, ripples=ripples) for ripples in (0.0, 1.0))
    first, last = (np.array(mesh.vertex_positions_buffer()) for mesh in (flat_, rippled))

    def place(params: mi.SceneParameters, latents: dict[str, Any]) -> None:
        params["slab.vertex_positions"] = mi.Float(first) + mi.Float(last - first) * latents["size"]

    return Moving(enclosed(bsdf, slab=flat_, top=None, lamp=slanted(40)), {"size": 0.0}, place)


def test_a_flat_mesh_that_bends_has_its_shading_normals():
    """An image without parameters, of the same integrator, before and after: the plan is renewed."""
    moving = bending(glass(1.5))
    ours, options = integrator("reslrb", 5, hide_emitters=True), {"seed": 1, "spp": 32}
    sensor = moving.loaded.sensors()[0]
    assert not ours.plan(moving.loaded, sensor).needs.has_shading_normals
    moving.value(ours, **options)
    bent = moving.value(ours, size=3.0, **options)
    assert ours.plan(moving.loaded, sensor).needs.has_shading_normals
    other = integrator("reslrb", 5, hide_emitters=True)
    assert bent == pytest.approx(moving.value(other, size=3.0, **options), rel=1e-4)


@pytest.mark.long
@pytest.mark.parametrize("size", [0.0, 0.5])
def test_the_derivative_of_a_flat_mesh_knows_that_it_will_bend(size: float):
    moving = bending(glass(1.5))
    moving.start["size"] = np.float64(size)
    ours = moving.gradient(integrator("reslrb", 5, estimator="stack", filter_normalization="detached",
                                      attached_sampling="follow", hide_emitters=True))  # fmt: skip
    stock = moving.gradient(integrator("ptracer", 5, hide_emitters=True))
    assert relative(ours["size"], stock["size"]) < 1e-3
