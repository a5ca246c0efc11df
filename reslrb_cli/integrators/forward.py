"""Forward mode: hooks of walks that add the derivative of the image along the parameters' tangents.

`TangentSplat` computes the derivative from light paths, and `CameraTangents` from camera paths. They store no data of a
path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.estimators.attached import Before, segment_again
from reslrb_cli.transport.bsdf import Scattering, evaluate, tracked_factor
from reslrb_cli.transport.camera import CameraHooks, FilmRay, MetLight, NextEvent, camera_walk
from reslrb_cli.transport.connection import Connection, before_lamps, passage
from reslrb_cli.transport.emission import primary_ray, sample_emission, visible_tangent
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.lamp_light import small_splat
from reslrb_cli.transport.masks import forward_derivatives, transmittance
from reslrb_cli.transport.samples import Numbers, Samples, in_passes
from reslrb_cli.transport.walk import Hooks, Vertex, walk


@dataclass
class Tangent:
    """Derivatives along the parameters' tangents.

    The state holds the derivative (C,) of the factor product so far. If light moves, the state also has the derivatives
    of the ray's origin and direction. `before` is the previous vertex if vertices stay at their places.
    """

    d_product: mi.Spectrum
    d_ray: list[mi.Vector3f]
    before: list[Before]


class TangentSplat(Hooks):
    """Hooks that splat the derivative of every connection along the parameters' tangents. `dE` is the derivative of
    emission.

    The product rule along the path needs no division.

        d(P s) = dP s + P ds,   dC = dP c + P dc,   d(k_p(u) C) = dk_p/du du C + k_p dC

    k_p is the filter's weight of pixel p. If light does not move, du is 0.
    """

    connects = False  # they evaluate connections themselves, including derivatives

    def __init__(self, samples: Samples, block: mi.ImageBlock, dE: mi.Spectrum) -> None:
        self.samples, self.block, self.dE = samples, block, dE

    def start(self, product: Product) -> Tangent:
        plan = self.samples.plan
        d_ray = [mi.Vector3f(0), mi.Vector3f(0)] if plan.attached else []
        return Tangent(mi.Spectrum(self.dE), d_ray, Before.start(plan))

    def survived(self, state: Tangent, factor: mi.Float) -> Tangent:
        return replace(state, d_product=state.d_product * factor)

    def vertex(
        self, state: Tangent, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Tangent:  # fmt: skip
        s, P, dP, plan = self.samples, vertex.product.value(), state.d_product, self.samples.plan
        if plan.attached:
            return self._attached(state, vertex, connection, scattering)
        seen, through, d_through = tangent_of_passage(s, vertex, connection)
        with dr.resume_grad(when=plan.differentiate_bsdfs):
            # Two indirect calls: Dr.Jit cannot forward-propagate through one of our own calls (`tracked_factors`) with
            # several parameters.
            f_c = evaluate(plan, vertex.si, vertex.bsdf, connection.wo, seen)
            f_s = tracked_factor(plan, vertex.si, vertex.bsdf, scattering, scattering.active)
            df_c, df_s = forward_derivatives(f_c, f_s)
            f_c = dr.detach(f_c)
        c = f_c * through * connection.rest
        dc = (df_c * through + f_c * d_through) * connection.rest
        s.film.put(self.block, connection.u, (dP * c + P * dc) * s.scale, seen, self.colours)
        return replace(state, d_product=dP * scattering.s + P * tangent_of_scattering(scattering, df_s))

    def _attached(self, state: Tangent, vertex: Vertex, connection: Connection, scattering: Scattering) -> Tangent:
        """Return the tangent after a vertex, for moving light.

        The tangents of the segment's ray are known. One propagation computes the derivatives with respect to the ray
        and to the scene's parameters together.
        """
        s, P, dP, scattered = self.samples, vertex.product.value(), state.d_product, scattering.active
        plan = s.plan
        seen, _ = passage(plan, s.scene, vertex.si, vertex.depth, connection)
        drawn = Numbers(scattering.sample_2, scattering.sample_1, connection.sample)
        with dr.resume_grad():
            ray = mi.Ray3f(vertex.ray)
            ray.o, ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
            dr.enable_grad(ray.o, ray.d)
            d_origin, d_direction = state.d_ray
            dr.set_grad(ray.o, mi.Point3f(d_origin))
            dr.set_grad(ray.d, d_direction)
            this, reached = segment_again(s, state.before, ray, vertex.pi, drawn, seen, scattered)
            following = this.next_ray(attached=True)
            taps, total = s.film.taps(this.connection.u, plan.attached_normalization)
            taps = [(pixel, k * dr.select(total != 0, dr.rcp(total), 0)) for pixel, k in taps]
            # `select` makes new variables: no other output depends on them, so clearing them on the way is harmless.
            there, sampled = this.connection, this.scattering
            c, weight = reached * there.f * there.rest, reached * sampled.s
            outputs = [dr.select(seen, c, 0)]
            outputs += [dr.select(scattered, value, 0) for value in (weight, following.o, following.d)]
            dc, ds, d_origin, d_direction, *d_weights = forward_derivatives(*outputs, *(k for _, k in taps))
        c, weight = dr.detach(c), dr.detach(weight)
        C, dC = P * c * s.scale, (dP * c + P * dc) * s.scale
        for (pixel, k), dk in zip(taps, d_weights, strict=True):
            s.film.add(self.block, pixel, dr.detach(k) * dC + dk * C, seen, self.colours)
        d_product = dr.select(scattered, dP * weight + P * ds, 0)
        return Tangent(d_product, [mi.Vector3f(d_origin), d_direction], Before.of(plan, vertex, sampled))


@dataclass
class CameraTangent:
    """Derivatives (C,) of the factor product so far and of the radiance, along the parameters' tangents."""

    d_product: mi.Spectrum
    d_radiance: mi.Spectrum


