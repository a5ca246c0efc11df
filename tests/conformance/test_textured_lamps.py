"""Textured lamps on shapes whose points share texture coordinates, as the faces of a `cube` do.

Mitsuba samples such lamps through their texture, and finds only one of the points. A texture of one colour must give
the image of this colour without a texture.
"""

from __future__ import annotations

import functools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from turns import a_few

from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.references import Situation, path_image, ptracer_image
from reslrb_cli.measure.scenes.small import bitmap, camera, diffuse, rgb, room, texture, transform
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.transport.lamps import beam_towards

pytestmark = pytest.mark.usefixtures("llvm")

TEXELS = "lamp.emitter.radiance.data"
PLACE = {"translate": [0.2, 0.1, 0.3], "rotate": ([1, 2, 3], 40), "scale": 0.35}


Corners = list[tuple[float, float]]


def sheets(first: Corners, second: Corners | None, emitter: str = "area", aside: float = 0) -> Any:
    """Return a mesh of two triangles, one above the other and `aside`. Corners have these texture coordinates."""
    uv = [] if second is None else [*first, *second]
    mesh = mi.Mesh("sheets", 6, 2, has_vertex_texcoords=bool(uv), props=_lamp(emitter, texture(2, 2, 0.2, 3)))
    params = mi.traverse(mesh)
    corners = np.array([[0, 0, 0], [0.8, 0, 0], [0, 0, 0.8]])
    params["vertex_positions"] = np.concatenate([corners, np.add(corners, [aside, 0.4, 0])]).ravel()
    params["faces"] = np.arange(6)
    if uv:
        params["vertex_texcoords"] = np.ravel(uv)
    params.update()
    return mesh


def _lamp(emitter: str, radiance: dict[str, Any]) -> Any:
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(diffuse(0, 0, 0))
    properties["mesh_emitter"] = mi.load_dict({"type": emitter, "radiance": radiance})
    return properties


LEFT, RIGHT = [(0.0, 0.0), (0.5, 0.0), (0.0, 1.0)], [(0.5, 0.0), (1.0, 0.0), (0.5, 1.0)]
HALF = [(0.2, 0.0), (0.7, 0.0), (0.2, 1.0)]
OUTSIDE = [(0.5, 0.0), (1.5, 0.0), (0.5, 1.0)]


@pytest.mark.parametrize(
    ("second", "shares"), [(RIGHT, False), (LEFT, True), (HALF, True), (OUTSIDE, True), (None, True)],
    ids=["apart", "equal", "overlapping", "outside", "none"],
)  # fmt: skip
def test_shared_coordinates_are_found(second: Any, shares: bool):
    scene = mi.load_dict(room(lamp=sheets(LEFT, second)), optimize=False)
    [lamp] = SceneGraph.of(scene).find_lamps(scene)
    assert lamp.shared == shares
    assert (lamp.texture is None) == shares


