"""Light-path contributions from which guiding learns. The contributions are recorded for each cell in which paths
start, and for each cell through which paths pass.

Trail: the vertices of a path are stored until the path ends. Only then is the contribution behind each vertex known.
The first PLACES vertices are stored in thread-local memory. A walk back sums over all later vertices, as in
`estimators/stack.py`.

`Onward`: contributions of later vertices, for each cell of ray position and ray direction. Roulette uses these
contributions. `transport/factors.py` defines the cells. Guiding learns two means over the rays that leave a vertex in
a cell. m is the mean squared later contribution at throughput 1. c is the mean number of later vertices. A ray that
leaves with throughput w survives with probability q = min(1, max(LEAST, w s)). The following value of s minimises
variance times work.

    s = sqrt(m W / (c V))        V: mean squared contribution of whole paths; W: mean number of their vertices

Source: Rath et al. 2022, "EARS: efficiency-aware Russian roulette and splitting". Here s is SURE times larger. Few
paths carry nearly all of a cell's contribution, so most cells are underestimated. Ending a path too early adds much
noise. Following a path too long adds comparatively little work.

Because most cells are underestimated, each cell is averaged with the larger cube around the cell. The cube has the
weight of LEAN rays. Each cube is in turn averaged with the next larger cube, up to the whole scene. Every cell's m / c
is at least FLOOR times the scene's m / c.

`Collecting`: contributions of light paths to gradient and image, for each cell in which paths start. A separate walk
with its own random numbers computes the contributions, for each path and each differentiated BSDF.

    G = sum_i delta_i C_i n_i        n_i: number of factors of C_i from this BSDF

G is a derivative with respect to the logarithm of a factor. The factor scales all values of the BSDF. For emission, n =
1. If light moves, G is the sum of |delta_i C_i|. The tables sum the squares of G p / v. If all paths started uniformly,
a path's contribution would be G p / v. The squares of G p / v determine the variance of the sum over all paths.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.estimators.stack import allocate, write
from reslrb_cli.transport.aim import film_blocks
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.factors import BITS, CELLS, SHAPE, Product
from reslrb_cli.transport.film import AdjointImage
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Hooks, Vertex, walk

Array = np.ndarray[Any, Any]
PLACES = 32  # vertices


@dataclass
class Trail:
    """Loop state of a path's vertices.

    For each vertex, the trail stores the contributions to each quantity (C,) and to the image. The trail also stores
    the outgoing ray's cell, the inverse of the ray's throughput (0 without a ray), and the roulette weight. Vertices
    beyond the last place share one place that is never read. `later` is the sum of the contributions of all vertices
    beyond the last place.
    """

    parts: list[dr.Local]
    left: list[dr.Local]
    roulette: list[dr.Local]
    count: mi.UInt32  # vertices so far
    later: list[mi.Spectrum | mi.Float]

    @staticmethod
    def begin(number: int) -> Trail:
        """Return an empty trail for `number` quantities and the image."""
        later = [*(mi.Spectrum(0) for _ in range(number)), mi.Float(0)]
        parts, left = allocate(later, PLACES), allocate([mi.UInt32(0), mi.Float(0)], PLACES)
        return Trail(parts, left, allocate([mi.Float(0)], PLACES), mi.UInt32(0), later)

    def with_vertex(self, parts: list[mi.Spectrum | mi.Float]) -> Trail:
        """Return the trail with one more vertex and its contributions. The contribution to the image comes last."""
        fits, place = self._place(self.count)
        write(self.parts, parts, place, fits)
        later = [a + dr.select(fits, 0, part) for a, part in zip(self.later, parts, strict=True)]
        return replace(self, count=self.count + 1, later=later)

    def leaves(self, cell: mi.UInt32, inverse: mi.Float) -> None:
        """Store the cell of the ray that leaves the last vertex, and the inverse of its throughput."""
        fits, place = self._place(self.count - 1)
        write(self.left, [cell, inverse], place, fits)

    def survives(self, weight: mi.Float) -> None:
        """Store the weight of roulette at the last vertex."""
        fits, place = self._place(self.count - 1)
        write(self.roulette, [weight], place, fits)

    @staticmethod
    def _place(number: mi.UInt32) -> tuple[mi.Bool, mi.UInt32]:
        fits = number < PLACES
        return fits, dr.select(fits, number, PLACES)


def later_contributions(trail: Trail) -> tuple[mi.Float, mi.Float, mi.Float]:
    """Return the later contributions of all paths in the form of `Collected`. Values that are not finite do not count.

    Roulette divides the weight of surviving paths by q. To undo the roulette weight, the walk back multiplies the
    squared contribution by q. The walk back also divides the number of vertices by q. With this correction, the means
    equal the means of paths without roulette.
    """
    squares, followed, left = (dr.zeros(mi.Float, rows * CELLS) for rows in (len(trail.later), 1, 1))

    def add(target: mi.Float, value: mi.Float, cell: mi.UInt32, active: mi.Bool) -> None:
        dr.scatter_reduce(dr.ReduceOp.Add, target, value, cell, active & dr.isfinite(value) & (value > 0))

    def body(height: mi.UInt32, after: list[mi.Spectrum | mi.Float], trail: Trail) -> Any:
        place = height - 1
        cell, inverse, weight = (array.read(place) for array in (*trail.left, *trail.roulette))
        leaves, q = inverse > 0, dr.rcp(weight)
        parts, image = after[:-1], after[-1]
        still = [*(dr.squared_norm(part * inverse) for part in parts), image * dr.square(inverse)]
        for k, square in enumerate(still):
            add(squares, square * q, cell + k * CELLS, leaves)
        add(followed, mi.Float(trail.count - height) * weight, cell, leaves)
        add(left, mi.Float(1), cell, leaves)
        return place, [still + array.read(place) for still, array in zip(after, trail.parts, strict=True)], trail

    dr.while_loop(
        state=(dr.minimum(trail.count, PLACES), trail.later, trail),
        cond=lambda height, after, trail: height > 0,
        body=body,
        labels=("height", "after", "trail"),
        label="walk back over contributions",
    )
    return squares, followed, left


NAMES = ("onward", "frame")  # of its arrays
KEEP = 0.75  # weight of the past relative to the newest walk
SURE = 16.0
LEAN = 100.0
FLOOR = 0.1
RAY = 0.2  # cost of a ray that hits nothing, in vertices


@dataclass
class Onward:
    """Sums (4, CELLS) as float32: squared contributions to gradient and image, later vertices, and rays.

    Squared contributions are divided by the squared contributions of whole paths, and multiplied by the square of
    `light`. The box `box` (2, 3) is divided into cubes. Arrays are never modified.
    """

    box: Array
    sums: Array
    light: float = 0.0
    length: float = 0.0

    @staticmethod
    def nothing(box: Array) -> Onward:
        """Return the state before the first walk."""
        return Onward(np.asarray(box, np.float32), np.zeros((4, CELLS), np.float32))

    def with_more(self, collected: Collected, paths: int) -> Onward:
        """Return the state after one more walk of `paths` paths. All quantities of the gradient have equal weights, and
        the image is last.

        A walk without contributions to gradient or image adds nothing.
        """
        *means, light, count = np.array(collected.whole, np.float64).reshape(-1, BINS).sum(1) / paths
        contributions, light, length = np.array(means), float(light), 1 + float(count)
        known = np.isfinite(contributions) & (contributions > 0)
        if not (known[:-1].any() and known[-1] and np.isfinite(light) and light > 0):
            return self
        squares = np.array(collected.squares).reshape(-1, CELLS)
        unit = np.divide(light**2, contributions, out=np.zeros(len(known)), where=known)
        gradient = unit[:-1] @ squares[:-1] / known[:-1].sum()
        newest = np.stack([gradient, unit[-1] * squares[-1], np.array(collected.followed), np.array(collected.left)])
        old = KEEP if self.light > 0 else 0.0
        light, length = (old * a + (1 - old) * b for a, b in ((self.light, light), (self.length, length)))
        return Onward(self.box, (KEEP * self.sums + newest).astype(np.float32), light, length)

    def arrays(self) -> dict[str, Array]:
        """Return all arrays by name. `taken` reads them back."""
        frame = np.array([*self.box.ravel(), self.light, self.length], np.float64)
        return dict(zip(NAMES, (self.sums, frame), strict=True))

    @staticmethod
    def taken(arrays: Mapping[str, Array]) -> Onward | str:
        """Return the state with these `arrays`, or the name of an array that does not fit."""
        sums, frame = (arrays[name] for name in NAMES)
        if sums.shape != (4, CELLS) or not (np.isfinite(sums) & (sums >= 0)).all():
            return "onward"
        if frame.shape != (8,) or not np.isfinite(frame).all() or (frame[6:] < 0).any():
            return "frame"
        box = frame[:6].reshape(2, 3).astype(np.float32)
        return Onward(box, sums.astype(np.float32), float(frame[6]), float(frame[7]))

    def chances(self, share: float) -> Array:
        """Return s of all cells (CELLS). `share` is the weight of the gradient. 1 - `share` is the weight of the image.

        If no ray has ever left a vertex, all values are infinite, so every path survives.
        """
        if not (self.light > 0 and self.sums[3].any()):
            return np.full(CELLS, np.inf)
        sums = self.sums.astype(np.float64)
        squares, followed, left = share * sums[0] + (1 - share) * sums[1], sums[2], sums[3]
        m, c = _leaning(np.stack([squares, followed]), left)
        ratio = m / (RAY + c)
        least = FLOOR * squares.sum() / (RAY * left.sum() + followed.sum())
        return np.asarray(SURE * np.sqrt(np.maximum(ratio, least) * self.length) / self.light)


def _leaning(sums: Array, counts: Array) -> Array:
    """Return the means (K, CELLS): `sums` divided by `counts`. Each cell's mean is averaged with the means of the
    larger cubes around the cell.
    """
    total = max(float(counts.sum()), 1.0)
    means = np.broadcast_to((sums.sum(1) / total)[:, None, None, None, None], (len(sums), 1, 1, 1, SHAPE[-1]))
    for level in range(BITS + 1):
        here, number = _cubes(sums, level), _cubes(counts[None], level)
        if level > 0:
            for axis in (1, 2, 3):
                means = means.repeat(2, axis)
        means = (here + LEAN * means) / (number + LEAN)
    return means.reshape(len(sums), CELLS)


def _cubes(values: Array, level: int) -> Array:
    """Return the sum for each cube of a level and each octant: (K, 2^level, 2^level, 2^level, 8)."""
    few, each = 1 << level, 1 << (BITS - level)
    return np.asarray(values.reshape(len(values), few, each, few, each, few, each, SHAPE[-1]).sum((2, 4, 6)))


MOST_BSDFS = 6  # that have separate sums; the others share one
BINS = 1024  # of sums over all paths, so that small terms are not lost


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
    parameters. `image` is sum_i |C_i|^2. `light` is the path's weight at the emitter.
    """

    counts: list[mi.UInt32]
    sums: list[mi.Spectrum]
    image: mi.Float
    light: mi.Float
    trail: Trail
    factor: list[mi.Float]  # r of the vertex, if paths are aimed


