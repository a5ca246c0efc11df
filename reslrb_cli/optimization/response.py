"""Recovery of a camera's response with the parameters.

The target T is decoded as the recovery starts, and does not change. The response gives the light g(T) of a pixel
(`scene/response.py`). The image is multiplied by a gain for each pixel and channel:

    T = gain * exposure * image,    gain = T / g(T) = exp(-sum of (s_k - start_k) B_k(T))

The gain depends on the target alone, so the loss of a noisy image has the same bias as without a response. A response
that maps all values to 0 does not reduce the loss, because the target keeps its values. The derivative with respect to
s_k is the sum of -B_k dL/dI I over pixels and channels, from the same samples as the derivative of an exposure.

Hardly any pixel may show a contrast of a curve. Noise would then move the contrast far, and shorten the joint steps of
all parameters. A weak cost (`Smoothness`) ties it to its neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.scene.response import basis, shown, start

Array = np.ndarray[Any, Any]

#: Cost of neighbouring contrasts whose logarithms differ by 1, as a share of the loss of a black image.
SMOOTHNESS = 1e-4


@dataclass
class RecoveredResponse:
    """Response of one view: the numbers s (K,) of `key` in `values`. `kind` is `gamma` or `curve`."""

    kind: str
    key: str
    values: Mapping[str, Any] = field(default_factory=dict)
    _basis: list[mi.TensorXf] = field(default_factory=list)

    def see(self, target: mi.TensorXf) -> None:
        """Take the B_k of a target (H, W, C), which is decoded as the recovery starts."""
        parts = basis(self.kind, np.array(target, dtype=np.float64)).astype(np.float32)
        self._basis = [mi.TensorXf(np.ascontiguousarray(part)) + dr.opaque(mi.Float, 0) for part in parts]
        dr.eval(self._basis)

    def now(self) -> Array:
        """Return the current numbers (K,)."""
        return np.array(dr.detach(self.values[self.key]), dtype=np.float64).ravel()

    def applied(self, image: mi.TensorXf) -> mi.TensorXf:
        """Return the image (H, W, C) times the gain. The result is attached if the image is."""
        numbers = dr.detach(self.values[self.key])
        total = dr.zeros(mi.Float, dr.width(image.array))
        for place, (part, first) in enumerate(zip(self._basis, start(self.kind), strict=True)):
            offset = dr.gather(mi.Float, numbers, mi.UInt32(place)) - dr.opaque(mi.Float, float(first))
            total -= offset * part.array
        return mi.TensorXf(image.array * dr.exp(total), image.shape)

    def scaled(self, image: Array) -> Array:
        """Return an image (H, W, C or more) times the gain. Channels beyond the target's are unchanged."""
        colours = self._basis[0].shape[2]
        offsets = self.now() - start(self.kind)
        total = sum(offset * np.array(part) for offset, part in zip(offsets, self._basis, strict=True))
        return np.concatenate([image[:, :, :colours] * np.exp(-total), image[:, :, colours:]], axis=2)

    def shown(self, image: Array, colours: int) -> Array:
        """Return an exposed image (H, W, C or more) as the camera would show it: with the values T of its light in the
        first `colours` channels.
        """
        seen = shown(self.kind, self.now(), image[:, :, :colours])
        return np.concatenate([seen, image[:, :, colours:]], axis=2)

    def add_gradient(self, leaf: Any, products: mi.Float) -> None:
        """Add dL/ds to the gradient of `leaf`. `products` are dL/dI I by pixel and channel."""
        total = dr.zeros(mi.Float, len(self._basis))
        for place, part in enumerate(self._basis):
            dr.scatter(total, -dr.sum(part.array * products), mi.UInt32(place))
        dr.accum_grad(leaf, total)


class Smoothness:
    """Cost of the contrasts s of a curve: the sum of (ln s_(k+1) - ln s_k)² times `SMOOTHNESS`, and times the loss of a
    black image, which `scale` returns. The cost has the form of a regularizer's (`regularizers.Cost`).
    """

    def __init__(self, scale: Callable[[], float]) -> None:
        self._scale = scale
        self._weight: float | None = None

    def __call__(self, numbers: Array) -> tuple[float, Array]:
        """Return the cost of the contrasts (K,), and its gradient (K,)."""
        if self._weight is None:  # the target does not exist before
            self._weight = SMOOTHNESS * self._scale()
        change = np.diff(np.log(numbers))
        slope = np.concatenate([[0.0], change]) - np.concatenate([change, [0.0]])
        return self._weight * float(change @ change), 2 * self._weight * slope / numbers
