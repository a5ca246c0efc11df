"""Effects of noise on the derivative dL/dI of the loss by the image: of noise in rendered targets, and of noise in the
images of a step.

Noise of a rendered target adds the same b = J^T d to all gradients. Here d is the noise's effect on dL/dI. Images of
the target's own integrator are samples of the effect d of the target's noise. `d_even` is the mean of d. A
relative loss gives darkened pixels more weight, so `d_even` pulls all pixels in the same direction. `d_odd` is the
remainder of d. `d_odd` is split into blocks of pixels that the film's filter may have mixed. B is the second moment of
b.

    B = sum over blocks (J_a^T d_odd) (J_b^T d_odd)^T + (J^T d_even) (J^T d_even)^T

Noise of a step's images adds the same b to all gradients too, if dL/dI is not a linear function of the image. `l1` and
`ssim` are examples. `image_biases` estimates the mean effect on dL/dI with two sets of images. `LossCurvature` adds the
square of the mean pull along each direction to B. For single entries, it adds the product of both pulls, whose noise
has no bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reslrb_cli.optimization.loading import make_configured, paths_of, render_in_passes
from reslrb_cli.optimization.nonfinite import fill_gaps, finite
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import see_images
from reslrb_cli.optimization.views import View, slope, to_tensor
from reslrb_cli.statistics import Array, rms

PURPOSE = "curvature"
#: Images for the target's noise, with the target's samples if these are at most a multiple of a step's.
REPLICAS, AGAIN = 4, 4
#: Number of the first image for the bias of the loss.
FIRST_BIAS = 1000
#: Deviation of dL/dI from a linear function of the image, as a share of dL/dI, that counts as rounding.
LINEAR = 1e-3
#: Maximum factor by which images are made brighter or darker.
MOST_ASTRAY = 10.0
#: Maximum number of blocks of pixels with common noise.
MOST_BLOCKS = 2**18


@dataclass
class TargetNoise:
    """Effect of the noise of one view's target on dL/dI, (H, W, C).

    `even` is the mean effect, and `odd` the remaining effect of one sample. Pixels within a block of side length `side`
    have common noise.
    """

    odd: Array
    even: Array
    side: int

    def in_blocks(self, slope: Array) -> Array:
        """Multiply an image's derivative (H, W, C) by the odd part. Return the sum over each block, as a flat array."""
        product = np.sum(slope * self.odd, axis=2)
        rows, columns = (np.arange(0, size, self.side) for size in product.shape)
        return np.asarray(np.add.reduceat(np.add.reduceat(product, rows, axis=0), columns, axis=1).ravel())

    def signed(self, random: np.random.Generator) -> Array:
        """Return the odd part with a random sign for each block."""
        height, width = self.odd.shape[:2]
        signs = random.choice([-1.0, 1.0], size=(-(-height // self.side), -(-width // self.side)))
        spread = np.repeat(np.repeat(signs, self.side, axis=0), self.side, axis=1)[:height, :width, None]
        return self.odd * spread


def target_noises(problem: Problem, spp: int) -> list[list[TargetNoise]]:
    """Return samples of the effects of the targets' noise, each by view; none if no target was rendered. Differences of
    images with `spp` samples give the noise of targets with many samples.
    """
    config, trained = problem.config, problem.trained
    render = config.target.render
    if render is None or all(view.file is not None for view in trained):
        return []
    chosen = render.integrator or config.integrator
    paths = paths_of(chosen, problem.scene, problem.sensors, problem.moves)
    integrator = make_configured(config, chosen, paths, problem.scene)
    multiple = chosen.options().get("samples_per_pass")
    by_view = [_noises(problem, view, integrator, spp, multiple) for view in trained]
    return [list(sample) for sample in zip(*by_view, strict=True)]


def _noises(problem: Problem, view: View, integrator: Any, least: int, multiple: int | None) -> list[TargetNoise]:
    """Return samples of the effect that the noise of a view's target has on dL/dI. For a file, the samples are
    zero.

    The function renders several images with the target's number of samples `spp`. Each image takes the role of the
    target in turn. The mean of the other images serves as the target's expected value. If `spp` exceeds `AGAIN` times
    the samples of a step, the images have few samples instead. Their differences, scaled to the target's noise, are
    then added to the target. All sample counts are multiples of `multiple`.
    """
    true = np.array(view.target, dtype=np.float64)
    if view.file is not None:
        return [TargetNoise(np.zeros_like(true), np.zeros_like(true), 1)] * REPLICAS
    assert problem.config.target.render is not None
    run, unit, spp = problem.config.run, multiple or 1, problem.config.target.render.spp
    again, few = spp <= AGAIN * run.spp, max(least // unit, 1) * unit
    images = []
    for number in range(REPLICAS):
        image = render_in_passes(
            integrator, problem.scene, view.sensor, spp if again else few, run.seed, number,
            f"{PURPOSE}, target", multiple,
        )  # fmt: skip
        shown = view.kept(image[:, :, : true.shape[2]].astype(np.float64))
        images.append(problem.leave_out(f"an image of the target of sensor {view.sensor}", shown))
    images = list(fill_gaps(np.array(images)))
    # If noise has led the values astray, the images are not as bright as the target.
    bright = np.sum(view.kept(true)) * REPLICAS / max(float(np.sum(images)), 1e-300)
    images = [image * np.clip(bright, 1 / MOST_ASTRAY, MOST_ASTRAY) for image in images]
    if again:
        total = np.sum(images, axis=0)
        found = [_slope(view, image, (total - image) / (REPLICAS - 1)) for image in images]
        even = np.mean(found, axis=0)
        odd = [(each - even) * np.sqrt(REPLICAS / (REPLICAS - 1)) for each in found]
    else:
        noises = [(a - b) * np.sqrt(few / spp / 2) for a, b in zip(images[::2], images[1::2], strict=True)]
        sides = [[_slope(view, true + side * noise, true) for side in (1, -1)] for noise in noises]
        odd = [0.5 * (up - down) for up, down in sides] * 2
        even = np.mean(sides, axis=(0, 1))
    mixed = max(round(2 * problem.scene.sensors()[view.sensor].film().rfilter().radius()), 1)
    side = max(mixed, round(np.ceil(np.sqrt(true.shape[0] * true.shape[1] / MOST_BLOCKS))))
    return [TargetNoise(each, even, side) for each in odd]


def is_linear(problem: Problem, base: Sequence[Sequence[Array]]) -> bool:
    """True if dL/dI is a linear function of the image, as that of `l2` is. Noise of the image then has no bias."""
    for view, *halves in zip(problem.trained, *base, strict=True):
        a, b = (fill_gaps(np.array([half]))[0] for half in halves)
        true = np.array(view.target, dtype=np.float64)
        apart = 0.5 * (_slope(view, true, a) + _slope(view, true, b))
        if rms(apart - _slope(view, true, 0.5 * (a + b))) > LINEAR * rms(apart):
            return False
    return True


def image_biases(problem: Problem, weights: Sequence[Array]) -> list[list[Array]]:
    """Return two samples of the mean effect of the images' noise on dL/dI, by view.

    The mean of several images takes the role of the image without noise. Its own noise leaves at most half of the
    effect, which is the share for a kink, as that of `l1`. The difference is therefore doubled. A kink is sharper
    without noise, so its curvature is larger than W. The effect is multiplied by the ratio of both, because offsets
    are divided by W.
    """
    found = []
    for half in (0, 1):
        numbers = range(FIRST_BIAS + REPLICAS * half, FIRST_BIAS + REPLICAS * (half + 1))
        images = [see_images(problem, problem.config.run.spp, -number, PURPOSE) for number in numbers]
        biases: list[Array] = []
        for view, samples in zip(problem.trained, zip(*images, strict=True), strict=True):
            true, known = np.array(view.target, dtype=np.float64), fill_gaps(np.array(samples))
            mean = known.mean(axis=0)
            bias = np.mean([_slope(view, true, image) for image in known], axis=0)
            softer = weights[len(biases)].sum() / max(float(second_derivative(view, mean).sum()), 1e-300)
            biases.append(2 * min(softer, 1.0) * (bias - _slope(view, true, mean)))
        found.append(biases)
    return found


def _slope(view: View, target: Array, image: Array) -> Array:
    """Return dL/dI of an exposed `image` for another `target`, both (H, W, C)."""
    return finite(slope(replace(view, made=to_tensor(target)).judge, image)) * view.share


def second_derivative(view: View, image: Array) -> Array:
    """Return d2L/dI2 for the pixels (H, W, C) of a view's exposed `image`. The second derivative is computed from
    differences of dL/dI.

    The differences of dL/dI use steps as large as the residual between image and target. If L has a kink (`l1`),
    the result is L's curvature at the scale of the noise.
    """
    true = view.kept(np.array(view.target, dtype=np.float64))
    known = np.isfinite(image)
    image = np.where(known, image, true)
    step = max(rms(image - true), 1e-3 * rms(true), 1e-6)
    up, down = (slope(view.judge, image + side * step).astype(np.float64) for side in (1, -1))
    return np.where(known, np.maximum(finite(up - down), 0.0), 0.0) / (2 * step) * view.share
