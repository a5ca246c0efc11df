"""What light paths have to say, by the cell that they start in: how much they would move gradient and image.

A walk of its own, with random numbers that nothing else has. Of each path and each BSDF that is differentiated

    G = sum_i delta_i C_i n_i        n_i: how many factors of C_i are this BSDF's

is the derivative by the logarithm of a factor that all its values share; of emission n = 1. Where light moves, it is
the sum of |delta_i C_i|. Summed are the squares of what a path would say if all paths started evenly, G p / v, as the
variance of the sum over all paths is made of these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.integrators.onward import Walked
from reslrb_cli.integrators.trail import Onwards, Trail, walk_back
from reslrb_cli.transport.blocks import film_blocks
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.emission import sample_time
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.hooks import Hooks, Vertex
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.scattering import Scattering
from reslrb_cli.transport.splat import AdjointImage
from reslrb_cli.transport.walk import walk

Array = np.ndarray[Any, Any]

MOST_BSDFS = 6  # that are heard apart; the others are heard together
BINS = 1024  # of sums over all paths, so that none loses small numbers


def bsdf_groups(plan: Plan) -> list[tuple[mi.BSDF, ...]]:
    """BSDFs whose derivatives are heard apart from one another; an empty group is all of the scene's."""
    if not plan.differentiate_bsdfs:
        return []
    if not plan.only_bsdfs:
        return [()]
    alone = plan.only_bsdfs[: MOST_BSDFS - 1]
    others = plan.only_bsdfs[MOST_BSDFS - 1 :]
    return [*((bsdf,) for bsdf in alone), *([others] if others else [])]


def voices(plan: Plan) -> int:
    """How many things are heard apart: groups of BSDFs, emission, what moves, and last the image."""
    return len(bsdf_groups(plan)) + plan.differentiate_emission + plan.attached + 1


@dataclass
class Heard:
    """Loop state. `counts` says how often a group's BSDFs have been met, `sums` are G (C,): of the groups, of emission,
    of what moves. `image` is sum_i |C_i|^2, `light` the weight that the path left the emitter with."""

    counts: list[mi.UInt32]
    sums: list[mi.Spectrum]
    image: mi.Float
    light: mi.Float
    trail: Trail
    factor: list[mi.Float]  # r of the vertex, where paths are aimed


class Hearing(Hooks):
    """Sums what each path says; dL/dI and contributions are scaled by `loudness` and by the number of paths."""

    def __init__(self, samples: Samples, adjoint: AdjointImage, loudness: mi.Float) -> None:
        self.samples, self.adjoint, self.loudness = samples, adjoint, loudness
        self.groups = bsdf_groups(samples.plan)
        assert samples.guide is not None
        self.survival = samples.guide.table.survival
        self.film = film_blocks(samples.sensor) if samples.plan.aimed else None
        # Squares by voice and block of the film, where paths are aimed.
        self.places = [dr.zeros(mi.Float, voices(samples.plan) * self.film.count)] if self.film else []

    def start(self, product: Product) -> Heard:
        number = voices(self.samples.plan) - 1
        light = dr.max(dr.abs(product.weight()))
        sums = [mi.Spectrum(0) for _ in range(number)]
        return Heard(
            [mi.UInt32(0) for _ in self.groups],
            sums,
            mi.Float(0),
            light,
            Trail.begin(number),
            [mi.Float(1)] if self.film else [],
        )

    def _met(self, group: tuple[mi.BSDF, ...], vertex: Vertex) -> mi.UInt32:
        met = mi.Bool(not group)
        for bsdf in group:
            met |= vertex.bsdf == mi.BSDFPtr(bsdf)
        return dr.select(met, mi.UInt32(1), 0)

    def connection(self, state: Heard, vertex: Vertex, connection: Connection, numbers: list[mi.Float]) -> Heard:
        plan, active = self.samples.plan, connection.active
        C = vertex.product.times(connection.c, vertex.depth)
        said = self.adjoint.lookup(connection.u, active) * self.loudness * C.weight()
        said = dr.select(active, said, 0)
        counts = [count + self._met(group, vertex) for count, group in zip(state.counts, self.groups, strict=True)]
        parts = [said * mi.Float(count) for count in counts]
        if plan.differentiate_emission:
            parts.append(said)
        if plan.attached:
            parts.append(dr.abs(said))
        image = dr.squared_norm(dr.select(active, C.value(), 0))
        for r in state.factor:
            assert self.film is not None
            block = self.film.block(connection.u)
            for voice, square in enumerate([*(dr.squared_norm(part) for part in parts), image]):
                counts = active & dr.isfinite(square) & (square > 0) & (r > 0)
                place = block + voice * self.film.count
                dr.scatter_reduce(dr.ReduceOp.Add, self.places[0], square / r, place, counts)
        sums = [total + part for total, part in zip(state.sums, parts, strict=True)]
        return replace(state, sums=sums, image=state.image + image, trail=state.trail.said(parts, image))

    def scattering(self, state: Heard, vertex: Vertex, connection: Connection, scattering: Scattering) -> Heard:
        counts = [
            count + dr.select(scattering.active, self._met(group, vertex), 0)
            for count, group in zip(state.counts, self.groups, strict=True)
        ]
        throughput = dr.max(dr.abs(vertex.product.times(scattering.weight, vertex.depth).weight()))
        inverse = dr.select(scattering.active & (throughput > 0), dr.rcp(throughput), 0)
        state.trail.leaves(self.survival.cell(vertex.si.p, scattering.d), inverse)
        return replace(state, counts=counts)

    def aimed(self, state: Heard, factor: mi.Float) -> Heard:
        # Part of what paths say, other than the weight of a roulette that is being learned for.
        return replace(state, factor=[factor])

    def survived(self, state: Heard, weight: mi.Float) -> Heard:
        state.trail.survives(weight)
        return state


