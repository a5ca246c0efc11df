"""ResLRB: keep one connection of each path by weighted reservoir sampling, then replay the path up to it.

    keep candidate i with probability w_i / W,  W = sum_i w_i,  w_i = luminance(C_i)
    dS ~ (W / w_I) delta_I [ C_I dE/E + sum_{j<I} C_I ds_j/s_j + C_I dc_I/c_I ]

Source: the ResLRB paper, Sections 2.2 to 2.4; reservoir: Chao 1982. Each bracket term needs the graph of one vertex
alone. With zero factors the weight is that of the nonzero ones, so that a connection whose value is zero and whose
derivative is not can be kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import Estimator, PathAdjoint, adjoint_of_factor
from reslrb_cli.transport.connection import Connection, connection_factor, stand_in
from reslrb_cli.transport.factors import MANY_ZEROS, NO_ZERO, Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.scattering import Scattering, attached_factor
from reslrb_cli.transport.splat import AdjointImage, Film
from reslrb_cli.transport.transmittance import transmittance
from reslrb_cli.transport.walk import Hooks, Vertex


@dataclass
class ReservoirState:
    """What is kept of a path, 32 bytes (and 12 more where zero factors are tracked)."""

    W: Any  # sum of all candidates' weights
    w: Any  # weight of the kept one
    I: Any  # its vertex; 0: none  # noqa: E741
    C: Product  # its contribution
    u: Any  # its film position


def luminance(value: Any) -> Any:
    """Selection weight of a contribution (C,); channels may not be negative."""
    return mi.luminance(mi.Color3f(value)) if len(value) == 3 else mi.Float(value[0])


class ReservoirSelection(Hooks):
    """Image pass: splat, and keep one connection."""

    numbers = 1

    def __init__(self, plan: Plan, scene: Any, film: Film, block: Any, scale: float) -> None:
        self.plan, self.scene, self.film, self.block, self.scale = plan, scene, film, block, scale

    def start(self, product: Product) -> ReservoirState:
        nothing = Product(mi.Spectrum(0), [mi.Int32(MANY_ZEROS) for _ in product.zero])
        return ReservoirState(mi.Float(0), mi.Float(0), mi.UInt32(0), nothing, mi.Point2f(0))

    def connection(
        self, state: ReservoirState, vertex: Vertex, connection: Connection, numbers: list[Any]
    ) -> ReservoirState:
        c, active = connection_factor(self.plan, self.scene, vertex, connection)
        C = vertex.product.times(c, vertex.depth, stand_in(connection)[1]).scaled(self.scale)
        if self.block is not None:
            self.film.put(self.block, connection.u, C.value(), active)
        w = dr.select(active, luminance(C.differentiable()), 0)
        W = state.W + w
        keep = (w > 0) & (numbers[0] * W < w)
        kept = ReservoirState(W, w, vertex.depth, C, connection.u)
        return dr.select(keep, kept, ReservoirState(W, state.w, state.I, state.C, state.u))


class ReservoirReplay(Hooks):
    """Replay up to the kept connection, and differentiate one factor a vertex: s_j on the way, c_I at its end."""

    replaying = True

    def __init__(self, plan: Plan, scene: Any, kept: ReservoirState, adjoint: PathAdjoint) -> None:
        self.plan, self.scene, self.kept, self.adjoint = plan, scene, kept, adjoint

    def goes_on(self, state: Any, vertex: Vertex) -> Any:
        return vertex.depth < self.kept.I

    def scattering(self, state: Any, vertex: Vertex, connection: Connection, scattering: Scattering) -> Any:
        at_end = vertex.depth == self.kept.I
        active = vertex.active & (at_end | scattering.active)
        rest = dr.select(at_end, dr.rcp(stand_in(connection)[0]), scattering.correction / scattering.pdf)
        if self.plan.needs.has_null:
            passed = self._transmittance(vertex, connection, vertex.active & at_end)
            rest = dr.select(at_end, rest * passed, mi.Spectrum(rest))
        # One evaluation serves both kinds of factor, since a vertex has either.
        wo = dr.select(at_end, connection.wo, scattering.wo)
        scattering.is_delta &= ~at_end
        scattering.is_null &= ~at_end
        with dr.resume_grad():
            f = attached_factor(self.plan, vertex.si, vertex.bsdf, wo, scattering, active)
            weight = adjoint_of_factor(self.adjoint, vertex.depth, f, rest)
            dr.backward_from(dr.select(active, weight * f, 0))
        return state

    def _transmittance(self, vertex: Vertex, connection: Connection, active: Any) -> Any:
        """Transmittance of masks between the kept vertex and the sensor; adds its derivative."""

        def differentiate(transmission: Any, hit: Any) -> None:
            # A segment with a transmission of zero is no candidate, so no index can match.
            weight = adjoint_of_factor(self.adjoint, mi.Int32(NO_ZERO), transmission, 0)
            dr.backward_from(dr.select(hit, weight * transmission, 0))

        with dr.resume_grad():
            limit = self.plan.max_depth - vertex.depth - 1
            return transmittance(self.scene, vertex.si, connection.target, limit, active, differentiate).value


class Reservoir(Estimator):
    """The paper's estimator: capacity 1, weight luminance, detached."""

    def __init__(self, image: str = "all") -> None:
        self.image = image

    def image_hooks(self, plan: Plan, scene: Any, film: Film, block: Any, scale: float) -> Hooks:
        return ReservoirSelection(plan, scene, film, block if self.image == "all" else None, scale)

    def finish_image(self, film: Film, block: Any, state: ReservoirState) -> None:
        if self.image == "retained":
            value = state.C.value() * dr.select(state.w > 0, state.W / state.w, 0)
            film.put(block, state.u, value, state.I > 0)

    def adjoint(self, state: ReservoirState, image: AdjointImage) -> PathAdjoint:
        active = state.I > 0
        delta = image.lookup(state.u, active)
        value = delta * state.C.nonzero * dr.select(active, state.W / state.w, 0)
        return PathAdjoint(value, state.C, active)

    def replay_hooks(self, plan: Plan, scene: Any, state: ReservoirState, adjoint: PathAdjoint) -> Hooks:
        return ReservoirReplay(plan, scene, state, adjoint)
