"""Gauss-Newton curvature of the loss, and the directions in which it is measured.

Images are differentiated along the entries of small parameters, and along the brightness of whole textures
(`plan_changes`). The curvature (`LossCurvature`) is H = J^T W J at the parameters' values. J is the derivative of the
image, and W = d2L/dI2 has a second derivative for each pixel. Differences of images have the blur of the iteration
(`run.blur`). Sharp images of a moving shape would overestimate the curvature of a blurred loss.

    along directions    J by differences of images at common random numbers, from two independent sets of samples a, b:
                        H = (J_a^T W J_b + J_b^T W J_a) / 2, whose noise has no bias
    by entry            random signs v over the pixels: with p_s = J_s^T (sqrt(W) v), the mean of p_a p_b is the
                        diagonal of H (Hutchinson 1989; Bekas et al. 2007), again from two sets of samples

For the curvature along directions, a standard error is subtracted from the sum over the pixels. Overestimated curvature
would make results look too certain. In the estimate by entry, single values are mostly noise, so `EntryCurvature`
averages them over groups.

The film's filter and the interpolation of a texture couple neighbouring texels. The mean of p_i p_j over the probes is
H_ij. `EntryCurvature` averages these products over all pairs of texels with the same distance. With D for the diagonal
of H, H is then D^1/2 K D^1/2, where K is a filter with the eigenvalues `eigenvalues` in a cosine transform. In the
directions of the smallest eigenvalues, images do not determine a texture.

Regularizers have their own curvature, without noise. Differences of the regularizers' gradient are added to both kinds
of curvature.

Noise of rendered targets and of a step's images adds the same b to all gradients (`noise.py`). B is the second moment
of b along the directions.

In the estimate by entry, the diagonal of B is probed and averaged like the diagonal of H. A standard error is then
added. For few entries, the average may be almost zero by chance. Underestimated target noise would also make results
look too certain.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.integrators.step import known_step
from reslrb_cli.optimization.nonfinite import finite
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import see_images, take_gradient
from reslrb_cli.optimization.uncertainty.noise import (
    PURPOSE,
    image_biases,
    is_linear,
    second_derivative,
    target_noises,
)
from reslrb_cli.optimization.uncertainty.posterior import pseudo_inverse
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import Array, scale_frequencies

#: Parts of keys of textures that mix channels into one number.
MIXING = ("alpha", "roughness", "weight", "opacity", "normalmap", "bump", "metallic", "anisotropic")
#: Maximum distance of two texels that are coupled, along each axis, and the smallest eigenvalue of their coupling that
#: counts as not 0.
NEIGHBOURS, LEAST_EIGENVALUE = 2, 0.05
#: Standard errors that are subtracted from curvature and added to the noise of the target.
MARGIN = 1.0
#: Maximum number of image values in H along directions; of more, a random subset, the same for all.
MOST_VALUES = 2**18
#: Smallest eigenvalue of the curvature along which a Newton step is made, as a share of the largest.
LEAST_STEP = 1e-3
#: Samples for probes of large parameters, and the number of the sample of products.
PROBED, FIRST_PRODUCT = 2, 1000


@dataclass(frozen=True)
class ParameterDirection:
    """One coordinate. `vector` is the change of the parameter `key` per unit, in the layout of a flat gradient.

    `channel` is the only image channel that the direction changes, or None. `entry` is the entry of a small parameter.
    `entry` is None if all entries of a texture's channel change together, in proportion to their values. `followers`
    has the change (N,) per unit of each texture that compensates for the change of a small parameter (`coupling.py`).
    `partner` is the texture that compensates for most of it.
    """

    key: str
    vector: Array
    channel: int | None = None
    entry: int | None = None
    partner: str | None = None
    followers: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class ParameterChange:
    """Rendering with changed parameter values. `values` has the changed values for each key, in the form of
    `Selection.array`. The change is `amount` along each of the directions.
    """

    values: dict[str, Array]
    amount: float
    directions: list[ParameterDirection]


def row_of(problem: Problem, key: str) -> Array:
    """Return a parameter's value in the layout of its flat gradient (`take_gradient`), including an environment map's
    halo.
    """
    return np.array(dr.detach(problem.optimizer[key]), dtype=np.float64).ravel()


def separates(problem: Problem, key: str) -> bool:
    """True if each parameter channel changes only the same channel of images, as three-channel colours do."""
    if not mi.is_rgb or any(view.target.shape[2] != 3 for view in problem.trained):
        return False
    if any(part in MIXING for part in key.replace("_", ".").split(".")):
        return False
    array = problem.selection.array(key)
    if array.ndim == 3:
        return array.shape[2] == 3 and not problem.selection.deformation.quantities.get(key)
    return isinstance(problem.optimizer[key], mi.Color3f)


def plan_changes(
    problem: Problem, scales: Mapping[str, float], share: float, most: int = MOST_VALUES, small: Collection[str] = ()
) -> list[ParameterChange]:
    """Return the renderings for the directions of all parameters in `scales`. Small parameters come first.

    Steps are `share` of the scale. There are at most `most` renderings. Parameters without a rendering have no
    directions. `small` has the large parameters whose entries have a direction each.
    """
    keys = [key for key in problem.selection.keys if key in scales]
    small = [key for key in keys if problem.optimizer.is_small(key) or key in small]
    textures = [key for key in keys if problem.selection.array(key).ndim == 3]
    changes: list[ParameterChange] = []
    for key in (*small, *(key for key in textures if key not in small)):
        made = _entries(problem, key, scales[key], share) if key in small else _wholes(problem, key, share)
        if len(changes) + len(made) <= most:
            changes += made
    return changes


def _entries(problem: Problem, key: str, scale: float, share: float) -> list[ParameterChange]:
    row, size = row_of(problem, key), 3 if separates(problem, key) else 1
    directions = [ParameterDirection(key, unit, k % 3 if size == 3 else None, k)
                  for k, unit in enumerate(np.eye(row.size))]  # fmt: skip
    low, high = problem.selection.specs[key].bounds or (-np.inf, np.inf)
    changes = []
    for group in (directions[first : first + size] for first in range(0, row.size, size)):
        step = sum(direction.vector for direction in group) * scale * share
        inside = [np.sum((moved >= low) & (moved <= high)) for moved in (row + step, row - step)]
        side = 1.0 if inside[0] >= inside[1] else -1.0
        moved = (row + side * step).reshape(problem.selection.array(key).shape)
        changes.append(ParameterChange({key: moved}, side * scale * share, group))
    return changes


def _wholes(problem: Problem, key: str, share: float) -> list[ParameterChange]:
    array, row = problem.selection.array(key), row_of(problem, key)
    channels = array.shape[2]
    if not np.any(row) or (channels > 1 and not separates(problem, key)):
        return []
    of = [np.where(np.arange(row.size) % channels == channel, row, 0.0) for channel in range(channels)]
    directions = [ParameterDirection(key, v, None if channels == 1 else c) for c, v in enumerate(of) if v.any()]
    # Darker, so that values exceed no bound except 0.
    return [ParameterChange({key: array * (1 - share)}, -share, directions)]


@dataclass(frozen=True)
class EntryCurvature:
    """Curvature of each of N entries, from random probes: the diagonal of H (N,), and that of B (N,) or None.

    For a texture, `probes` has pairs of probes (N,) with common signs, and `shape` is (height, width, channels).
    """

    diagonal: Array
    of_target: Array | None
    probes: Sequence[tuple[Array, Array]] = ()
    shape: tuple[int, ...] = ()

    def mean_of_target(self, group: Array) -> float:
        """Return the mean of B's diagonal over some entries, plus a margin."""
        if self.of_target is None:
            return 0.0
        chosen = self.of_target[group]
        return max(float(chosen.mean() + MARGIN * chosen.std() / len(chosen) ** 0.5), 0.0)

    def solve(self, gradients: Array, groups: Sequence[Array]) -> tuple[Array, Array, float]:
        """Return the offsets (K, N) that would cause K gradients (K, N), and the mean curvature (N,) of each entry's
        group. Also return the share of directions that images do not determine, which are left out of the offsets.

        Entries outside all groups have no offset. A mean curvature of 0 is not known.
        """
        h = np.zeros_like(self.diagonal)
        for group in groups:
            h[group] = max(float(self.diagonal[group].mean()), 0.0)
        root = np.where(h > 0, 1 / np.sqrt(np.maximum(h, 1e-300)), 0.0)
        if len(self.shape) != 3 or not self.probes or not root.any():
            return gradients * root**2, h, 0.0
        eigenvalues = self._eigenvalues(root)
        kept = eigenvalues > LEAST_EIGENVALUE
        images = (gradients * root).reshape(-1, *self.shape)
        factors = (kept / np.maximum(eigenvalues, LEAST_EIGENVALUE))[:, :, None]
        offsets = scale_frequencies(images, factors).reshape(gradients.shape) * root
        return offsets, h, 1 - float(kept.mean())

    def _eigenvalues(self, root: Array) -> Array:
        """Return the eigenvalues (height, width) of the coupling K between texels of unit curvature."""
        known = _correlation((root > 0).reshape(self.shape), (root > 0).reshape(self.shape))
        pairs = (((a * root).reshape(self.shape), (b * root).reshape(self.shape)) for a, b in self.probes)
        sums = np.sum([(_correlation(a, b), _correlation(a**2, b**2)) for a, b in pairs], axis=0)
        kernel, squares = 0.25 * (sums + sums[:, ::-1] + sums[:, :, ::-1] + sums[:, ::-1, ::-1])
        # A few probes of a small texture show mostly noise.
        kernel *= np.maximum(1 - squares / np.maximum(kernel**2, 1e-300), 0.0) / np.maximum(known, 0.5)
        lags = np.arange(-NEIGHBOURS, NEIGHBOURS + 1)
        waves = [np.cos(np.outer(np.pi * np.arange(size) / size, lags)) for size in self.shape[:2]]
        middle = max(float(kernel[NEIGHBOURS, NEIGHBOURS]), 1e-300)
        return np.asarray(waves[0] @ (kernel / middle) @ waves[1].T)


