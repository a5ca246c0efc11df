"""Whether glass is so thin that rays, which start off the surface that they leave, jump over its other side."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import UnsupportedScene
from .emitted import emitted_rays
from .graph import SceneGraph

#: Rays start so many offsets before the next surface, at least, where nothing is said.
LEAST_OFFSETS = 10
#: Of the crossings that light meets, the share that may be nearer: at edges, and where it grazes a ball.
SHARE = 0.01
#: What rounding may put between the places where two rays meet one surface: in offsets, and of the longer ray's length.
ROUNDING, FAR = 0.1, 1e-5
#: Paths that are followed, and surfaces along each.
_PATHS, _SURFACES = 4096, 8


def thin_glass(scene: mi.Scene) -> str | None:
    """What is wrong with a scene in which light passes through two surfaces that nearly touch; None where nothing is.

    Rays from the lights go straight on through what lets light pass; what lies between two surfaces is measured from
    both sides, since a ray that leaves the first may not see the second.
    """
    passing = int(mi.BSDFFlags.Transmission)
    if not any(int(bsdf.flags()) & passing for bsdf in SceneGraph.of(scene).surface_bsdfs()):
        return None
    index = dr.arange(mi.UInt32, _PATHS)
    numbers = [mi.Float(mi.sample_tea_float32(index, mi.UInt32(k))) for k in range(5)]
    try:
        ray, _ = emitted_rays(scene, numbers[0], mi.Point2f(*numbers[1:3]), mi.Point2f(*numbers[3:5]))
    except UnsupportedScene:  # which is said where paths from the light are wanted
        return None
    si = scene.ray_intersect(ray)
    active = si.is_valid()
    gaps: list[np.ndarray] = []
    for _ in range(_SURFACES):
        active = active & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Transmission)
        following = scene.ray_intersect(si.spawn_ray(ray.d), active)
        onward = active & following.is_valid()
        # From the next surface back: this one, or what the ray on has jumped over.
        back = scene.ray_intersect(following.spawn_ray(-ray.d), onward)
        offset = mi.math.RayEpsilon * (1 + dr.max(dr.abs(si.p)))
        jumped = dr.dot(back.p - si.p, ray.d)
        apart = dr.select(
            onward & back.is_valid() & (jumped > offset * ROUNDING + FAR * following.t),
            jumped,
            dr.norm(following.p - si.p),
        )
        gaps.append(np.array(dr.select(onward, apart / offset, dr.nan)))
        si, active = following, onward
    found = np.concatenate(gaps)
    found = found[np.isfinite(found)]
    near = found[found < LEAST_OFFSETS]
    if len(near) <= SHARE * len(found) or len(near) == 0:
        return None
    return (
        f"light passes through surfaces that are {np.median(near):.2g} ray offsets apart (a ray starts "
        f"{mi.math.RayEpsilon:.2g} (1 + max |p|) off the surface at p): it may jump over what is thinner than "
        f"{LEAST_OFFSETS}; make the glass thicker, or the scene larger"
    )
