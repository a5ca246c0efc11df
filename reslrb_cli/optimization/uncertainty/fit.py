"""Test of fit: whether noise explains the residual between the images of the final values and the targets.

The noise of a target file is not known. But the noise of pixels far enough apart is independent, whereas an error of
the model changes neighbouring pixels alike. The test therefore uses products of the residuals of different pixels. A
pixel and another pixel of one window are compared if their distance is a multiple of a lattice constant, beyond which
the film's filter does not correlate the noise. With the residual V_c of a cell c, which has a component for each pixel
and channel,

    Q(s) = sum over windows of s x s cells (|sum V_c|^2 - sum |V_c|^2)

has a mean of 0 for noise. Random signs of the cells give the distribution of all Q(s) for noise with the same second
moments, whatever its size and its tails. The largest Q(s), in standard deviations, decides.

Each pixel has the weight 1 / (noise^2 + (`FLOOR` target)^2) for the decision. The size of the misfit has the weights of
the loss. For a misfit that is constant in each window, Q(s) is n (n - 1) / n times the sum of its squares over the n
cells of each window. The `energy` is this sum for the scale with the largest sum, so that the misfit adds energy / 2 to
the loss. A misfit that the parameters have made up for is not in it. The misfit that they have made up for is assumed
to be as large as the one that is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np

from reslrb_cli.optimization.nonfinite import finite
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import see_images
from reslrb_cli.optimization.uncertainty.curvature import LossCurvature
from reslrb_cli.optimization.uncertainty.noise import second_derivative
from reslrb_cli.optimization.views import View, slope
from reslrb_cli.records.decisions import Jsonable
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import Array

PURPOSE = "fit"
#: Images of the final values, each with the samples of a step, and the least samples of all together.
IMAGES, LEAST_SPP = 8, 64
#: Side in pixels of the mean of the noise's variance.
SMOOTHED = 5
#: Deviation of a pixel, as a share of the target, that counts as much as noise of the same size.
FLOOR = 0.02
#: Correlation of the film's filter that counts as none. Lattice constant of compressed files, whose blocks have common
#: noise.
UNCORRELATED, COMPRESSED, COMPRESSED_FILES = 1e-3, 8, (".jpg", ".jpeg", ".webp", ".heic", ".avif")
#: Limit of the squares of residuals, relative to their expected variance, in their mean.
MOST_RATIO = 9.0
#: Maximum number of cells along a side of the image.
MOST_CELLS = 64
#: Number of random signs, and of values that are computed at once.
FLIPS, MOST_AT_ONCE = 499, 2**21
#: Standard deviations of noise that the energy must exceed.
LEAST_ENERGY = 3.0


@dataclass(frozen=True)
class Candidate(Jsonable):
    """A parameter that would reduce the misfit: `explained` is the share of the misfit's loss, at most 1. `value` is
    the present value, and `proposed` the value to which the test points, empty if this is outside of the bounds; a
    texture has one factor for each channel.
    `p` is the probability that noise shows any of the tested parameters like this one. `bounds` are YAML, or "".
    """

    key: str
    p: float
    explained: float
    value: list[float]
    proposed: list[float]
    bounds: str = ""


@dataclass(frozen=True)
class FitRecord(Jsonable):
    """Whether the model fits the targets. `p` is the probability that noise looks like the residuals or, if it is
    smaller, like the effect of any of the tested parameters. `misfit` is the root mean square of the misfit over the
    images, as a share of the target's. `energy` is twice the loss of the misfit. `candidates` are parameters that would
    reduce the misfit, the most effective one first.
    """

    p: float
    misfit: float
    energy: float
    is_significant: bool
    candidates: list[Candidate]

    def without(self, energy: float) -> FitRecord:
        """Return the record without the part of the energy that offsets of the recovered values explain. Without any
        energy left, the model fits.
        """
        left = max(self.energy - energy, 0.0)
        if left == 0:
            return replace(self, misfit=0.0, energy=0.0, is_significant=False, candidates=[])
        return replace(self, misfit=self.misfit * (left / self.energy) ** 0.5, energy=left)


@dataclass(frozen=True)
class Residual:
    """Residual of a view: dL/dI (H, W, C) at the final values, and the variance of its noise (H, W, C). The variance
    contains a factor for neighbouring pixels, as if all were independent.
    """

    slope: Array
    variance: Array


@dataclass(frozen=True)
class Fit:
    """Result of the test of fit. `p` is the probability that noise looks like the residuals. `energy` is twice the loss
    of the misfit, `total` that of the whole residuals, and `size` that of black images.
    """

    p: float
    energy: float
    total: float
    size: float
    residuals: list[Residual]


def measure_fit(problem: Problem, curvature: LossCurvature) -> Fit:
    """Test the images of the current values against the targets of all training views.

    `curvature` has measured the recovered directions. The parameters may still be on their way to the optimum. The part
    of the residual that their movement would remove is subtracted.
    """
    spp = problem.config.run.spp
    count = max(IMAGES, -(-LEAST_SPP // spp))
    images = [see_images(problem, spp, -each, PURPOSE) for each in range(count)]
    random = np.random.default_rng(seed(problem.config.run.seed, 0, 0, PURPOSE))
    judged, energy, total, size = [], 0.0, 0.0, 0.0
    residuals: list[Residual] = []
    means = [np.array(samples, dtype=np.float64).mean(axis=0) for samples in zip(*images, strict=True)]
    slopes = [finite(slope(view.judge, mean)) * view.share for view, mean in zip(problem.trained, means, strict=True)]
    removed = curvature.removed(slopes)
    for number, (view, samples) in enumerate(zip(problem.trained, zip(*images, strict=True), strict=True)):
        known, true = np.array(samples, dtype=np.float64), np.array(view.target, dtype=np.float64)
        mean = means[number]
        residual = finite(view.kept(mean - true)) - removed[number]
        lattice, correlated = lattice_of(problem, view)
        noise, weight = _noise(known, true), second_derivative(view, mean)
        judged.append(compare(cells_of(residual / np.sqrt(noise), lattice), random))
        own = compare(cells_of(residual * np.sqrt(weight), lattice), random)
        energy += own.energy
        total += float(np.sum(weight * residual**2))
        size += float(np.sum(weight * view.kept(true) ** 2))
        # The variance has the right pattern, and its size is that of most residuals.
        ratio = float(np.mean(np.minimum(residual**2 / noise, MOST_RATIO)))
        residuals.append(Residual(slopes[number], weight**2 * ratio * noise * correlated))
    # Any of the views may show the misfit.
    return Fit(min(min(each.p for each in judged) * len(judged), 1.0), energy, total, size, residuals)


def _noise(images: Array, target: Array) -> Array:
    """Return the variance (H, W, C) of the residual for the decision, from several images (K, H, W, C)."""
    from scipy.ndimage import uniform_filter  # imported here, because only the end of a run needs it

    variance = finite(images.var(axis=0, ddof=1)) / len(images)
    smooth = np.stack([uniform_filter(each, SMOOTHED, mode="nearest") for each in np.moveaxis(variance, 2, 0)], axis=2)
    size = float(np.mean(target**2))
    return np.asarray(smooth + (FLOOR * target) ** 2 + 1e-6 * size + 1e-30)


def lattice_of(problem: Problem, view: View) -> tuple[int, float]:
    """Return the distance in pixels from which the noise of two pixels of a view is independent, and the sum of its
    correlations with all pixels.
    """
    own = correlations(problem.scene.sensors()[view.sensor].film().rfilter())
    lattice = 1 + int(np.max(np.nonzero(own >= UNCORRELATED)[0]))
    is_compressed = view.file is not None and view.file.suffix.lower() in COMPRESSED_FILES
    return max(lattice, COMPRESSED) if is_compressed else lattice, float(2 * own.sum() - own[0]) ** 2


def correlations(rfilter: mi.ReconstructionFilter) -> Array:
    """Return a filter's autocorrelation at the distances 0, 1 and so on, in pixels."""
    if rfilter.is_box_filter():
        return np.ones(1)
    steps, radius = 20, int(np.ceil(rfilter.radius()))
    places = (np.arange(2 * radius * steps) + 0.5) / steps - radius
    values = np.array(rfilter.eval(mi.Float(places)), dtype=np.float64)
    found = [values[distance * steps :] @ values[: len(values) - distance * steps] for distance in range(2 * radius)]
    return np.array(found) / found[0]


