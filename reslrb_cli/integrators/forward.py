"""Forward mode and naive AD: hooks of walks that keep nothing of a path.

- `TrackedSplat`, `RecordedObjective`: the image, or the objective, with derivatives tracked (naive AD, and Dr.Jit's own
  reversal).
- `TangentSplat`: the image's forward-mode derivative.
- `AttachedTangentSplat`: the same where light moves: the derivative of every connection and of where it lands, splatted
  as it is found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.camera import splat_camera_paths
from reslrb_cli.estimators.kept import Before, segment_again
from reslrb_cli.transport.bsdf import Scattering, evaluate, tracked_factor
from reslrb_cli.transport.connection import Connection, forward_derivatives, passage, transmittance
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.film import AdjointImage
from reslrb_cli.transport.samples import Numbers, Samples
from reslrb_cli.transport.visible import (
    differentiate_visible_emission,
    moving_splats,
    primary_ray,
    small_splat,
    splat_visible_emission,
    visible_tangent,
)
from reslrb_cli.transport.walk import Hooks, Splat, Vertex, walk


class TrackedSplat(Splat):
    """Splat every connection, derivatives of its factors tracked, and those of rays and film positions if `attached`
    (walk_ad)."""

    tracked = True

    def __init__(self, samples: Samples, block: mi.ImageBlock, attached: bool) -> None:
        super().__init__(samples, block)
        self.attached = attached


class RecordedObjective(Hooks):
    """Sum each path's share of the objective, S = sum_i delta_i C_i, derivatives tracked (trajectory).

    A splat in a loop that is reversed would have no derivative: side effects are none of the loop's state.
    """

    tracked = True

    def __init__(self, samples: Samples, adjoint: AdjointImage) -> None:
        self.samples, self.adjoint = samples, adjoint
        self.max_iterations = max(samples.plan.max_depth - 1, 1)

    def start(self, product: Product) -> mi.Float:
        return mi.Float(0)

    def vertex(
        self, state: mi.Float, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> mi.Float:  # fmt: skip
        C = vertex.product.times(connection.c, vertex.depth).scaled(self.samples.scale).value()
        delta = self.adjoint.lookup(connection.u, connection.active)
        return state + dr.select(connection.active, dr.dot(delta, C), 0)


@dataclass
class Tangent:
    """Derivative of the product of the factors so far, (C,)."""

    d_product: mi.Spectrum


class Tangents(Hooks):
    """Splats of derivatives along the parameters' tangents; `dE` is that of emission."""

    connects = False  # they evaluate connections themselves, with their derivatives

    def __init__(self, samples: Samples, block: mi.ImageBlock, dE: mi.Spectrum) -> None:
        self.samples, self.block, self.dE = samples, block, dE

    def survived(self, state: Tangent, weight: mi.Float) -> Tangent:
        return replace(state, d_product=state.d_product * weight)


