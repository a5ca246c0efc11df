"""Whether glass is so thin that rays, which start off the surface that they leave, jump over its other side."""

from __future__ import annotations

from typing import Any

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
    # Each surface of a shape is a program of its own to trace, in every interaction that is asked for: of thousands of
    # shapes as many. So the loop is symbolic, and the way back, of which the distance alone is wanted, has none.
    first = scene.ray_intersect_preliminary(ray)
    si = first.compute_surface_interaction(ray, mi.RayFlags.Minimal)
    gaps = dr.full(mi.Float, dr.nan, _PATHS * _SURFACES)
    passing_on = si.is_valid() & mi.has_flag(si.bsdf().flags(), mi.BSDFFlags.Transmission)
    d = ray.d

    def goes_on(k: mi.UInt32, o: mi.Point3f, p: mi.Point3f, active: mi.Mask) -> mi.Mask:
        return active & (k < _SURFACES)

    def cross(k: mi.UInt32, o: mi.Point3f, p: mi.Point3f, active: mi.Mask) -> tuple[Any, ...]:
        """From the surface at `p`, which the ray leaves from `o`, to the next one."""
        ray = mi.Ray3f(o, d)
        hit = scene.ray_intersect_preliminary(ray, active=active)
        following = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        onward = active & following.is_valid()
        # From the next surface back: this one, or what the ray on has jumped over.
        returning = following.spawn_ray(-d)
        back = scene.ray_intersect_preliminary(returning, active=onward)
        offset = mi.math.RayEpsilon * (1 + dr.max(dr.abs(p)))
        jumped = dr.dot(returning(back.t) - p, d)
        apart = dr.select(
            onward & back.is_valid() & (jumped > offset * ROUNDING + FAR * following.t),
            jumped,
            dr.norm(following.p - p),
        )
        dr.scatter(gaps, apart / offset, k * _PATHS + index, onward)
        is_passed = onward & mi.has_flag(following.bsdf().flags(), mi.BSDFFlags.Transmission)
        return k + 1, following.spawn_ray(d).o, following.p, is_passed

    state = (dr.zeros(mi.UInt32, _PATHS), si.spawn_ray(d).o, si.p, passing_on)
    dr.while_loop(state, goes_on, cross, labels=("k", "o", "p", "active"), label="thin glass")
    found = np.array(gaps)
    found = found[np.isfinite(found)]
    near = found[found < LEAST_OFFSETS]
    if len(near) <= SHARE * len(found) or len(near) == 0:
        return None
    return (
        f"light passes through surfaces that are {np.median(near):.2g} ray offsets apart (a ray starts "
        f"{mi.math.RayEpsilon:.2g} (1 + max |p|) off the surface at p): it may jump over what is thinner than "
        f"{LEAST_OFFSETS}; make the glass thicker, or the scene larger"
    )
