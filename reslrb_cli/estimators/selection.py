"""Weighted reservoir sampling of a path's connections (Chao 1982), and replays towards those that were chosen.

slot k keeps candidate i with probability w_i / W,   W = sum_i w_i
"""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.base import Pass, PathAdjoint, VertexHooks
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.walk import Vertex

S = TypeVar("S")
SHARE = 0.01  # the least share of a candidate in the weights up to it


class Chosen(Protocol):
    """What any slot holds of its connection: selection weight (0: it holds none), contribution, film position."""

    w: mi.Float
    C: Product
    u: mi.Point2f


def selection_weight(p: Pass, weight: str, connection: Connection, C: Product) -> mi.Float:
    """w of a connection: `luminance` of C, or `adjoint`, sum_c |delta_c C_c|.

    Raises ValueError where the latter is asked for and delta is not known.
    """
    value = C.weight()
    if weight == "luminance":
        return mi.luminance(mi.Color3f(value)) if len(value) == 3 else mi.Float(value[0])
    if p.adjoint is None:
        raise ValueError('weight "adjoint" needs dL/dI before the paths are traced, which correlated samples lack')
    return dr.sum(dr.abs(p.delta(connection.u, connection.active) * value))


def is_taken(number: mi.Float, w: mi.Float, W: mi.Float) -> mi.Bool:
    """Whether a candidate of weight `w` takes the slot, `W` being the sum up to it: with probability w / W.

    A weight that is not finite is always taken, and so is all that follows: what is wrong must not be lost.
    """
    return (w != 0) & ((number * W < w) | ~dr.isfinite(W))


def at_least_share(w: mi.Float, W: mi.Float) -> mi.Float:
    """A candidate's weight, raised to SHARE of all before it, W, unless it is 0.

    What comes after a heavy connection may be all that some parameter has: it is chosen with a probability of SHARE at
    least, where its own weight may be a millionth. What comes before needs no such care, since its parameters have a
    part in the heavy one too.
    """
    least = SHARE * W
    return dr.select((w != 0) & (w < least), least, w)  # a comparison: what is not a number stays


def inverse_probability(W: mi.Float, slot: Chosen, capacity: int) -> mi.Float:
    """W / (m w): 1 over the probability of a slot's selection, shared among the slots; 0 where it holds nothing."""
    return dr.select(slot.w != 0, W / (capacity * slot.w), 0)


def slot_adjoint(p: Pass, W: mi.Float, slot: Chosen, capacity: int) -> PathAdjoint:
    """Sensitivity of the objective to what a slot holds, standing for all that it was chosen from."""
    delta = p.delta(slot.u, slot.w != 0)
    return PathAdjoint(delta * slot.C.nonzero * inverse_probability(W, slot, capacity), slot.C)


def chosen_by(numbers: list[mi.Float], w: mi.Float, W: mi.Float, this: S, slots: list[S]) -> list[S]:
    """The slots behind one more candidate, `this`, each of which has a number to choose by."""
    return [dr.select(is_taken(number, w, W), this, slot) for number, slot in zip(numbers, slots, strict=True)]


class SlotReplay(VertexHooks):
    """A replay up to the last vertex, `last`, that any slot has anything to differentiate at."""

    replaying = True
    connects = False

    def __init__(self, p: Pass, last: list[mi.UInt32]) -> None:
        super().__init__(p)
        self.last = last[0]
        for other in last[1:]:
            self.last = dr.maximum(self.last, other)

    def goes_on(self, state: Any, vertex: Vertex) -> mi.Bool:
        return vertex.depth <= self.last

    def is_followed(self, state: Any, vertex: Vertex) -> mi.Bool:
        return vertex.depth < self.last
