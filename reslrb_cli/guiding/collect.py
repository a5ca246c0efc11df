"""The words that guiding learns from: what light paths say, by the cells that they start in and go on through.

Trail: the vertices of a path, kept until it ends, as only then is it known what it went on to say behind each of them.
They lie in thread-local memory, the first PLACES of them. From the last one back the sum over all later vertices is at
hand when a vertex is reached, as in `estimators/stack.py`.

Onward: what light paths go on to say from where they are, and whether they are worth following by that. Of every cell
of place and direction (`transport/roulette.py`) two means are learned over the rays that leave a vertex there: the
square of what the path still says behind it if its throughput is 1 (m), and how many vertices still follow (c). A ray
that leaves with throughput w goes on with probability q = min(1, max(LEAST, w s)). Of all q those make variance times
work least for which

    s = sqrt(m W / (c V))        V: the mean square of what a whole path says; W: the mean number of its vertices

(Rath et al. 2022, "EARS: efficiency-aware Russian roulette and splitting"). Here s is SURE times that: few of the paths
that a cell is known by say nearly all that it ever says, so that most cells look quieter than they are, and what ends
there too often makes for much more noise than what goes on too long makes for work.

For the same reason a cell leans on the larger cube that it lies in, with the weight of LEAN rays, that one on the next,
and so on up to the whole scene; and no cell has less than FLOOR of the scene's own m / c.

Hearing: what light paths have to say, by the cell that they start in: how much they would move gradient and image. It
is a walk of its own, with random numbers that nothing else has. Of each path and each BSDF that is differentiated

    G = sum_i delta_i C_i n_i        n_i: how many factors of C_i are this BSDF's

is the derivative by the logarithm of a factor that all its values share; of emission n = 1. Where light moves, it is
the sum of |delta_i C_i|. Summed are the squares of what a path would say if all paths started evenly, G p / v, as the
variance of the sum over all paths is made of these.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.estimators.base import allocate, write
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.connection import Connection
from reslrb_cli.transport.emission import sample_time
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.film import AdjointImage, film_blocks
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.roulette import BITS, CELLS, SHAPE
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Hooks, Vertex, walk

Array = np.ndarray[Any, Any]
PLACES = 32  # vertices


@dataclass
class Trail:
    """Loop state. Of each vertex: what it says, by voice (C,), and about the image; the cell that its ray leaves by,
    and one over its throughput, 0 where none leaves; the weight of roulette.

    What finds no room goes to one more place, which nobody reads; what those said is summed in `later`.
    """

    said: list[dr.Local]
    left: list[dr.Local]
    roulette: list[dr.Local]
    count: mi.UInt32  # vertices so far
    later: list[mi.Spectrum | mi.Float]

    @staticmethod
    def begin(voices: int) -> Trail:
        """An empty one, for so many voices beside the image."""
        later = [*(mi.Spectrum(0) for _ in range(voices)), mi.Float(0)]
        said, left = allocate(later, PLACES), allocate([mi.UInt32(0), mi.Float(0)], PLACES)
        return Trail(said, left, allocate([mi.Float(0)], PLACES), mi.UInt32(0), later)

    def with_vertex(self, said: list[mi.Spectrum | mi.Float]) -> Trail:
        """With one more vertex, and what it says, about the image last."""
        fits, place = self._place(self.count)
        write(self.said, said, place, fits)
        later = [a + dr.select(fits, 0, part) for a, part in zip(self.later, said, strict=True)]
        return replace(self, count=self.count + 1, later=later)

    def leaves(self, cell: mi.UInt32, inverse: mi.Float) -> None:
        """Write how the ray of the vertex that was named last leaves it."""
        fits, place = self._place(self.count - 1)
        write(self.left, [cell, inverse], place, fits)

    def survives(self, weight: mi.Float) -> None:
        """Write the weight of roulette there."""
        fits, place = self._place(self.count - 1)
        write(self.roulette, [weight], place, fits)

    @staticmethod
    def _place(number: mi.UInt32) -> tuple[mi.Bool, mi.UInt32]:
        fits = number < PLACES
        return fits, dr.select(fits, number, PLACES)


def walk_back(trail: Trail) -> tuple[mi.Float, mi.Float, mi.Float]:
    """What all paths went on to say, as `Said` has it; what is not finite does not count.

    What roulette lets live it weights up by 1 / q: of all rays that leave, whether it lets them live or not, q times
    such a square and 1 / q times such a number of vertices have the means that they would have without it.
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
        for voice, square in enumerate(still):
            add(squares, square * q, cell + voice * CELLS, leaves)
        add(followed, mi.Float(trail.count - height) * weight, cell, leaves)
        add(left, mi.Float(1), cell, leaves)
        return place, [still + array.read(place) for still, array in zip(after, trail.said, strict=True)], trail

    dr.while_loop(
        state=(dr.minimum(trail.count, PLACES), trail.later, trail),
        cond=lambda height, after, trail: height > 0,
        body=body,
        labels=("height", "after", "trail"),
        label="walk back over what is heard",
    )
    return squares, followed, left


