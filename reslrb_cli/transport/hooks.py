"""What an estimator sees of a walk, and what it may do along it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi

from reslrb_cli.transport.connection import Connection, Seen
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.scattering import Scattering


@dataclass
class Vertex:
    """The current vertex as hooks see it; `product` does not include the vertex's own scattering."""

    pi: mi.PreliminaryIntersection3f
    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    ray: mi.Ray3f
    depth: mi.UInt32
    product: Product
    active: mi.Bool


class Hooks:
    """What an estimator does along a walk. All are pure: state in, state out; none draws a random number.

    `numbers` says how many random numbers `connection` wants at each vertex; without `connects` no connection is
    evaluated, and `connection` is not called. A walk whose hooks are `replaying` follows a path that is known to get as
    far as `goes_on` asks, so that neither its throughput nor its roulette is computed.
    Hooks that are `tracked` keep derivatives of the factors in the loop state, which is then evaluated vertex by vertex
    (naive AD); with `max_iterations` the loop stays symbolic, and Dr.Jit itself reverses it, from a record of the loop
    state in thread-local memory. Where they are `attached` too, so are the rays.
    """

    numbers: int = 0
    connects: bool = True
    replaying: bool = False
    tracked: bool = False
    attached: bool = False
    max_iterations: int | None = None

    def start(self, product: Product) -> Any:
        """State before the first vertex, any PyTree; `product` is E."""
        return []

    def seen(self, vertex: Vertex) -> Seen | None:
        """What is known of the sensor's visibility from this vertex."""
        return None

    def wants(self, state: Any, vertex: Vertex) -> mi.Bool:
        """Lanes whose connection from this vertex is of use; others trace no shadow ray."""
        return mi.Bool(True)

    def connection(self, state: Any, vertex: Vertex, connection: Connection, numbers: list[mi.Float]) -> Any:
        """Called at each vertex with its connection to the sensor."""
        return state

    def goes_on(self, state: Any, vertex: Vertex) -> mi.Bool:
        """Lanes that scatter on from this vertex, as far as the hooks care."""
        return mi.Bool(True)

    def is_followed(self, state: Any, vertex: Vertex) -> mi.Bool:
        """In a replay: lanes that `goes_on` let scatter, and whose next vertex is wanted as well."""
        return mi.Bool(True)

    def scattering(self, state: Any, vertex: Vertex, connection: Connection, scattering: Scattering) -> Any:
        """Called at each vertex with the sampled scattering event, also in lanes that `goes_on` ended."""
        return state

    def survived(self, state: Any, weight: mi.Float) -> Any:
        """Called with the weight that roulette has just given the path's product, 1 where it was not played."""
        return state

    def aimed(self, state: Any, factor: mi.Float) -> Any:
        """Called, where paths are aimed (`aim.py`), with the factor r that the path's product has just been given."""
        return self.survived(state, factor)


class Splat(Hooks):
    """Splat every connection, and keep nothing."""

    def __init__(self, samples: Samples, block: mi.ImageBlock) -> None:
        self.samples, self.block = samples, block

    def connection(self, state: Any, vertex: Vertex, connection: Connection, numbers: list[mi.Float]) -> Any:
        s = self.samples
        C = vertex.product.times(connection.c, vertex.depth).scaled(s.scale)
        normalization = self.attached and s.plan.attached_normalization
        s.film.put(self.block, connection.u, C.value(), connection.active, normalization)
        return state