class TangentSplat(Tangents):
    """Splat the derivative of every connection in the direction of the parameters' tangents.

    By the product rule along the path, d(P s) = dP s + P ds and dC_i = dP c_i + P dc_i: nothing is divided, so that
    zero factors need no care.
    """

    def start(self, product: Product) -> Tangent:
        return Tangent(mi.Spectrum(self.dE))

    def vertex(
        self, state: Tangent, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Tangent:  # fmt: skip
        s, P, scattered = self.samples, vertex.product.value(), scattering.active
        if s.plan.needs.has_null:
            limit = s.plan.max_depth - vertex.depth - 1
            through = transmittance(
                s.scene, vertex.si, connection.target, limit, connection.active, tangents=True,
                past_lamps=s.plan.passes_lamps,
            )  # fmt: skip
            seen, passed, d_passed = through.reached, through.value, through.tangent[0]
        else:
            (seen, passed), d_passed = passage(s.plan, s.scene, vertex.si, vertex.depth, connection), mi.Spectrum(0)
        with dr.resume_grad(when=s.plan.differentiate_bsdfs):
            # Two indirect calls: Dr.Jit cannot forward-propagate through one of our own (`tracked_factors`) that reads
            # several parameters.
            f_c = evaluate(s.plan, vertex.si, vertex.bsdf, connection.wo, seen)
            f_s = tracked_factor(s.plan, vertex.si, vertex.bsdf, scattering, scattered)
            df_c, df = forward_derivatives(f_c, f_s)
            f_c = dr.detach(f_c)
        c = f_c * passed * connection.weight
        dc = (df_c * passed + f_c * d_passed) * connection.weight
        s.film.put(self.block, connection.u, (state.d_product * c + P * dc) * s.scale, seen)
        ds = dr.select(scattered, df * (scattering.correction / scattering.pdf), 0)
        return Tangent(state.d_product * scattering.weight + P * ds)


@dataclass
class AttachedTangent(Tangent):
    """Derivatives along the parameters' tangents: of the product of the factors so far, (C,), and of the ray."""

    d_origin: mi.Vector3f
    d_direction: mi.Vector3f
    before: list[Before]


class AttachedTangentSplat(Tangents):
    """As `TangentSplat`, with rays, hit points and film positions that move:

    d(k_p(u) C) = dk_p/du du C + k_p dC,   dC = dP c + P dc         k_p: the filter's weight of pixel p

    A segment's derivatives are those by its ray, whose tangents are at hand, and by the scene's parameters, in one
    propagation.
    """

    def start(self, product: Product) -> AttachedTangent:
        before = Before.start(self.samples.plan)
        return AttachedTangent(mi.Spectrum(self.dE), mi.Vector3f(0), mi.Vector3f(0), before)

    def vertex(
        self, state: AttachedTangent, vertex: Vertex, connection: Connection, scattering: Scattering,
        numbers: list[mi.Float],
    ) -> AttachedTangent:  # fmt: skip
        s, P, scattered = self.samples, vertex.product.value(), scattering.active
        plan = s.plan
        seen, _ = passage(plan, s.scene, vertex.si, vertex.depth, connection)
        drawn = Numbers(connection.sample, scattering.sample_2, scattering.sample_1)
        with dr.resume_grad():
            ray = mi.Ray3f(vertex.ray)
            ray.o, ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
            dr.enable_grad(ray.o, ray.d)
            dr.set_grad(ray.o, mi.Point3f(state.d_origin))
            dr.set_grad(ray.d, state.d_direction)
            this, reached = segment_again(s, state.before, ray, vertex.pi, drawn, seen, scattered)
            following, taps = this.next_ray(attached=True), s.film.taps(this.connection.u, plan.attached_normalization)
            # Selected: no other of these hangs on what that makes, which would be cleared on the way.
            connection, scattering = this.connection, this.scattering
            c, weight = reached * connection.f * connection.weight, reached * scattering.weight
            outputs = [dr.select(seen, c, 0)]
            outputs += [dr.select(scattered, value, 0) for value in (weight, following.o, following.d)]
            found = forward_derivatives(*outputs, *(k for _, k in taps))
        dc, ds, d_origin, d_direction, *d_weights = found
        c, weight = dr.detach(c), dr.detach(weight)
        C, dC = P * c * s.scale, (state.d_product * c + P * dc) * s.scale
        for (pixel, k), dk in zip(taps, d_weights, strict=True):
            s.film.add(self.block, pixel, dr.detach(k) * dC + dk * C, seen)
        d_product = dr.select(scattered, state.d_product * weight + P * ds, 0)
        return AttachedTangent(d_product, mi.Vector3f(d_origin), d_direction, Before.of(plan, vertex, scattering))


def reverse_recorded(samples: Samples, adjoint: AdjointImage) -> None:
    """Add the same derivatives by Dr.Jit's own reversal of the walk, which records the loop's state on the way."""
    differentiate_visible_emission(samples, adjoint)
    with dr.resume_grad():
        S = walk(samples, RecordedObjective(samples, adjoint))
        dr.backward_from(S, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)


def splat_tangents(samples: Samples, block: mi.ImageBlock) -> None:
    """Add the forward-mode derivative of the samples' contributions to the block, exactly and in one traversal."""
    plan, dE = samples.plan, mi.Spectrum(0)
    with dr.resume_grad():
        if plan.differentiate_emission and not plan.camera:
            E = sample_emission(samples, samples.sampler()).weight
            [dE] = forward_derivatives(E)
        if plan.visible_emission and plan.paths == "light" and (plan.differentiate_emission or plan.differentiate_null):
            primary = primary_ray(samples)
            tangent = visible_tangent(plan, samples.scene, primary)
            samples.film.put(block, primary.u, tangent * primary.weight * samples.fraction, primary.active)
        if plan.small_lamps and plan.differentiate_emission:
            u, C, active = small_splat(samples)
            [tangent] = forward_derivatives(C)
            samples.film.put(block, u, tangent, active)
    if plan.camera:
        return
    hooks = AttachedTangentSplat if plan.attached else TangentSplat
    walk(samples, hooks(samples, block, dE))


def splat_tracked(samples: Samples, block: mi.ImageBlock) -> None:
    """Add the contributions with derivatives tracked to the block: naive AD, its memory proportional to depth."""
    with dr.resume_grad():
        splat_visible_emission(samples, block, "evaluated")
        for u, C, active in moving_splats(samples):  # twice, so that the image stays as it is
            samples.film.put(block, u, C, active, samples.plan.attached_normalization)
            samples.film.put(block, dr.detach(u), -dr.detach(C), active)
        for side in samples.sides():
            if side.plan.camera:
                splat_camera_paths(side, block, tracked=True)
            else:
                walk(side, TrackedSplat(side, block, side.plan.attached))
