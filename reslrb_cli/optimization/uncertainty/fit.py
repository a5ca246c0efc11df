"""Test of fit: whether noise explains the residual between the images of the final values and the targets.

The noise of a target file is not known. But distant pixels have independent noise, whereas an error of the model
changes neighbouring pixels alike. The test therefore uses products of the residuals of different pixels. A cell is a
square of pixels whose side is the smallest distance at which the film's filter does not correlate the noise. The
residual V_c of cell c is a vector with a component for each pixel and channel. The sum

    Q(s) = sum over windows of s x s cells (|sum V_c|^2 - sum |V_c|^2)

has a mean of 0 for noise. Random signs of the cells give the distribution of all Q(s) for noise with the same second
moments, whatever its size and its tails. A gamma distribution with the same skewness gives the probability of each
Q(s). An image has few large windows, so their sums have long tails. The least probable Q(s) of the residual is compared
with the least probable one of each set of random signs. For this decision, each pixel has the weight
1 / (noise^2 + (`FLOOR` target)^2). If the decision is not clear, a second look takes more samples.

The `energy` of the misfit uses the weights of the loss. If the misfit is constant in windows of n cells, Q(s) is n - 1
times the sum of its squares over all cells. The energy is the largest of these sums over the scales s. The misfit then
adds energy / 2 to the loss. The part of a misfit that the parameters have made up for does not show in the residual.
This part is assumed to be as large as the part that is left.
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
from reslrb_cli.statistics import Array, special

PURPOSE = "fit"
#: Images of the final values, each with the samples of a step, their least number, and the least samples of all.
IMAGES, LEAST_IMAGES, LEAST_SPP = 8, 4, 64
#: Maximum number of looks. The second one has `MORE` times the images of the first, and takes place if the first `p` is
#: neither small enough nor above `CLEAR`.
LOOKS, MORE, CLEAR = 2, 4, 0.2
#: Largest `p` of residuals, over all looks, with which the model does not fit.
LEVEL = 0.01
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
#: Probability of a sum under noise below which it counts as energy.
RARE = 1e-3
#: Windows around each pixel of a map count as this many independent ones for each window that fits beside the others.
OVERLAP = 4


@dataclass(frozen=True)
class Candidate(Jsonable):
    """Parameter that would reduce the misfit.

    - `p` is the probability that noise has as large an effect along any of the tested parameters.
    - `explained` is the share of the misfit's loss that the parameter removes, at most 1.
    - `value` is the present value, and `proposed` the value at which the loss would be smallest. `proposed` is empty if
        that value is outside of the bounds. For a texture, both are one factor for each channel.
    - `bounds` are YAML, or "".
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
class Fit:
    """Result of the test of fit. `p` is the probability that noise looks like the residuals. `energy` is twice the loss
    of the misfit, `total` that of the whole residuals, and `size` that of black images. `slopes` are dL/dI of each view
    (H, W, C) at the final values, and `variances` their noise. The variances contain a factor for the noise that
    neighbouring pixels share, so that all pixels may be taken as independent. `maps` are the misfit maps of
    all views if the residuals are not noise.
    """

    p: float
    energy: float
    total: float
    size: float
    slopes: list[Array]
    variances: list[Array]
    maps: list[Array]


