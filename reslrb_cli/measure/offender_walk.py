"""A walk that looks for the first value on each path that is not finite, and that reaches the image or a gradient."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.hooks import Hooks, Vertex
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.scattering import Scattering, evaluate
from reslrb_cli.transport.splat import Film
from reslrb_cli.transport.tracked import tracked_factor
from reslrb_cli.transport.transmittance import forward_derivatives

#: What may not be finite; `Suspect.kind` is the index.
QUANTITIES = (
    "nothing",
    "emission E",
    "derivative of emission, dE",
    "scattering weight s",
    "derivative of the scattering factor, ds",
    "product of the factors E s_1 ... s_j",
    "connection factor c",
    "derivative of the connection factor, dc",
    "contribution C = E s_1 ... s_{i-1} c_i",
)
_E, _DE, _S, _DS, _PRODUCT, _C, _DC, _CONTRIBUTION = range(1, len(QUANTITIES))


@dataclass
class Suspect:
    """A value (C,), its kind (0: none), and the vertex at which it stands."""

    kind: Any
    vertex: Any
    p: Any
    shape: Any
    value: Any

    @staticmethod
    def none() -> Suspect:
        """Nothing found."""
        return Suspect(mi.UInt32(0), mi.UInt32(0), mi.Point3f(0), mi.UInt32(0), mi.Spectrum(0))

    def otherwise(self, other: Suspect, active: Any) -> Suspect:
        """This, or where there is none, in `active` lanes, `other` if it is not finite."""
        take: Suspect = dr.select((self.kind == 0) & active & is_bad(other.value), other, self)
        return take


def is_bad(value: Any) -> Any:
    """Lanes in which a channel of `value` (C,) is not finite."""
    return ~dr.all(dr.isfinite(value))


def reaches(film: Film, u: Any, pixel: tuple[int, int] | None) -> Any:
    """Lanes whose film position `u` is within the filter's reach of `pixel`."""
    if pixel is None:
        return mi.Bool(False)
    centre = mi.Point2f(pixel[0] + 0.5, pixel[1] + 0.5)
    return dr.all(dr.abs(u - centre) <= film.film.rfilter().radius())


@dataclass
class Search:
    """Loop state.

    `first` is the first suspect of the path so far, and `found` the one that was first when a connection took it to
    film position `u`: the first such connection, or, where there is one, the first whose pixel is the wanted one
    (`there`). `largest` is the largest contribution (its `value`), which lands at `largest_u`.
    """

    first: Suspect
    found: Suspect
    u: Any
    there: Any
    largest: Suspect
    largest_u: Any


class SearchHooks(Hooks):
    """Looks at every factor that a connection passes on, at its derivative along the parameters' tangents, and at the
    product of them all."""

    def __init__(self, samples: Samples, emission: Any, derivative: Any, pixel: tuple[int, int] | None) -> None:
        """`emission` is a ray of each path, with E; `derivative` is dE (C,); `pixel` the one that is wanted, if any."""
        self.samples, self.emission, self.derivative, self.pixel = samples, emission, derivative, pixel

    def start(self, product: Product) -> Search:
        first = Suspect.none()
        for kind, value in ((_E, dr.detach(self.emission.weight)), (_DE, self.derivative)):
            here = Suspect(mi.UInt32(kind), mi.UInt32(0), self.emission.ray.o, mi.UInt32(0), mi.Spectrum(value))
            first = first.otherwise(here, mi.Bool(True))
        return Search(first, Suspect.none(), mi.Point2f(0), mi.Bool(False), Suspect.none(), mi.Point2f(0))

    def scattering(self, state: Search, vertex: Vertex, connection: Connection, scattering: Scattering) -> Search:
        plan, seen, scattered = self.samples.plan, connection.active, scattering.active
        shape = dr.reinterpret_array(mi.UInt32, vertex.si.shape)

        def here(kind: int, value: Any) -> Suspect:
            return Suspect(mi.UInt32(kind), vertex.depth, vertex.si.p, shape, mi.Spectrum(value))

        with dr.resume_grad(when=plan.differentiate_bsdfs):
            f_c = evaluate(plan, vertex.si, vertex.bsdf, connection.wo, seen)
            f_s = tracked_factor(plan, vertex.si, vertex.bsdf, scattering, scattered)
            df_c, df_s = forward_derivatives(f_c, f_s)
        useful = plan.differentiates(vertex.bsdf)
        C = vertex.product.times(connection.c, vertex.depth).scaled(self.samples.scale).value()
        found = state.first.otherwise(here(_C, connection.c), seen).otherwise(here(_DC, df_c), seen & useful)
        found = found.otherwise(here(_CONTRIBUTION, C), seen)
        there = reaches(self.samples.film, connection.u, self.pixel)
        new = seen & (found.kind != 0) & ((state.found.kind == 0) | (there & ~state.there))
        larger = seen & (dr.max(dr.abs(C)) > dr.max(dr.abs(state.largest.value)))

        first = state.first.otherwise(here(_S, scattering.weight), scattered)
        first = first.otherwise(here(_DS, df_s), scattered & useful)
        product = vertex.product.times(scattering.weight, vertex.depth).value()
        first = first.otherwise(here(_PRODUCT, product), scattered)
        return Search(
            first,
            dr.select(new, found, state.found),
            dr.select(new, connection.u, state.u),
            state.there | (new & there),
            dr.select(larger, here(_CONTRIBUTION, C), state.largest),
            dr.select(larger, connection.u, state.largest_u),
        )
