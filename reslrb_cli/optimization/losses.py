"""Losses between an image and its target, by functions that Dr.Jit differentiates.

Each loss takes the image I and the target T, both (H, W, C) in linear radiance. I is attached to the AD graph. Optional
weights have the same shape and a mean of 1. A loss is an array of width 1. A loss is a mean over pixels and channels.
The value depends neither on the resolution nor on the number of masked pixels.

`weighted` returns a weighted sum of losses.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

#: A loss with bound options, as a function of an image, its target, and optional weights.
Loss = Callable[..., "mi.Float"]


def _mean(values: mi.TensorXf, weights: mi.TensorXf | None) -> mi.Float:
    return dr.mean(values if weights is None else values * weights, axis=None).array


def l1(image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
    """Return mean |I - T|. Its gradient is 0 where I = T."""
    return _mean(dr.abs(image - target), weights)


def l2(image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
    """Return mean (I - T)²."""
    return _mean(dr.square(image - target), weights)


def relative_l2(
    image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /, epsilon: float = 1e-2
) -> mi.Float:
    """Return mean (I - T)² / (T² + ε), with ε in squared units of radiance.

    The denominator uses the target, which is constant. The computed gradient is therefore the gradient of the complete
    loss. A denominator with the detached noisy image would contain the same noise as the numerator.
    """
    return _mean(dr.square(image - target) / (dr.square(target) + epsilon), weights)


#: SSIM's Gaussian window, standard deviation and side in pixels, and the constants K_1 and K_2 (Wang et al.).
SSIM_SIGMA, SSIM_SIDE, SSIM_K = 1.5, 11, (0.01, 0.03)


def ssim(image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
    """Return 1 - mean SSIM (Wang, Bovik, Sheikh and Simoncelli 2004, equation 13), for images of at least 11x11 pixels.

        SSIM = (2 μ_I μ_T + C_1) (2 σ_IT + C_2) / ((μ_I² + μ_T² + C_1) (σ_I² + σ_T² + C_2)),  C_k = (K_k L)²

    SSIM is computed for each channel and window. SSIM's windows are Gaussian, with a standard deviation of 1.5 pixels
    and a width of 11 pixels. Variances within a window are population variances, without the sample correction. The
    result equals scikit-image's with `gaussian_weights=True, use_sample_covariance=False`. The mean is over the windows
    that lie within the image, each with the weight of its central pixel. A masked pixel must be the same in both
    images. `View.judge` ensures equal values. L is the largest value of the target. Raises ValueError for smaller
    images.
    """
    if min(image.shape[:2]) < SSIM_SIDE:
        raise ValueError(f"SSIM needs images of {SSIM_SIDE}x{SSIM_SIDE} pixels, not {image.shape[1]}x{image.shape[0]}")
    mean_i, mean_t = _windows(image), _windows(target)
    most = dr.max(target.array if weights is None else dr.select(weights.array > 0, target.array, 0))
    extent = dr.select(most > 0, most, 1)
    first, second = (dr.square(factor * extent) for factor in SSIM_K)
    # About the means of the images, on which variances do not depend: squares of bright pixels lose digits.
    level = dr.detach(dr.mean(target, axis=None).array)
    i, t = image - level, target - level
    at_i, at_t = mean_i - level, mean_t - level
    across = _windows(i * t) - at_i * at_t
    both = _windows(dr.square(i) + dr.square(t)) - dr.square(at_i) - dr.square(at_t)
    above = (2 * mean_i * mean_t + first) * (2 * across + second)
    unlike = 1 - above / ((dr.square(mean_i) + dr.square(mean_t) + first) * (both + second))
    if weights is None:
        return _mean(unlike, None)
    margin = SSIM_SIDE // 2
    inner = weights[margin : image.shape[0] - margin, margin : image.shape[1] - margin]
    return dr.sum(unlike * inner, axis=None).array / dr.maximum(dr.sum(inner, axis=None).array, 1e-30)


def _windows(image: mi.TensorXf) -> mi.TensorXf:
    """Return the mean of an image (H, W, C) over each SSIM window. The result (H - 10, W - 10, C) is attached."""
    margin = SSIM_SIDE // 2
    raw = [math.exp(-0.5 * (place / SSIM_SIGMA) ** 2) for place in range(-margin, margin + 1)]
    factors = [each / sum(raw) for each in raw]
    for axis in (0, 1):
        shape = list(image.shape)
        step = math.prod(shape[axis + 1 :])
        extent = shape[axis]
        shape[axis] -= 2 * margin
        lane = dr.arange(mi.UInt32, math.prod(shape))
        inner = step * shape[axis]
        start = lane // inner * (step * extent) + lane % inner
        total = dr.zeros(mi.Float, math.prod(shape))
        for place, factor in enumerate(factors):
            # Entries have several destinations in one kernel, so atomics add up the derivative.
            total += factor * dr.gather(mi.Float, image.array, start + place * step)
        image = mi.TensorXf(total, tuple(shape))
    return image


LOSSES: dict[str, Loss] = {"l1": l1, "l2": l2, "relative_l2": relative_l2, "ssim": ssim}

#: Losses with a derivative linear in the image, so that its noise averages out.
QUADRATIC = ("l2", "relative_l2")


def make_loss(type: str, **options: float) -> Loss:
    """Return the loss named `type` with its options. Raises KeyError for an unknown name."""
    return functools.partial(LOSSES[type], **options)


def weighted(
    losses: Sequence[tuple[float, Loss]],
    image: mi.TensorXf,
    target: mi.TensorXf,
    weights: mi.TensorXf | None = None,
    /,
) -> mi.Float:
    """Return the sum of losses, each multiplied by its weight."""
    first, *others = (factor * loss(image, target, weights) for factor, loss in losses)
    return sum(others, first)
