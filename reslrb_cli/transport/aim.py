"""Scattering that is aimed at what the sensor sees, mixed with the BSDF's own.

A glossy surface that faces the sensor shows the light of directions which few paths come from, and those few count for
so much that they make up most of the noise. So of the paths that scatter at a surface a share SHARE is sent to a point
that the sensor sees: a position on the film is drawn, the first surface there is found, and the path goes on to it.
Both ways of finding the next vertex z are one mixture (Veach's thesis, ch. 9; one-sample model, balance heuristic). In
place of f cos / p_b a path has

    f cos / ((1 - SHARE) p_b + SHARE p_a)        p_a = p_film |cos_z| W / d^2 * |x - z|^2 / |cos|

for p_b the density of the BSDF's own directions at x, W / d^2 the sensor's importance and geometry at z, cos_z towards
the sensor and cos towards x. p_a is 0 where the sensor does not see z, which only z can know. So a path that leaves x
has the weight f cos / p_b with either way, and at z the factor

    r = 1 / ((1 - SHARE) + SHARE p_a / p_b)

which is at most 1 / (1 - SHARE). A path that was aimed and meets something else on its way, or a point that the sensor
does not see, ends. r has no derivative, as little as a weight of roulette.

Positions on the film are drawn by blocks of pixels, AIM_UNIFORM of them evenly, the others by what earlier steps have
found and by the step's own dL/dI, where that is known before its samples are drawn (`Aim`).
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
from reslrb_cli.transport.film import Blocks, film_blocks

SHARE = 0.25  # of the paths that scatter
AIM_UNIFORM = 0.2  # of these, how many are sent to places drawn evenly on the film, at least
AIM_SLOTS = 1 << 17
REACHED = 1 - 1e-3  # of the distance to a point, where nothing stands in the way: as far as shadow rays look


@dataclass
class Aim:
    """Where on the film paths are sent: the block of each slot (SLOTS), and the density of each block's positions,
    relative to an even one."""

    slots: mi.UInt32
    density: mi.Float

    @staticmethod
    def of(blocks: Blocks, wanted: NDArray[np.float64]) -> Aim:
        """Blocks in proportion to `wanted` (rows * columns), nowhere negative, and UNIFORM of them evenly."""
        even = blocks.areas() / blocks.areas().sum()
        total = wanted.sum()
        density = AIM_UNIFORM * even + (1 - AIM_UNIFORM) * (
            wanted / total if np.isfinite(total) and total > 0 else even
        )
        # One each, so that there is none that no path is sent to; the others rounded along the blocks' order.
        ends = np.rint(np.cumsum(density) * ((AIM_SLOTS - len(even)) / density.sum()))
        counts = 1 + np.diff(ends, prepend=0).astype(np.int64)
        return Aim(
            own_memory(mi.UInt32, np.repeat(np.arange(len(counts), dtype=np.uint32), counts)),
            own_memory(mi.Float, (counts / AIM_SLOTS / even).astype(np.float32)),
        )


@dataclass
class Pending:
    """Loop state: what the next vertex is to know of the event that its path comes from.

    `share` is that of aimed paths there, `pdf` p_b (infinite where the direction was one of few, which no aimed path
    takes), `distance` how far away the point is that it was aimed at; negative where it was not.
    """

    share: mi.Float
    pdf: mi.Float
    distance: mi.Float

    @staticmethod
    def nothing() -> Pending:
        """That of a path that leaves an emitter."""
        return Pending(mi.Float(0), mi.Float(1), mi.Float(-1))

    @staticmethod
    def of(aimed: Aimed, si: mi.SurfaceInteraction3f, pdf: mi.Float, discrete: mi.Bool) -> Pending:
        """That of an event at `si`, aimed or not, that gave a direction of this density, or one of few."""
        distance = dr.select(aimed.active, dr.norm(aimed.point - si.p), -1)
        return Pending(aimed.share, dr.select(discrete, dr.inf, dr.detach(pdf)), dr.detach(distance))

    def factor(
        self, aim: Aim, sensor: mi.Sensor, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, connection: Connection,
        visible: mi.Bool,
    ) -> mi.Float:  # fmt: skip
        """r at the vertex `si`, which `ray` reaches, and from which the sensor is `visible`; 0 where its path ends.

        `connection` is as from an emitter, without the correction for shading normals.
        """
        film = film_blocks(sensor)
        p_film = dr.gather(mi.Float, aim.density, film.block(connection.u), visible)
        cos_z = dr.abs(dr.dot(si.n, dr.normalize(connection.target - si.p)))
        cos = dr.maximum(dr.abs(dr.dot(si.n, ray.d)), 1e-20)
        p_a = p_film * cos_z * connection.weight[0] * dr.square(si.t) / cos
        r = dr.rcp((1 - self.share) + self.share * dr.select(visible, p_a, 0) / self.pdf)
        missed = (self.distance > 0) & ~(visible & (si.t > self.distance * REACHED))
        return dr.detach(dr.select(missed, 0, r))


def worthwhile(needs: SceneNeeds, max_depth: int) -> bool:
    """Whether paths are aimed in such a scene: where there are glossy surfaces, and a pinhole that sees them.

    Diffuse ones gain little by it: they show what comes from anywhere. Perturbed normals have a mixture of their own.
    """
    return needs.has_glossy and not (needs.thin_lens or needs.has_perturbed_normals) and max_depth > 2


def aims_from(bsdf: mi.BSDFPtr) -> mi.Bool:
    """Lanes whose BSDF lets paths be aimed; no path is aimed at others either."""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)


def choose(
    scene: mi.Scene, sensor: mi.Sensor, aim: Aim, time: mi.Float, bsdf_1d: mi.Float, bsdf_2d: mi.Point2f,
    slot: mi.Float, able: mi.Bool,
) -> tuple[Aimed, mi.Float]:  # fmt: skip
    """Which of the lanes that are `able` are aimed, and where to; and the BSDF's one number, new for the others.

    The BSDF's one number chooses; `slot`, in [0, 1), and the BSDF's other two are the position on the film.
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
