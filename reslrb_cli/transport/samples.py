"""Samples of an image in passes: random numbers, number of paths, and film.

Images and gradients of several passes are added. In single precision, a sum over very many samples would lose the last
terms. With 1e8 samples, a sum in single precision would lose a quarter of a pixel. Each pass therefore has its own
block and gradients.

Random numbers are drawn in the order of Mitsuba's `ptracer`, even if they are not used. This package and `ptracer`
therefore trace the same paths from one seed. Low-discrepancy numbers (`sobol.py`) replace the first random numbers of
each path. A `Guide` draws the numbers of emission from a learned table (`guiding/tables.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.config.files import PASS_PATHS, PASS_SAMPLES, PASSES
from reslrb_cli.scene.edges import EdgeTable
from reslrb_cli.scene.graph import Lamp
from reslrb_cli.transport.aim import Aim
from reslrb_cli.transport.bsdf import EventNumbers
from reslrb_cli.transport.densities import EmitterDensities
from reslrb_cli.transport.film import Film
from reslrb_cli.transport.lamps import sums_of_areas
from reslrb_cli.transport.pixel_shares import PixelShares
from reslrb_cli.transport.plan import Grid, Plan
from reslrb_cli.transport.sobol import Net, Points

Array = np.ndarray[Any, Any]


def in_passes(
    samples: list[Samples], work: Callable[[Samples, mi.ImageBlock | None], None], block: mi.ImageBlock | None,
    params: mi.SceneParameters | None = None,
) -> None:  # fmt: skip
    """Call `work(part, block)` for each pass. `work` splats into the block and adds gradients of `params`.

    `block` is None if nothing is splatted, and `params` is None if nothing is differentiated.
    """
    if len(samples) == 1:
        work(samples[0], block)
        return
    sums = None if params is None else GradientSum(params)
    for part in samples:
        own = None if block is None else part.film.block()
        work(part, own)
        if block is not None:
            block.put_block(own)
        finish_pass([] if block is None else block.tensor())
        if sums is not None:
            sums.take()
    if sums is not None:
        sums.put()


def tracked_values(params: mi.SceneParameters) -> dict[str, Any]:
    """Return the values of all parameters that track derivatives, by name.

    `params[key]` is not used, because it fails for missing values such as an optional texture.
    """
    found = {}
    with dr.resume_grad():  # with suspended gradients, nothing shows that it tracks them
        for key, (value, kind, node, _) in params.properties.items():
            value = value if kind is None else params.get_property(value, kind, node)
            if dr.grad_enabled(value):
                found[key] = value
    return found


class GradientSum:
    """Sum of the parameters' gradients over passes, separate from the gradients of the current pass."""

    def __init__(self, params: mi.SceneParameters) -> None:
        with dr.resume_grad():
            self.values = [array for value in tracked_values(params).values() for array in _arrays(value)]
        self.totals: list[dr.ArrayBase] = []

    def take(self) -> None:
        """Add the current gradients of the parameters to the sums, and clear them."""
        with dr.resume_grad():
            found = [dr.detach(dr.grad(value)) for value in self.values]
            self.totals = [a + b for a, b in zip(self.totals, found, strict=True)] if self.totals else found
            for value in self.values:
                dr.clear_grad(value)
        finish_pass(self.totals)

    def put(self) -> None:
        """Write the sums to the gradients of the parameters."""
        with dr.resume_grad():
            for value, total in zip(self.values, self.totals, strict=True):
                dr.accum_grad(value, total)


def _arrays(value: dr.ArrayBase | mi.AffineTransform4f) -> list[dr.ArrayBase]:
    """Return the arrays of a parameter that have gradients. Transforms cannot be added, so the function returns the two
    arrays of a transform.
    """
    return [value.matrix, value.inverse_transpose] if isinstance(value, mi.AffineTransform4f) else [value]


def finish_pass(*results: object) -> None:
    """Evaluate the result of a pass and wait for it. Otherwise, queued passes would accumulate memory."""
    dr.eval(*results)
    dr.sync_thread()