def _correlation(one: Array, other: Array) -> Array:
    """Return the sums of products of texels with each distance up to `NEIGHBOURS` along both axes."""
    size = [length + NEIGHBOURS for length in one.shape[:2]]
    a, b = (np.fft.rfft2(each, s=size, axes=(0, 1)) for each in (one, other))
    lags = np.arange(-NEIGHBOURS, NEIGHBOURS + 1)
    return np.asarray(np.fft.irfft2(np.conj(a) * b, s=size, axes=(0, 1)).sum(axis=2)[np.ix_(lags, lags)])


class LossCurvature:
    """Measurement of the curvature at the current values of `problem`. The problem needs its targets.

    There are two sets of samples, each with `spp` samples per pixel. Measurements with different numbers `round` have
    independent samples. `of_target` includes the noise of the target.
    """

    def __init__(self, problem: Problem, spp: int, of_target: bool = True, round: int = 0) -> None:
        self.problem, self.spp, self.round = problem, spp, round
        self._values = problem.values()
        self._base = self.see_at({})
        pairs = zip(problem.trained, *self._base, strict=True)
        self._weights = [second_derivative(view, 0.5 * (a + b)) for view, a, b in pairs]
        values = sum(weight.size for weight in self._weights)
        random = np.random.default_rng(self._seed(0, 0))
        self._picked = None if values <= MOST_VALUES else np.sort(random.choice(values, MOST_VALUES, replace=False))
        #: Number of values of the images for each value that is used.
        self.thinned = max(values / MOST_VALUES, 1.0)
        #: Share (M,) of the curvature along each direction that remains without its standard error.
        self.sure = np.zeros(0)
        #: Derivatives (M, N) of all pixels along each direction, by each set of samples. The first set has the weights.
        self.slopes: tuple[Array, Array] = np.zeros((0, 0)), np.zeros((0, 0))
        self.directions: list[ParameterDirection] = []
        #: Samples of the targets' noise by view; empty if no target was rendered.
        self.noises = target_noises(problem, spp) if of_target else []
        #: Two samples of the mean effect that the noise of a step's images has on dL/dI (H, W, C), by view; empty if
        #: there is none.
        self.biases = image_biases(problem, self._weights) if of_target and not is_linear(problem, self._base) else []

    def repeated(self, round: int) -> LossCurvature:
        """Return a measurement with other samples. The noise of targets and the biases are not measured again."""
        other = LossCurvature(self.problem, self.spp, of_target=False, round=round)
        other.noises, other.biases = self.noises, self.biases
        return other

    def along(
        self, changes: Sequence[ParameterChange], go_on: Callable[[], bool]
    ) -> tuple[list[ParameterDirection], Array, Array]:
        """Return the directions of the rendered changes, and the matrices H and B (M, M) along the directions.
        Rendering ends when `go_on` returns false.
        """
        directions: list[ParameterDirection] = []
        columns: list[list[Array]] = [[], []]
        odd: list[list[Array]] = [[], []]
        even: list[float] = []
        bias: list[float] = []
        for change in changes:
            if not go_on():
                break
            derivatives = self._derivatives(change)
            for direction in change.directions:
                directions.append(direction)
                even.append(0.0)
                bias.append(0.0)
                for half in (0, 1):
                    slopes = [_of_channel(each, direction.channel) for each in derivatives[half]]
                    columns[half].append(self.in_a_row(slopes))
                    if self.biases:
                        views = zip(slopes, self.biases[half], strict=True)
                        bias[-1] += 0.5 * sum(float(np.sum(each * effect)) for each, effect in views)
                    pulls = [(n, each) for views in self.noises for n, each in zip(views, slopes, strict=True)]
                    if pulls:
                        odd[half].append(np.concatenate([noise.in_blocks(each) for noise, each in pulls]))
                        sums = sum(float(np.sum(each * noise.even)) for noise, each in pulls)
                        even[-1] += 0.5 * sums / len(self.noises)
        if not directions:
            return [], np.zeros((0, 0)), np.zeros((0, 0))
        a, b = (np.array(rows) for rows in columns)
        a = a * self.weights
        self.slopes, self.directions = (a, b), directions
        self.sure = _sure_share(a * b)
        sure = np.sqrt(np.outer(self.sure, self.sure))
        H = _symmetric(a @ b.T * sure) + self._of_regularizers(directions)
        B = np.outer(bias, bias)
        if self.noises:
            a, b = (np.array(rows) for rows in odd)
            B += _symmetric(a @ b.T / len(self.noises)) + np.outer(even, even)
        return directions, H, B

    def products(self, change: ParameterChange) -> list[dict[str, tuple[Array, Array]]]:
        """Return two samples of the product of H and each direction of a change, by parameter. All products have the
        same samples, so they are those of one matrix.
        """
        found = []
        weighted = [
            [weight * image for weight, image in zip(self._weights, views, strict=True)]
            for views in self._derivatives(change)
        ]
        for direction in change.directions:
            one, other = ([_of_channel(image, direction.channel) for image in views] for views in weighted)
            found.append(self._two_probes(one, other, FIRST_PRODUCT))
        return found

    def see(self) -> list[list[Array]]:
        """Render all views at the current values of the scene, with each set of samples."""
        return [see_images(self.problem, self.spp, -1 - 2 * self.round - half, PURPOSE) for half in (0, 1)]

    def see_at(self, values: Mapping[str, Array]) -> list[list[Array]]:
        """Return the images of `see` with other `values`. The recording of an image depends on which parameters have
        derivatives, so here none has.
        """
        self.problem.selection.set_arrays({**self._values, **values})
        images = self.see()
        self.problem.apply()
        return images

    def _derivatives(self, change: ParameterChange) -> list[list[Array]]:
        """Return the derivative of each view's exposed image (H, W, C) along a change, for each set of samples."""
        pairs = zip(self.see_at(change.values), self._base, strict=True)
        return [
            [
                view.blurred(finite(a - b)) / change.amount
                for view, a, b in zip(self.problem.trained, *pair, strict=True)
            ]
            for pair in pairs
        ]

    def for_verdicts(self, directions: Sequence[ParameterDirection], places: Sequence[int]) -> Array:
        """Return H (M, M) along `directions`, which were at `places` in the latest call of `along`. Its eigenvalues
        are lowered by their standard errors (`lower_eigenvalues`).
        """
        a, b = (slopes[list(places)] for slopes in self.slopes)
        return lower_eigenvalues(a, b) + self._of_regularizers(directions)

    def for_steps(self, directions: Sequence[ParameterDirection]) -> tuple[Array, float]:
        """Return H (M, M) along the directions of `along`, with eigenvalues of at least their standard errors, and the
        standard error of the smallest eigenvalue (`raise_eigenvalues`).
        """
        return raise_eigenvalues(*self.slopes, self._of_regularizers(directions))

    def _of_regularizers(self, directions: Sequence[ParameterDirection]) -> Array:
        """Return the curvature of regularizers along directions (M, M). It is zero between different parameters."""
        bent = [self.problem.stiffness(direction.key, direction.vector) for direction in directions]
        return _symmetric(np.array([
            [one.vector @ change if one.key == other.key else 0.0
             for other, change in zip(directions, bent, strict=True)]
            for one in directions
        ]))  # fmt: skip

    def by_entry(self, probes: int, go_on: Callable[[], bool]) -> dict[str, EntryCurvature]:
        """Return the curvature of each entry of all parameters. The result is empty if the first call of `go_on`
        returns false.
        """
        found: list[dict[str, tuple[Array, Array]]] = []
        bent: dict[str, Array] = {}
        random = np.random.default_rng(self._seed(0, probes))
        for probe in range(probes):
            if not go_on():
                break
            roots = [np.sqrt(weight) * random.choice([-1.0, 1.0], size=weight.shape) for weight in self._weights]
            found.append(self._two_probes(roots, roots, 2 * probe))
            for key, (a, _) in found[-1].items():
                signs = random.choice([-1.0, 1.0], size=a.shape)
                bent[key] = bent.get(key, 0.0) + signs * self.problem.stiffness(key, signs)
        if not found:
            return {}
        of_target = self._by_entry_of_target(probes, go_on)
        return {
            key: EntryCurvature(
                np.mean([each[key][0] * each[key][1] for each in found], axis=0) + bent[key] / len(found),
                of_target.get(key),
                [each[key] for each in found],
                tuple(dr.shape(self.problem.optimizer[key])),
            )
            for key in bent
        }

    def _by_entry_of_target(self, first: int, go_on: Callable[[], bool]) -> dict[str, Array]:
        """Return the diagonal of B for each parameter as a flat array. The probes are numbered from `first` on. It is
        empty without a rendered target, if noise of the images has no bias.
        """
        total: dict[str, Array] = {}
        if self.biases:
            pairs = self._two_probes(self.biases[0], self.biases[1], 2 * (first + PROBED + 1))
            total = {key: a * b for key, (a, b) in pairs.items()}
        views = self.noises[:PROBED]
        random = np.random.default_rng(self._seed(1, first))
        for number, noises in enumerate(views):
            if not go_on():
                return {}
            signed = [noise.signed(random) for noise in noises]
            for key, (a, b) in self._two_probes(signed, signed, 2 * (first + number)).items():
                total[key] = total.get(key, 0.0) + a * b / len(views)
        if views:
            even = [noise.even for noise in views[0]]
            for key, (a, b) in self._two_probes(even, even, 2 * (first + PROBED)).items():
                total[key] = total[key] + a * b
        return total

    def _two_probes(self, one: Sequence[Array], other: Sequence[Array], number: int) -> dict[str, tuple[Array, Array]]:
        """Return two gradients of each parameter from separate samples, for two lists of dL/dI by view."""
        a, b = (self._probe(gradients, number + half) for half, gradients in enumerate((one, other)))
        return {key: (a[key].astype(np.float64), b[key].astype(np.float64)) for key in a}

    @property
    def images(self) -> list[list[Array]]:
        """The images (H, W, C) of all views at the current values, by each set of samples."""
        return self._base

    @property
    def weights(self) -> Array:
        """The weights (N,) in the first set of `slopes`."""
        return self.in_a_row(self._weights) * self.thinned

    @property
    def derivatives(self) -> tuple[Array, Array]:
        """The derivatives of `slopes`, both without the weights. In the first set, values without weight are 0."""
        (a, b), weights = self.slopes, self.weights
        return (a / np.where(weights > 0, weights, np.inf) if len(a) else a), b

    def newton_change(self, slopes: Sequence[Array]) -> list[Array]:
        """Return the change of each view's image (H, W, C) that a Newton step along the directions of `along` makes.
        The step ends at the bounds. `slopes` are dL/dI of the views.
        """
        a, b = self.slopes
        if not len(a):
            return [np.zeros_like(image) for image in slopes]
        problem, J = self.problem, 0.5 * sum(self.derivatives)
        step = pseudo_inverse(a @ b.T, LEAST_STEP) @ (J @ (self.thinned * self.in_a_row(slopes)))
        values = {each.key: problem.selection.array(each.key).astype(np.float64) for each in self.directions}
        for each, size in zip(self.directions, step, strict=True):
            if each.entry is not None:
                values[each.key].ravel()[each.entry] -= size
            else:
                values[each.key][..., slice(None) if each.channel is None else each.channel] *= 1 - size
        for key, value in values.items():
            low, high = problem.selection.specs[key].bounds or (-np.inf, np.inf)
            values[key] = np.clip(value, low, high)
        one, other = self._derivatives(ParameterChange(values, 1.0, self.directions))
        return [0.5 * (up + down) for up, down in zip(one, other, strict=True)]

    def in_a_row(self, images: Sequence[Array]) -> Array:
        """Return the used values (N,) of images of all views (H, W, C)."""
        row = np.concatenate([image.ravel() for image in images])
        return row if self._picked is None else row[self._picked]

    def _probe(self, gradients: Sequence[Array], number: int) -> dict[str, Array]:
        """Return the gradient of the parameters, given dL/dI of the views' exposed images (H, W, C). The gradient uses
        one set of samples.
        """
        problem = self.problem
        for place, view in enumerate(problem.trained):
            channels = int(problem.scene.sensors()[view.sensor].film().base_channels_count())
            v = view.exposed_array(gradients[place])
            v = np.pad(v, ((0, 0), (0, 0), (0, channels - v.shape[2]))).astype(np.float32)
            gradient = mi.TensorXf(v) + dr.opaque(mi.Float, 0)
            dr.make_opaque(gradient)
            known_step(
                problem.integrator, problem.scene, view.sensor, gradient, seed=self._seed(view.sensor, number),
                spp=self.spp, params=problem.selection.params,
            )  # fmt: skip
        return take_gradient(problem)

    def _seed(self, sensor: int, number: int) -> int:
        return seed(self.problem.config.run.seed, number, sensor, PURPOSE)


