"""Losses: how an image is compared with its target.

Each takes the image I, (H, W, C) and attached to the AD graph, and the target T of the same shape, both in linear
radiance, and returns a width-1 array: a mean over pixels and channels, so that it does not depend on the resolution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr

#: A loss with its options bound: (image, target) -> scalar.
Loss = Callable[[Any, Any], Any]


def _mean(values: Any) -> Any:
    return dr.mean(values, axis=None).array


def l1(image: Any, target: Any) -> Any:
    """mean |I - T|. Its gradient is 0 where I = T."""
    return _mean(dr.abs(image - target))


def l2(image: Any, target: Any) -> Any:
    """mean (I - T)²."""
    return _mean(dr.square(image - target))


def relative_l2(image: Any, target: Any, epsilon: float = 1e-2) -> Any:
    """mean (I - T)² / (T² + ε), ε in squared units of radiance.

    The denominator holds the target, not the image: a constant, so the gradient is that of the loss itself. With the
    (detached) noisy image in its place the noise of one pixel would stand in numerator and denominator at once.
    """
    return _mean(dr.square(image - target) / (dr.square(target) + epsilon))


def log_l2(image: Any, target: Any, epsilon: float = 1e-2) -> Any:
    """mean (log(I + ε) - log(T + ε))², ε in units of radiance.

    Negative values, as filters with negative lobes make them, count as 0.
    """
    difference = dr.log(dr.maximum(image, 0.0) + epsilon) - dr.log(dr.maximum(target, 0.0) + epsilon)
    return _mean(dr.square(difference))


LOSSES: dict[str, Callable[..., Any]] = {"l1": l1, "l2": l2, "relative_l2": relative_l2, "log_l2": log_l2}


def make_loss(type: str, **options: float) -> Loss:
    """Return the loss of that name with its options bound. Raises KeyError for an unknown name."""
    function = LOSSES[type]
    return lambda image, target: function(image, target, **options)