#: Names of the random streams other than the sampler's own, mixed into the seed.
SELECTION_STREAM = 0x5E1EC7  # random numbers with which hooks select
VISIBLE_STREAM = 0xD1EC7  # primary rays
LAMP_STREAM = 0x1A3B5 << 12  # points of lamps; the lamp's number is added
CAMERA_STREAM = 0xCA3E2A  # seeds of camera paths, next to those of light paths
PASS_STREAM = 0x9A55E5  # seeds of the second and later passes
SMALL_LAMP_STREAM = 0x57A25  # points of lamps smaller than a pixel
GUIDE_STREAM = 0x6D1DE  # cells of emission
NET_STREAM = 0x5EC0E  # scrambles of low-discrepancy numbers


@dataclass
class Numbers(EventNumbers):
    """Random numbers of one path segment. `aperture` is a point on the sensor's aperture."""

    aperture: mi.Point2f

    @staticmethod
    def draw(sampler: mi.Sampler, active: mi.Bool) -> Numbers:
        """Draw the numbers of the next segment. After this call, the walk draws the random number for roulette."""
        aperture = sampler.next_2d(active)  # drawn first, as in `ptracer`
        return Numbers(sampler.next_2d(active), sampler.next_1d(active), aperture)

    def of_early(self, early: list[EventNumbers], depth: mi.UInt32) -> Numbers:
        """Return a copy of these numbers. At the first vertices, the `early` numbers replace the numbers for the BSDF.
        The first vertex has depth 1.
        """
        bsdf = EventNumbers(self.bsdf_2d, self.bsdf_1d)
        for bounce, own in enumerate(early):
            bsdf = dr.select(depth == bounce + 1, own, bsdf)
        return replace(self, bsdf_2d=bsdf.bsdf_2d, bsdf_1d=bsdf.bsdf_1d)


@dataclass
class Table:
    """Table for sampling.

    `slots` holds the cell of each slot, `weights` holds v / p of each cell, and `edges` holds the edges of the grid.
    `aim` holds data for aiming.
    """

    slots: mi.UInt32
    weights: mi.Float
    edges: mi.Float
    aim: Aim | None = None

    @staticmethod
    def of(grid: Grid, counts: Array, aim: Aim | None = None) -> Table:
        """Return the table in which cell k has `counts[k]` slots. The total is `grid.slots`."""
        weights = grid.measures() * grid.slots  # 0 without a slot
        weights /= np.maximum(counts, 1)
        return Table(
            own_memory(mi.UInt32, np.repeat(np.arange(grid.cells, dtype=np.uint32), counts)),
            own_memory(mi.Float, weights.astype(np.float32)),
            own_memory(mi.Float, np.array(grid.edges, np.float32)),
            aim,
        )


@dataclass
class Drawn:
    """Random numbers of emission that a guide has drawn. `cell` is the cell of these numbers, and `weight` is the
    cell's v / p.
    """

    choice: mi.Float
    position: mi.Point2f
    direction: mi.Point2f
    cell: mi.UInt32
    weight: mi.Float


@dataclass
class Guide:
    """Table, and the number of lanes that share the table. The number is opaque."""

    table: Table
    lanes: mi.UInt64

    @staticmethod
    def of(table: Table, width: int) -> Guide:
        """Return a guide for a pass of `width` light paths."""
        return Guide(table, dr.opaque(mi.UInt64, width))

    def draw(
        self, grid: Grid, width: int, stream: mi.PCG32, choice: mi.Float, position: mi.Point2f, direction: mi.Point2f,
    ) -> Drawn:  # fmt: skip
        """Draw the start of each of `width` lanes. The random numbers `choice`, `position` and `direction` determine
        the start's place within its cell.
        """
        lane, jitter = mi.UInt64(dr.arange(mi.UInt32, width)), mi.UInt64(stream.next_uint32())
        slot = ((lane << 32) | jitter) // self.lanes >> (32 - (grid.slots.bit_length() - 1))
        cell = dr.gather(mi.UInt32, self.table.slots, mi.UInt32(slot))
        weight = dr.gather(mi.Float, self.table.weights, cell)
        numbers, shift, below = [position.x, position.y, direction.x, direction.y], 0, dr.one_minus_epsilon(mi.Float)
        for k, bits in enumerate(grid.bits):
            if bits > 0:
                index = (cell >> shift) & ((1 << bits) - 1)
                # Rounding may reach the next cell, but must not leave the cube.
                numbers[k] = dr.minimum((mi.Float(index) + numbers[k]) * 2.0**-bits, below)
                shift += bits
        if grid.emitters > 1:
            emitter = cell >> shift
            begin, end = (dr.gather(mi.Float, self.table.edges, emitter + k) for k in (0, 1))
            choice = dr.minimum(dr.fma(choice, end - begin, begin), end * below)
        return Drawn(choice, mi.Point2f(numbers[0], numbers[1]), mi.Point2f(numbers[2], numbers[3]), cell, weight)


