"""Light-path contributions from which guiding learns, for each cell in which paths start.

A separate walk with its own random numbers computes the contributions, for each path and each differentiated BSDF.

    G = sum_i delta_i C_i n_i        n_i: number of factors of C_i from this BSDF

G is a derivative with respect to the logarithm of a factor. The factor scales all values of the BSDF. For emission, n =
1. If light moves, G is the sum of |delta_i C_i|. The tables sum the squares of G p / v. If all paths started uniformly,
a path's contribution would be G p / v. The squares of G p / v determine the variance of the sum over all paths.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.aim import film_blocks
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.film import AdjointImage
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Hooks, Vertex, walk

MOST_BSDFS = 6  # that have separate sums; the others share one


def bsdf_groups(plan: Plan) -> list[tuple[mi.BSDF, ...]]:
    """Return the groups of BSDFs whose derivatives are recorded separately. An empty group means all BSDFs of the
    scene.
    """
    if not plan.differentiate_bsdfs:
        return []
    if not plan.only_bsdfs:
        return [()]
    alone, others = plan.only_bsdfs[: MOST_BSDFS - 1], plan.only_bsdfs[MOST_BSDFS - 1 :]
    return [*((bsdf,) for bsdf in alone), *([others] if others else [])]


def meets(group: tuple[mi.BSDF, ...], vertex: Vertex) -> mi.UInt32:
    """Return 1 if a vertex is on a surface with one of the group's BSDFs, otherwise 0. An empty group contains all
    BSDFs.
    """
    met = mi.Bool(not group)
    for bsdf in group:
        met |= vertex.bsdf == mi.BSDFPtr(bsdf)
    return dr.select(met, mi.UInt32(1), 0)


def quantities(plan: Plan) -> int:
    """Return the number of separate quantities: groups of BSDFs, emission, moving parameters, and the image. The image
    comes last.
    """
    return len(bsdf_groups(plan)) + plan.differentiate_emission + plan.attached + 1


@dataclass
class PathSums:
    """Loop state of the hooks.

    `counts` tells how often the path met each group's BSDFs. `sums` are G (C,) of groups, emission and moving
    parameters. `image` is sum_i |C_i|^2.
    """

    counts: list[mi.UInt32]
    sums: list[mi.Spectrum]
    image: mi.Float
    factor: list[mi.Float]  # r of the vertex, if paths are aimed


class Collecting(Hooks):
    """Hooks that sum the contributions of each path. dL/dI is multiplied by `unit_scale`, which is the reciprocal of
    the largest |dL/dI|. Contributions are not divided by the number of paths.
    """

    def __init__(self, samples: Samples, adjoint: AdjointImage, unit_scale: mi.Float) -> None:
        self.samples, self.adjoint, self.unit_scale = samples, adjoint, unit_scale
        self.groups = bsdf_groups(samples.plan)
        self.film = film_blocks(samples.sensor) if samples.plan.aimed else None
        # Squares by group and block of the film, if paths are aimed.
        self.places = [dr.zeros(mi.Float, quantities(samples.plan) * self.film.count)] if self.film else []

    def start(self, product: Product) -> PathSums:
        number, factor = quantities(self.samples.plan) - 1, [mi.Float(1)] if self.film else []
        counts, sums = [mi.UInt32(0) for _ in self.groups], [mi.Spectrum(0) for _ in range(number)]
        return PathSums(counts, sums, mi.Float(0), factor)

    def vertex(
        self, state: PathSums, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> PathSums:  # fmt: skip
        plan, active = self.samples.plan, connection.active
        C = vertex.product.times(connection.c, vertex.depth)
        contribution = self.adjoint.lookup(connection.u, active, self.colours) * self.unit_scale * C.magnitude()
        contribution = dr.select(active, contribution, 0)
        met = [meets(group, vertex) for group in self.groups]
        parts = [contribution * mi.Float(count + here) for count, here in zip(state.counts, met, strict=True)]
        if plan.differentiate_emission:
            parts.append(contribution)
        if plan.attached:
            parts.append(dr.abs(contribution))
        image = dr.squared_norm(dr.select(active, self.colours.seen(C.value()), 0))
        for r in state.factor:
            assert self.film is not None
            block = self.film.block(connection.u)
            for k, square in enumerate([*(dr.squared_norm(part) for part in parts), image]):
                valid = active & dr.isfinite(square) & (square > 0) & (r > 0)
                place = block + k * self.film.count
                dr.scatter_reduce(dr.ReduceOp.Add, self.places[0], square / r, place, valid)
        sums = [total + part for total, part in zip(state.sums, parts, strict=True)]
        counts = [count + dr.select(scattering.active, here, 0) for count, here in zip(state.counts, met, strict=True)]
        return replace(state, counts=counts, sums=sums, image=state.image + image)

    def aimed(self, state: PathSums, factor: mi.Float) -> PathSums:
        return replace(state, factor=[factor])


@dataclass
class Collected:
    """Evaluated contributions of guided samples: sums over paths.

    - `starts` (quantities * cells) has squared contributions for each quantity and each cell in which paths start. The
        image is the last quantity.
    - `places` (quantities * blocks, or empty) has squared contributions for each block of the film. The values are
        corrected to paths without aiming.
    """

    starts: mi.Float
    places: list[mi.Float]


def collect(samples: Samples, gradient: mi.TensorXf) -> Collected:
    """Return the contributions of guided samples. `gradient` (H, W, C) is dL/dI. Values that are not finite are left
    out.
    """
    plan, adjoint = samples.plan, samples.film.adjoint(gradient)
    assert plan.grid is not None
    largest = dr.max(dr.abs(dr.select(dr.isfinite(adjoint.image), adjoint.image, 0)))
    unit_scale = dr.select(largest > 0, dr.rcp(largest), 0)
    dr.make_opaque(unit_scale)
    hooks = Collecting(samples, adjoint, unit_scale)
    found: PathSums = walk(samples, hooks)
    sampler = samples.sampler()
    samples.time(sampler.next_1d)
    drawn = samples.drawn(*samples.emission_numbers(sampler))  # the numbers that the walk used
    assert drawn is not None
    squares = [dr.squared_norm(total) for total in found.sums] + [found.image]
    cells = plan.grid.cells
    sums = dr.zeros(mi.Float, len(squares) * cells)
    for k, square in enumerate(squares):
        value = square / dr.square(drawn.weight)
        counts = dr.isfinite(value) & (value > 0)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, value, drawn.cell + k * cells, counts)
    # One kernel: a later evaluation would trace everything again.
    result = Collected(sums, hooks.places)
    dr.eval(result)
    return result
