"""Camera paths: their image, and its derivative in one traversal, for a film whose dL/dI is known.

All light that a camera path finds arrives at one place of the film, so that delta is one number a channel, known before
the path is traced. As in `stack.py`, vertices are pushed, and the path is walked back:

    A_k = 0,   A_{j-1} = A_j + delta (N_j + H_j)
    dS  = sum_j [ A_j ds_j/s_j + delta dN_j + delta dH_j ]

with N_j the contribution of vertex j's next event, and H_j of the light that is met there. What the last factors of
both change, the BSDF towards the emitter and the radiance, hangs on nothing that comes later, and is differentiated on
the way out, without a division. The weights of the ways to find a path have no derivative.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import (
    STACK_SIZE,
    Pass,
    PathAdjoint,
    allocate,
    differentiate_passage,
    entry_bytes,
    places,
    vertices,
)
from reslrb_cli.estimators.kept import AdjointSum, PlainSum
from reslrb_cli.estimators.stack import Frame, Pushed, push, walk_back
from reslrb_cli.transport.bsdf import Scattering, evaluate, tracked_factor, tracked_factors
from reslrb_cli.transport.camera import CameraHooks, FilmRay, Met, NextEvent, camera_walk
from reslrb_cli.transport.connection import forward_derivatives, transmittance
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Vertex

#: No light may reach what is differentiated.
_MAY_LACK = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad


class Radiance(CameraHooks):
    """What arrives along each path, (C,)."""

    def start(self, first: FilmRay) -> mi.Spectrum:
        return mi.Spectrum(0)

    def vertex(
        self, state: mi.Spectrum, vertex: Vertex, met: Met | None, event: NextEvent | None, scattering: Scattering
    ) -> mi.Spectrum:  # fmt: skip
        P = vertex.product.value()
        if met is not None:
            state = state + P * (met.radiance() if self.tracked else met.Le) * met.weight
        if event is not None:
            state = state + P * event.c
        return state


class TrackedRadiance(Radiance):
    """The same with derivatives of all factors, for naive AD."""

    tracked = True


def splat_camera_paths(samples: Samples, block: mi.ImageBlock, tracked: bool = False) -> None:
    """Add the image of camera paths to the block."""
    first, L = camera_walk(samples, TrackedRadiance() if tracked else Radiance())
    samples.film.put(block, first.u, L * first.weight, first.active)


@dataclass
class Kept:
    """Loop state of the way out: what is pushed, and the radiance so far, (C,), where there is an image."""

    pushed: Pushed
    L: list[mi.Spectrum]


class Differentiating(CameraHooks):
    """Differentiates what each vertex finds; `delta` (C,) is set at the start."""

    def __init__(self, p: Pass) -> None:
        self.p = p
        self.delta = mi.Spectrum(0)

    def start(self, first: FilmRay) -> Any:
        self.delta = self.p.delta(first.u, first.active) * first.weight
        return []

    def found(self, vertex: Vertex, met: Met | None, event: NextEvent | None) -> list[tuple[Product, mi.Bool]]:
        """The contributions of a vertex, and where there are any."""
        result, P, depth = [], vertex.product, vertex.depth
        if met is not None:
            result.append((P.times(met.Le * met.weight, depth), met.active))
        if event is not None:
            result.append((P.times(event.c, depth), event.active))
        return result


class Pushing(Differentiating):
    """The way out: sum up the image, differentiate what is found, and push vertices."""

    def __init__(self, p: Pass, stack_size: int) -> None:
        super().__init__(p)
        self.size = places(p.plan, stack_size)

    def start(self, first: FilmRay) -> Kept:
        super().start(first)
        plan = self.p.plan
        form = Frame.blank(plan)
        stack = allocate(form, self.size) if plan.differentiate_bsdfs else []
        since, tail = PlainSum.zero(plan.track_zeros), AdjointSum.zero(plan.track_zeros)
        pushed = Pushed(stack, mi.UInt32(0), since, tail, mi.UInt32(0), mi.UInt32(0))
        return Kept(pushed, [] if self.p.block is None else [mi.Spectrum(0)])

    def vertex(
        self, state: Kept, vertex: Vertex, met: Met | None, event: NextEvent | None, scattering: Scattering
    ) -> Kept:  # fmt: skip
        p, plan, P = self.p, self.p.plan, vertex.product.value()
        found = self.found(vertex, met, event)
        L = [sum((dr.select(active, C.value(), 0) for C, active in found), own) for own in state.L]
        if plan.differentiate_emission and found:
            self._differentiate_emission(vertex, met, event)
        weight_c, wo_c = mi.Spectrum(0), mi.Vector3f(0)
        if event is not None:
            through = event.through
            if plan.differentiate_null:
                C = found[-1][0]
                adjoint = PathAdjoint(dr.select(event.active, self.delta * C.nonzero, 0), C)
                through = differentiate_passage(p, vertex.si, vertex.depth, event, event.active, adjoint)
            weight_c = dr.select(event.active, self.delta * P * event.weight * through, 0)
            wo_c = event.wo
        if not plan.differentiate_bsdfs:
            return Kept(state.pushed, L)
        useful = vertex.active & vertex.si.is_valid() & plan.differentiates(vertex.bsdf)
        sums = [(self.delta, C, active) for C, active in found]
        pushed = push(plan, state.pushed, self.size, vertex, useful, wo_c, weight_c, scattering, sums)
        return Kept(pushed, L)

    def _differentiate_emission(self, vertex: Vertex, met: Met | None, event: NextEvent | None) -> None:
        """Add the derivatives by the radiance that a vertex finds."""
        weight = self.delta * vertex.product.value()
        with dr.resume_grad():
            objective = mi.Spectrum(0)
            if met is not None:
                objective += dr.select(met.active, weight * met.weight * met.radiance(), 0)
            if event is not None:
                assert event.f is not None
                towards = dr.detach(event.f * event.through * event.scale)
                radiance = event.radiance(self.p.samples.scene, vertex.si)
                objective += dr.select(event.active, weight * towards * radiance, 0)
            dr.backward_from(objective, flags=_MAY_LACK)


class Taking(Differentiating):
    """A second walk along paths that the stack had no room for: `S` sums what vertices find from `first` to `last`, and
    is taken apart again."""

    def __init__(self, p: Pass, S: AdjointSum, first: mi.UInt32, last: mi.UInt32) -> None:
        super().__init__(p)
        self.S, self.first, self.last = S, first, last

    def start(self, first: FilmRay) -> AdjointSum:
        super().start(first)
        return self.S

    def goes_on(self, state: AdjointSum, vertex: Vertex) -> mi.Bool:
        return vertex.depth < self.last

    def vertex(
        self, state: AdjointSum, vertex: Vertex, met: Met | None, event: NextEvent | None, scattering: Scattering
    ) -> AdjointSum:  # fmt: skip
        plan, beyond = self.p.plan, vertex.depth >= self.first
        S = state
        for C, active in self.found(vertex, met, event):
            S = S.minus(self.delta, C, vertex.depth, active & beyond)
        useful = beyond & vertex.active & vertex.si.is_valid() & plan.differentiates(vertex.bsdf)
        rest = scattering.correction / scattering.pdf
        weight_s = S.adjoint_of_factor(scattering.f, vertex.product, rest)
        scattered, connected = scattering.active & useful, mi.Bool(False)
        weight_c, wo = mi.Spectrum(0), mi.Vector3f(0)
        if event is not None:
            connected, wo = event.active & useful, event.wo
            weight_c = self.delta * vertex.product.value() * event.weight * event.through
        with dr.resume_grad():
            f_c, f_s = tracked_factors(plan, vertex.si, vertex.bsdf, wo, connected, scattering, scattered)
            dr.backward_from(dr.select(connected, weight_c * f_c, 0) + dr.select(scattered, weight_s * f_s, 0))
        return S


def differentiate_camera_paths(p: Pass, stack_size: int = STACK_SIZE) -> None:
    """Add the derivatives of the camera paths of a pass, whose dL/dI is known, and their image to its block, if any."""
    plan = p.plan
    first, kept = camera_walk(p.samples, Pushing(p, stack_size))
    if p.block is not None:
        p.samples.film.put(p.block, first.u, kept.L[0] * first.weight, first.active)
    if not plan.differentiate_bsdfs:
        return
    pushed = kept.pushed
    walk_back(p, pushed)
    if vertices(plan) > places(plan, stack_size):
        beyond = (pushed.first > 0) & (pushed.first <= pushed.last)
        camera_walk(p.samples, Taking(p, pushed.tail, pushed.first, pushed.last), beyond)


def camera_scratch_bytes(plan: Plan, stack_size: int = STACK_SIZE) -> int:
    """Thread-local bytes of each camera path that is being traced."""
    if not plan.differentiate_bsdfs:
        return 0
    return sum(entry_bytes(Frame.blank(plan))) * (places(plan, stack_size) + 1)


@dataclass
class Tangent:
    """Derivatives along the parameters' tangents: of the product of the factors so far, and of the radiance, (C,)."""

    d_product: mi.Spectrum
    d_radiance: mi.Spectrum