@dataclass
class Samples:
    """Samples of one pass: `width` light paths, or `width` camera paths if `plan.camera` is true. `seed` is an opaque
    UInt32.

    `scale` (width 1) normalises a sum over paths to an image. The pass contains a share `fraction` (width 1) of the
    image's samples. With a `guide`, emission is sampled from its table. With a `net`, the first numbers are
    low-discrepancy numbers.
    """

    scene: mi.Scene
    sensor: mi.Sensor
    plan: Plan
    film: Film
    seed: mi.UInt32
    spp: int
    width: int
    scale: mi.Float
    fraction: mi.Float
    guide: Guide | None = None
    net: Net | None = None
    #: If paths from both sides are weighted: all light paths divided by the camera paths of a pixel (width 1).
    ratio: mi.Float | None = None
    #: The emitters' densities, if paths from both sides are weighted or not all emitters are lit.
    emitters: EmitterDensities | None = None
    #: Distribution of the camera paths over the pixels; None: uniform.
    shares: PixelShares | None = None
    #: The edges of moving shapes, if the gradient includes the derivatives of edges.
    edges: EdgeTable | None = None
    #: The camera paths of the same pass, next to light paths.
    camera: Samples | None = None
    #: Cumulative areas of the faces of lamps with moving faces.
    areas: dict[Lamp, mi.Float] = field(init=False)

    def __post_init__(self) -> None:
        # Evaluated now: during tracing, they would split a kernel.
        lamps = self.plan.reshaped_lamps
        self.areas = dict(zip(lamps, sums_of_areas(lamps), strict=True)) if lamps else {}

    def ratio_at(self, u: mi.Point2f) -> mi.Float:
        """Return the number of all light paths divided by one pixel's number of camera paths. The film position `u`
        selects the pixel.

        For positions off the film, the mean number of camera paths per pixel replaces the pixel's number.
        """
        assert self.ratio is not None
        if self.shares is None:
            return self.ratio
        width, height = (int(n) for n in self.film.size)
        inside = (u.x >= 0) & (u.x < width) & (u.y >= 0) & (u.y < height)
        pixel = mi.UInt32(mi.Int32(u.y) * width + mi.Int32(u.x))
        mean = self.shares.mean()
        return self.ratio * dr.select(inside, mean / self.shares.count(pixel, inside), 1)

    def choose_emitter(self, number: mi.Float, active: mi.Bool) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Select a lit emitter. Returns its index in `scene.emitters()`, 1 / probability, and a new uniform number."""
        if self.plan.lit is None:
            index, weight, reused = self.scene.sample_emitter(number, active)
            return index, weight, reused
        assert self.emitters is not None
        return self.emitters.select(number, active)

    def emitter_of(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.EmitterPtr:
        """Return the lit emitter at `si`, or null."""
        emitter = si.emitter(self.scene, active)
        if self.plan.lit is None:
            return emitter
        assert self.emitters is not None
        on = dr.gather(mi.UInt32, self.emitters.on, dr.reinterpret_array(mi.UInt32, emitter), active)
        return dr.select(on != 0, emitter, dr.zeros(mi.EmitterPtr))

    def chance_of(self, lamp: Lamp) -> mi.Float:
        """Return the probability that `choose_emitter` selects a lamp."""
        if self.plan.lit is None:
            return self.scene.pdf_emitter(mi.UInt32(lamp.index))
        assert self.emitters is not None
        number = dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(lamp.emitter))
        return dr.gather(mi.Float, self.emitters.choice, number)

    def sampler(self) -> mi.Sampler:
        """Return a sampler at the beginning of these samples' random number stream.

        Light paths alone use the sensor's sampler if it can make this number of samples. A stratified sampler, for
        example, makes only square numbers. Otherwise the random numbers are independent.
        """
        sampler = self.sensor.sampler().clone()
        sampler.set_sample_count(self.spp)
        if self.plan.paths != "light" or sampler.sample_count() != self.spp:
            sampler = mi.load_dict({"type": "independent"})
        else:
            sampler.set_samples_per_wavefront(self.spp)
        sampler.seed(self.seed, self.width)
        return sampler

    def sides(self) -> list[Samples]:
        """Return these samples, and the camera paths of the same pass."""
        return [self] if self.camera is None else [self, self.camera]

    def with_edges(self, edges: EdgeTable, of_camera: EdgeTable | None = None) -> Samples:
        """Return the same samples with edges. The camera paths of the same pass, next to light paths, have others."""
        camera = self.camera if self.camera is None else replace(self.camera, edges=of_camera)
        return replace(self, edges=edges, camera=camera)

    def stream(self, name: int) -> mi.PCG32:
        """Return a stream of random numbers independent of the sampler, so that light paths remain those of `ptracer`.

        The stream is hashed for each lane, as in Mitsuba's samplers. Without the hash, the first numbers of the lanes
        would be evenly distributed, with the same offset for all seeds.
        """
        seed = mi.sample_tea_32(self.seed, mi.UInt32(name))[0]
        state, sequence = mi.sample_tea_32(seed, dr.arange(mi.UInt32, self.width))
        return mi.PCG32(1, mi.UInt64(state), mi.UInt64(sequence))

    def time(self, next_1d: Callable[[], mi.Float]) -> mi.Float:
        """Return a time within the shutter interval. A random number is drawn only if the interval is longer than 0."""
        time = mi.Float(self.sensor.shutter_open())
        if self.plan.needs.moving_shutter:
            time += next_1d() * self.sensor.shutter_open_time()
        return time

    def emission_numbers(self, sampler: mi.Sampler) -> tuple[mi.Float, mi.Point2f, mi.Point2f]:
        """Return the random numbers of emission in the order of `ptracer`. The order is the choice of an emitter, the
        place, and the direction.
        """
        choice, place, direction = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
        if self.net is None:
            return choice, place, direction
        return self._points(choice, place, direction)[1]

    def early_numbers(self) -> list[EventNumbers]:
        """Return the low-discrepancy numbers for the BSDFs of the first vertices. Return an empty list if there are no
        low-discrepancy numbers.
        """
        if self.net is None:
            return []
        assert self.plan.sequence is not None
        # Their dimensions in the sequence follow those of emission.
        points, _ = self._points(mi.Float(0), mi.Point2f(0), mi.Point2f(0))
        return [EventNumbers(points.next_2d(), points.next_1d()) for _ in range(self.plan.sequence.bounces)]

    def _points(
        self, choice: mi.Float, place: mi.Point2f, direction: mi.Point2f
    ) -> tuple[Points, tuple[mi.Float, mi.Point2f, mi.Point2f]]:
        """Return the net's points and the random numbers of emission. The numbers of emission have already been drawn
        from the points.

        `choice`, `place` and `direction` are the corresponding independent random numbers.
        """
        which = self.plan.sequence
        assert which is not None
        # A guide stratifies the lanes itself, including emitters: the position of a choice within its share carries no
        # information.
        guided = self.guide is not None
        points = Points(mi.sample_tea_32(self.seed, mi.UInt32(NET_STREAM))[0], self.width, None if guided else self.net)
        if which.choice and not guided:
            choice = points.next_1d(choice)
        direction = points.next_2d(direction, which.direction)
        place = points.next_2d(place, which.place)
        points.net = None  # with or without stratified numbers
        return points, (choice, place, direction)

    def drawn(self, choice: mi.Float, position: mi.Point2f, direction: mi.Point2f) -> Drawn | None:
        """Return the start of each path from the guide, or None without a guide. The arguments are emission's own
        random numbers.
        """
        if self.guide is None:
            return None
        assert self.plan.grid is not None
        stream = self.stream(GUIDE_STREAM)
        return self.guide.draw(self.plan.grid, self.width, stream, choice, position, direction)


def passes(
    plan: Plan, scene: mi.Scene, sensor: mi.Sensor, seed: mi.UInt32, spp: int, spp_per_pass: int | None,
    table: Table | None = None, light_share: float = 1, emitters: EmitterDensities | None = None,
    shares: Callable[[int], PixelShares | None] | None = None,
) -> list[Samples]:  # fmt: skip
    """Return all samples of an image in passes of at most `spp_per_pass` samples per pixel. `spp_per_pass` must divide
    `spp`.

    The first pass uses `seed` itself, so that it traces the same paths as `ptracer`. With a `table` for the plan's
    grid, emission is sampled from the table. If the plan has both kinds of paths, `light_share` is the share of light
    paths in each pass. If both kinds are weighted, `emitters` has the emitters' densities. Raises ValueError for
    too many passes, or too many paths in one pass.
    """
    unit = spp if spp_per_pass is None else min(spp_per_pass, spp)
    if spp % unit:
        raise ValueError(f"the sample count ({spp}) must be a multiple of samples_per_pass ({unit})")
    if -(-unit // PASS_SAMPLES) * (spp // unit) > PASSES:
        raise ValueError(
            f"{spp} samples per pixel in passes of {min(unit, PASS_SAMPLES)} are more than {PASSES} passes"
        )
    sizes = _parts(unit) * (spp // unit)
    # Opaque: a literal seed in the kernel would compile a new one each step.
    others = [mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(PASS_STREAM + p))[0] for p in range(1, len(sizes))]
    seeds = [mi.UInt32(seed), *others]
    dr.make_opaque(seeds)
    if plan.lit is not None and emitters is None:
        emitters = EmitterDensities.of(plan, scene)
    if table is None:  # a plan has a grid only if paths are guided
        plan = replace(plan, grid=None, aims=False)
    film, pixels = Film(sensor, plan.whole), int(dr.prod(sensor.film().size()))  # as in `ptracer`
    crop = int(dr.prod(film.size))
    # Opaque: literals would compile kernels for every sample count.
    scale = dr.opaque(mi.Float, float(crop) / (float(pixels) * spp))

    def part(size: int) -> Samples:
        """Return one pass. If the plan has both kinds of paths, the pass has at least one path of each kind."""
        fraction, own_scale, ratio, camera = dr.opaque(mi.Float, size / spp), scale, None, None
        n_camera = size * crop
        width = n_camera if plan.paths == "camera" else size * pixels
        if plan.paths == "both":
            width = max(round(light_share * size * pixels), 1)
            n_camera = max(round((1 - light_share) * size * crop), 1)
            ratio = dr.opaque(mi.Float, width / (n_camera / crop)) if plan.weighs else None
            own_scale = dr.opaque(mi.Float, crop / width) * fraction
        most = max(width, n_camera)
        if most > PASS_PATHS:
            raise ValueError(f"{most} paths in one pass are more than 2^32 - 1: set samples_per_pass below {size}")
        given = scene, sensor, plan, film, seeds[0], size
        if plan.paths != "light":
            camera_scale = dr.opaque(mi.Float, crop / n_camera) * fraction
            dr.make_opaque(own_scale, camera_scale)
            own = None if shares is None else shares(n_camera)
            camera = Samples(*given, n_camera, camera_scale, fraction, None, None, ratio, emitters, own)
            camera.plan = plan.for_camera()
            if plan.paths == "camera":
                return camera
        guide, net = None if table is None else Guide.of(table, width), None if plan.sequence is None else Net.of(width)
        shared = None if camera is None else camera.shares
        return Samples(*given, width, own_scale, fraction, guide, net, ratio, emitters, shared, camera=camera)

    made = {size: part(size) for size in set(sizes)}
    return [_seeded(made[size], s) for size, s in zip(sizes, seeds, strict=True)]


def _seeded(samples: Samples, seed: mi.UInt32) -> Samples:
    """Return the same samples with another seed."""
    camera = samples.camera
    if camera is not None:
        apart = mi.sample_tea_32(seed, mi.UInt32(CAMERA_STREAM))[0]
        dr.make_opaque(apart)
        camera = replace(camera, seed=apart)
    return replace(samples, seed=seed, camera=camera)


def _parts(spp: int) -> list[int]:
    """Divide `spp` into the fewest parts of at most PASS_SAMPLES samples. Their sizes differ by at most 1."""
    count = -(-spp // PASS_SAMPLES)
    return [spp // count + (part < spp % count) for part in range(count)]
