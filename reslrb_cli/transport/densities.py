"""Probabilities of a scene's emitters, and densities of the rays that emitters send out. The densities are defined for
any ray, not only for sampled rays.

Mitsuba does not provide these densities. The densities describe the rays of Mitsuba's `sample_ray`, and the rays that
`emission.py` and `lamps.py` sample.

    lamp                 choice / area * cos / pi;  textured, in proportion to its texture
    constant, map, sky   choice p(d) / (pi r^2)         r: of the sphere around the scene
    directional          choice / (pi r^2)
    point, spot          choice / (4 pi), choice / (the cone's solid angle)
    projector            choice p(u) / (A cos^3)        A: the area of its picture at a distance of 1
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.scene.graph import Lamp, SceneGraph
from reslrb_cli.transport.lamps import DEFENSIVE
from reslrb_cli.transport.plan import Plan

EVEN, TEXTURED, ENVIRONMENT, PROJECTOR, UNSEEN = range(5)  # method for the density of an emitter's rays


@dataclass
class EmitterDensities:
    """Densities of a scene's emitters, as opaque arrays (R,). The index is the emitter's number in Dr.Jit's registry,
    which emitter pointers also contain.

    `choice` is the probability of selecting an emitter. `emitted` is e without the factor that varies between rays, for
    example a texture's density. `kind` tells which factor this is. If not all emitters are lit, `lit` (L,) has the
    indices of the lit ones in `scene.emitters()`, and `ends` (L,) has the cumulative sums of their probabilities.
    `on` (R,) is 1 for the lit ones, which may have the probability 0.
    """

    choice: mi.Float
    emitted: mi.Float
    kind: mi.UInt32
    lit: mi.UInt32 | None = None
    ends: mi.Float | None = None
    on: mi.UInt32 | None = None

    @staticmethod
    def of(plan: Plan, scene: mi.Scene) -> EmitterDensities:
        """Return the densities of all emitters of a scene."""
        emitters = scene.emitters()
        numbers = [int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter))[0]) for emitter in emitters]
        lit = range(len(emitters)) if plan.lit is None else plan.lit
        sampled = np.zeros(len(emitters))
        sampled[[*lit]] = [float(np.ravel(emitters[index].sampling_weight())[0]) for index in lit]
        choice, emitted, kind = (np.zeros(max(numbers) + 1) for _ in range(3))
        lamps = {lamp.index: lamp for lamp in plan.needs.lamps}
        for index, (emitter, number) in enumerate(zip(emitters, numbers, strict=True)):
            choice[number] = sampled[index] / sampled.sum()
            own, kind[number] = _ray_density(plan, emitter, lamps.get(index), emitter == scene.environment())
            emitted[number] = choice[number] * own
        made = [(mi.Float, choice), (mi.Float, emitted), (mi.UInt32, kind)]
        if plan.lit is not None:  # opaque as well, so that views with other lamps have the same kernels
            on = np.zeros(len(choice))
            on[[numbers[index] for index in lit]] = 1
            ends = np.cumsum(sampled[[*lit]]) / sampled.sum()
            made += [(mi.UInt32, np.array(lit)), (mi.Float, ends), (mi.UInt32, on)]
        return EmitterDensities(*(own_memory(kind, array) for kind, array in made))

    def select(self, number: mi.Float, active: mi.Bool) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Select one of the lit emitters, as `mi.Scene.sample_emitter` selects one of all emitters.

        Returns the index in `scene.emitters()`, 1 / probability, and a new uniform number.
        """
        lit, ends = self.lit, self.ends
        assert lit is not None
        assert ends is not None
        last = dr.width(lit) - 1
        if last == 0:
            return lit, mi.Float(1), number
        place = dr.binary_search(0, last, lambda index: dr.gather(mi.Float, ends, index, active) <= number)
        begin = dr.select(place > 0, dr.gather(mi.Float, ends, place - 1, active & (place > 0)), 0)
        chance = dr.gather(mi.Float, ends, place, active) - begin
        reused = dr.clip((number - begin) / chance, 0, dr.one_minus_epsilon(mi.Float))
        return dr.gather(mi.UInt32, lit, place, active), dr.rcp(chance), reused


def _ray_density(plan: Plan, emitter: mi.Emitter, lamp: Lamp | None, surrounds: bool) -> tuple[float, int]:
    """Return the part of e that is equal for all rays of an emitter, and the kind of the remaining factor. The part
    does not include the probability of selecting the emitter.
    """
    name = emitter.class_name()
    disk = 0.0 if plan.horizon is None else 1 / (np.pi * plan.horizon.radius**2)
    if lamp is not None:
        if lamp.parallel:
            return 0.0, UNSEEN  # its rays follow the normal: only light paths find it
        if lamp.texture is not None:
            return 1 / np.pi, TEXTURED
        return 1 / (np.pi * float(np.ravel(lamp.shape.surface_area())[0])), EVEN
    if surrounds:
        return (disk / (4 * np.pi), EVEN) if name == "ConstantBackgroundEmitter" else (disk, ENVIRONMENT)
    if name == "DirectionalEmitter":
        return disk, EVEN
    if name == "SpotLight":
        return 1 / (2 * np.pi * (1 - _cosine_of_cutoff(emitter))), EVEN
    if name == "Projector":
        return 1 / _projected_area(emitter), PROJECTOR
    return 1 / (4 * np.pi), EVEN


