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

from collections.abc import Callable, Sequence
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
#: Images of the final values, each with the samples of a step, their least number, and the least samples of all.
IMAGES, LEAST_IMAGES, LEAST_SPP = 8, 4, 64
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
    """Whether the model fits the targets. `p` is the probability that noise looks like the residuals. `misfit` is the
    root mean square of the misfit over the images, as a share of the target's. `energy` is twice the loss of the
    misfit. `candidates` are parameters that would reduce the misfit, the most effective one first.
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


def measure_fit(problem: Problem, curvature: LossCurvature, go_on: Callable[[], bool]) -> Fit:
    """Test the images of the current values against the targets of all training views.

    `curvature` has measured the recovered directions. The parameters may still be on their way to the optimum. The part
    of the residual that a Newton step would remove is subtracted. Rendering ends early if `go_on` returns false.
    """
    means, variances = _mean_images(problem, go_on)
    slopes = [finite(slope(view.judge, mean)) * view.share for view, mean in zip(problem.trained, means, strict=True)]
    random = np.random.default_rng(seed(problem.config.run.seed, 0, 0, PURPOSE))
    changes, judged, energy, total, size = curvature.newton_change(slopes), [], 0.0, 0.0, 0.0
    residuals: list[Residual] = []
    for number, view in enumerate(problem.trained):
        true, mean = np.array(view.target, dtype=np.float64), means[number]
        residual = view.kept(finite(mean - true) + changes[number])
        lattice, correlated = lattice_of(problem, view)
        noise, weight = _noise(variances[number], true), second_derivative(view, mean)
        if curvature.biases:  # a kink, as that of `l1`, has a derivative that says nothing about single pixels
            weight = np.where(weight > 0, weight.mean(), view.kept(np.full(weight.shape, weight.mean())))
        judged.append(compare(cells_of(residual / np.sqrt(noise), lattice), random))
        energy += compare(cells_of(residual * np.sqrt(weight), lattice), random).energy
        total += float(np.sum(weight * residual**2))
        size += float(np.sum(weight * view.kept(true) ** 2))
        # The variance has the right pattern, and its size is that of most residuals.
        ratios = np.minimum(residual**2 / noise, MOST_RATIO)[residual != 0]
        ratio = float(ratios.mean()) if ratios.size else 0.0
        residuals.append(Residual(slopes[number], weight**2 * ratio * noise * correlated))
    # Any of the views may show the misfit.
    largest = np.max([each.noise for each in judged], axis=0)
    p = (1 + int(np.sum(largest >= max(each.z for each in judged)))) / (FLIPS + 1)
    return Fit(p, min(energy, total), total, size, residuals)


def _mean_images(problem: Problem, go_on: Callable[[], bool]) -> tuple[list[Array], list[Array]]:
    """Return the mean image of each view (H, W, C), and the variance of its noise."""
    spp, count = problem.config.run.spp, 0
    sums, squares = ([np.zeros(view.target.shape) for view in problem.trained] for _ in range(2))
    for number in range(max(IMAGES, -(-LEAST_SPP // spp))):
        if number >= LEAST_IMAGES and not go_on():
            break
        images = [np.asarray(image, dtype=np.float64) for image in see_images(problem, spp, -number, PURPOSE)]
        sums = [a + b for a, b in zip(sums, images, strict=True)]
        squares = [a + b**2 for a, b in zip(squares, images, strict=True)]
        count += 1
    means = [each / count for each in sums]
    pairs = zip(means, squares, strict=True)
    return means, [np.maximum(square / count - mean**2, 0.0) / (count - 1) for mean, square in pairs]


def _noise(variance: Array, target: Array) -> Array:
    """Return the variance (H, W, C) of the residual for the decision, from that of an image."""
    from scipy.ndimage import uniform_filter  # imported here, because only the end of a run needs it

    bands = np.moveaxis(finite(variance), 2, 0)
    smooth = np.stack([uniform_filter(each, SMOOTHED, mode="nearest") for each in bands], axis=2)
    size = float(np.mean(target**2))
    return np.asarray(smooth + (FLOOR * target) ** 2 + 1e-6 * size + 1e-30)


def lattice_of(problem: Problem, view: View) -> tuple[int, float]:
    """Return the distance in pixels from which the noise of two pixels of a view is independent, and the sum of its
    correlations with all pixels.
    """
    own = correlations(problem.scene.sensors()[view.sensor].film().rfilter())
    lattice = 1 + int(np.max(np.nonzero(np.abs(own) >= UNCORRELATED)[0]))
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
    Large images have the sums over several cells,
    divided by the side of their square, so that a constant residual keeps its sum of squares.
    """
    height, width = (size // lattice for size in image.shape[:2])
    if not height or not width:
        return np.zeros((1, 1, 1))
    cut = image[: height * lattice, : width * lattice]
    cells = cut.reshape(height, lattice, width, lattice, -1).swapaxes(1, 2).reshape(height, width, -1)
    side = -(-max(height, width) // MOST_CELLS)
    return _sums(cells, side) / side


def _sums(cells: Array, side: int) -> Array:
    """Return the sums (..., h, w, N) over windows of `side` x `side` cells."""
    rows, columns = (np.arange(0, size, side) for size in cells.shape[-3:-1])
    return np.asarray(np.add.reduceat(np.add.reduceat(cells, rows, axis=-3), columns, axis=-2))


@dataclass(frozen=True)
class Coherence:
    """The largest Q of a residual in standard deviations `z`, those of its random signs `noise` (FLIPS,), and the
    energy of the part that neighbouring pixels share.
    """

    z: float
    noise: Array
    energy: float

    @property
    def p(self) -> float:
        """The probability that noise looks like the residual."""
        return (1 + int(np.sum(self.noise >= self.z))) / (FLIPS + 1)


def compare(cells: Array, random: np.random.Generator) -> Coherence:
    """Compare the residual (h, w, N) with noise."""
    if min(cells.shape[:2]) < 2 or not np.any(cells):
        return Coherence(-np.inf, np.full(FLIPS, -np.inf), 0.0)
    found = _products(cells)
    at_once = max(MOST_AT_ONCE // cells.size, 1)
    signs = random.choice([-1.0, 1.0], size=(FLIPS, *cells.shape[:2], 1))
    noise = np.concatenate([_products(cells * signs[first : first + at_once]) for first in range(0, FLIPS, at_once)])
    spread = np.maximum(noise.std(axis=0), 1e-300)
    z, energies = found / spread, found / _pairs(cells.shape[:2])
    return Coherence(z.max(), (noise / spread).max(axis=1), float(np.where(z > LEAST_ENERGY, energies, 0.0).max()))


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
