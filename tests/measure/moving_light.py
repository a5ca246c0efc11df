"""Scenes in which parameters move light, built so that finite differences hold.

- `GLASS_SCENES`: light passes through glass to a receiver. The glass is displaced, tilted and moved.
- `MIRRORS_SCENES`: light reaches a receiver by mirrors. The mirrors are displaced or rough.
- `PLACES_SCENES`: lamps and receivers move.
- `ROOMS_SCENES`: light passes through glass to a floor, and from there to walls. Only the walls are seen. The scenes
    test the path after a diffuse bounce. The walls have edges at rest. A direction that turns with the floor, starting
    from a moving point on the floor, sweeps over these edges.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from measure.differenced import SIZE, attached
from numpy.typing import NDArray

from reslrb_cli.measure.scenes.case import SceneCase
from reslrb_cli.measure.scenes.moving import (
    FILTER,
    Move,
    displacement,
    grid,
    mesh,
    number,
    pose,
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
    """Return a scene with a receiver at y = 0 and a camera at y = 1. The camera sees the part within 1 of the axis. The
    other objects are `objects`.
    """
    seen = pinhole([0, 1, 0], [0, 0, 0], [0, 0, -1], 90, size, rfilter=FILTER)
    floor = rectangle(diffuse(0.8, 0.7, 0.6), rotate=([1, 0, 0], -90), scale=50)
    return {"type": "scene", "camera": seen, "floor": floor} | objects


def spot(origin: tuple = (0.05, 3.2, -0.04), target: tuple = (0, 0, 0), cutoff: float = 14) -> dict:
    """Return a spot light whose intensity ends smoothly."""
    return {"type": "spot", "intensity": rgb(9, 8, 7), "cutoff_angle": cutoff, "beam_width": cutoff / 3,
            "to_world": look_at(origin, target)}  # fmt: skip


def slab(bsdf: dict = GLASS, lamp: Any = None, **objects: Any) -> dict:
    """Return a scene with a slab under a lamp. The slab's upper surface has waves."""
    positions, faces, uv = grid(64, lambda x, z: 1.8 + waves(x, z))
    return setting(
        lamp=spot() if lamp is None else lamp,
        top=mesh(positions, faces, bsdf, uv, True),
        bottom=rectangle(bsdf, translate=[0, 1.6, 0], rotate=([1, 0, 0], 90), scale=3),
        **objects,
    )


def rough_surface() -> dict:
    """Return a scene with rough glass with waves, and the receiver inside the glass."""
    scene = slab(ROUGH)
    del scene["bottom"]
    return scene


def waving(scene: Any, name: str = "top", height: float = 1.8, count: int = 10) -> list[Move]:
    """Return the moves of a sheet: the size of its waves, and smooth displacements."""
    positions = vertices(scene, name)
    amplitude = np.zeros_like(positions)
    amplitude[:, 1] = (positions[:, 1] - height) * 3
    return [displacement(f"{name}.vertex_positions", np.stack([amplitude, *smooth_fields(positions, count, 1.0)]))]


def moving_sphere(name: str, pivot: tuple[float, float, float]) -> list[Move]:
    return [pose(f"{name}.to_world", ("tx", "ty", "tz", "s"), pivot)]


def beam(half: float = 0.3) -> dict:
    """Return a lamp with parallel light from a square, at thirty degrees."""
    aim = look_at([0.9, 3.2, -0.04], [0.05, 1.8, 0])
    return lit_square(rgb(9, 8, 7), aim @ transform(scale=half), "directionalarea")


def sphere_lens(radius: float = 0.8, y: float = 1.95, cutoff: float = 18, bsdf: dict = GLASS) -> dict:
    """Return a scene with a glass ball in a cone of light that the ball contains."""
    return setting(lamp=spot(cutoff=cutoff, origin=(0.1, 3.6, -0.08), target=(0.05, y, 0)),
                   lens={"type": "sphere", "center": [0, y, 0], "radius": radius, "bsdf": bsdf})  # fmt: skip


GLASS_SCENES = [
    attached("slab", "a glass slab with waves under a spot light", slab, waving, spp=256),
    attached("slab_beam", "the same under parallel light with a hard edge", lambda: slab(lamp=beam()), waving,
                  step=0.005),
    attached("sphere_lens", "a ball of glass, moved and scaled", sphere_lens,
                  lambda scene: moving_sphere("lens", (0, 1.95, 0)), spp=512),
    attached("rough_surface", "rough glass with waves, the receiver inside", rough_surface, waving,
                  spp=512, seeds=32, options={"max_depth": 3}),
    attached("rough_surface_alpha", "the roughness of rough glass", rough_surface,
                  lambda scene: [number("top.bsdf.alpha.value")], step=0.03, spp=512, seeds=32,
                  options={"max_depth": 3, "attached": True}),
]  # fmt: skip

MIRROR = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.9, 0.8, 0.7)}

#: Its samples do not depend on the incident direction. With sampling of visible normals, derivatives have heavy tails.
BRUSHED = {"type": "roughconductor", "material": "none", "alpha": 0.1, "sample_visible": False}


def ceiling(bsdf: dict = MIRROR) -> dict:
    """Return a scene with a mirror with waves that faces down and is lit from below."""
    positions, faces, uv = grid(64, lambda x, z: 1.9 + waves(x, z))
    return setting(lamp=spot(origin=(0.03, 0.6, -0.02), target=(0, 1.9, 0)),
                   mirror=mesh(positions, faces[:, ::-1], bsdf, uv, True))  # fmt: skip


