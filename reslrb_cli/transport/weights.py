"""Balance heuristic weights of paths that both light paths and camera paths can find.

A path z_0 (sensor), z_1 .. z_{K-1} (surfaces), z_K (on an emitter) can be found in three ways. A camera path hits the
emitter (H), or its last vertex z_{K-1} samples the emitter by next event estimation (N). A light path connects its last
vertex z_1 to the sensor (L). The weight of each way is its density divided by the sum of the densities of all three
ways. Therefore, w_H + w_N + w_L = 1. The weights depend only on the path, and have no derivative.

Each walk carries two numbers. M is the density of finding the path if the other walk joins at the newest vertex. M is
relative to this walk's own density. V is the density of finding the path if the other walk joins at an earlier vertex.
These symbols are used below.

- p is the BSDF's density of the direction taken. p~ is the BSDF's density of the reverse direction in the other walk.
- c is the |cosine| of the direction taken, and d the length of the segment.
- N is the number of all light paths divided by the number of camera paths per pixel.
- p_cam is the sensor's density of a direction for one pixel.
- e is the density of an emitter's rays over place and direction. If the emitter has a surface, this density is divided
    by the cosine at the surface.
- p_D is the density with which next event estimation samples an emitter's directions at a vertex.

Both e and p_D include the choice of the emitter.

    every arrival     M *= d^2 (not from infinity);  M, V /= |cos| at the surface that is reached
    camera walk       start: M = N / p_cam, V = 0.    m = M at the first vertex, V p~ at later ones
      next event      w_N = 1 / (1 + p / p_D + m e c / (p_D g))    g: d^2 for a light at a point, else 1; p = 0 for both
      smooth event    V = (c / p) m,  M = 1 / p         delta event   V *= c,  M = 0
      light is met    w_H = 1 / (1 + p_D M + e V)       of M and V before the arrival, or 1 where it is seen directly
    light walk        at the first vertex: M = p_D g / (e |cos|),  V = 1 / (e |cos|); V = 0 for delta lights
      connection      w_L = 1 / (1 + p_camA / N (M + V p~))        p_camA: p_cam as a density of area at the vertex
      smooth event    V = (c / p) (M + V p~), then M = 0 for good  delta event   V *= c,  M = 0

A null event is not a vertex. At a null event, M and V do not change, and the length d continues. The weights do not
include roulette, guiding and aiming, but still sum to 1. Source: Georgiev 2012, "Implementing Vertex Connection and
Merging". Its recursion weights all connections. This is the restriction to three ways.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.densities import EmitterDensities, density_of_rays
from reslrb_cli.transport.emission import Emission
from reslrb_cli.transport.lamps import lamp_point
from reslrb_cli.transport.plan import Plan

FROM_INFINITY = -1e30  # the length so far of a path that comes from infinity


@dataclass
class Rivals:
    """Loop state: a walk's M and V before the arrival at its current vertex, and the length d since the last vertex.

    Null events are not vertices. The density p_D of an outward spherical lamp without a texture depends on the vertex.
    If there are spherical lamps of this kind, `sphere` is therefore the shape number of the lamp that a light path
    comes from. For other emitters, and after the first event, `sphere` is 0.
    """

    M: mi.Float
    V: mi.Float
    distance: mi.Float
    sphere: list[mi.UInt32] = field(default_factory=list)

    def arrive(self, si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> Rivals:
        """Return M and V at the vertex `si` that `ray` reaches."""
        d = self.distance + si.t
        cos = dr.maximum(dr.abs(dr.dot(si.n, ray.d)), 1e-12)
        M = self.M * dr.select(d < 0, 1, dr.square(d)) / cos
        for number in self.sphere:  # one or none
            ds = dr.zeros(mi.DirectionSample3f)
            ds.d, ds.dist, ds.n = -ray.d, d, mi.Normal3f(ray.d)  # the cone of directions is the same for all lanes
            shape = dr.reinterpret_array(mi.ShapePtr, number)
            p_D = shape.pdf_direction(si, ds, number != 0)
            M = dr.select(number != 0, self.M * p_D / cos, M)
        return Rivals(M, self.V / cos, d, self.sphere)

    def after_null(self, arrived: Rivals) -> Rivals:
        """Return M and V after a null event. `arrived` holds the values of M and V at the vertex."""
        return replace(self, distance=arrived.distance)

    def after(self, renewed: mi.Float, joined: mi.Float, scattering: Scattering, cos: mi.Float) -> Rivals:
        """Return M and V after an event. A smooth event sets M to `renewed`, and computes V from `joined`."""
        p, is_delta = scattering.ways.p, scattering.is_delta
        V = dr.select(is_delta, self.V * cos, dr.select(joined > 0, cos / p * joined, 0))
        sphere = [mi.UInt32(0) for _ in self.sphere]
        return Rivals(dr.select(is_delta, 0, renewed), V, mi.Float(0), sphere)


def cosine(si: mi.SurfaceInteraction3f, d: mi.Vector3f) -> mi.Float:
    """Return the |cosine| of direction `d` to the normal at `si`."""
    return dr.abs(dr.dot(si.n, d))


# ---- The walk from the light ----


def leave_emitter(plan: Plan, table: EmitterDensities, scene: mi.Scene, emission: Emission) -> Rivals:
    """Return M and V of a light path that has left an emitter and has not yet reached its first vertex."""
    ray, emitter = emission.ray, emission.emitter
    choice = dr.gather(mi.Float, table.choice, dr.reinterpret_array(mi.UInt32, emitter))
    lamps = {lamp.emitter: lamp for lamp in plan.needs.lamps}
    environment = None if plan.needs.environment is None else scene.environment()

    def leave(
        self: mi.Emitter, time: mi.Float, position: mi.Point2f, o: mi.Point3f, d: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float, mi.Point2f, mi.Float, mi.Float]:  # fmt: skip
        """Return five values for each emitted ray. The values are the density of places or directions, the cosine, the
        texture coordinates, 1 if V is not 0, and d.
        """
        one, zero = mi.Float(1), mi.Float(0)
        lamp = lamps.get(self)
        if lamp is not None and not lamp.parallel:
            si, weight = lamp_point(lamp, None, time, position, active, lamp in plan.evened_lamps)
            own = dr.rcp(weight)
            if lamp.texture is not None and lamp in plan.evened_lamps:
                there = lamp.shape.eval_parameterization(si.uv, mi.RayFlags.All, active)
                own = lamp.texture.pdf_position(si.uv, active) / dr.norm(dr.cross(there.dp_du, there.dp_dv))
            return own, dr.abs(dr.dot(si.n, d)), si.uv, one, zero
        if self == environment:
            ds = dr.zeros(mi.DirectionSample3f)
            ds.d = -d
            return self.pdf_direction(dr.zeros(mi.Interaction3f), ds, active), one, mi.Point2f(0), one, far
        # Directions have the scale of `to_world`; up to the first vertex, distances are in units of it.
        distant = self.class_name() == "DirectionalEmitter"
        scaled = dr.norm(d) if distant else dr.norm(d) ** 3
        if self.class_name() == "Projector":
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.p = o + d
            return scaled, one, self.sample_direction(si, mi.Point2f(0.5), active)[0].uv, zero, zero
        return scaled, one, mi.Point2f(0), zero, far if distant else zero

    far = mi.Float(FROM_INFINITY)
    with dr.suspend_grad():
        own, cos, uv, surface, distance = dr.dispatch(
            emitter, leave, ray.time, emission.position, ray.o, ray.d, mi.Bool(True)
        )
        e = density_of_rays(plan, table, emitter, own, uv, dr.normalize(ray.d), mi.Bool(True))
        unseen = mi.Bool(False)
        sphere = []
        M = choice * own / (e * dr.maximum(cos, 1e-12))
        spheres = [lamp for lamp in plan.needs.lamps if lamp.is_sphere and lamp.texture is None]
        spheres = [lamp for lamp in spheres if not (lamp.parallel or lamp.surrounds)]
        if spheres:
            number = mi.UInt32(0)
            for lamp in spheres:
                shape = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(lamp.shape))
                number = dr.select(emitter == mi.EmitterPtr(lamp.emitter), shape, number)
            sphere, M = [number], dr.select(number != 0, choice / e, M)
        for lamp in plan.needs.lamps:
            if lamp.parallel:
                unseen |= emitter == mi.EmitterPtr(lamp.emitter)
        # No other technique finds points without density.
        M, V = (dr.select(unseen | ~dr.isfinite(x), 0, x) for x in (M, surface / e))
        return Rivals(M, V, distance, sphere)


def weight_of_connection(
    arrived: Rivals, p_camA: mi.Float, N: mi.Float, back: mi.Float
) -> mi.Float:  # fmt: skip
    """Return w_L of a connection to the sensor. `back` is p~, the density of the continuation of a path from the
    sensor.
    """
    rivals = p_camA / N * (arrived.M + arrived.V * back)
    return dr.rcp(1 + dr.select(p_camA > 0, rivals, 0))