def _cosine_of_cutoff(spot: mi.Emitter) -> float:
    """Return the cosine of the cutoff angle of a spot's rays, which its plugin does not expose."""
    rim = mi.Point2f(1 - 1e-7, 0.5)  # the rim of the unit disk, which the position sample selects
    axis = np.ravel(mi.traverse(spot)["to_world"] @ mi.Vector3f(0, 0, 1))
    d = np.ravel(spot.sample_ray(0, 0.5, rim, rim, True)[0].d)
    return min(float(axis @ d / (np.linalg.norm(axis) * np.linalg.norm(d))), 1 - 1e-7)


def _projected_area(projector: mi.Emitter) -> float:
    """Return the area of a projector's picture at a distance of 1."""
    params = mi.traverse(projector)
    toward = params["to_world"] @ mi.Vector3f(mi.Float([0.0, 1e-3, 0.0]), mi.Float([0.0, 0.0, 1e-3]), 1)
    si = dr.zeros(mi.SurfaceInteraction3f, 3)
    si.p = params["to_world"] @ mi.Point3f(0) + toward
    uv = np.array(projector.sample_direction(si, mi.Point2f(0.5), True)[0].uv)
    across, down = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    return 1e-6 / max(abs(float(across[0] * down[1] - across[1] * down[0])), 1e-12)


def density_of_rays(
    plan: Plan, table: EmitterDensities, emitter: mi.EmitterPtr, own: mi.Float, uv: mi.Point2f, d: mi.Vector3f,
    active: mi.Bool,
) -> mi.Float:  # fmt: skip
    """Return e, the density of the rays that leave an emitter along `d`. If the emitter has a surface, e is divided by
    the cosine at the surface.

    `own` is a density of next event estimation, without the choice of the emitter: of the place per area on a lamp, of
    the direction for an environment. `uv` are the texture coordinates of the place.
    """
    number = dr.reinterpret_array(mi.UInt32, emitter)
    e = dr.gather(mi.Float, table.emitted, number, active)
    textured = any(lamp.texture is not None for lamp in plan.needs.lamps)
    mapped = plan.needs.environment not in (None, "ConstantBackgroundEmitter")
    if not (textured or mapped or "Projector" in plan.needs.emitters):
        return e
    kind = dr.gather(mi.UInt32, table.kind, number, active)
    factor = mi.Float(1)
    if textured:
        by_texture = mi.Float(own)
        for lamp in plan.evened_lamps:
            here = emitter == mi.EmitterPtr(lamp.emitter)
            by_texture = dr.select(here, _evened(lamp, own, uv, active & here), by_texture)
        factor = dr.select(kind == TEXTURED, by_texture, factor)
    if mapped:
        by_map = own
        if plan.environment_map and plan.differentiate_emission:
            by_map = dr.select(dr.isfinite(own), (1 - DEFENSIVE) * own + DEFENSIVE * dr.inv_four_pi, dr.inv_four_pi)
        factor = dr.select(kind == ENVIRONMENT, by_map, factor)
    if "Projector" in plan.needs.emitters:
        factor = dr.select(kind == PROJECTOR, _projected(emitter, uv, d, active & (kind == PROJECTOR)), factor)
    return e * factor


def _evened(lamp: Lamp, own: mi.Float, uv: mi.Point2f, active: mi.Bool) -> mi.Float:
    """Return the density per area of a lamp whose points are sampled partly from its texture and partly uniformly."""
    there = lamp.shape.eval_parameterization(uv, mi.RayFlags.All, active)
    stretch = dr.norm(dr.cross(there.dp_du, there.dp_dv))
    drawn = own * stretch
    return dr.select(dr.isfinite(drawn), (1 - DEFENSIVE) * drawn + DEFENSIVE, 1) / stretch


def _projected(emitter: mi.EmitterPtr, uv: mi.Point2f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
    """Return the density of a projector's directions, without the factor 1 / A. A is the picture's area at a distance
    of 1. `uv` are coordinates of the picture.
    """

    def density(self: mi.Emitter, uv: mi.Point2f, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
        if self.class_name() != "Projector":
            return mi.Float(0)
        picture = next(child for child in SceneGraph.of(self).objects if isinstance(child, mi.Texture))
        axis = dr.normalize(dr.detach(mi.traverse(self)["to_world"] @ mi.Vector3f(0, 0, 1)))
        return picture.pdf_position(uv, active) / dr.dot(axis, d) ** 3

    return dr.dispatch(emitter, density, uv, d, active)
