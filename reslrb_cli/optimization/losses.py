"""Losses: how an image is compared with its target.

Each takes the image I, (H, W, C) and attached to the AD graph, the target T of the same shape, both in linear radiance,
and what each entry weighs, of that shape too with a mean of 1 (None: all the same). It returns a width-1 array: a mean
over pixels and channels, so that it depends neither on the resolution nor on how many pixels are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import drjit as dr
import mitsuba as mi


class Loss(Protocol):
    """A loss with its options bound."""

    def __call__(self, image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float: ...


def _mean(values: mi.TensorXf, weights: mi.TensorXf | None) -> mi.Float:
    return dr.mean(values if weights is None else values * weights, axis=None).array


def l1(image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
    """mean |I - T|. Its gradient is 0 where I = T."""
    return _mean(dr.abs(image - target), weights)


def l2(image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
    """mean (I - T)²."""
    return _mean(dr.square(image - target), weights)


def relative_l2(
    image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /, epsilon: float = 1e-2
) -> mi.Float:
    """mean (I - T)² / (T² + ε), ε in squared units of radiance.

    The denominator holds the target, not the image: a constant, so the gradient is that of the loss itself. With the
    (detached) noisy image in its place the noise of one pixel would stand in numerator and denominator at once.
    """
    return _mean(dr.square(image - target) / (dr.square(target) + epsilon), weights)


def log_l2(
    image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /, epsilon: float = 1e-2
) -> mi.Float:
    """mean (log(I + ε) - log(T + ε))², ε in units of radiance.

    Negative values, as filters with negative lobes make them, count as 0.
    """
    difference = dr.log(dr.maximum(image, 0.0) + epsilon) - dr.log(dr.maximum(target, 0.0) + epsilon)
    return _mean(dr.square(difference), weights)


LOSSES: dict[str, Callable[..., mi.Float]] = {"l1": l1, "l2": l2, "relative_l2": relative_l2, "log_l2": log_l2}


def make_loss(type: str, **options: float) -> Loss:
    """Return the loss of that name with its options bound. Raises KeyError for an unknown name."""
    function = LOSSES[type]
    return lambda image, target, weights=None: function(image, target, weights, **options)