def measure_fit(problem: Problem, curvature: LossCurvature, go_on: Callable[[], bool]) -> Fit:
    """Test the images of the current values against the targets of all training views.

    `curvature` has measured the recovered directions. The parameters may still be on their way to the optimum. The part
    of the residual that a Newton step would remove is subtracted. Rendering ends early if `go_on` returns false.
    """
    random = np.random.default_rng(seed(problem.config.run.seed, 0, 0, PURPOSE))
    images = _Images(problem)
    images.render(max(IMAGES, -(-LEAST_SPP // problem.config.run.spp)), go_on)
    return repeat_unclear(
        lambda: _judge(problem, curvature, images, random),
        lambda: images.render((MORE - 1) * images.count, go_on),
    )


def repeat_unclear(judge: Callable[[], Fit], more: Callable[[], bool]) -> Fit:
    """Return the fit that `judge` finds. If it is not clear, take `more` images and judge again. `p` is the probability
    that noise looks like the residuals in any look.
    """
    fits = [judge()]
    while len(fits) < LOOKS and LEVEL / LOOKS < fits[-1].p <= CLEAR and more():
        fits.append(judge())
    return replace(fits[-1], p=min(LOOKS * min(each.p for each in fits), 1.0))


def _judge(problem: Problem, curvature: LossCurvature, images: _Images, random: np.random.Generator) -> Fit:
    means, of_means = images.means()
    slopes = [finite(slope(view.judge, mean)) * view.share for view, mean in zip(problem.trained, means, strict=True)]
    trues = [np.array(view.target, dtype=np.float64) for view in problem.trained]
    weights = [second_derivative(view, mean) for view, mean in zip(problem.trained, means, strict=True)]
    steps = curvature.newton_change(slopes)
    changes = [view.kept(step) for view, step in zip(problem.trained, steps, strict=True)]
    left = [view.kept(finite(mean - true)) for view, mean, true in zip(problem.trained, means, trues, strict=True)]
    part = useful_part(left, changes, weights)
    residuals = [own + part * change for own, change in zip(left, changes, strict=True)]
    judged, energy, total, size = [], 0.0, 0.0, 0.0
    variances: list[Array] = []
    of_residuals: list[Array] = []
    for view, residual, true, weight, of_mean in zip(problem.trained, residuals, trues, weights, of_means, strict=True):
        lattice, correlated = lattice_of(problem, view)
        noise = _noise(of_mean, true)
        if curvature.biases:  # a kink, as that of `l1`, has a derivative that says nothing about single pixels
            weight = view.kept(np.full_like(weight, weight.mean()))
        judged.append(compare(cells_of(residual / np.sqrt(noise), lattice), random))
        energy += compare(cells_of(residual * np.sqrt(weight), lattice), random).energy
        total += float(np.sum(weight * residual**2))
        size += float(np.sum(weight * view.kept(true) ** 2))
        # The variance has the right pattern, and its size is that of most residuals.
        ratios = np.minimum(residual**2 / noise, MOST_RATIO)[residual != 0]
        ratio = float(ratios.mean()) if ratios.size else 0.0
        of_residuals.append(ratio * noise * correlated)
        variances.append(weight**2 * of_residuals[-1])
    # Any of the views may show the misfit.
    noise = np.max([each.noise for each in judged], axis=0)
    together = Coherence(max(each.surprisal for each in judged), noise, energy)
    maps = [misfit_map(residual, variance, true, lattice_of(problem, view)[0])
            for residual, variance, true, view in zip(residuals, of_residuals, trues, problem.trained, strict=True)
            if together.p <= LEVEL]  # fmt: skip
    return Fit(together.p, min(energy, total), total, size, slopes, variances, maps)


def useful_part(residuals: Sequence[Array], changes: Sequence[Array], weights: Sequence[Array]) -> float:
    """Return the part of a Newton step, from 0 to 1, at which the squares of `residuals` + part * `changes` have the
    smallest sum. If the images do not determine the parameters, a whole step may be far too long.
    """
    rows = list(zip(residuals, changes, weights, strict=True))
    along = sum(float(np.sum(weight * residual * change)) for residual, change, weight in rows)
    square = sum(float(np.sum(weight * change**2)) for _, change, weight in rows)
    return float(np.clip(-along / square, 0.0, 1.0)) if square > 0 else 0.0


def misfit_map(residual: Array, variance: Array, target: Array, lattice: int) -> Array:
    """Return the misfit (H, W, 1) at each pixel, as a share of the target: positive where the image is too bright.

    The misfit is the sum of the residual (H, W, C) over the smallest window around the pixel whose sum noise does not
    explain, divided by that of the target. It is 0 if there is no such window. A window counts only if its middle
    deviates in the same direction, because it may lie beside the misfit. `variance` is that of independent pixels.
    Windows have sides of 2, 4 and so on times `lattice` pixels. Pixels without a residual do not count.
    """
    from scipy.ndimage import uniform_filter  # imported here, because only the end of a run needs it

    kept = np.any(residual != 0, axis=2)
    spread = np.sqrt(np.maximum(variance, 0.0)).sum(axis=2)
    total = residual.sum(axis=2)
    decisive = np.clip(total, -(MOST_RATIO**0.5) * spread, MOST_RATIO**0.5 * spread)  # a firefly is no misfit
    layers = [np.where(kept, each, 0.0) for each in (decisive, spread**2, total, np.abs(target).sum(axis=2))]
    height, width = kept.shape
    sides = [lattice * 2**k for k in range(1 + int(np.log2(max(min(height, width) / lattice, 1))))]
    windows = sum(max(height // side, 1) * max(width // side, 1) * OVERLAP for side in sides[1:])
    limit = -float(special().ndtri(0.5 * LEVEL / max(windows, 1)))
    found, is_open, middle = np.zeros((height, width)), kept, np.zeros((height, width))
    for side in sides:
        decisive, of_noise, total, light = (uniform_filter(each, side, mode="constant") * side**2 for each in layers)
        z = decisive / np.sqrt(np.maximum(of_noise, 1e-300))
        is_seen = is_open & (np.abs(z) > limit) & (np.sign(z) * middle > 1) & (light > 0)
        found = np.where(is_seen, total / np.maximum(light, 1e-300), found)
        is_open, middle = is_open & ~is_seen, z
    return found[:, :, None]


class _Images:
    """Images of the current values, each with the samples of a step: their `count`, and their sums by view."""

    def __init__(self, problem: Problem) -> None:
        self.problem, self.count = problem, 0
        self._sums, self._squares = ([np.zeros(view.target.shape) for view in problem.trained] for _ in range(2))

    def render(self, number: int, go_on: Callable[[], bool]) -> bool:
        """Add up to `number` images of each view. After `LEAST_IMAGES`, end early if `go_on` returns false. Return
        whether images were added.
        """
        before = self.count
        while self.count < before + number and (self.count < LEAST_IMAGES or go_on()):
            found = see_images(self.problem, self.problem.config.run.spp, -self.count, PURPOSE)
            images = [np.asarray(image, dtype=np.float64) for image in found]
            self._sums = [a + b for a, b in zip(self._sums, images, strict=True)]
            self._squares = [a + b**2 for a, b in zip(self._squares, images, strict=True)]
            self.count += 1
        return self.count > before

    def means(self) -> tuple[list[Array], list[Array]]:
        """Return the mean image of each view (H, W, C), and the variance of its noise."""
        means, count = [each / self.count for each in self._sums], self.count
        pairs = zip(means, self._squares, strict=True)
        return means, [np.maximum(square / count - mean**2, 0.0) / (count - 1) for mean, square in pairs]


def _noise(variance: Array, target: Array) -> Array:
    """Return the variance (H, W, C) of the residual for the decision, from that of an image."""
    from scipy.ndimage import uniform_filter  # imported here, because only the end of a run needs it

    smooth = uniform_filter(finite(variance), (SMOOTHED, SMOOTHED, 1), mode="nearest")
    return np.asarray(smooth + (FLOOR * target) ** 2 + 1e-6 * np.mean(target**2) + 1e-30)


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
    Large images have the sums over squares of cells. They are divided by the side of a square, so that a constant
    residual keeps its sum of squares.
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
    """The least probable Q of a residual: its `surprisal`, which is the negative logarithm of its probability. `noise`
    (FLIPS,) are those of random signs, and `energy` is that of the part that neighbouring pixels share.
    """

    surprisal: float
    noise: Array
    energy: float

    @property
    def p(self) -> float:
        """The probability that noise looks like the residual."""
        return (1 + int(np.sum(self.noise >= self.surprisal))) / (FLIPS + 1)


def compare(cells: Array, random: np.random.Generator) -> Coherence:
    """Compare the residual (h, w, N) with noise."""
    if min(cells.shape[:2]) < 2 or not np.any(cells):
        return Coherence(-np.inf, np.full(FLIPS, -np.inf), 0.0)
    found = _products(cells)
    at_once = max(MOST_AT_ONCE // cells.size, 1)
    signs = random.choice([-1.0, 1.0], size=(FLIPS, *cells.shape[:2], 1))
    noise = np.concatenate([_products(cells * signs[first : first + at_once]) for first in range(0, FLIPS, at_once)])
    spread = np.maximum(noise.std(axis=0), 1e-300)
    all_of_them = surprisals(np.vstack([found, noise]) / spread, noise / spread)
    energies = np.where(all_of_them[0] > -np.log(RARE), found / _pairs(cells.shape[:2]), 0.0)
    least_probable = all_of_them.max(axis=1)
    return Coherence(float(least_probable[0]), least_probable[1:], float(energies.max()))


def surprisals(z: Array, noise: Array) -> Array:
    """Return the negative logarithms of the probabilities of at least `z` (..., S) in standard deviations. `noise`
    (N, S) are samples of each distribution with a mean of 0.
    """
    k = 4 / np.maximum(np.mean(noise**3, axis=0), 1e-2) ** 2  # the gamma distribution with their skewness
    return np.asarray(-np.log(np.maximum(special().gammaincc(k, np.maximum(k + np.sqrt(k) * z, 0.0)), 1e-300)))


def _products(cells: Array) -> Array:
    """Return Q (..., S) of residuals (..., h, w, N) for each of S sides of windows: 2, 4 and so on cells, up to the
    first side that contains the image.
    """
    own = np.sum(cells**2, axis=(-3, -2, -1))
    found, sums = [], cells
    for _ in range(int(np.ceil(np.log2(max(cells.shape[-3:-1]))))):
        sums = _sums(sums, 2)
        found.append(np.sum(sums**2, axis=(-3, -2, -1)) - own)
    return np.stack(found, axis=-1)


def _pairs(shape: Sequence[int]) -> Array:
    """Return Q of a residual of 1 in each cell, divided by the number of cells, for each side of windows."""
    ones = np.ones((*shape, 1))
    return _products(ones) / ones.size
