"""Scenes in which parameters move light, so made that finite differences hold.

- `GLASS_SCENES`: light through glass onto a receiver: what bends it is displaced, tilted and moved.
- `MIRRORS_SCENES`: light by way of mirrors onto a receiver: what reflects it is displaced, and rough.
- `PLACES_SCENES`: lamps and receivers that move.
- `ROOMS_SCENES`: rooms: light through glass onto a floor, and from there onto walls that alone are seen: what follows a
  diffuse bounce. On the wall there are edges at rest, over which a direction that turns with the floor, from a point
  that moves on it, sweeps.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from measure.differenced import SIZE, AttachedScene
from numpy.typing import NDArray

from reslrb_cli.measure.scenes.moving import (
    FILTER,
    Displacement,
    Move,
    Number,
    Pose,
    grid,
    mesh,
    smooth_fields,
    vertices,
    waves,
)
from reslrb_cli.measure.scenes.small import (
    bitmap,
    diffuse,
    glass,
    lit_square,
    look_at,
    pinhole,
    rectangle,
    rgb,
    transform,
)

Array = NDArray[np.float64]
GLASS = glass()
ROUGH = {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.1}


def setting(size: int = SIZE, **objects: Any) -> dict:
    """A receiver at y = 0, and a camera at y = 1 that sees the part within 1 of the axis; the rest are `objects`."""
    seen = pinhole([0, 1, 0], [0, 0, 0], [0, 0, -1], 90, size, rfilter=FILTER)
    floor = rectangle(diffuse(0.8, 0.7, 0.6), rotate=([1, 0, 0], -90), scale=50)
    return {"type": "scene", "camera": seen, "floor": floor} | objects


def spot(origin: tuple = (0.05, 3.2, -0.04), target: tuple = (0, 0, 0), cutoff: float = 14) -> dict:
    """A lamp whose light ends smoothly."""
    return {"type": "spot", "intensity": rgb(9, 8, 7), "cutoff_angle": cutoff, "beam_width": cutoff / 3,
            "to_world": look_at(origin, target)}  # fmt: skip


def sheet(y: float, up: bool, bsdf: dict, tilt: float = 0, scale: float = 3) -> dict:
    """A flat surface; light that comes through it from the side that it faces enters the glass."""
    turn = (-90 if up else 90) + tilt
    return rectangle(bsdf, translate=[0, y, 0], rotate=([1, 0, 0], turn), scale=scale)


def slab(bsdf: dict = GLASS, cells: int = 64, half: float = 1.0, wide: float = 0, lamp: Any = None, y: float = 1.8,
         **objects: Any) -> dict:  # fmt: skip
    """A slab whose upper surface, at `y`, has waves, under a lamp."""
    positions, faces, uv = grid(cells, lambda x, z: y + waves(x, z), half, wide)
    return setting(
        lamp=spot() if lamp is None else lamp,
        top=mesh(positions, faces, bsdf, uv),
        bottom=sheet(y - 0.2, False, bsdf, scale=max(3, half)),
        **objects,
    )


def rough_surface() -> dict:
    """Rough glass with waves, and the receiver inside of it."""
    scene = slab(ROUGH)
    del scene["bottom"]
    return scene


def waving(scene: Any, name: str = "top", height: float = 1.8, count: int = 10) -> list[Move]:
    """The waves of a sheet by their size, and smooth displacements."""
    positions = vertices(scene, name)
    amplitude = np.zeros_like(positions)
    amplitude[:, 1] = (positions[:, 1] - height) * 3
    return [Displacement(f"{name}.vertex_positions", np.stack([amplitude, *smooth_fields(positions, count, 1.0)]))]


def moving_sphere(name: str, pivot: tuple[float, float, float]) -> list[Move]:
    return [Pose(f"{name}.to_world", ("tx", "ty", "tz", "s"), pivot)]


def beam(half: float = 0.3) -> dict:
    """Parallel light from a square, at thirty degrees."""
    aim = look_at([0.9, 3.2, -0.04], [0.05, 1.8, 0])
    return lit_square(rgb(9, 8, 7), aim @ transform(scale=half), "directionalarea")


def square_lamp(half: float = 0.25, y: float = 3.2) -> dict:
    """An area light that shines down."""
    return lit_square(rgb(9, 8, 7), translate=[0.05, y, -0.04], rotate=([1, 0, 0], 90), scale=half)


def sphere_lens(radius: float = 0.8, y: float = 1.95, cutoff: float = 18, bsdf: dict = GLASS) -> dict:
    """A ball of glass in a cone of light that it contains."""
    return setting(lamp=spot(cutoff=cutoff, origin=(0.1, 3.6, -0.08), target=(0.05, y, 0)),
                   lens={"type": "sphere", "center": [0, y, 0], "radius": radius, "bsdf": bsdf})  # fmt: skip


def ball(radius: float, center: tuple[float, float, float], levels: int = 4, inward: bool = False
         ) -> tuple[Array, Array]:  # fmt: skip
    """A sphere of 20 * 4^levels triangles that faces outward, or `inward`: vertices and triangles."""
    golden = (1 + 5**0.5) / 2
    corners = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)]
    points = np.array([np.roll(corner, turn) for turn in range(3) for corner in corners], float)
    points /= np.linalg.norm(points[0])
    near = np.linalg.norm(points[:, None] - points[None], axis=-1) < 1.1
    faces = np.array([(a, b, c) for a in range(12) for b in range(a) for c in range(b)
                      if near[a, b] and near[b, c] and near[a, c]])  # fmt: skip
    for _ in range(levels):
        points, faces = _divided(points, faces)
    p, q, r = (points[faces[:, k]] for k in range(3))
    outward = np.sum(np.cross(q - p, r - p) * p, 1) > 0
    faces = np.where((outward != inward)[:, None], faces, faces[:, ::-1])
    return points * radius + np.array(center), faces


def _divided(points: Array, faces: Array) -> tuple[Array, Array]:
    """Each triangle divided into four, all vertices on the unit sphere."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    unique, number = np.unique(edges, axis=0, return_inverse=True)
    middles = points[unique].sum(1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    ab, bc, ca = np.split(number.ravel() + len(points), 3)
    a, b, c = faces.T
    divided = [np.stack(corners, 1) for corners in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
    return np.concatenate([points, middles]), np.concatenate(divided)


def mesh_lens(radius: float = 0.8, y: float = 1.95) -> dict:
    """The same as a mesh."""
    return setting(lamp=spot(cutoff=18, origin=(0.1, 3.6, -0.08), target=(0.05, y, 0)),
                   lens=mesh(*ball(radius, (0, y, 0), 5), GLASS))  # fmt: skip


def bent(scene: Any, name: str = "lens", count: int = 10, span: float = 0.8) -> list[Move]:
    """A mesh by its size along x, about its middle, and smooth displacements."""
    positions = vertices(scene, name)
    wider = np.zeros_like(positions)
    wider[:, 0] = positions[:, 0] - positions[:, 0].mean()
    return [Displacement(f"{name}.vertex_positions", np.stack([wider, *smooth_fields(positions, count, span)]))]


def prism() -> dict:
    """A slab whose flat upper surface is tilted."""
    return setting(lamp=spot(), top=sheet(1.9, True, GLASS, tilt=12), bottom=sheet(1.6, False, GLASS))


def two_lenses() -> dict:
    """A slab with waves over a ball: four surfaces of glass in a row."""
    scene = slab(lamp=spot(cutoff=7, origin=(0.03, 4.4, -0.02)), y=2.8)
    return scene | {"lens": {"type": "sphere", "center": [0, 1.55, 0], "radius": 0.5, "bsdf": GLASS}}


def smooth_texture() -> dict:
    """A receiver whose colours change without a step."""
    at = np.linspace(0, 2 * np.pi, 65)
    x, y = np.meshgrid(at, at)
    texels = np.stack([0.5 + 0.3 * np.sin(3 * x), 0.5 + 0.3 * np.cos(2 * x + y), 0.5 + 0.3 * np.sin(4 * y)], -1)
    floor = setting()["floor"]
    floor["to_world"] = transform(rotate=([1, 0, 0], -90), scale=3)
    return floor | {"bsdf": {"type": "diffuse", "reflectance": bitmap(texels, "bilinear")}}


GLASS_SCENES = [
    AttachedScene("slab", "a glass slab with waves under a spot light", slab, waving, spp=256),
    AttachedScene("slab_beam", "the same under parallel light with a hard edge", lambda: slab(lamp=beam()), waving,
                  step=0.005),
    AttachedScene("slab_area", "the same, wide and under an area light",
                  lambda: slab(lamp=square_lamp(0.2, 2.3), half=40, wide=6, cells=160), waving, spp=512, seeds=16),
    AttachedScene("slab_depth_6", "the same with what is reflected inside of it twice", slab, waving,
                  options={"max_depth": 6}, step=0.0025, spp=512, seeds=16),
    AttachedScene("slab_texture", "the same over a smooth texture", lambda: slab(floor=smooth_texture()), waving,
                  spp=256),
    AttachedScene("sphere_lens", "a ball of glass, moved and scaled", sphere_lens,
                  lambda scene: moving_sphere("lens", (0, 1.95, 0)), spp=512),
    AttachedScene("mesh_lens", "a ball of glass, a mesh that is bent", mesh_lens, bent,
                  step=0.005, spp=512, seeds=24),
    AttachedScene("prism", "a tilted flat surface, turned and moved", prism,
                  lambda scene: [Pose("top.to_world", ("rx", "rz", "ty"), (0, 1.9, 0))], spp=512, seeds=16),
    AttachedScene("two_lenses", "a slab with waves over a ball", two_lenses,
                  lambda scene: [*waving(scene, height=2.8), *moving_sphere("lens", (0, 1.55, 0))],
                  options={"max_depth": 6}, spp=512, seeds=24),
    AttachedScene("rough_surface", "rough glass with waves, the receiver inside", rough_surface, waving,
                  spp=512, seeds=32, options={"max_depth": 3}),
    AttachedScene("rough_surface_alpha", "the roughness of rough glass", rough_surface,
                  lambda scene: [Number("top.bsdf.alpha.value")], step=0.03, spp=512, seeds=32,
                  options={"max_depth": 3, "attached": True}),
    AttachedScene("rough_surface_eta", "the index of rough glass", rough_surface,
                  lambda scene: [Number("top.bsdf.eta")], step=0.1, spp=1024, seeds=96,
                  options={"max_depth": 3, "attached": True}),
]  # fmt: skip

MIRROR = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.9, 0.8, 0.7)}