def _symmetric(product: Array) -> Array:
    return np.asarray(0.5 * (product + product.T))


def _of_channel(image: Array, channel: int | None) -> Array:
    if channel is None:
        return image
    return np.asarray(np.where(np.arange(image.shape[2]) == channel, image, 0.0))


def raise_eigenvalues(a: Array, b: Array, certain: Array) -> tuple[Array, float]:
    """Return the sum of a bᵀ and `certain` (M, M), with eigenvalues of at least their standard errors, and the
    standard error of the smallest eigenvalue. The eigenvalues are those in units in which the diagonal is 1. The
    columns of a and b (M, N) are independent samples.

    Noise may exceed a small eigenvalue. Steps in its direction would be too long if the result is small, and would stop
    if it is negative. Noise also couples directions. The products of a direction with others are therefore reduced by
    the `_share_of_signal` of both. Otherwise, one direction that the images hardly determine would hide small
    eigenvalues of all others.
    """
    share, diagonal = _share_of_signal(a, b), np.sum(a * b, axis=1)
    noise = (1 - share) * np.sqrt(np.square(a * b).sum(axis=1))
    a, b = np.sqrt(share)[:, None] * a, np.sqrt(share)[:, None] * b
    values, vectors, errors, units = _eigenvalues(a, b, certain + np.diag((1 - share) * diagonal), noise)
    raised = np.maximum(values, errors)
    return np.asarray((vectors * raised) @ vectors.T * units), float(errors[np.argmin(raised)])