class Collecting(Hooks):
    """Hooks that sum the contributions of each path. dL/dI is multiplied by `unit_scale`, which is the reciprocal of
    the largest |dL/dI|. Contributions are not divided by the number of paths.
    """

    def __init__(self, samples: Samples, adjoint: AdjointImage, unit_scale: mi.Float) -> None:
        self.samples, self.adjoint, self.unit_scale = samples, adjoint, unit_scale
        self.groups = bsdf_groups(samples.plan)
        assert samples.guide is not None
        self.survival = samples.guide.table.survival
        self.film = film_blocks(samples.sensor) if samples.plan.aimed else None
        # Squares by group and block of the film, if paths are aimed.
        self.places = [dr.zeros(mi.Float, quantities(samples.plan) * self.film.count)] if self.film else []

    def start(self, product: Product) -> PathSums:
        number, factor = quantities(self.samples.plan) - 1, [mi.Float(1)] if self.film else []
        counts, sums = [mi.UInt32(0) for _ in self.groups], [mi.Spectrum(0) for _ in range(number)]
        light = dr.max(dr.abs(self.colours.seen(product.magnitude())))
        return PathSums(counts, sums, mi.Float(0), light, Trail.begin(number), factor)

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
        trail = state.trail.with_vertex([*parts, image])
        scattered = scattering.active
        counts = [count + dr.select(scattered, here, 0) for count, here in zip(state.counts, met, strict=True)]
        behind = vertex.product.times(scattering.s, vertex.depth).magnitude()
        throughput = dr.max(dr.abs(self.colours.seen(behind)))
        inverse = dr.select(scattered & (throughput > 0), dr.rcp(throughput), 0)
        trail.leaves(self.survival.cell(vertex.si.p, scattering.d), inverse)
        return replace(state, counts=counts, sums=sums, image=state.image + image, trail=trail)

    def aimed(self, state: PathSums, factor: mi.Float) -> PathSums:
        # Leave out the weight of a roulette that is being learned from.
        return replace(state, factor=[factor])

    def survived(self, state: PathSums, factor: mi.Float) -> PathSums:
        state.trail.survives(factor)
        return state


