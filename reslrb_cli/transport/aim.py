"""Scattering towards points that the sensor sees, mixed with BSDF sampling.

A glossy surface reflects light to the sensor from few directions. Few paths arrive from the directions that a glossy
surface reflects to the sensor. The weights of these few paths are so large that they dominate the noise. At each
surface, a share SHARE of the paths is therefore aimed at a point that the sensor sees. A position on the film is
sampled, the first surface there is found, and the path continues to it. The next vertex z can be found by BSDF sampling
or by aiming. Both ways form a mixture in the one-sample model with the balance heuristic (Veach's thesis, ch. 9). The
following weight replaces f cos / p_b.

    f cos / ((1 - SHARE) p_b + SHARE p_a)        p_a = p_film |cos_z| W / d^2 * |x - z|^2 / |cos|

p_b is the density of the BSDF's directions at x. W / d^2 is the sensor's importance and geometry at z. cos_z is the
cosine at z towards the sensor, and cos is the cosine at z towards x. If the sensor does not see z, p_a is 0. The
visibility of z is known only when the path reaches z. A path therefore leaves x with the weight f cos / p_b, whether
the sensor sees z or not. At z, the path's weight is multiplied by r, which is at most 1 / (1 - SHARE).

    r = 1 / ((1 - SHARE) + SHARE p_a / p_b)

An aimed path ends if it meets another surface on its way, or a point that the sensor does not see. Like the weight of
roulette, r has no derivative.

A film position is sampled as a block of pixels (`Aim`) and a position in the block. A share AIM_UNIFORM is uniform. The
remaining share of film positions follows the contributions found in earlier steps. The remaining share also follows the
step's own dL/dI if dL/dI is known before the samples are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.scene.needs import SceneNeeds
from reslrb_cli.transport.bsdf import Aimed
from reslrb_cli.transport.connection import Connection

SHARE = 0.25  # share of aimed paths among the scattered ones
AIM_UNIFORM = 0.2  # minimum share of aimed paths with a uniform target on the film
AIM_SLOTS = 1 << 17
BLOCKS = 1 << 14  # maximum number of blocks of pixels
REACHED = 1 - 1e-3  # part of the distance to a point that must be free, as for shadow rays


@dataclass(frozen=True)
class Blocks:
    """Blocks of `side` x `side` pixels that cover a film (crop window) of `width` x `height`. The last blocks may be
    cut off.
    """

    width: int
    height: int
    side: int

    @staticmethod
    def of(size: tuple[int, int]) -> Blocks:
        """Return the smallest blocks that cover the film with at most BLOCKS blocks."""
        side = 1
        while -(-size[0] // side) * -(-size[1] // side) > BLOCKS:
            side += 1
        return Blocks(*size, side)

    @property
    def columns(self) -> int:
        return -(-self.width // self.side)

    @property
    def rows(self) -> int:
        return -(-self.height // self.side)

    @property
    def count(self) -> int:
        return self.rows * self.columns

    def block(self, u: mi.Point2f) -> mi.UInt32:
        """Return the block of a film position (pixels), or the nearest block."""
        column, row = (mi.UInt32(dr.clip(x, 0, n - 1)) // self.side for x, n in ((u.x, self.width), (u.y, self.height)))
        return row * self.columns + column

    def areas(self) -> NDArray[np.float64]:
        """Return the number of pixels of each block (rows * columns)."""
        across, down = (np.minimum(self.side, n - np.arange(0, n, self.side)) for n in (self.width, self.height))
        return np.outer(down, across).ravel().astype(np.float64)

    def root_means(self, image: mi.TensorXf) -> NDArray[np.float64]:
        """Return the root mean square of an image (height, width, C) in each block (rows * columns), times the block's
        area.

        All values are divided by the image's largest absolute value. Values that are not finite count as 0.
        """
        channels, values = image.shape[2], dr.abs(image.array)
        values = dr.select(dr.isfinite(values), values, 0)
        largest = dr.max(values)
        values = dr.select(largest > 0, values / largest, 0)
        pixel = dr.arange(mi.UInt32, self.width * self.height)
        square = mi.Float(0)
        for channel in range(channels):
            square += dr.square(dr.gather(mi.Float, values, pixel * channels + channel))
        sums = dr.zeros(mi.Float, self.count)
        position = mi.Point2f(pixel % self.width, pixel // self.width)
        dr.scatter_reduce(dr.ReduceOp.Add, sums, square, self.block(position))
        return np.sqrt(np.array(sums, np.float64) * self.areas())


def film_blocks(sensor: mi.Sensor) -> Blocks:
    """Return the blocks of a sensor's film."""
    size = sensor.film().crop_size()
    return Blocks.of((int(size[0]), int(size[1])))