NAMES = ("onward", "frame")  # of its arrays
KEEP = 0.75  # what of the past counts beside the newest walk
SURE = 16.0
LEAN = 100.0
FLOOR = 0.1
RAY = 0.2  # what a ray costs that meets nothing, in vertices


@dataclass
class Walked:
    """What one walk has shown, float64: of each cell the squares of what paths still said at a throughput of 1
    (voices, CELLS), the vertices that followed, and the rays that left there, summed over its paths.

    Means over its paths: `said`, the squares of all they said (voices); `light`, the weight they left emitters with;
    `length`, their vertices, and one for their start.
    """

    squares: Array
    followed: Array
    left: Array
    said: Array
    light: float
    length: float


@dataclass
class Onward:
    """Sums (4, CELLS), float32: of squares that concern the gradient and the image, of vertices that followed, of rays.

    Squares are in units of what whole paths said, and of `light`. `box` (2, 3) is what is cut into cubes. No array is
    ever changed.
    """

    box: Array
    sums: Array
    light: float = 0.0
    length: float = 0.0

    @staticmethod
    def nothing(box: Array) -> Onward:
        """Before the first walk."""
        return Onward(np.asarray(box, np.float32), np.zeros((4, CELLS), np.float32))

    def with_more(self, walked: Walked) -> Onward:
        """With what one more walk has shown, each voice of the gradient as much as another, the image last.

        A walk in which nothing was said about either tells nothing of where paths would say something.
        """
        heard = np.isfinite(walked.said) & (walked.said > 0)
        if not (heard[:-1].any() and heard[-1] and np.isfinite(walked.light) and walked.light > 0):
            return self
        unit = np.divide(walked.light**2, walked.said, out=np.zeros(len(heard)), where=heard)
        gradient = unit[:-1] @ walked.squares[:-1] / heard[:-1].sum()
        newest = np.stack([gradient, unit[-1] * walked.squares[-1], walked.followed, walked.left])
        old = KEEP if self.light > 0 else 0.0
        light, length = (old * a + (1 - old) * b for a, b in ((self.light, walked.light), (self.length, walked.length)))
        return Onward(self.box, (KEEP * self.sums + newest).astype(np.float32), light, length)

    def arrays(self) -> dict[str, Array]:
        """All of it, by name; the inverse of `taken`."""
        frame = np.array([*self.box.ravel(), self.light, self.length], np.float64)
        return dict(zip(NAMES, (self.sums, frame), strict=True))

    @staticmethod
    def taken(arrays: Mapping[str, Array]) -> Onward | str:
        """What had these `arrays`; the name of one that cannot be."""
        sums, frame = (arrays[name] for name in NAMES)
        if sums.shape != (4, CELLS) or not (np.isfinite(sums) & (sums >= 0)).all():
            return "onward"
        if frame.shape != (8,) or not np.isfinite(frame).all() or (frame[6:] < 0).any():
            return "frame"
        box = frame[:6].reshape(2, 3).astype(np.float32)
        return Onward(box, sums.astype(np.float32), float(frame[6]), float(frame[7]))

    def chances(self, share: float) -> Array:
        """s of all cells (CELLS); `share` is that of the gradient in what counts as said, the rest is the image's.

        Where no ray has ever left a vertex all are infinite: whatever does go on.
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
    """Means (K, CELLS) of sums (K, CELLS) over counts (CELLS), each leaning on that of the larger cubes about it."""
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
    """Sums over the cubes of a level, 2^level along each axis, octants apart: (K, 2^level, 2^level, 2^level, 8)."""
    few, each = 1 << level, 1 << (BITS - level)
    return np.asarray(values.reshape(len(values), few, each, few, each, few, each, SHAPE[-1]).sum((2, 4, 6)))


MOST_BSDFS = 6  # that are heard apart; the others are heard together
BINS = 1024  # of sums over all paths, so that none loses small numbers


def bsdf_groups(plan: Plan) -> list[tuple[mi.BSDF, ...]]:
    """BSDFs whose derivatives are heard apart from one another; an empty group is all of the scene's."""
    if not plan.differentiate_bsdfs:
        return []
    if not plan.only_bsdfs:
        return [()]
    alone, others = plan.only_bsdfs[: MOST_BSDFS - 1], plan.only_bsdfs[MOST_BSDFS - 1 :]
    return [*((bsdf,) for bsdf in alone), *([others] if others else [])]