#: Its samples do not depend on the incident direction: those of visible normals have derivatives of heavy tails.
BRUSHED = {"type": "roughconductor", "material": "none", "alpha": 0.1, "sample_visible": False}


def ceiling(bsdf: dict = MIRROR) -> dict:
    """A mirror with waves that faces down, lit from below."""
    positions, faces, uv = grid(64, lambda x, z: 1.9 + waves(x, z))
    return setting(lamp=spot(origin=(0.03, 0.6, -0.02), target=(0, 1.9, 0)),
                   mirror=mesh(positions, faces[:, ::-1], bsdf, uv))  # fmt: skip


def convex(bsdf: dict = MIRROR) -> dict:
    """A mirror that is a ball, lit from below by a cone that it contains."""
    return setting(lamp=spot(origin=(0.03, 0.6, -0.02), target=(0, 2, 0), cutoff=9),
                   mirror={"type": "sphere", "center": [0, 2.1, 0], "radius": 0.6, "bsdf": bsdf})  # fmt: skip


MIRRORS_SCENES = [
    AttachedScene("mirror", "a mirror with waves", ceiling, lambda scene: waving(scene, "mirror", 1.9), step=0.002),
    AttachedScene("mirror_ball", "a mirror that is a ball, moved and scaled", convex,
                  lambda scene: [Pose("mirror.to_world", ("tx", "ty", "tz", "s"), (0, 2.1, 0))], spp=128),
    AttachedScene("rough_mirror", "a rough metal with waves", lambda: ceiling(BRUSHED),
                  lambda scene: waving(scene, "mirror", 1.9), step=0.003, options={"max_depth": 3}),
    AttachedScene("rough_mirror_alpha", "the roughness of a metal",
                  lambda: ceiling(BRUSHED | {"sample_visible": True}),
                  lambda scene: [Number("mirror.bsdf.alpha.value")], spp=256,
                  options={"max_depth": 3, "attached": True}),
]  # fmt: skip

