"""Forward mode where light moves: the derivative of every connection and of where it lands, splatted as it is found."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.staying import Before, reach
from reslrb_cli.transport.connection import Connection, passage
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.hooks import Hooks, Vertex
from reslrb_cli.transport.numbers import Numbers
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.scattering import Scattering
from reslrb_cli.transport.segment import segment
from reslrb_cli.transport.transmittance import forward_derivatives


@dataclass
class AttachedTangent:
    """Derivatives along the parameters' tangents: of the product of the factors so far, (C,), and of the ray."""

    d_product: mi.Spectrum
    d_origin: mi.Vector3f
    d_direction: mi.Vector3f
    before: list[Before]


class AttachedTangentSplat(Hooks):
    """As `TangentSplat`, with rays, hit points and film positions that move:

    d(k_p(u) C) = dk_p/du du C + k_p dC,   dC = dP c + P dc         k_p: the filter's weight of pixel p

    A segment's derivatives are those by its ray, whose tangents are at hand, and by the scene's parameters, in one
    propagation.
    """

    connects = False  # it evaluates them itself, with their derivatives

    def __init__(self, samples: Samples, block: mi.ImageBlock, dE: mi.Spectrum) -> None:
        self.samples, self.block, self.dE = samples, block, dE

    def start(self, product: Product) -> AttachedTangent:
        before = Before.start(self.samples.plan)
        return AttachedTangent(mi.Spectrum(self.dE), mi.Vector3f(0), mi.Vector3f(0), before)

    def scattering(
        self, state: AttachedTangent, vertex: Vertex, connection: Connection, scattering: Scattering
    ) -> AttachedTangent:
        s, P, scattered = self.samples, vertex.product.value(), scattering.active
        plan = s.plan
        seen, _ = passage(plan, s.scene, vertex.si, vertex.depth, connection)
        numbers = Numbers(connection.sample, scattering.sample_2, scattering.sample_1)
        with dr.resume_grad():
            ray = mi.Ray3f(vertex.ray)
            ray.o, ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
            dr.enable_grad(ray.o, ray.d)
            dr.set_grad(ray.o, mi.Point3f(state.d_origin))
            dr.set_grad(ray.d, state.d_direction)
            si, bsdf, reaching, reached = reach(plan, state.before, ray, vertex.pi, seen | scattered)
            this = segment(plan, s.sensor, reaching, si, bsdf, numbers, seen, scattered, attached=True)
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

    def survived(self, state: AttachedTangent, weight: mi.Float) -> AttachedTangent:
        return AttachedTangent(state.d_product * weight, state.d_origin, state.d_direction, state.before)