def cells_of(image: Array, lattice: int) -> Array:
    """Return the components (h, w, N) of an image (H, W, C) in cells. Pixels beyond the last whole cell are left out.
    Large images have the sums over several cells.
    """
    height, width = (size // lattice for size in image.shape[:2])
    cut = image[: height * lattice, : width * lattice]
    cells = cut.reshape(height, lattice, width, lattice, -1).swapaxes(1, 2).reshape(height, width, -1)
    return _sums(cells, -(-max(height, width, 1) // MOST_CELLS))


def _sums(cells: Array, side: int) -> Array:
    """Return the sums (..., h, w, N) over windows of `side` x `side` cells."""
    rows, columns = (np.arange(0, size, side) for size in cells.shape[-3:-1])
    return np.asarray(np.add.reduceat(np.add.reduceat(cells, rows, axis=-3), columns, axis=-2))


@dataclass(frozen=True)
class Coherence:
    """Probability that noise looks like a residual, and the energy of the part that neighbouring pixels share."""

    p: float
    energy: float


def compare(cells: Array, random: np.random.Generator) -> Coherence:
    """Compare the residual (h, w, N) with noise."""
    if min(cells.shape[:2]) < 2 or not np.any(cells):
        return Coherence(1.0, 0.0)
    found = _products(cells)
    at_once = max(MOST_AT_ONCE // cells.size, 1)
    signs = random.choice([-1.0, 1.0], size=(FLIPS, *cells.shape[:2], 1))
    noise = np.concatenate([_products(cells * signs[first : first + at_once]) for first in range(0, FLIPS, at_once)])
    spread = np.maximum(noise.std(axis=0), 1e-300)
    z = found / spread
    p = (1 + int(np.sum((noise / spread).max(axis=1) >= z.max()))) / (FLIPS + 1)
    energies = found / _pairs(cells.shape[:2])
    return Coherence(p, float(np.where(z > LEAST_ENERGY, energies, 0.0).max()))


def _scales(shape: Sequence[int]) -> list[int]:
    """Return the sides of windows in cells: 2, 4 and so on, to the first one that contains the image."""
    return [2**power for power in range(1, int(np.ceil(np.log2(max(shape)))) + 1)]


def _products(cells: Array) -> Array:
    """Return Q (..., S) of residuals (..., h, w, N) for each of S sides of windows."""
    own = np.sum(cells**2, axis=(-3, -2, -1))
    found, sums = [], cells
    for _ in _scales(cells.shape[-3:-1]):
        sums = _sums(sums, 2)
        found.append(np.sum(sums**2, axis=(-3, -2, -1)) - own)
    return np.stack(found, axis=-1)


def _pairs(shape: Sequence[int]) -> Array:
    """Return Q of a residual of 1 in each cell, divided by the number of cells, for each side of windows."""
    ones = np.ones((*shape, 1))
    return _products(ones) / ones.size
