"""Distribution of camera paths over the pixels, according to how much each pixel's noise affects the gradient.

In some scenes, only a few pixels matter. For example, a wall may be visible to camera paths only in the pixels of a
mirror, while other pixels show nothing that is differentiated. Before the first iteration, a few camera paths are
therefore traced through each pixel. For each differentiated BSDF, the module records the effect of these paths on the
gradient, as in `collect.py`. The loss of this gradient has dL/dI = 1.

    G = sum_i C_i n_i        n_i: number of factors of contribution C_i from this BSDF;  n = 1 for emission

Near the end of a run, dL/dI is mostly noise. In pixel j, dL/dI is w_j times the noise of I_j. The weight w_j is the
curvature of the loss, and 0 in an excluded pixel. With n_j paths in pixel j, the variance of the gradient is a sum over
the pixels.

    w_j^2 Var(I_j) (E G_j)^2 / n_j        The sum is least, at equal sums of n_j, for  n_j ~ w_j sd(I_j) E|G_j|.

The variances of several groups are added. Each group's variance is divided by the square of the group's whole gradient,
sum_j w_j E|G_j|. The quotient is multiplied by the group's number of entries, K. Each texel is visible in K times fewer
pixels than a colour, so its relative variance is K times larger. A rare bright path would attract all other paths to
its pixel. Means are therefore over blocks of pixels. No pixel's density exceeds MOST times the mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from reslrb_cli.guiding.collect import bsdf_groups, meets
from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.camera import CameraHooks, FilmRay, MetLight, NextEvent, camera_walk
from reslrb_cli.transport.densities import EmitterDensities
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples, passes
from reslrb_cli.transport.walk import Vertex

NOTED_SPP = 16  # recorded camera paths through each pixel
BLOCK = 9  # side length in pixels of the blocks for means
MOST = 8.0  # maximum density of a pixel, as a multiple of the mean
NOTING_STREAM = 0x9072E5  # seed of the recorded samples
LEAST_PATHS, MOST_PART = 1e7, 0.02  # for a run that has time for it, and the recording beside its samples


@dataclass
class NotedSums:
    """Loop state of the hooks.

    `counts` tells how often the path met each group's BSDFs. `sums` holds the sums G (C,) for the groups and for
    emission. The last entry is the radiance.
    """

    counts: list[mi.UInt32]
    sums: list[mi.Spectrum]


class Noting(CameraHooks):
    """Hooks that sum the contributions of each camera path, and add no derivatives."""

    def __init__(self, samples: Samples) -> None:
        self.plan, self.groups = samples.plan, bsdf_groups(samples.plan)

    def start(self, first: FilmRay) -> NotedSums:
        number = len(self.groups) + self.plan.differentiate_emission + 1
        return NotedSums([mi.UInt32(0) for _ in self.groups], [mi.Spectrum(0) for _ in range(number)])

    def vertex(
        self, state: NotedSums, vertex: Vertex, met: MetLight | None, event: NextEvent | None, scattering: Scattering
    ) -> NotedSums:  # fmt: skip
        P, zero = vertex.product.value(), mi.Spectrum(0)
        H = zero if met is None else dr.select(met.active, P * met.Le * met.weight, 0)
        N = zero if event is None else dr.select(event.active, P * event.c, 0)
        here = [meets(group, vertex) for group in self.groups]
        parts = [H * mi.Float(n) + N * mi.Float(n + own) for n, own in zip(state.counts, here, strict=True)]
        parts += [H + N] * (1 + self.plan.differentiate_emission)
        counts = [n + dr.select(scattering.active, own, 0) for n, own in zip(state.counts, here, strict=True)]
        return NotedSums(counts, [total + part for total, part in zip(state.sums, parts, strict=True)])


def note(samples: Samples) -> NDArray[np.float64]:
    """Return means over the camera paths of each pixel, (K, H, W): |G| of each group and of emission, |I|, and |I|^2.

    Values that are not finite count as 0.
    """
    hooks = Noting(samples)
    first, noted = camera_walk(samples, hooks)
    width, height = (int(n) for n in samples.film.size)
    pixel = mi.UInt32(first.u.y) * width + mi.UInt32(first.u.x)
    rows = [dr.norm(hooks.colours.seen(total * first.weight)) for total in noted.sums]
    rows.append(dr.square(rows[-1]))
    sums = dr.zeros(mi.Float, len(rows) * width * height)
    for number, value in enumerate(rows):
        dr.scatter_reduce(dr.ReduceOp.Add, sums, value, pixel + number * width * height, dr.isfinite(value))
    dr.eval(sums)
    return np.array(sums, np.float64).reshape(len(rows), height, width) * (width * height / samples.width)


def noted_part(paths: float, spp: float) -> float | None:
    """Return the share of a run's paths that is recorded, or None if the run has no time for the measurement.

    `paths` is the run's path count. `spp` is the path count per pixel over all iterations.
    """
    part = NOTED_SPP / spp
    return part if paths >= LEAST_PATHS and part <= MOST_PART else None


def wanted(
    plan: Plan, scene: mi.Scene, sensor: mi.Sensor, entries: list[int], light_share: float,
    emitters: EmitterDensities | None, curvature: NDArray[np.floating] | None = None,
) -> NDArray[np.float32]:  # fmt: skip
    """Return the density of camera paths over the pixels (H, W), with mean 1, for the current scene.

    `entries` has the number of differentiated entries of each group of BSDFs, and of emission. `light_share` and
    `emitters` are as in `samples.passes`. `curvature` (H, W) is the curvature of the loss, or None if it is the same in
    all pixels.
    """
    spp = math.ceil(NOTED_SPP / (1 - light_share)) if plan.weighs else NOTED_SPP
    seed = dr.opaque(mi.UInt32, NOTING_STREAM)
    samples, *_ = passes(plan, scene, sensor, seed, spp, None, None, light_share, emitters)
    return density_of(note(samples.sides()[-1]), entries, curvature)


def density_of(
    rows: NDArray[np.float64], entries: list[int], curvature: NDArray[np.floating] | None = None
) -> NDArray[np.float32]:
    """Return the density of camera paths over the pixels (H, W), with mean 1.

    `rows` are the means that `note` returns, and `curvature` (H, W) is the curvature of the loss.
    """
    from scipy import ndimage  # imported here: few commands need it, and all import this module

    # The variance of each pixel comes first, then the mean over a block: the joint variance of a block would count
    # edges and the surroundings of a lamp as noise. The curvature also comes before the mean: the noise at a lamp's
    # edge counts little in relative_l2, and not at all in excluded pixels.
    w = np.ones_like(rows[-1]) if curvature is None else curvature
    variances = np.square(w) * np.maximum(rows[-1] - np.square(rows[-2]), 0)
    *said, variance = (ndimage.uniform_filter(row, BLOCK, mode="nearest") for row in (*rows[:-2], variances))
    weight = np.zeros_like(variance)
    for K, row in zip(entries, said, strict=True):
        whole = np.sum(w * row)
        weight += K * np.square(row / whole) if whole > 0 else 0
    # The filter's running sums leave values just below 0 in empty regions.
    density = np.where(w > 0, np.sqrt(np.maximum(variance, 0) * weight), 0)
    if not density.sum() > 0:
        return np.ones_like(variance, np.float32)
    for _ in range(8):  # clipping raises all others
        density = np.minimum(density / density.mean(), MOST)
    return np.asarray(density / density.mean(), np.float32)