AIM = ("tx", "ty", "tz", "rx", "rz")


def point(position: tuple = (0.1, 1.5, 0.2)) -> dict:
    return {"type": "point", "position": list(position), "intensity": rgb(3, 2, 4)}


def bulb(radius: float = 0.3) -> dict:
    """A ball that glows."""
    return {"type": "sphere", "center": [0.1, 2.2, 0.2], "radius": radius, "bsdf": diffuse(0, 0, 0),
            "emitter": {"type": "area", "radiance": rgb(3, 2, 4)}}  # fmt: skip


def hills() -> dict:
    """A receiver that is bent a little, under a point light."""
    positions, faces, uv = grid(128, lambda x, z: 0.05 * np.sin(2 * x + 1) * np.cos(3 * z), 4, 1.5)
    return setting(floor=mesh(positions, faces, diffuse(0.8, 0.7, 0.6), uv), lamp=point())


def rolling(scene: Any, name: str = "floor", y: float = 0) -> list[Move]:
    """A sheet by smooth displacements that end beyond the film, and before the sheet does."""
    positions = vertices(scene, name)
    about = positions - [0, y, 0]
    near = np.exp(-np.square(about / 1.5).sum(1))[:, None]
    hills = about * [0, 4, 0]
    return [Displacement(f"{name}.vertex_positions", np.stack([hills, *smooth_fields(positions, 10, 1.5)]) * near)]