MIRRORS_SCENES = [
    attached("mirror", "a mirror with waves", ceiling, lambda scene: waving(scene, "mirror", 1.9), step=0.002),
    attached("rough_mirror", "a rough metal with waves", lambda: ceiling(BRUSHED),
                  lambda scene: waving(scene, "mirror", 1.9), step=0.003, options={"max_depth": 3}),
]  # fmt: skip


def point(position: tuple = (0.1, 1.5, 0.2)) -> dict:
    return {"type": "point", "position": list(position), "intensity": rgb(3, 2, 4)}


def hills() -> dict:
    """Return a scene with a slightly curved receiver under a point light."""
    positions, faces, uv = grid(128, lambda x, z: 0.05 * np.sin(2 * x + 1) * np.cos(3 * z), 4, 1.5)
    return setting(floor=mesh(positions, faces, diffuse(0.8, 0.7, 0.6), uv, True), lamp=point())


def rolling(scene: Any, name: str = "floor", y: float = 0) -> list[Move]:
    """Return the moves of a sheet: smooth displacements that vanish beyond the film and before the sheet's edge."""
    positions = vertices(scene, name)
    about = positions - [0, y, 0]
    near = np.exp(-np.square(about / 1.5).sum(1))[:, None]
    hills = about * [0, 4, 0]
    return [displacement(f"{name}.vertex_positions", np.stack([hills, *smooth_fields(positions, 10, 1.5)]) * near)]


PLACES_SCENES = [
    attached("moved_point", "a point light over a plane", lambda: setting(lamp=point()),
                  lambda scene: [pose("lamp.position", ("ty", "tx", "tz"))], options={"max_depth": 2}),
    attached("moved_receiver", "a plane under a point light, moved and tilted", lambda: setting(lamp=point()),
                  lambda scene: [pose("floor.to_world", ("ty", "rx", "rz"))], options={"max_depth": 2}),
    attached("bent_receiver", "a plane under a point light that is bent", hills, rolling,
                  options={"max_depth": 2}, spp=256),
]  # fmt: skip


def wall(bsdf: dict[str, Any], turn: float = -90, x: float = 1.0) -> dict[str, Any]:
    """Return a wall at `x` that faces the axis. `turn` is its angle about the vertical."""
    return rectangle(bsdf, translate=[x, 1, 0], rotate=([0, 1, 0], turn), scale=3)


def room(**changes: Any) -> dict[str, Any]:
    """Return a scene with a slab with waves over the floor of a room. The camera is above the caustic and looks at x =
    1.

    `changes` add objects, or replace objects of the scene.
    """
    seen = pinhole([-0.6, 0.8, 0], [1, 0.8, 0], [0, 1, 0], 40, SIZE, rfilter=FILTER)
    return slab(lamp=spot(cutoff=8), camera=seen) | changes


def steps() -> dict[str, Any]:
    """Return a diffuse BSDF with a texture of 24 x 24 light and dark texels."""
    texels = np.random.default_rng(2).choice([0.1, 0.9], (24, 24, 1)) * np.ones(3)
    return {"type": "diffuse", "reflectance": bitmap(texels, "nearest")}


def corner() -> dict[str, Any]:
    """Return a room with two walls that meet in the middle of the view. One wall is light, and one is dark."""
    return room(light=wall(diffuse(0.9, 0.9, 0.9), -50), dark=wall(diffuse(0.15, 0.15, 0.15), -130))


def shelf() -> dict[str, Any]:
    """Return a scene with a panel that faces the wall and fills the view. Each path to the panel has two diffuse
    vertices and one connection.

    The panel hangs above the floor. Light passes below the panel to the wall, and returns from there. The derivatives
    do not include the edge of the panel's shadow.
    """
    seen = pinhole([0.95, 0.8, 0], [0, 0.8, 0], [0, 1, 0], 50, SIZE, rfilter=FILTER)
    panel = rectangle(diffuse(0.7, 0.8, 0.9), translate=[0.45, 0.8, 0], rotate=([0, 1, 0], 90), scale=0.3)
    return slab(lamp=spot(cutoff=8), camera=seen, wall=wall(diffuse(0.8, 0.7, 0.6)), panel=panel)


def moved(scene: Any) -> list[Move]:
    """Return the moves of the slab: the size of its waves, and two smooth displacements."""
    return waving(scene, count=2)


#: A path from the lamp through both surfaces of the slab to the floor, a wall, and the camera.
OPTIONS = {"max_depth": 5}

ROOMS_SCENES = [
    attached("bounce", "a slab that lights a wall by way of the floor",
                  lambda: room(wall=wall(diffuse(0.8, 0.7, 0.6))), moved, spp=512, seeds=32, options=OPTIONS),
    attached("bounce_steps", "the same onto a texture with steps", lambda: room(wall=wall(steps())), moved,
                  spp=512, seeds=32, options=OPTIONS),
    attached("bounce_corner", "the same into a corner of two walls", corner, moved,
                  spp=512, seeds=32, options=OPTIONS),
]  # fmt: skip

SCENES: dict[str, SceneCase] = {
    scene.name: scene for scene in (*GLASS_SCENES, *MIRRORS_SCENES, *PLACES_SCENES, *ROOMS_SCENES)
}
