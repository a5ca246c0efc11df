"""Which texels the sensors see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .graph import SceneGraph

#: Primary rays for each pixel and for each texel, and in one pass.
_RAYS_PER_CELL, _MAX_RAYS, _RAYS_PER_PASS = 64, 2**25, 2**20
_CROSSINGS = 8


def visible_texels(
    scene: Any, sensors: Sequence[Any], key: str, pixels: Sequence[np.ndarray[Any, Any] | None] = ()
) -> np.ndarray[Any, Any]:
    """Which texels of the texture `key` some sensor sees: boolean (H, W).

    `pixels` (H, W) are those of each sensor that count; None, or none at all, where all do.

    A texel counts as seen if a primary ray hits the inner quarter of its cell, after see-through surfaces (masks), but
    not through glass or in mirrors, from where light paths cannot connect to the sensor. For a texture that is not on a
    surface (an environment map, emission), every texel counts. Texture coordinates outside of [0, 1] are taken to
    repeat.
    """
    params = mi.traverse(scene)
    node = params.properties[key][2]
    height, width = params[key].shape[:2]
    owners = SceneGraph.of(scene).owning_bsdfs(node)
    to_uv = key.removesuffix("data") + "to_uv"
    if not owners or to_uv not in params:
        return np.ones((height, width), dtype=bool)
    transform = np.array(params[to_uv].matrix, dtype=np.float64)

    seen = dr.zeros(mi.UInt32, height * width)
    for place, sensor in enumerate(sensors):
        count = int(np.prod(sensor.film().crop_size()))
        kept = pixels[place] if place < len(pixels) else None
        rays = min(_RAYS_PER_CELL * max(count, height * width), _MAX_RAYS)
        for number in range(-(-rays // _RAYS_PER_PASS)):
            random = mi.PCG32(size=min(rays, _RAYS_PER_PASS), initstate=dr.opaque(mi.UInt64, number))
            _mark_seen(scene, sensor, owners, transform, random, seen, width, height, kept)
            dr.eval(seen)
    return np.array(seen).reshape(height, width) > 0


def _mark_seen(
    scene: Any, sensor: Any, owners: Sequence[Any], transform: Any, random: Any, seen: Any, width: int, height: int,
    kept: np.ndarray[Any, Any] | None,
) -> None:  # fmt: skip
    """Cast one primary ray per lane, through pixels (H, W) that are `kept`, and mark in `seen` the texels whose inner
    quarter it hits."""
    time = sensor.shutter_open() + random.next_float32() * sensor.shutter_open_time()
    film = mi.Point2f(random.next_float32(), random.next_float32())
    aperture = mi.Point2f(random.next_float32(), random.next_float32())
    ray, _ = sensor.sample_ray(time, 0.5, film, aperture, True)
    active = mi.Mask(True)
    if kept is not None:
        rows, columns = kept.shape
        x, y = (mi.UInt32(dr.minimum(c * size, size - 1)) for c, size in ((film.x, columns), (film.y, rows)))
        active = dr.gather(mi.UInt32, mi.UInt32(kept.ravel().astype(np.uint32)), y * columns + x) > 0
    for _ in range(_CROSSINGS):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf()
        is_owner = mi.Mask(False)
        for owner in owners:
            is_owner |= bsdf == mi.BSDFPtr(owner)
        u, v = (row[0] * si.uv.x + row[1] * si.uv.y + row[2] for row in transform.tolist()[:2])
        cell = mi.Point2f(u * width, v * height)
        inside = mi.Vector2f(cell - dr.floor(cell))
        inner = (dr.abs(inside.x - 0.5) < 0.25) & (dr.abs(inside.y - 0.5) < 0.25)
        x, y = (mi.Int32(dr.floor(c)) for c in (cell.x, cell.y))
        index = _modulo(y, height) * width + _modulo(x, width)
        dr.scatter(seen, mi.UInt32(1), mi.UInt32(index), active & is_owner & inner)
        active &= mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
        ray = si.spawn_ray(ray.d)
        dr.eval(seen, active, ray)
        if dr.none(active):
            break


def _modulo(value: Any, size: int) -> Any:
    remainder = value % size
    return dr.select(remainder < 0, remainder + size, remainder)