def meets(group: tuple[mi.BSDF, ...], vertex: Vertex) -> mi.UInt32:
    """1 where a vertex is on a surface with one of the group's BSDFs, of an empty group anywhere; else 0."""
    met = mi.Bool(not group)
    for bsdf in group:
        met |= vertex.bsdf == mi.BSDFPtr(bsdf)
    return dr.select(met, mi.UInt32(1), 0)


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
        number, factor = voices(self.samples.plan) - 1, [mi.Float(1)] if self.film else []
        counts, sums = [mi.UInt32(0) for _ in self.groups], [mi.Spectrum(0) for _ in range(number)]
        return Heard(counts, sums, mi.Float(0), dr.max(dr.abs(product.weight())), Trail.begin(number), factor)

    def vertex(
        self, state: Heard, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Heard:  # fmt: skip
        plan, active = self.samples.plan, connection.active
        C = vertex.product.times(connection.c, vertex.depth)
        said = self.adjoint.lookup(connection.u, active) * self.loudness * C.weight()
        said = dr.select(active, said, 0)
        met = [meets(group, vertex) for group in self.groups]
        parts = [said * mi.Float(count + here) for count, here in zip(state.counts, met, strict=True)]
        if plan.differentiate_emission:
            parts.append(said)
        if plan.attached:
            parts.append(dr.abs(said))
        image = dr.squared_norm(dr.select(active, C.value(), 0))
        for r in state.factor:
            assert self.film is not None
            block = self.film.block(connection.u)
            for voice, square in enumerate([*(dr.squared_norm(part) for part in parts), image]):
                valid = active & dr.isfinite(square) & (square > 0) & (r > 0)
                place = block + voice * self.film.count
                dr.scatter_reduce(dr.ReduceOp.Add, self.places[0], square / r, place, valid)
        sums = [total + part for total, part in zip(state.sums, parts, strict=True)]
        trail = state.trail.with_vertex([*parts, image])
        scattered = scattering.active
        counts = [count + dr.select(scattered, here, 0) for count, here in zip(state.counts, met, strict=True)]
        throughput = dr.max(dr.abs(vertex.product.times(scattering.weight, vertex.depth).weight()))
        inverse = dr.select(scattered & (throughput > 0), dr.rcp(throughput), 0)
        trail.leaves(self.survival.cell(vertex.si.p, scattering.d), inverse)
        return replace(state, counts=counts, sums=sums, image=state.image + image, trail=trail)

    def aimed(self, state: Heard, factor: mi.Float) -> Heard:
        # Part of what paths say, other than the weight of a roulette that is being learned for.
        return replace(state, factor=[factor])

    def survived(self, state: Heard, weight: mi.Float) -> Heard:
        state.trail.survives(weight)
        return state


@dataclass
class Said:
    """What guided samples have said, evaluated: sums over paths.

    `starts` (voices * cells), voice by voice, the image last, are squares by the cell that a path starts in. By the
    cell that a ray leaves a vertex by (`transport/roulette.py`): `squares` (voices * CELLS) of what paths still said at
    a throughput of 1, the vertices that `followed` and the rays that `left` (CELLS). `whole` (rows * BINS) are squares
    by voice, the weights that paths left emitters with, and their vertices. `places` (voices * blocks, or none) are
    squares of what was said at a block of the film, as if no path had been aimed there.
    """

    starts: mi.Float
    squares: mi.Float
    followed: mi.Float
    left: mi.Float
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
        squares, followed, left = (np.array(sums) for sums in (self.squares, self.followed, self.left))
        squares = squares.reshape(len(said), CELLS)
        return Walked(squares, followed, left, np.array(said), float(light), 1 + float(count))


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
    said = Said(sums, *walk_back(heard.trail), whole, hooks.places)
    dr.eval(said)
    return said


def _sums(values: list[mi.Float], width: int) -> mi.Float:
    """Sums (len(values) * BINS) over paths, what is not finite left out."""
    result, lane = dr.zeros(mi.Float, len(values) * BINS), dr.arange(mi.UInt32, width) % BINS
    for number, value in enumerate(values):
        dr.scatter_reduce(dr.ReduceOp.Add, result, value, lane + number * BINS, dr.isfinite(value))
    return result