@pytest.mark.parametrize("kind", ["rectangle", "disk", "mesh", "flipped"])
def test_parallel_light_comes_from_the_point_that_a_ray_meets(kind: str):
    """The ray leaves a point against the direction of the light. Some points are beside or behind the lamp."""
    if kind == "mesh":
        shape = sheets(LEFT, RIGHT, "directionalarea", 0.9)
    else:
        emitter = {"type": "directionalarea", "radiance": texture(3, 5, 0.2, 3)}
        place = transform(translate=[0.2, 0.1, 0.3], rotate=([1, 2, 3], 40), scale=[0.3, 0.6, 0.4])
        name, flips = ("rectangle", True) if kind == "flipped" else (kind, False)
        shape = {"type": name, "to_world": place, "flip_normals": flips, "emitter": emitter}
    scene = mi.load_dict({"type": "scene", "lamp": shape}, optimize=False)
    [lamp] = SceneGraph.of(scene).find_lamps(scene)
    assert lamp.is_beam
    count = 1000
    numbers = mi.PCG32(count)
    there = lamp.shape.sample_position(0, mi.Point2f(numbers.next_float32(), numbers.next_float32()))
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    aside = mi.Vector3f(*(0.3 * numbers.next_float32() - 0.15 for _ in range(3)))
    si.p = there.p + there.n * (numbers.next_float32() - 0.2) + dr.cross(there.n, aside)
    met = scene.ray_intersect(mi.Ray3f(si.p, -there.n))
    expected = dr.select(met.is_valid(), lamp.radiance.eval(met), 0)
    dr.eval(si, met, expected)
    light, places = np.zeros((3, count)), np.zeros(count, dtype=bool)
    for number in (0.25, 0.75):  # selects the face of a mesh
        ds, weight = beam_towards(lamp, si, mi.Float(number), mi.Bool(True))
        light += 0.5 * np.array(weight)
        same = np.linalg.norm(np.array(ds.p) - np.array(met.p), axis=0) < 1e-5
        places |= (np.array(ds.pdf) > 0) & same & (abs(np.array(ds.dist) - np.array(met.t)) < 1e-5)
    inside = np.array(met.is_valid())
    assert 0.2 < inside.mean() < 0.9
    assert np.array_equal(places, inside)
    np.testing.assert_allclose(light, np.array(expected), atol=1e-5)


def lit(kind: str, radiance: dict[str, Any]) -> Case:
    """Return the room, lit by a lamp of this shape in view. On a rough metal floor near the lamp, rays that hit the
    lamp and samples of its points have similar densities, so that the weights of both count.
    """
    emitter = {"type": "area", "radiance": radiance}
    shape = {"type": kind, "to_world": transform(**PLACE), "bsdf": diffuse(0, 0, 0), "emitter": emitter}
    metal = {"type": "roughconductor", "alpha": 0.4}
    scene = room(camera=camera("gaussian"), floor=metal, lamp=shape)
    return Case(scene, (TEXELS,) if radiance["type"] == "bitmap" else ())


@functools.cache
def expected(kind: str) -> np.ndarray:
    case = lit(kind, rgb(1.5, 2, 1))
    return np.array([np.array(case.image(integrator("path", 3), seed, 256)) for seed in seeds(8, 1)])


CASES = [
    f"{kind}-{paths}" for kind in ("cube", "rectangle", "disk", "sphere", "cylinder")
    for paths in ("light", "camera", "both")
]  # fmt: skip


@pytest.mark.parametrize("name", a_few(CASES, ["cube-camera", "cube-both"]))
def test_a_texture_of_one_colour_is_that_colour(name: str):
    kind, paths = name.split("-")
    tracer = integrator("reslrb", 3, estimator="stack", paths=paths)
    case = lit(kind, bitmap(np.broadcast_to(np.array([1.5, 2, 1]), (2, 2, 3))))
    ours = np.array([np.array(case.image(tracer, seed, 128)) for seed in seeds(8)])
    inner = slice(3, -3)  # light paths lose the light of samples outside of the film
    result = compare(ours[:, inner, inner], expected(kind)[:, inner, inner])
    print(name, result)
    assert result


@pytest.mark.parametrize("name", a_few(CASES, ["cube-both"]))
def test_gradients_of_texels_give_the_image(name: str):
    """The image is a sum over the texels. The gradient times the texels is therefore the weighted image."""
    kind, paths = name.split("-")
    tracer = integrator("reslrb", 3, estimator="stack", paths=paths)
    case = lit(kind, texture(2, 2, 0.2, 3))
    found = case.gradient(tracer, 3, 64)
    assert (found > 0).all()
    assert found @ case.initial[TEXELS] == pytest.approx(case.weighted(case.image(tracer, 3, 64)), rel=0.05)


def test_stock_integrators_are_no_references_for_shared_coordinates():
    for kind, refused in (("cube", True), ("rectangle", False)):
        case = lit(kind, texture(2, 2))
        at = Situation.of(case.scene, case.scene.sensors()[0], case.params, 4, False)
        for reason in (path_image(at), ptracer_image(at)):
            assert (reason is not None and "same texture coordinates" in reason) == refused