@dataclass
class Said:
    """What guided samples have said, evaluated: sums over paths.

    `starts` (voices * cells), voice by voice, are squares by the cell that a path starts in; `onward` is what paths go
    on to say from where they are; `whole` (rows * BINS) are squares by voice, the weights that paths left emitters
    with, and their vertices. `places` (voices * blocks, or none) are squares of what was said at a block of the film,
    as if no path had been aimed there.
    """

    starts: mi.Float
    onward: Onwards
    whole: mi.Float
    places: list[mi.Float]

    def by_start(self, cells: int) -> Array:
        """Sums of squares (voices, cells), float32."""
        return np.array(self.starts).reshape(-1, cells)

    def by_block(self) -> Array | None:
        """Sums of squares (voices, blocks of the film), float32; None where no path is aimed."""
        rows = len(self.whole) // BINS - 2
        return np.array(self.places[0]).reshape(rows, -1) if self.places else None

    def walked(self, paths: int) -> Walked:
        """What that says of where paths go on to."""
        *said, light, count = np.array(self.whole, np.float64).reshape(-1, BINS).sum(1) / paths
        return Walked(*self.onward.arrays(len(said)), np.array(said), float(light), 1 + float(count))


def hear(samples: Samples, gradient: mi.TensorXf) -> Said:
    """What guided samples with dL/dI `gradient` (H, W, C) say; what is not finite is not heard."""
    plan, adjoint = samples.plan, samples.film.adjoint(gradient)
    assert plan.grid is not None
    loudest = dr.max(dr.abs(dr.select(dr.isfinite(adjoint.image), adjoint.image, 0)))
    loudness = dr.select(loudest > 0, dr.rcp(loudest), 0)
    dr.make_opaque(loudness)
    hooks = Hearing(samples, adjoint, loudness)
    heard: Heard = walk(samples, hooks)
    sampler = samples.sampler()
    sample_time(plan, samples.sensor, sampler)
    drawn = samples.drawn(*samples.emission_numbers(sampler))  # as the walk had them
    assert drawn is not None
    squares = [dr.squared_norm(total) for total in heard.sums] + [heard.image]
    cells = plan.grid.cells
    sums = dr.zeros(mi.Float, len(squares) * cells)
    for voice, square in enumerate(squares):
        value = square / dr.square(drawn.weight)
        counts = dr.isfinite(value) & (value > 0)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, value, drawn.cell + voice * cells, counts)
    # All is one kernel: what is evaluated apart would be traced again.
    whole = _sums([*squares, heard.light, mi.Float(heard.trail.count)], samples.width)
    said = Said(sums, walk_back(heard.trail), whole, hooks.places)
    dr.eval(said)
    return said


def _sums(values: list[mi.Float], width: int) -> mi.Float:
    """Sums (len(values) * BINS) over paths, what is not finite left out."""
    result, lane = dr.zeros(mi.Float, len(values) * BINS), dr.arange(mi.UInt32, width) % BINS
    for number, value in enumerate(values):
        dr.scatter_reduce(dr.ReduceOp.Add, result, value, lane + number * BINS, dr.isfinite(value))
    return result