class Tangents(CameraHooks):
    """Forward mode, by the product rule along the path: nothing is divided."""

    def __init__(self, samples: Samples) -> None:
        self.samples = samples

    def start(self, first: FilmRay) -> Tangent:
        return Tangent(mi.Spectrum(0), mi.Spectrum(0))

    def survived(self, state: Tangent, weight: mi.Float) -> Tangent:
        return replace(state, d_product=state.d_product * weight)

    def vertex(
        self, state: Tangent, vertex: Vertex, met: Met | None, event: NextEvent | None, scattering: Scattering
    ) -> Tangent:  # fmt: skip
        s, plan, P, dP, dL = self.samples, self.samples.plan, vertex.product.value(), state.d_product, state.d_radiance
        si, bsdf, zero = vertex.si, vertex.bsdf, mi.Spectrum(0)
        through, d_through = mi.Spectrum(1), zero
        if event is not None and plan.needs.has_null:
            limit = plan.max_depth - vertex.depth - 1
            passed = transmittance(s.scene, si, event.target, limit, event.active, tangents=True)
            through, d_through = passed.value, passed.tangent[0]
        with dr.resume_grad():
            f_s = tracked_factor(plan, si, bsdf, scattering, scattering.active)
            Le_h = zero if met is None else met.radiance()
            f_c = zero if event is None else evaluate(plan, si, bsdf, event.wo, event.active)
            Le_n = zero if event is None else event.radiance(s.scene, si)
            df_s, dLe_h, df_c, dLe_n = forward_derivatives(f_s, Le_h, f_c, Le_n)
        if met is not None:
            dL = dL + dr.select(met.active, (dP * met.Le + P * dLe_h) * met.weight, 0)
        if event is not None:
            assert event.f is not None
            f_c, Le = event.f, event.Le
            c = f_c * Le * through
            dc = (df_c * Le + f_c * dLe_n) * through + f_c * Le * d_through
            dL = dL + dr.select(event.active, (dP * c + P * dc) * event.scale, 0)
        ds = dr.select(scattering.active, df_s * (scattering.correction / scattering.pdf), 0)
        return Tangent(dP * scattering.weight + P * ds, dL)


def splat_camera_tangents(samples: Samples, block: mi.ImageBlock) -> None:
    """Add the forward-mode derivative of the image of camera paths to the block."""
    first, state = camera_walk(samples, Tangents(samples))
    samples.film.put(block, first.u, state.d_radiance * first.weight, first.active)
