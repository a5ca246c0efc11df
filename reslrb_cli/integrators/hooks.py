"""Hooks of walks that keep nothing of a path: the image alone, its forward-mode derivative, and naive AD."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.connection import Connection, connection_factor
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.scattering import Scattering, attached_factor
from reslrb_cli.transport.walk import Hooks, Vertex

if TYPE_CHECKING:
    from reslrb_cli.integrators.light_tracer import Samples


class Splat(Hooks):
    """Splat every connection."""

    def __init__(self, samples: Samples, block: Any) -> None:
        self.samples, self.block = samples, block

    def connection(self, state: Any, vertex: Vertex, connection: Connection, numbers: list[Any]) -> Any:
        s = self.samples
        mode = "evaluated" if self.attached else "symbolic"
        c, active = connection_factor(s.plan, s.scene, vertex, connection, mode)
        C = vertex.product.times(c, vertex.depth).scaled(s.scale)
        s.film.put(self.block, connection.u, C.value(), active)
        return state


class AttachedSplat(Splat):
    """Splat every connection, derivatives attached (walk_ad)."""

    attached = True


@dataclass
class Tangent:
    """Derivative of the product of the factors so far, (C,)."""

    d_product: Any


class TangentSplat(Hooks):
    """Splat the derivative of every connection in the direction of the parameters' tangents.

    By the product rule along the path, d(P s) = dP s + P ds and dC_i = dP c_i + P dc_i: nothing is divided, so that
    zero factors need no care.
    """

    def __init__(self, samples: Samples, block: Any, dE: Any) -> None:
        self.samples, self.block, self.dE = samples, block, dE

    def start(self, product: Product) -> Tangent:
        return Tangent(mi.Spectrum(self.dE))

    def connection(self, state: Tangent, vertex: Vertex, connection: Connection, numbers: list[Any]) -> Tangent:
        s = self.samples
        with dr.resume_grad():
            c, active = connection_factor(s.plan, s.scene, vertex, connection)
            dc = dr.detach(dr.forward_to(c)) if s.plan.differentiate_bsdfs else mi.Spectrum(0)
        dC = state.d_product * dr.detach(c) + vertex.product.value() * dc
        s.film.put(self.block, connection.u, dC * s.scale, active)
        return state

    def scattering(self, state: Tangent, vertex: Vertex, connection: Connection, scattering: Scattering) -> Tangent:
        s, d_product = self.samples, state.d_product * scattering.weight
        if s.plan.differentiate_bsdfs:
            active = scattering.active
            with dr.resume_grad():
                f = attached_factor(s.plan, vertex.si, vertex.bsdf, scattering.wo, scattering, active)
                df = dr.detach(dr.forward_to(f))
            ds = dr.select(active, df * (scattering.correction / scattering.pdf), 0)
            d_product += vertex.product.value() * ds
        return Tangent(d_product)
