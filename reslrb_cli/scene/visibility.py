"""Pixels and texels that light tracing can use for sensors, and the necessary length of paths.

Light tracing lacks light at the film's border (`interior`). Light tracing also lacks light where the sensor sees glass,
mirrors, or coats (`sees_specular`), because smooth specular lobes cannot be connected to the sensor. A photograph
contains light of any number of bounces. An image of paths of at most d segments is darker. An exposure or a colour
would compensate for the missing light (`find_depth`).
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Sequence
from functools import partial
from itertools import zip_longest
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.needs import LOOK, surfaces_met, what_is_seen
from reslrb_cli.scene.rays import brightness, sensor_rays

#: Primary rays of a pixel are spread over this many rows and columns of cells.
CELLS = 4
#: Points of the aperture, in [0, 1]^2, from which a thin-lens camera looks for lamps.
_APERTURE = ((0.5, 0.5), (0.05, 0.5), (0.95, 0.5), (0.5, 0.05), (0.5, 0.95))


def _margin(sensor: mi.Sensor) -> int:
    """Return how many pixels the reconstruction filter extends beyond the pixel at its centre, rounded up."""
    return int(np.ceil(float(sensor.film().rfilter().radius()) - 0.5))


def interior(shape: tuple[int, ...], sensor: mi.Sensor) -> np.ndarray:
    """Return the pixels, boolean (H, W), that lose no light at the film's border under light tracing. `shape` starts
    with the (H, W) of the film of `sensor`.

    Samples just outside of the film are lost, so pixels within the filter's radius of the film's border are too dark.
    Camera paths do not lose light there.
    """
    margin = _margin(sensor)
    inside = np.zeros(shape[:2], dtype=bool)
    inside[margin : shape[0] - margin, margin : shape[1] - margin] = True
    return inside


def spread(pixels: np.ndarray, sensor: mi.Sensor) -> np.ndarray:
    """Return `pixels` together with all pixels whose reconstruction filter reaches some of `pixels`. Masks are boolean
    (H, W).
    """
    return widened(pixels, _margin(sensor))


def widened(pixels: np.ndarray, margin: int) -> np.ndarray:
    """Return the pixels, boolean (H, W), with a true pixel at most `margin` rows and columns away. SciPy's filter would
    take 0.1 s to import.
    """
    for axis in (0, 1):
        padded = np.pad(pixels, [(margin, margin) if each == axis else (0, 0) for each in (0, 1)])
        pixels = np.asarray(np.lib.stride_tricks.sliding_window_view(padded, 2 * margin + 1, axis).any(axis=-1))
    return pixels


def sees_specular(scene: mi.Scene, sensor: mi.Sensor, partly: bool = False) -> np.ndarray:
    """Return the pixels, boolean (H, W) of a sensor's crop window, whose reconstruction filter reaches surfaces that
    have only smooth specular lobes (glass, mirrors). These surfaces stay black under light tracing.

    With `partly`, surfaces that also have other lobes count as well (coats, blends, thin panes). Light tracing lacks a
    part of the light of these surfaces.

    The function may miss objects smaller than a cell (`_sees`).
    """
    return _sees(scene, sensor, partial(_is_specular, partly=partly))


def sees_materials(scene: mi.Scene, sensor: mi.Sensor, bsdfs: Sequence[mi.BSDF]) -> np.ndarray:
    """Return the pixels, boolean (H, W) of a sensor's crop window, whose reconstruction filter reaches surfaces with
    one of the `bsdfs`. The function may miss objects smaller than a cell (`_sees`).
    """
    pointers = [mi.BSDFPtr(bsdf) for bsdf in bsdfs]
    return _sees(scene, sensor, lambda si: functools.reduce(operator.or_, (si.bsdf() == each for each in pointers)))


def _sees(scene: mi.Scene, sensor: mi.Sensor, shows: Callable[[mi.SurfaceInteraction3f], mi.Bool]) -> np.ndarray:
    """Return the pixels, boolean (H, W), whose reconstruction filter reaches a surface for which `shows` is true.

    The function traces CELLS^2 primary rays per pixel, the same rays at every call. A ray passes through see-through
    surfaces, and ends at the first other surface.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    count = width * height
    lane = dr.arange(mi.UInt32, count)
    corner = mi.Point2f(lane % width, lane // width)
    random = mi.PCG32(count)
    seen = dr.zeros(mi.Bool, count)
    for cell in range(CELLS * CELLS):
        # Opaque, so that all cells have one kernel.
        row, column = dr.opaque(mi.Float, cell // CELLS), dr.opaque(mi.Float, cell % CELLS)
        jitter = mi.Point2f(random.next_float32(), random.next_float32())
        u = (corner + (mi.Point2f(column, row) + jitter) / CELLS) / mi.Vector2f(width, height)
        aperture = mi.Point2f(random.next_float32(), random.next_float32())
        ray, _ = sensor_rays(sensor, sensor.shutter_open(), u, aperture)
        for si, reached in surfaces_met(scene, ray, dr.full(mi.Bool, True, count)):
            seen |= reached & si.is_valid() & shows(si)
            dr.schedule(seen)
        dr.eval(seen, random)
    return spread(np.array(seen, dtype=bool).reshape(height, width), sensor)


def sees_lamps(scene: mi.Scene, sensor: mi.Sensor) -> np.ndarray:
    """Return the pixels (H, W) of a sensor's crop window that see an emitter directly.

    The result includes the neighbouring pixels that the reconstruction filter reaches. The function may miss a lamp
    smaller than the cells of a grid of LOOK^2.
    """
    width, height = (int(n) for n in sensor.film().crop_size())
    cells = np.zeros((LOOK, LOOK), dtype=bool)
    for point in _APERTURE if sensor.needs_aperture_sample() else (None,):
        cells |= np.array(what_is_seen(scene, sensor, point)[2]).reshape(LOOK, LOOK)
    if not cells.any():
        return np.zeros((height, width), dtype=bool)
    cells = widened(cells, 1)  # an edge may be anywhere between the centres of two cells
    for axis, size in enumerate((height, width)):
        first = np.arange(size) * LOOK // size
        cells = np.maximum.reduceat(cells, first, axis=axis) if size < LOOK else np.take(cells, first, axis=axis)
    return spread(cells, sensor)


def sees_even_lamps(scene: mi.Scene, sensor: mi.Sensor) -> np.ndarray:
    """Return the pixels, boolean (H, W) of a sensor's crop window, whose reconstruction filter reaches the lit side of
    a shape that emits without a texture. The function may miss lamps smaller than a cell (`_sees`).
    """

    def shows(si: mi.SurfaceInteraction3f) -> mi.Bool:
        emitter = si.emitter(scene)
        is_even = ~mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)
        return is_even & dr.any(emitter.eval(si) > 0)

    return _sees(scene, sensor, shows)


def _is_specular(si: mi.SurfaceInteraction3f, partly: bool) -> mi.Bool:
    """Return whether a surface has only delta lobes. With `partly`, return whether it has any delta lobe."""
    lobes = int(mi.BSDFFlags.DeltaReflection | mi.BSDFFlags.DeltaTransmission)
    others = int(mi.BSDFFlags.Null | mi.BSDFFlags.Smooth)
    flags = si.bsdf().flags()
    specular = (flags & lobes) != 0
    return specular if partly else specular & ((flags & others) == 0)


#: Primary rays for each pixel and each texel, and rays of one pass.
_RAYS_PER_CELL, _MAX_RAYS, _RAYS_PER_PASS = 64, 2**25, 2**20


def visible_texels(
    scene: Any, sensors: Sequence[Any], key: str, pixels: Sequence[np.ndarray[Any, Any] | None] = (),
    mirrored: bool = False,
) -> np.ndarray[Any, Any]:  # fmt: skip
    """Return the texels of the texture `key` that some sensor sees: boolean (H, W).

    `pixels` has a mask (H, W) of the pixels that count for each sensor, or None if all pixels count. With `mirrored`,
    texels seen through mirrors and clear glass count as well. Camera paths find these texels.

    A texel counts if a primary ray hits the inner quarter of its cell. Rays pass see-through surfaces (masks). Without
    `mirrored`, rays do not pass glass or mirrors, because light paths cannot connect to the sensor through glass or
    mirrors. For a texture that is on no surface (an environment map, emission), every texel counts. Texture coordinates
    outside of [0, 1] are assumed to repeat.
    """
    params = mi.traverse(scene)
    node = params.properties[key][2]
    height, width = params[key].shape[:2]
    owners = SceneGraph.of(scene).owning_bsdfs(node)
    to_uv = key.removesuffix("data") + "to_uv"
    if not owners or to_uv not in params:
        return np.ones((height, width), dtype=bool)
    transform = np.array(params[to_uv].matrix, dtype=np.float64).tolist()
    met = partial(_texels_met, owners, transform, (width, height))
    seen = dr.zeros(mi.UInt32, height * width)
    for sensor, kept in zip_longest(sensors, pixels[: len(sensors)]):
        count = int(np.prod(sensor.film().crop_size()))
        rays = min(_RAYS_PER_CELL * max(count, height * width), _MAX_RAYS)
        for number in range(-(-rays // _RAYS_PER_PASS)):
            random = mi.PCG32(size=min(rays, _RAYS_PER_PASS), initstate=dr.opaque(mi.UInt64, number))
            _mark_seen(scene, sensor, met, random, seen, kept, mirrored)
            dr.eval(seen)
    return np.array(seen).reshape(height, width) > 0


def _texels_met(owners: Sequence[Any], transform: list[list[float]], size: tuple[int, int], si: Any) -> tuple[Any, Any]:
    """Return the texel at each surface point, and whether the point is in the inner quarter of the texel's cell.

    The texture has `size` (width, height), belongs to the BSDFs `owners`, and has `transform` as its `to_uv`.
    """
    is_owner = mi.Mask(False)
    for owner in owners:
        is_owner |= si.bsdf() == mi.BSDFPtr(owner)
    u, v = (row[0] * si.uv.x + row[1] * si.uv.y + row[2] for row in transform[:2])
    cell = mi.Point2f(u, v) * mi.Vector2f(size)
    inside = mi.Vector2f(cell - dr.floor(cell))
    inner = (dr.abs(inside.x - 0.5) < 0.25) & (dr.abs(inside.y - 0.5) < 0.25)
    # Twice, because the remainder of a negative number is not positive.
    x, y = ((mi.Int32(dr.floor(c)) % n + n) % n for c, n in zip((cell.x, cell.y), size, strict=True))
    return mi.UInt32(y * size[0] + x), si.is_valid() & is_owner & inner


def _mark_seen(
    scene: Any, sensor: Any, met: Callable[[Any], tuple[Any, Any]], random: Any, seen: Any,
    kept: np.ndarray[Any, Any] | None, mirrored: bool,
) -> None:  # fmt: skip
    """Cast one primary ray per lane through the pixels marked in `kept` (H, W). In `seen`, mark the texels that the
    rays meet, as `met` finds them.

    With `mirrored`, rays also pass mirrors and clear glass.
    """
    time = sensor.shutter_open() + random.next_float32() * sensor.shutter_open_time()
    film = mi.Point2f(random.next_float32(), random.next_float32())
    aperture = mi.Point2f(random.next_float32(), random.next_float32())
    ray, _ = sensor_rays(sensor, time, film, aperture)
    active = mi.Mask(True)
    if kept is not None:
        rows, columns = kept.shape
        x, y = (mi.UInt32(dr.minimum(c * size, size - 1)) for c, size in ((film.x, columns), (film.y, rows)))
        active = dr.gather(mi.UInt32, mi.UInt32(kept.ravel().astype(np.uint32)), y * columns + x) > 0
    for si, reached in surfaces_met(scene, ray, active, random if mirrored else None):
        texel, inner = met(si)
        dr.scatter(seen, mi.UInt32(1), texel, reached & inner)
        dr.schedule(seen, random)


#: Depths to try; the last one counts as all light.
DEPTHS = (8, 16, 32, 64)
#: Mean share of a pixel's light that may be missing. Recovered colours are too bright by up to this share. Their spread
#: does not include this error, so the share must be smaller than most spreads.
LOST = 0.001
#: Rays per axis of the film, and paths for each of them.
_RAYS, _PATHS = 48, 32


def find_depth(scene: mi.Scene, sensor: int) -> tuple[int, float | None]:
    """Return the smallest depth in `DEPTHS`, in segments, whose image lacks at most the share `LOST` of the light.
    `sensor` is the index of the sensor.

    The function also returns the mean share of a pixel's light that longer paths would add. For the greatest depth,
    this share is None, because there is no greater depth to compare with.

    The function uses camera paths with equal random numbers and without roulette. With equal random numbers and no
    roulette, the paths of one depth are the first parts of the next depth's paths.
    """
    whole = _pixels(scene, sensor, DEPTHS[-1])
    lit = np.isfinite(whole) & (whole > 0)
    for segments in DEPTHS[:-1]:
        # The mean missing share over lit pixels, so that no bright pixels dominate.
        lacking = 1 - _pixels(scene, sensor, segments)[lit] / whole[lit]
        missing = float(lacking.mean()) if lit.any() else 0.0
        if missing <= LOST:
            return segments, missing
    return DEPTHS[-1], None


def _pixels(scene: mi.Scene, index: int, segments: int) -> np.ndarray:
    """Return the light (N,) of each ray, as float64. The light comes from paths of at most `segments` segments."""
    sensor, count = scene.sensors()[index], _RAYS**2 * _PATHS
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, count)
    pixel = dr.arange(mi.UInt32, count) // _PATHS
    corner = mi.Point2f(pixel % _RAYS, pixel // _RAYS)
    position = (corner + sampler.next_2d()) / _RAYS
    ray, weight = sensor_rays(sensor, sensor.shutter_open(), position, sampler.next_2d())
    integrator = mi.load_dict({"type": "path", "max_depth": segments, "rr_depth": DEPTHS[-1] + 1})
    light, _, _ = integrator.sample(scene, sampler, mi.RayDifferential3f(ray))
    rows = np.array(brightness(weight * light, ray.wavelengths), dtype=np.float64).reshape(_RAYS**2, _PATHS)
    return np.asarray(rows.mean(axis=1))