def _share_of_signal(a: Array, b: Array) -> Array:
    """Return 1 minus the squared relative noise of the sums of a b, at least 0, for each row (M,).

    Half the square of a - b estimates the variance of the noise of a value. A rare bright sample would have a far too
    large estimate, but it changes a sum by about its own product at most.
    """
    products, squares = a * b, np.square(a - b)
    variances = np.abs(products) * squares + squares**2 / 12  # normal noise
    variance = np.minimum(variances, products**2).sum(axis=1)
    size = np.maximum(products.sum(axis=1), 0.0)
    return np.asarray(1 - variance / np.maximum(np.maximum(size**2, variance), 1e-300))


def lower_eigenvalues(a: Array, b: Array) -> Array:
    """Return the sum of a bᵀ (M, M) with eigenvalues that are lowered by MARGIN standard errors, to at least 0.

    In a direction without an effect on the image, noise makes the eigenvalue positive by chance. The gradients are
    almost 0 along this direction, so its offset would seem to be known.
    """
    values, vectors, errors, units = _eigenvalues(a, b, np.zeros((len(a), len(a))), np.zeros(len(a)))
    return np.asarray((vectors * np.maximum(values - MARGIN * errors, 0.0)) @ vectors.T * units)


def _eigenvalues(a: Array, b: Array, certain: Array, noise: Array) -> tuple[Array, Array, Array, Array]:
    """Return the eigenvalues (M,) of the sum of a bᵀ and `certain` in units in which the diagonal is 1, the
    eigenvectors (M, M), the standard errors (M,) of the eigenvalues, and the squares (M, M) of the units. `noise` (M,)
    has standard errors of the diagonal beside those of a bᵀ.
    """
    H = _symmetric(a @ b.T) + certain
    size = np.maximum(np.diag(H), np.sqrt(np.square(a * b).sum(axis=1)) + noise)
    root = np.sqrt(np.where(size > 0, size, 1.0))[:, None]
    values, vectors = np.linalg.eigh(H / (root @ root.T))
    squares = np.square((vectors.T @ (a / root)) * (vectors.T @ (b / root))).sum(axis=1)
    errors = np.sqrt(squares + np.square(vectors.T**2 * (noise / root[:, 0] ** 2)).sum(axis=1))
    return values, vectors, errors, root @ root.T


def _sure_share(terms: Array) -> Array:
    """Return the fraction (M,) of each row sum of `terms` (M, N) that remains after subtracting MARGIN standard errors.

    By chance, a few bright pixels may contribute all of a curvature.
    """
    sums, errors = terms.sum(axis=1), np.sqrt(np.square(terms).sum(axis=1))
    return np.asarray(np.clip(1 - MARGIN * errors / np.maximum(sums, 1e-300), 0, 1))
