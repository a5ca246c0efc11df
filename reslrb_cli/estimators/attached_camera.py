"""Camera paths with attached derivatives: the walk back evaluates each segment again, as in `attached.py`.

The ray through a film position is fixed. The first vertex slides along this ray as its surface moves. Behind a specular
vertex, the next vertex slides along the ray that the vertex reflects or refracts. Behind all other vertices, the next
vertex and the points on emitters stay at their places on their surfaces (`stay` in `attached.py`). Both ways to find
light, by hitting an emitter and by next event estimation, then differentiate the same integral over places. The weights
of the two ways therefore need no derivative, because their sum at each place is 1. For this reason, light of an emitter
that a path hits has no share with fixed directions (`Plan.near`).

delta is one number per channel for each path, and is a factor of P_i. e_i is the emission of an emitter that the path
hits at vertex i, times its weight. c_i is the next event. m_i is the factor that `reach` returns, and r_i is the
roulette weight.

    S_i     = <P_i, m_i (e_i + c_i + r_i s_i B_i)> + <a_{i+1}, v_{i+1}>
    B_{i-1} = e_i + c_i + r_i s_i B_i
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import Adjoint, Before, begins, concerns_emission, reach
from reslrb_cli.estimators.base import Pass, SurfacePoint
from reslrb_cli.estimators.stack import Ring, StackState
from reslrb_cli.transport.bsdf import EventNumbers, Scattering, scatter
from reslrb_cli.transport.camera import CameraHooks, FilmRay, MetLight, NextEvent, next_event_again
from reslrb_cli.transport.factors import MAY_LACK
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.walk import Vertex


@dataclass
class AttachedCameraFrame:
    """Vertex on the stack, with the data to evaluate its segment again.

    `prefix` (C,) is P_i, which contains delta. `met` is the weight of the emission at the vertex, or 0. `scale` is the
    weight of the next event divided by its density, or 0 without a visible emitter. `place` holds the random numbers of
    the next event. `met`, or `scale` and `place`, are empty if camera paths do not find light in this way. `leaves` is
    1 if the ray has left the scene.
    """

    point: SurfacePoint
    sample_1: mi.Float
    sample_2: mi.Point2f
    prefix: mi.Spectrum
    roulette: mi.Float
    met: list[mi.Float]
    scale: list[mi.Float]
    place: list[mi.Point2f]
    leaves: list[mi.UInt32]
    before: list[Before]

    @staticmethod
    def blank(plan: Plan) -> AttachedCameraFrame:
        """Return a frame of zeros with the members that the plan needs."""
        met = [mi.Float(0)] if plan.needs.has_visible_emitters else []
        scale, place = ([mi.Float(0)], [mi.Point2f(0)]) if plan.samples_emitters else ([], [])
        leaves = [mi.UInt32(0)] if plan.needs.environment is not None else []
        zeros = mi.Float(0), mi.Point2f(0), mi.Spectrum(0), mi.Float(0)
        return AttachedCameraFrame(SurfacePoint.blank(plan), *zeros, met, scale, place, leaves, Before.start(plan))

    def differentiate(self, p: Pass, adjoint: Adjoint) -> Adjoint:
        """Add the derivatives of the vertex's segment.

        Takes the adjoint of the segment's outgoing ray, and returns the adjoint of the ray that reaches the vertex.
        """
        plan, samples, P, B = p.plan, p.samples, self.prefix, adjoint.B
        leaves = self.leaves[0] != 0 if self.leaves else mi.Bool(False)
        scattered = dr.any(B != 0) | dr.any(adjoint.origin != 0) | dr.any(adjoint.direction != 0)
        connected = self.scale[0] != 0 if self.scale else mi.Bool(False)
        lit = self.met[0] != 0 if self.met else mi.Bool(False)
        pi, ray = self.point.hit(p.wavelengths)
        pi.valid &= ~leaves
        with dr.resume_grad():
            ray.o, ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
            dr.enable_grad(ray.o, ray.d)
            hit, factor = reach(plan, self.before, ray, pi, (connected | scattered | lit) & ~leaves, lit=lit)
            event, own = None, mi.Spectrum(0)
            if self.scale:
                event = next_event_again(samples, hit.si, self.place[0], connected)
            numbers = EventNumbers(self.sample_2, self.sample_1)
            scattering, f = scatter(plan, hit, numbers, scattered, event, attached=True)
            if event is not None:
                own = dr.select(connected, f * event.rest * self.scale[0], 0)
            for weight in self.met:
                there = hit.si
                if self.leaves:
                    there.wi = dr.select(leaves, -ray.d, there.wi)
                own += dr.select(lit, there.emitter(samples.scene, lit).eval(there, lit) * weight, 0)
            later = dr.select(scattered, scattering.s * B, 0)
            following = hit.si.spawn_ray(scattering.d)
            moved = dr.dot(following.o, adjoint.origin) + dr.dot(following.d, adjoint.direction)
            objective = dr.dot(P, factor * (own + later)) + dr.select(scattered, moved, 0)
            dr.backward_from(objective, flags=MAY_LACK)
            # A lane without light may compute NaN, which must not reach earlier vertices.
            B = dr.detach(own + later) * self.roulette
            here = connected | scattered | lit
            values = mi.Vector3f(dr.grad(ray.o)), dr.grad(ray.d), B
            return Adjoint(*(dr.select(here, value, 0) for value in values))


@dataclass
class AttachedCameraState:
    """Loop state of the forward pass: the stack, the data of the current vertex that the next vertex needs, and, if
    there is an image, the radiance so far (C,).
    """

    stack: StackState
    before: list[Before]
    L: list[mi.Spectrum]


class AttachedCameraSweep(CameraHooks):
    """Forward pass. The pass sums the image if there is one, and pushes the vertices that the ring takes."""

    def __init__(self, p: Pass, ring: Ring) -> None:
        self.p, self.ring = p, ring
        self.delta = mi.Spectrum(0)  # assigned at the start

    def start(self, first: FilmRay) -> AttachedCameraState:
        plan = self.p.plan
        self.delta = self.p.delta(first.u, mi.Bool(True), self.colours) * first.weight
        stack = StackState.empty(AttachedCameraFrame.blank(plan), self.ring, mi.Float(1))
        return AttachedCameraState(stack, Before.start(plan), [] if self.p.block is None else [mi.Spectrum(0)])

    def goes_on(self, state: AttachedCameraState, vertex: Vertex) -> mi.Bool:
        return self.ring.takes(state.stack.count)

    def vertex(
        self, state: AttachedCameraState, vertex: Vertex, met: MetLight | None, event: NextEvent | None,
        scattering: Scattering,
    ) -> AttachedCameraState:  # fmt: skip
        plan, P = self.p.plan, vertex.product.value()
        found, contributes = [], mi.Bool(False)
        if met is not None:
            found.append(dr.select(met.active, P * met.Le * met.weight, 0))
            contributes |= met.active
        if event is not None:
            found.append(dr.select(event.active, P * event.c, 0))
            contributes |= event.active
        L = [sum(found, own) for own in state.L]
        on_surface = vertex.active & vertex.si.is_valid()
        useful = mi.Bool(True) if concerns_emission(plan) else on_surface & begins(plan, vertex)
        here = vertex.active & ((state.stack.count > 0) | useful)
        frame = AttachedCameraFrame(
            point=SurfacePoint.of(plan, vertex),
            sample_1=scattering.sample_1,
            sample_2=scattering.sample_2,
            prefix=self.delta * P,
            roulette=state.stack.T,
            met=[] if met is None else [dr.select(met.active, met.weight, 0)],
            scale=[] if event is None else [dr.select(event.active, event.scale, 0)],
            place=[] if event is None else [event.sample],
            leaves=[dr.select(on_surface, mi.UInt32(0), 1)] if plan.needs.environment is not None else [],
            before=state.before,
        )
        stack = state.stack.push(frame, self.ring, here, contributes)
        return AttachedCameraState(stack, Before.of(plan, vertex, scattering), L)

    def survived(self, state: AttachedCameraState, factor: mi.Float) -> AttachedCameraState:
        return AttachedCameraState(state.stack.with_factor(factor), state.before, state.L)
