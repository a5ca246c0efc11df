"""Use every connection of a path without additional variance. The image pass stores a sum over all connections. The
replay subtracts each connection's contribution from the sum.

    S_0 = sum_i delta_i C_i,   S_j = S_{j-1} - delta_j C_j
    dS  = S_0 dE/E + sum_j [ S_j ds_j/s_j + delta_j C_j dc_j/c_j ]

Source: the second extension that the ResLRB paper proposes in its conclusion. The sum needs delta. If dL/dI is known
only after the image, a walk without shadow rays computes the sum first. One bit per vertex stores which connections
were visible. Vertices beyond the last bit trace their shadow rays again, so memory is constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import (
    Estimator,
    Pass,
    PathAdjoint,
    VertexHooks,
    adjoint_of_factor,
    contribution,
    differentiate_emission,
    differentiate_passage,
    vertices,
)
from reslrb_cli.transport.bsdf import Scattering, tracked_factors
from reslrb_cli.transport.connection import Connection, KnownVisibility, stand_in
from reslrb_cli.transport.factors import MAY_LACK, NO_ZERO, Product, showing
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.walk import Vertex

WORDS = 2  # of visibility bits for 32 vertices each


@dataclass
class Visibility:
    """Visibility of a path's connections: one bit for each of 32 * WORDS vertices, and the last visible vertex."""

    words: list[mi.UInt32]
    # Last vertex that must be visited again, usually the last with a visible connection; 0 if none.
    last: mi.UInt32

    @staticmethod
    def none(plan_depth: int) -> Visibility:
        """Return an empty visibility, with as many words as paths of this depth can fill."""
        return Visibility([mi.UInt32(0) for _ in range(min(WORDS, -(-plan_depth // 32)))], mi.UInt32(0))

    def with_vertex(self, depth: mi.UInt32, visible: mi.Bool, last: mi.UInt32) -> Visibility:
        """Return the visibility after adding the connection of vertex `depth`. If the connection is visible, `last`
        becomes the last vertex that a replay must visit.
        """
        index = depth - 1
        bit = mi.UInt32(1) << (index & 31)
        words = [word | dr.select(visible & ((index >> 5) == k), bit, 0) for k, word in enumerate(self.words)]
        return Visibility(words, dr.select(visible, last, self.last))

    def of(self, depth: mi.UInt32, vertices: int) -> KnownVisibility:
        """Return the known visibility at vertex `depth`, for paths with at most `vertices` vertices."""
        index = depth - 1
        visible = mi.Bool(False)
        for k, word in enumerate(self.words):
            visible |= ((index >> 5) == k) & (((word >> (index & 31)) & 1) != 0)
        enough = vertices <= 32 * len(self.words)
        return KnownVisibility(visible, None if enough else index < 32 * len(self.words))


@dataclass
class AdjointSum:
    """Sum (C,) of delta_i C_i over a path's connections, stored as `value` + `rest`.

    `rest` is the rounding error (Knuth's two-sum). With `rest`, subtracting all terms leaves exactly zero, even after a
    thousand vertices. `behind_zero` is a second sum. The sum covers contributions whose prefix has exactly one zero
    factor. `behind_zero` leaves out the zero factor, so `behind_zero` is the derivative with respect to the zero
    factor. It is empty if zeros are not tracked.
    """

    value: mi.Spectrum
    rest: mi.Spectrum
    behind_zero: list[mi.Spectrum]

    @staticmethod
    def zero(track_zeros: bool) -> AdjointSum:
        """Return the empty sum."""
        behind_zero = [mi.Spectrum(0), mi.Spectrum(0)] if track_zeros else []
        return AdjointSum(mi.Spectrum(0), mi.Spectrum(0), behind_zero)

    def plus(self, delta: mi.Spectrum, C: Product, index: mi.UInt32, active: mi.Bool) -> AdjointSum:
        """Return the sum after adding delta C of the connection at vertex `index`."""
        delta = dr.select(active, delta, 0)
        value, rest = self._add(self.value, self.rest, delta * C.value())
        if not self.behind_zero:
            return AdjointSum(value, rest, [])
        term = delta * C.nonzero
        for c, zero in enumerate(C.zero):
            # If the connection's own factor is the zero one, the derivative is here and not in the prefix.
            term[c] = dr.select((zero >= 0) & (zero != mi.Int32(index)), term[c], 0)
        return AdjointSum(value, rest, list(self._add(self.behind_zero[0], self.behind_zero[1], term)))

    def minus(self, delta: mi.Spectrum, C: Product, index: mi.UInt32, active: mi.Bool) -> AdjointSum:
        """Return the sum after removing delta C of the connection at vertex `index`."""
        return self.plus(-delta, C, index, active)

    def adjoint_of_factor(self, f: mi.Spectrum, prefix: Product, rest: mi.Float | float) -> mi.Spectrum:
        """Return the sum's derivative (C,) with respect to a factor `f * rest` that follows the path prefix `prefix`.

        The factor must come before all connections in the sum.
        """
        f, total = dr.detach(f), self.value + self.rest
        result = mi.Spectrum(dr.select(f == 0, 0, total / f))  # passes NaN on
        if self.behind_zero:
            behind = (self.behind_zero[0] + self.behind_zero[1]) * rest
            for c, zero in enumerate(prefix.zero):
                result[c] = dr.select((f[c] == 0) & (zero == NO_ZERO), behind[c], result[c])
        return showing(result)

    def adjoint_of_emission(self, E: mi.Spectrum) -> mi.Spectrum:
        """Return d(sum)/dE (C,)."""
        return self.adjoint_of_factor(E, Product.one(bool(self.behind_zero)), 1)

    @staticmethod
    def _add(value: mi.Spectrum, rest: mi.Spectrum, term: mi.Spectrum) -> tuple[mi.Spectrum, mi.Spectrum]:
        """Return value + rest + term as two numbers, the rounded sum and its rounding error (Knuth 1969, 4.2.2, theorem
        B).
        """
        total = value + term
        part = total - value
        return total, rest + ((value - (total - part)) + (term - part))


@dataclass
class GatherState:
    """Stored data of a path: visibility and, if delta is known, S_0.

    If delta is known, `latest` holds the number of the latest differentiated vertex while the path is traced.
    """

    visibility: Visibility
    S: list[AdjointSum]
    latest: list[mi.UInt32]


class Gathering(VertexHooks):
    """Image pass: splat, store the visibility, and sum if delta is known."""

    def start(self, product: Product) -> GatherState:
        p = self.p
        # Derivatives of emission need only the sum.
        traced_again = p.adjoint is None or p.plan.differentiate_bsdfs
        visibility = Visibility.none(vertices(p.plan) if traced_again else 0)
        if p.adjoint is None:
            return GatherState(visibility, [], [])
        return GatherState(visibility, [AdjointSum.zero(p.plan.track_zeros)], [mi.UInt32(0)])

    def vertex(
        self, state: GatherState, vertex: Vertex, connection: Connection, scattering: Scattering,
        numbers: list[mi.Float],
    ) -> GatherState:  # fmt: skip
        p, depth, last = self.p, vertex.depth, vertex.depth
        C = contribution(p, vertex, connection)
        p.splat(connection.u, C.value(), connection.active, self.colours)
        # The latest differentiable vertex up to this one; 0 if none.
        latest = [dr.select(p.plan.concerns(vertex.bsdf), depth, before) for before in state.latest]
        if latest:
            last = needed(latest[0], depth)
        visibility = state.visibility.with_vertex(depth, connection.active, last)
        S = [
            total.plus(p.delta(connection.u, connection.active, self.colours), C, depth, connection.active)
            for total in state.S
        ]
        return GatherState(visibility, S, latest)


class Revisiting(VertexHooks):
    """Walk again along paths that were already traced. The walk goes only as far as necessary and traces no shadow
    rays.
    """

    def __init__(self, p: Pass, visibility: Visibility) -> None:
        super().__init__(p)
        self.visibility = visibility

    def known_visibility(self, vertex: Vertex) -> KnownVisibility:
        return self.visibility.of(vertex.depth, vertices(self.p.plan))

    def goes_on(self, state: Any, vertex: Vertex) -> mi.Bool:
        return vertex.depth < self.visibility.last


class Summing(Revisiting, Gathering):
    """Sum delta_i C_i along the same paths. The visibility tells where each path may end."""

    def start(self, product: Product) -> GatherState:
        return GatherState(Visibility.none(0), [AdjointSum.zero(self.p.plan.track_zeros)], [mi.UInt32(0)])


class Taking(Revisiting):
    """Replay: subtract each contribution from the sum, and differentiate both factors of each vertex."""

    def __init__(self, p: Pass, visibility: Visibility, S: AdjointSum) -> None:
        super().__init__(p, visibility)
        self.S = S

    def start(self, product: Product) -> AdjointSum:
        return self.S

    def vertex(
        self, state: AdjointSum, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> AdjointSum:  # fmt: skip
        p, plan, connected = self.p, self.p.plan, connection.active
        useful = plan.differentiates(vertex.bsdf)
        C = contribution(p, vertex, connection)
        delta = p.delta(connection.u, connected, self.colours)
        S = state.minus(delta, C, vertex.depth, connected)
        own = PathAdjoint(delta * C.nonzero, C)
        adjoint_c = adjoint_of_connection(p, vertex, connection, connected, own)
        adjoint_s = S.adjoint_of_factor(scattering.f, vertex.product, scattering.correction / scattering.pdf)
        connected, scattered = connected & useful, scattering.active & useful
        with dr.resume_grad():
            f_c, f_s = tracked_factors(plan, vertex.si, vertex.bsdf, connection.wo, connected, scattering, scattered)
            objective = dr.select(connected, adjoint_c * f_c, 0) + dr.select(scattered, adjoint_s * f_s, 0)
            dr.backward_from(objective, flags=MAY_LACK)
        return S


def adjoint_of_connection(
    p: Pass, vertex: Vertex, connection: Connection, active: mi.Bool, adjoint: PathAdjoint
) -> mi.Spectrum:
    """Return the derivative (C,) of the objective with respect to the BSDF of a connection. Also add the derivative of
    the masks between vertex and sensor.
    """
    rest = mi.Spectrum(dr.rcp(stand_in(connection)[0]))
    rest *= differentiate_passage(p, vertex.si, vertex.depth, connection, active, adjoint)
    return adjoint_of_factor(adjoint, vertex.depth, connection.f, rest)


def needed(latest: mi.UInt32, depth: mi.UInt32) -> mi.UInt32:
    """Return the last vertex that a replay must visit for a connection from vertex `depth`, or 0 if there is none.

    The result is the vertex after the latest differentiated vertex, because the replay must also sample the scattering
    of the latest differentiated vertex. If the connection starts at the latest differentiated vertex, the result is
    this vertex.
    """
    return dr.select(latest > 0, dr.minimum(latest + 1, depth), 0)


class Gather(Estimator):
    """The estimator `gather`: every connection, by a replay."""

    exact = True

    def forward(self, p: Pass) -> GatherState:
        state: GatherState = p.walk(Gathering(p))
        return GatherState(state.visibility, state.S, [])

    def backward(self, p: Pass, state: GatherState) -> None:
        visibility = state.visibility
        if not state.S:
            state = p.walk(Summing(p, visibility), visibility.last > 0)
            visibility = Visibility(visibility.words, state.visibility.last)
            dr.eval(state.S, visibility)  # both the emission and the replay read them
        [S] = state.S
        differentiate_emission(p, S.adjoint_of_emission)
        if p.plan.differentiate_bsdfs:
            p.walk(Taking(p, visibility, S), visibility.last > 0)

    def kept(self, plan: Plan) -> GatherState:
        visibility = Visibility.none(vertices(plan))
        return GatherState(visibility, [AdjointSum.zero(plan.track_zeros)], [mi.UInt32(0)])