@dataclass
class Aim:
    """Sampling of positions on the film.

    `slots` holds the block of each slot (AIM_SLOTS). `density` holds the density of film positions in each block,
    relative to a uniform density.
    """

    slots: mi.UInt32
    density: mi.Float

    @staticmethod
    def of(blocks: Blocks, wanted: NDArray[np.float64]) -> Aim:
        """Return an `Aim` whose blocks have a density proportional to `wanted` (rows * columns, nonnegative). A share
        AIM_UNIFORM of the density is uniform.
        """
        even = blocks.areas() / blocks.areas().sum()
        total = wanted.sum()
        density = AIM_UNIFORM * even + (1 - AIM_UNIFORM) * (
            wanted / total if np.isfinite(total) and total > 0 else even
        )
        # One each, so that every block gets paths; the rest is rounded along the order of the blocks.
        ends = np.rint(np.cumsum(density) * ((AIM_SLOTS - len(even)) / density.sum()))
        counts = 1 + np.diff(ends, prepend=0).astype(np.int64)
        return Aim(
            own_memory(mi.UInt32, np.repeat(np.arange(len(counts), dtype=np.uint32), counts)),
            own_memory(mi.Float, (counts / AIM_SLOTS / even).astype(np.float32)),
        )


@dataclass
class Pending:
    """Loop state: data of the last scattering event, needed at the next vertex.

    `share` is the share of aimed paths at the last scattering event. `pdf` is p_b, or infinity for discrete directions.
    Aimed paths never take discrete directions. `distance` is the distance to the target point, or negative if the path
    is not aimed.
    """

    share: mi.Float
    pdf: mi.Float
    distance: mi.Float

    @staticmethod
    def of(aimed: Aimed, si: mi.SurfaceInteraction3f, pdf: mi.Float, discrete: mi.Bool) -> Pending:
        """Return the state after an event at `si`. `pdf` is the density of the event's direction. `discrete` marks the
        lanes in which the direction is discrete.
        """
        distance = dr.select(aimed.active, dr.norm(aimed.point - si.p), -1)
        return Pending(aimed.share, dr.select(discrete, dr.inf, dr.detach(pdf)), dr.detach(distance))

    def factor(
        self, aim: Aim, sensor: mi.Sensor, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, connection: Connection,
        visible: mi.Bool,
    ) -> mi.Float:  # fmt: skip
        """Return the factor r at the vertex `si` that `ray` reaches. It is 0 if the path ends there.

        `visible` tells whether the sensor sees the vertex. `connection` has no correction for shading normals, like a
        connection from an emitter.
        """
        film = film_blocks(sensor)
        p_film = dr.gather(mi.Float, aim.density, film.block(connection.u), visible)
        cos_z = dr.abs(dr.dot(si.n, dr.normalize(connection.target - si.p)))
        cos = dr.maximum(dr.abs(dr.dot(si.n, ray.d)), 1e-20)
        p_a = p_film * cos_z * connection.rest[0] * dr.square(si.t) / cos
        r = dr.rcp((1 - self.share) + self.share * dr.select(visible, p_a, 0) / self.pdf)
        missed = (self.distance > 0) & ~(visible & (si.t > self.distance * REACHED))
        return dr.detach(dr.select(missed, 0, r))


def worthwhile(needs: SceneNeeds, max_depth: int) -> bool:
    """Whether paths are aimed in this scene. Aiming needs glossy surfaces and a pinhole camera.

    Diffuse surfaces gain little, because they reflect light from all directions. Perturbed normals use their own
    mixture.
    """
    return needs.has_glossy and not (needs.thin_lens or needs.has_perturbed_normals) and max_depth > 2


def aims_from(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Return the lanes whose BSDF allows aiming. The surface at the target point must also have a BSDF that allows
    aiming.
    """
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def choose(
    scene: mi.Scene, sensor: mi.Sensor, aim: Aim, time: mi.Float, bsdf_1d: mi.Float, bsdf_2d: mi.Point2f,
    slot: mi.Float, able: mi.Bool,
) -> tuple[Aimed, mi.Float]:  # fmt: skip
    """Choose which of the `able` lanes are aimed, and choose their target points.

    The BSDF's 1D random number `bsdf_1d` selects the aimed lanes. The function also returns `bsdf_1d`, rescaled for the
    lanes that are not aimed. `slot`, in [0, 1), selects the block of film pixels. The BSDF's two other random numbers,
    `bsdf_2d`, give the position within the block.
    """
    share, below = dr.select(able, mi.Float(SHARE), 0), dr.one_minus_epsilon(mi.Float)
    active = bsdf_1d < share
    own = dr.select(active, bsdf_1d / share, (bsdf_1d - share) / (1 - share))
    film = film_blocks(sensor)
    block = dr.gather(mi.UInt32, aim.slots, dr.minimum(mi.UInt32(slot * AIM_SLOTS), AIM_SLOTS - 1), active)
    begin = mi.Vector2f(block % film.columns, block // film.columns) * film.side
    end = dr.minimum(begin + film.side, mi.Vector2f(film.width, film.height))
    u = dr.fma(bsdf_2d, end - begin, begin) / mi.Vector2f(film.width, film.height)
    ray, _ = sensor.sample_ray(time, 0.5, mi.Point2f(u), mi.Point2f(0.5), active)
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    aimed = Aimed(active, dr.detach(ray(pi.t)), pi.is_valid(), share)
    return aimed, dr.clip(own, 0, below)
