"""What a view's image is multiplied by before it is compared: a number, or one that is recovered with the rest.

The model is  target = exposure * image,  with one exposure E for all channels or one for each. The derivative of a loss
L(E I) with respect to E is the sum over pixels of dL/dI I / E: it takes the samples that the other parameters'
derivatives are made of, and no more. Where dL/dI comes from other samples than I, it is as unbiased as those are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import Settings
from reslrb_cli.integrators import first_channels
from reslrb_cli.scene import Selection

Array = np.ndarray[Any, Any]

#: The key of an exposure that all views share.
SHARED = "exposure"


@dataclass
class Exposure:
    """The exposure of one view: `fixed`, or where `key` is not empty the value of that key in `values`."""

    fixed: float = 1.0
    key: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)

    def now(self) -> mi.Float | mi.Color3f | float:
        """The exposure as it stands, without derivatives: of width 1, one for each channel, or the fixed number."""
        return dr.detach(self.values[self.key]) if self.key else self.fixed

    def applied(self, image: mi.TensorXf) -> mi.TensorXf:
        """E I of an image (H, W, C), attached to what the image is attached to."""
        value = self.now()
        if isinstance(value, (int, float)):
            return image if value == 1 else image * value
        if dr.size_v(value) == 3:
            channel = dr.arange(mi.UInt32, dr.width(image.array)) % image.shape[2]
            factor = dr.select(channel == 0, value.x, dr.select(channel == 1, value.y, value.z))
            return mi.TensorXf(image.array * factor, image.shape)
        return mi.TensorXf(image.array * value, image.shape)

    def of_array(self, image: Array) -> Array:
        """E I of an image (H, W, C or more), its alpha as it is."""
        value = np.atleast_1d(np.array(self.now(), np.float32).ravel())
        if np.all(value == 1):
            return image
        factor = np.ones(image.shape[2], np.float32)
        colors = 1 if image.shape[2] <= 2 else 3
        factor[:colors] = value
        return image * factor

    def add_gradient(self, leaf: Any, channels: int, image: mi.TensorXf, gradient: mi.TensorXf) -> None:
        """Add dL/dE to the gradient of `leaf`, of an image (H, W, `channels` or more) and its dL/dI."""
        product = first_channels(image, channels) * first_channels(gradient, channels)
        # A pixel that is left out may hold anything, and has no derivative.
        each = dr.select(first_channels(gradient, channels).array != 0, product.array, 0)
        if dr.size_v(leaf) == 3:
            pixel = dr.arange(mi.UInt32, dr.width(each) // 3)
            total = mi.Color3f(*(dr.sum(dr.gather(mi.Float, each, 3 * pixel + channel)) for channel in range(3)))
        else:
            total = dr.sum(each)
        dr.accum_grad(leaf, total / dr.detach(leaf))


def add_exposure(selection: Selection, key: str, kind: str, channels: int) -> None:
    """Recover an exposure, in its logarithm, from 1 on: `auto`, or `per_channel` of a film with that many channels."""
    if key in selection.factors:
        return
    one = mi.Color3f(1) if kind == "per_channel" and channels == 3 else mi.Float(1)
    value = one + dr.opaque(mi.Float, 0)
    selection.add_factor(key, value, Settings(initial=1.0, transform="log"))