@dataclass
class Collected:
    """Evaluated contributions of guided samples: sums over paths.

    - `starts` (quantities * cells) has squared contributions for each quantity and each cell in which paths start. The
        image is the last quantity.
    - `squares` (quantities * CELLS) has squared later contributions at throughput 1, for each cell of a ray that leaves
        a vertex. `followed` counts later vertices, and `left` (CELLS) counts rays.
    - `whole` (rows * BINS) has the squared contributions for each quantity, the weights of paths at the emitter, and
        the paths' vertex counts.
    - `places` (quantities * blocks, or empty) has squared contributions for each block of the film. The values are
        corrected to paths without aiming.
    """

    starts: mi.Float
    squares: mi.Float
    followed: mi.Float
    left: mi.Float
    whole: mi.Float
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
    rows = [*squares, found.light, mi.Float(found.trail.count)]
    whole, lane = dr.zeros(mi.Float, len(rows) * BINS), dr.arange(mi.UInt32, samples.width) % BINS
    for number, value in enumerate(rows):
        dr.scatter_reduce(dr.ReduceOp.Add, whole, value, lane + number * BINS, dr.isfinite(value))
    # One kernel: a later evaluation would trace everything again.
    result = Collected(sums, *later_contributions(found.trail), whole, hooks.places)
    dr.eval(result)
    return result