class CameraTangents(CameraHooks):
    """Hooks for camera paths with the product rule of `TangentSplat`. They sum the radiance."""

    def __init__(self, samples: Samples) -> None:
        self.samples = samples

    def start(self, first: FilmRay) -> CameraTangent:
        return CameraTangent(mi.Spectrum(0), mi.Spectrum(0))

    def survived(self, state: CameraTangent, factor: mi.Float) -> CameraTangent:
        return replace(state, d_product=state.d_product * factor)

    def vertex(
        self, state: CameraTangent, vertex: Vertex, met: MetLight | None, event: NextEvent | None,
        scattering: Scattering,
    ) -> CameraTangent:  # fmt: skip
        s, P, dP, dL = self.samples, vertex.product.value(), state.d_product, state.d_radiance
        plan, si, bsdf, zero = s.plan, vertex.si, vertex.bsdf, mi.Spectrum(0)
        through, d_through = mi.Spectrum(1), zero
        if event is not None and plan.needs.has_null:
            _, through, d_through = tangent_of_passage(s, vertex, event)
        with dr.resume_grad():
            f_s = tracked_factor(plan, si, bsdf, scattering, scattering.active)
            Le_h = zero if met is None else met.radiance()
            f_c = zero if event is None else evaluate(plan, si, bsdf, event.wo, event.active)
            Le_n = zero if event is None else event.radiance(si, s)
            df_s, dLe_h, df_c, dLe_n = forward_derivatives(f_s, Le_h, f_c, Le_n)
        if met is not None:
            dL = dL + dr.select(met.active, (dP * met.Le + P * dLe_h) * met.weight, 0)
        if event is not None:
            assert event.f is not None
            f_c, Le = event.f, event.Le
            c = f_c * Le * through
            dc = (df_c * Le + f_c * dLe_n) * through + f_c * Le * d_through
            dL = dL + dr.select(event.active, (dP * c + P * dc) * event.scale, 0)
        return CameraTangent(dP * scattering.s + P * tangent_of_scattering(scattering, df_s), dL)


def tangent_of_passage(
    samples: Samples, vertex: Vertex, connection: Connection
) -> tuple[mi.Bool, mi.Spectrum, mi.Spectrum]:
    """For a connection, return the target's visibility, the transmittance (C,) of the masks before the target, and the
    transmittance's derivative.
    """
    plan = samples.plan
    if not plan.needs.has_null:
        return *passage(plan, samples.scene, vertex.si, vertex.depth, connection), mi.Spectrum(0)
    active = before_lamps(plan, samples.scene, vertex.si, connection.active)
    passed = transmittance(plan, samples.scene, vertex.si, vertex.depth, connection.target, active, tangents=True)
    return passed.reached, passed.value, passed.tangent[0]


def tangent_of_scattering(scattering: Scattering, df: mi.Spectrum) -> mi.Spectrum:
    """Return the derivative (C,) of an event's factor. `df` is the derivative of the event's f."""
    return dr.select(scattering.active, df * (scattering.correction / scattering.pdf), 0)


def tangent_of(parts: list[Samples]) -> mi.TensorXf:
    """Return the derivative (H, W, C) of the image of all passes. Raises UnsupportedScene if emitters move, or if the
    derivative includes edges.
    """
    if parts[0].plan.has_edges:
        raise UnsupportedScene("forward mode has no derivatives of edges; use reverse mode, or edges: off", "edges")
    if parts[0].plan.attached and parts[0].plan.paths != "light":
        raise UnsupportedScene("forward mode has no derivatives of moving shapes for camera paths; use paths: light")
    if parts[0].plan.moving_emission:
        raise UnsupportedScene("forward mode has no derivatives of moving emitters; use reverse mode")
    film = parts[0].film
    block = film.block()
    in_passes(parts, splat_tangents, block)
    return film.develop(block, tangent=True)


def splat_tangents(samples: Samples, block: mi.ImageBlock) -> None:
    """Add the forward-mode derivative of the samples' contributions to the block. The derivative is exact and needs one
    traversal.
    """
    plan, dE = samples.plan, mi.Spectrum(0)
    with dr.resume_grad():
        if plan.differentiate_emission and not plan.camera:
            E = sample_emission(samples, samples.sampler()).E
            [dE] = forward_derivatives(E)
        if plan.visible_emission and plan.paths == "light" and (plan.differentiate_emission or plan.differentiate_null):
            ray, u, weight, colours = primary_ray(samples)
            tangent = visible_tangent(samples, ray)
            samples.film.put(block, u, tangent * weight * samples.fraction, mi.Bool(True), colours)
        if plan.small_lamps and plan.differentiate_emission:
            u, C, active, colours = small_splat(samples)
            [tangent] = forward_derivatives(C)
            samples.film.put(block, u, tangent, active, colours)
    for side in samples.sides():
        if side.plan.camera:
            hooks = CameraTangents(side)
            first, state = camera_walk(side, hooks)
            side.film.put(block, first.u, state.d_radiance * first.weight, mi.Bool(True), hooks.colours)
        else:
            walk(side, TangentSplat(side, block, dE))
