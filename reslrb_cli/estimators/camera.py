"""Camera paths: the image, and the image's derivative in one traversal. dL/dI of the film must be known.

All light of a camera path arrives at one place of the film. Therefore delta is one number per channel, which is known
before the path is traced. The walk back works as in `stack.py`. Here, c_j is the contribution of next event estimation
at vertex j. The emission of a hit emitter does not depend on the BSDF at the hit point. The emission therefore belongs
to the earlier vertices.

The radiance of an emitter is the last factor of a contribution. The derivative with respect to an emitter's radiance
needs no later data. The forward pass therefore adds this derivative. The weights of combined paths have no derivative.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import Adjoint
from reslrb_cli.estimators.attached_camera import AttachedCameraFrame, AttachedCameraSweep
from reslrb_cli.estimators.base import STACK_SIZE, Pass, PathAdjoint, differentiate_passage
from reslrb_cli.estimators.stack import Frame, Ring, StackState, pass_vertex, walk_back
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.camera import CameraHooks, FilmRay, MetLight, NextEvent, camera_walk
from reslrb_cli.transport.factors import MAY_LACK
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Vertex


class Radiance(CameraHooks):
    """Radiance (C,) that arrives along each path. If `tracked`, all factors have derivatives, for naive AD."""

    def __init__(self, tracked: bool) -> None:
        self.tracked = tracked

    def start(self, first: FilmRay) -> mi.Spectrum:
        return mi.Spectrum(0)

    def vertex(
        self, state: mi.Spectrum, vertex: Vertex, met: MetLight | None, event: NextEvent | None, scattering: Scattering
    ) -> mi.Spectrum:  # fmt: skip
        P = vertex.product.value()
        if met is not None:
            state = state + P * (met.radiance() if self.tracked else met.Le) * met.weight
        if event is not None:
            state = state + P * event.c
        return state


def splat_camera_paths(samples: Samples, block: mi.ImageBlock, tracked: bool = False) -> None:
    """Add the image of camera paths to the block."""
    hooks = Radiance(tracked)
    first, L = camera_walk(samples, hooks)
    samples.film.put(block, first.u, L * first.weight, mi.Bool(True), hooks.colours)


@dataclass
class CameraState:
    """Loop state of the forward pass: the stack and, if there is an image, the radiance so far (C,)."""

    stack: StackState
    L: list[mi.Spectrum]


class CameraSweep(CameraHooks):
    """Forward pass of camera paths. The pass sums the image, differentiates radiances, and pushes vertices. If the ring
    has an `end`, the pass only pushes vertices.
    """

    def __init__(self, p: Pass, ring: Ring) -> None:
        self.p, self.ring = p, ring
        self.delta = mi.Spectrum(0)  # assigned at the start

    def start(self, first: FilmRay) -> CameraState:
        self.delta = self.p.delta(first.u, mi.Bool(True), self.colours) * first.weight
        stack = Frame.empty_stack(self.p.plan, self.ring)
        return CameraState(stack, [] if self.p.block is None else [mi.Spectrum(0)])

    def goes_on(self, state: CameraState, vertex: Vertex) -> mi.Bool:
        return self.ring.takes(state.stack.count)

    def vertex(
        self, state: CameraState, vertex: Vertex, met: MetLight | None, event: NextEvent | None, scattering: Scattering
    ) -> CameraState:  # fmt: skip
        plan, P, depth = self.p.plan, vertex.product, vertex.depth
        found = [] if met is None else [(P.times(met.Le * met.weight, depth), met.active)]
        found += [] if event is None else [(P.times(event.c, depth), event.active)]
        L = [sum((dr.select(active, C.value(), 0) for C, active in found), own) for own in state.L]
        if self.ring.end is None and plan.differentiate_emission and found:
            self._differentiate_emission(vertex, met, event)
        if self.ring.end is None and plan.differentiate_null and event is not None:
            C, active = found[-1]
            adjoint = PathAdjoint(dr.select(active, self.delta * C.nonzero, 0), C)
            differentiate_passage(self.p, vertex.si, depth, event, active, adjoint)
        if not plan.differentiate_bsdfs:
            return CameraState(state.stack, L)
        stack, delta_r = state.stack, mi.Spectrum(0)
        if met is not None:
            stack = stack.with_contribution(self.delta * met.Le * met.weight, met.active)
        if event is not None:
            delta_r = dr.select(event.active, self.delta * event.rest * event.through, 0)
        here = vertex.active & vertex.si.is_valid() & (depth < plan.max_depth) & plan.differentiates(vertex.bsdf)
        return CameraState(pass_vertex(plan, stack, self.ring, here, vertex, scattering, event, delta_r), L)

    def survived(self, state: CameraState, factor: mi.Float) -> CameraState:
        return CameraState(state.stack.with_factor(factor), state.L)

    def _differentiate_emission(self, vertex: Vertex, met: MetLight | None, event: NextEvent | None) -> None:
        """Add the derivatives at a vertex with respect to the radiance of emitters."""
        weight = self.delta * vertex.product.value()
        with dr.resume_grad():
            objective = mi.Spectrum(0)
            if met is not None:
                objective += dr.select(met.active, weight * met.weight * met.radiance(), 0)
            if event is not None:
                assert event.f is not None
                towards = dr.detach(event.f * event.through * event.scale)
                radiance = event.radiance(vertex.si)
                objective += dr.select(event.active, weight * towards * radiance, 0)
            dr.backward_from(objective, flags=MAY_LACK)


def differentiate_camera_paths(p: Pass, stack_size: int = STACK_SIZE) -> None:
    """Add the derivatives of a pass's camera paths with known dL/dI, and splat their image if there is one."""
    attached = p.plan.attached
    form = (AttachedCameraFrame if attached else Frame).blank(p.plan)
    sweep = AttachedCameraSweep if attached else CameraSweep
    ring, again = Ring.of(p.plan, stack_size, last=int(attached)), Pass(p.samples, None, p.adjoint)
    hooks = sweep(p, ring)
    first, state = camera_walk(p.samples, hooks)
    if p.block is not None:
        p.splat(first.u, state.L[0] * first.weight, mi.Bool(True), hooks.colours)

    def retrace(ring: Ring) -> StackState:
        return camera_walk(p.samples, sweep(again, ring), ring.takes(mi.UInt32(0)))[1].stack

    walk_back(p.along(hooks), form, ring, state.stack, Adjoint.none() if attached else state.stack.D, retrace)
