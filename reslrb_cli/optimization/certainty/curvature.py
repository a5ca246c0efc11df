"""The Gauss-Newton curvature H = J^T W J of the loss at the parameters' values: J of the image, W = d2L/dI2, by pixel.

    along directions    J by differences of images at common random numbers, from two independent sets of samples a, b:
                        H = (J_a^T W J_b + J_b^T W J_a) / 2, whose noise has no bias
    by entry            random signs v over the pixels: with p_s = J_s^T (sqrt(W) v), the mean of p_a p_b is the
                        diagonal of H (Hutchinson 1989; Bekas et al. 2007), again from two sets of samples

Of the first kind a standard error is taken off, by the terms of its sum over the pixels: too much curvature would make
results look too sure. The second kind is noise for the most part at each entry alone. Entries whose gradients have
alike noise have alike curvature, so it is averaged over those: `smooth`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.integrators import known_step, render_image
from reslrb_cli.integrators.tracer import LightTracer
from reslrb_cli.optimization.certainty.directions import Change, Direction
from reslrb_cli.optimization.samples import take_gradient
from reslrb_cli.optimization.views import View, slope
from reslrb_cli.seeds import seed

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

Array = np.ndarray[Any, Any]

_PURPOSE = "curvature"
#: Entries over which curvature is averaged, at least.
GROUP = 64
#: A pixel shows a texture where it changes by this share of the most that any does.
SHOWN = 0.05
#: So many standard errors are taken off.
SURE = 1.0
#: Values of the images that enter H along directions: of more, so many at random, the same for all.
MOST_VALUES = 2**18


class Curvature:
    """Measures it where `problem`, which has its targets, stands, with `spp` samples per pixel in each of two sets."""

    def __init__(self, problem: Problem, spp: int) -> None:
        self.problem, self.spp = problem, spp
        #: What was done so far.
        self.changes = self.probes = 0
        #: By how many values of the images each texture is seen, of those that were changed as a whole.
        self.pixels: dict[str, int] = {}
        self.integrator = problem.integrator
        if isinstance(self.integrator, LightTracer):  # a recording would cost more than so few probes save
            per_pass = self.integrator.samples_per_pass
            self.integrator = self.integrator.with_options(samples_per_pass=per_pass, freeze=False)
        self._base = [self._images(half) for half in (0, 1)]
        self._weights = [self._weight(place, view) for place, view in enumerate(problem.trained)]
        values = sum(weight.size for weight in self._weights)
        random = np.random.default_rng(self._seed(0, 0))
        self._picked = None if values <= MOST_VALUES else np.sort(random.choice(values, MOST_VALUES, replace=False))
        self._thinned = max(values / MOST_VALUES, 1.0)

    def along(self, changes: Sequence[Change], go_on: Callable[[], bool]) -> tuple[list[Direction], Array]:
        """The directions of the changes that were rendered before `go_on` said no, and H of those (M, M)."""
        directions: list[Direction] = []
        columns: list[list[Array]] = [[], []]
        for change in changes:
            if not go_on():
                break
            self.problem.selection.set_arrays(change.values)
            images = [self._images(half) for half in (0, 1)]
            self.changes += 1
            self.problem.apply()
            for direction in change.directions:
                directions.append(direction)
                for half in (0, 1):
                    pairs = zip(images[half], self._base[half], strict=True)
                    slopes = [_of_channel((a - b) / change.amount, direction.channel) for a, b in pairs]
                    columns[half].append(self._in_a_row(slopes))
                if direction.entry is None:
                    self.pixels[direction.key] = self.pixels.get(direction.key, 0) + _changed(slopes)
        if not directions:
            return [], np.zeros((0, 0))
        a, b = (np.nan_to_num(np.array(rows)) for rows in columns)
        a = a * self._in_a_row(self._weights)
        sure = _sure_share(a * b)
        product = a @ b.T * self._thinned * np.sqrt(np.outer(sure, sure))
        return directions, 0.5 * (product + product.T)

    def by_entry(self, probes: int, go_on: Callable[[], bool]) -> dict[str, Array]:
        """For each parameter the diagonal of H in a row, unsmoothed; nothing where `go_on` said no at once."""
        total: dict[str, Array] = {}
        random = np.random.default_rng(self._seed(0, probes))
        for probe in range(probes):
            if not go_on():
                break
            signs = [random.choice([-1.0, 1.0], size=weight.shape) for weight in self._weights]
            a, b = (self._probe(signs, 2 * probe + half) for half in (0, 1))
            for key in a:
                total[key] = total.get(key, 0.0) + a[key].astype(np.float64) * b[key]
            self.probes += 1
        return {key: value / self.probes for key, value in total.items()}

    def _in_a_row(self, images: Sequence[Array]) -> Array:
        row = np.concatenate([image.ravel() for image in images])
        return row if self._picked is None else row[self._picked]

    def _probe(self, signs: Sequence[Array], number: int) -> dict[str, Array]:
        problem = self.problem
        for place, view in enumerate(problem.trained):
            channels = int(problem.scene.sensors()[view.sensor].film().base_channels_count())
            v = view.exposure.of_array(np.sqrt(self._weights[place]) * signs[place])
            v = np.pad(v, ((0, 0), (0, 0), (0, channels - v.shape[2]))).astype(np.float32)
            gradient = mi.TensorXf(v) + dr.opaque(mi.Float, 0)
            dr.make_opaque(gradient)
            known_step(
                self.integrator, problem.scene, view.sensor, gradient, seed=self._seed(view.sensor, number),
                spp=self.spp, params=problem.selection.params,
            )  # fmt: skip
        return take_gradient(problem)

    def _images(self, half: int) -> list[Array]:
        """Every view that is trained on as the scene stands, exposed, without alpha, from the seeds of that set."""
        images = []
        for view in self.problem.trained:
            number = self._seed(view.sensor, -1 - half)
            image = render_image(self.problem.integrator, self.problem.scene, view.sensor, number, self.spp)
            colors = np.array(image, dtype=np.float64)[:, :, : view.target.shape[2]]
            images.append(view.kept(view.exposure.of_array(colors)))
        return images

    def _weight(self, place: int, view: View) -> Array:
        """d2L/dI2 of a view's exposed image, for its pixels (H, W, C): differences of dL/dI over the residual's size.

        Where L has a kink (`l1`), this is its curvature as noise of that size sees it.
        """
        image = 0.5 * (self._base[0][place] + self._base[1][place])
        true = view.kept(np.array(view.target, dtype=np.float64))
        step = max(_rms(image - true), 1e-3 * _rms(true), 1e-6)
        up, down = (slope(view.judge, image + side * step).astype(np.float64) for side in (1, -1))
        return np.maximum(np.nan_to_num(up - down), 0.0) / (2 * step) * view.share

    def _seed(self, sensor: int, number: int) -> int:
        return seed(self.problem.config.run.seed, number, sensor, _PURPOSE)


def smooth(diagonal: Array, noise: Array) -> Array:
    """`diagonal` (N,) averaged over groups of entries whose gradients have alike `noise`, at least GROUP of them."""
    order = np.argsort(noise, kind="stable")
    result = np.empty_like(diagonal)
    for group in np.array_split(order, max(len(order) // GROUP, 1)):
        result[group] = max(float(diagonal[group].mean()), 0.0)
    return result


def _of_channel(image: Array, channel: int | None) -> Array:
    if channel is None:
        return image
    kept = np.zeros_like(image)
    kept[:, :, channel] = image[:, :, channel]
    return kept


def _sure_share(terms: Array) -> Array:
    """What of the sums of (M, N) terms is left once SURE of their standard errors are taken off, as a share, (M,).

    A few bright pixels may make up all of a curvature, and be an accident.
    """
    sums, errors = terms.sum(axis=1), np.sqrt(np.square(terms).sum(axis=1))
    result: Array = np.clip(1 - SURE * errors / np.maximum(sums, 1e-300), 0, 1)
    return result


def _changed(slopes: Sequence[Array]) -> int:
    most = max(float(np.abs(slope).max()) for slope in slopes)
    return sum(int(np.sum(np.abs(slope) > SHOWN * most)) for slope in slopes) if most else 0


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