PLACES_SCENES = [
    AttachedScene("moved_point", "a point light over a plane", lambda: setting(lamp=point()),
                  lambda scene: [Pose("lamp.position", ("ty", "tx", "tz"))], options={"max_depth": 2}),
    AttachedScene("moved_spot", "a spot light over glass with waves, moved and turned", slab,
                  lambda scene: [Pose("lamp.to_world", AIM, (0.05, 3.2, -0.04))], spp=512),
    AttachedScene("moved_area", "an area light over a plane, moved, turned and scaled",
                  lambda: setting(lamp=square_lamp(0.4, 2.2)),
                  lambda scene: [Pose("lamp.to_world", (*AIM, "s"), (0.05, 2.2, -0.04))],
                  options={"max_depth": 2}, spp=128),
    AttachedScene("moved_bulb", "a ball that glows over a plane, moved and scaled", lambda: setting(lamp=bulb()),
                  lambda scene: [Pose("lamp.to_world", ("ty", "tx", "tz", "s"), (0.1, 2.2, 0.2))],
                  options={"max_depth": 2}),
    AttachedScene("moved_receiver", "a plane under a point light, moved and tilted", lambda: setting(lamp=point()),
                  lambda scene: [Pose("floor.to_world", ("ty", "rx", "rz"))], options={"max_depth": 2}),
    AttachedScene("bent_receiver", "a plane under a point light that is bent", hills, rolling,
                  options={"max_depth": 2}, spp=256),
]  # fmt: skip


def wall(bsdf: dict[str, Any], turn: float = -90, x: float = 1.0) -> dict[str, Any]:
    """A wall at `x`, which faces back to the axis; `turn` is its angle about the vertical."""
    return rectangle(bsdf, translate=[x, 1, 0], rotate=([0, 1, 0], turn), scale=3)


def room(**changes: Any) -> dict[str, Any]:
    """A slab with waves over the floor of a room, and a camera over the caustic that looks at what is at x = 1.

    `changes` are objects beside these, or in place of them.
    """
    seen = pinhole([-0.6, 0.8, 0], [1, 0.8, 0], [0, 1, 0], 40, SIZE, rfilter=FILTER)
    return slab(lamp=spot(cutoff=8), camera=seen) | changes


def steps() -> dict[str, Any]:
    """A texture of 24 stripes and blocks, light and dark."""
    texels = np.random.default_rng(2).choice([0.1, 0.9], (24, 24, 1)) * np.ones(3)
    return {"type": "diffuse", "reflectance": bitmap(texels, "nearest")}


def corner() -> dict[str, Any]:
    """Two walls that meet in the middle of the view, one light and one dark."""
    return room(light=wall(diffuse(0.9, 0.9, 0.9), -50), dark=wall(diffuse(0.15, 0.15, 0.15), -130))


def shelf() -> dict[str, Any]:
    """A panel that faces the wall and fills the view: each path to it has two diffuse vertices and one connection.

    It hangs above the floor: light passes below it to the wall, and comes back. Its shadow's edge is missing.
    """
    seen = pinhole([0.95, 0.8, 0], [0, 0.8, 0], [0, 1, 0], 50, SIZE, rfilter=FILTER)
    panel = rectangle(diffuse(0.7, 0.8, 0.9), translate=[0.45, 0.8, 0], rotate=([0, 1, 0], 90), scale=0.3)
    return slab(lamp=spot(cutoff=8), camera=seen, wall=wall(diffuse(0.8, 0.7, 0.6)), panel=panel)


def moved(scene: Any) -> list[Move]:
    """The waves of the slab by their size, and a few smooth displacements."""
    return waving(scene, count=2)


#: A path from the lamp through both surfaces of the slab to the floor, a wall, and the camera.
OPTIONS = {"max_depth": 5}

ROOMS_SCENES = [
    AttachedScene("bounce", "a slab that lights a wall by way of the floor",
                  lambda: room(wall=wall(diffuse(0.8, 0.7, 0.6))), moved, spp=512, seeds=32, options=OPTIONS),
    AttachedScene("bounce_steps", "the same onto a texture with steps", lambda: room(wall=wall(steps())), moved,
                  spp=512, seeds=32, options=OPTIONS),
    AttachedScene("bounce_corner", "the same into a corner of two walls", corner, moved,
                  spp=512, seeds=32, options=OPTIONS),
]  # fmt: skip

SCENES: dict[str, AttachedScene] = {
    scene.name: scene for scene in (*GLASS_SCENES, *MIRRORS_SCENES, *PLACES_SCENES, *ROOMS_SCENES)
}
