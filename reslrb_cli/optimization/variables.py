"""Variables of the optimiser, through which it moves the parameters of a scene.

Transforms (`Transform`, `Variable`): the optimiser moves an unconstrained variable u, and the scene gets x = T(u).

    none      x = u
    sigmoid   x = low + (high - low) / (1 + exp(-u))     between the bounds, which it never reaches
    log       x = exp(u)                                 positive; a step is a relative change

By the chain rule, dL/du = dL/dx T'(u). The factor T'(u) is applied to the accumulated gradient, so the kernels of a
step do not depend on the factor. T is increasing in each entry.

Smooth steps (`precondition`, `Smoother`) move v instead of u: x = T(S v).

    S = (1 - l^2 Δ)^-1,   dL/dv = S dL/du                Nicolet, Jacobson and Jakob 2021 ("large steps"), eq. 9 to 12

S is symmetric, and a step of gradient descent is S^2 dL/du. A step therefore moves details finer than l by a smaller
amount. The reduction factor is the fourth power of the ratio of the detail's size to l. Refracting surfaces need this.
The light from refracting surfaces depends on the surface's second derivatives. The curvature of a loss therefore grows
with the fourth power of the spatial frequency. Without S, the map's finest ripple limits the step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from reslrb_cli.backend.memory import flat
from reslrb_cli.statistics import Array, rms, scale_frequencies

Bounds = tuple[float, float] | None

#: Limit of u: x stays away from the sigmoid's bounds by 1e-7 of their distance, and neither underflows nor overflows.
SIGMOID_END, EXPONENT_END = 16.0, 80.0


@dataclass(frozen=True)
class Transform:
    """Transform T with its inverse, its derivative T'(u), and the smallest and largest u. The functions accept any
    Dr.Jit array type.
    """

    forward: Callable[[Any], Any]
    inverse: Callable[[Any], Any]
    derivative: Callable[[Any], Any]
    low: float
    high: float


def make_transform(name: str, bounds: Bounds) -> Transform | None:
    """Return the transform called `name`, or None for `none`. `bounds` are those of x. Raises KeyError for an unknown
    name.
    """
    low, high = bounds or (-math.inf, math.inf)
    if name == "none":
        return None
    if name == "sigmoid":
        return Transform(
            forward=lambda u: low + (high - low) * _logistic(u),
            inverse=lambda x: dr.log((x - low) / (high - x)),
            derivative=lambda u: (high - low) * _logistic(u) * _logistic(-u),
            low=-SIGMOID_END,
            high=SIGMOID_END,
        )
    if name != "log":
        raise KeyError(name)
    least = -EXPONENT_END if low <= 0 else max(math.log(low), -EXPONENT_END)
    return Transform(dr.exp, dr.log, dr.exp, least, min(math.log(high), EXPONENT_END))


def _logistic(u: Any) -> Any:
    return 1 / (1 + dr.exp(-u))


class Smoother:
    """Smoothing operator S for textures and heightmaps of the shape (height, width, channels) with at least two texels.

    `length` is l, as a fraction of the longer side, so the effect does not depend on the resolution. Δ is a sum of
    differences of neighbours without flow through the edges, so the cosine transform diagonalises S. `gain` is the mean
    of the diagonal of S^2, which is each entry's response to a gradient of the entry alone.
    """

    def __init__(self, shape: tuple[int, ...], length: float) -> None:
        texels = length * max(shape[:2])  # l in texels, which are square
        along = [2 - 2 * np.cos(np.pi * np.arange(size) / size) for size in shape[:2]]
        self._shape = shape
        self._eigenvalues = 1 + texels**2 * (along[0][:, None] + along[1])[:, :, None]
        self.gain = float(np.mean(self._eigenvalues**-2.0))

    def smooth(self, value: Any) -> Any:
        """Return S `value`, evaluated. S is symmetric, so S also turns the gradient by S v into the gradient by v."""
        return self._scaled(value, 1 / self._eigenvalues)

    def roughen(self, value: Any) -> Any:
        """Return the inverse of `smooth`."""
        return self._scaled(value, self._eigenvalues)

    def _scaled(self, value: Any, factors: Array) -> Any:
        array = np.array(dr.detach(value), dtype=np.float64)
        result = scale_frequencies(array.reshape(self._shape), factors)
        return type(value)(result.reshape(array.shape).astype(np.float32))


@dataclass
class Variable:
    """Variable v of the optimiser for a parameter x: x = T(S v), with x within its bounds.

    S is 1 or a `Smoother`. The optimiser receives the gradient `gain` times dL/dv. `gain` is 1 until it is measured
    (`sensitivity.py`). It reaches kernels as data, so a new value does not require new kernels.
    """

    transform: Transform | None
    bounds: Bounds
    gain: float = 1.0
    smoother: Smoother | None = None

    @property
    def ends(self) -> Bounds:
        """Smallest and largest u."""
        return self.bounds if self.transform is None else (self.transform.low, self.transform.high)

    def to_scene(self, v: Any) -> Any:
        """Return x for v."""
        u = self._u(v)
        x = u if self.transform is None else self.transform.forward(u)
        return x if self.bounds is None else dr.clip(x, self.bounds[0], self.bounds[1])  # rounding may exceed them

    def from_scene(self, x: Any) -> Any:
        """Return v for x."""
        u = x if self.transform is None else self.transform.inverse(x)
        if self.smoother is not None:
            u = self.smoother.roughen(u)
        return self.clamp(u)

    def clamp(self, v: Any) -> Any:
        """Return v if its x is within the bounds, otherwise the nearest allowed value."""
        ends = self.ends
        if ends is None:
            return v
        if self.smoother is None:
            return dr.clip(v, *(_opaque(v, end) for end in ends))
        u = self._u(v)
        if not dr.any(flat((u < ends[0]) | (u > ends[1])))[0]:
            return v  # unchanged: transforming back and forth would round it again in each step
        return self.smoother.roughen(dr.clip(u, *ends))

    def chain(self, v: Any, gradient: Any) -> Any:
        """Return `gain` times dL/dv, given dL/dx."""
        result = gradient * _opaque(v, self.gain)
        if self.transform is not None:
            result = result * self.transform.derivative(self._u(v))
        return result if self.smoother is None else self.smoother.smooth(result)

    def reach(self, v: Any, rate: float) -> float:
        """Return the root mean square change of x if v moves by `rate`. For each entry, the larger of the upward and
        downward movements counts.
        """
        value = self.to_scene(v)
        up, down = (dr.abs(self.to_scene(v + side * rate) - value) for side in (1, -1))
        return rms(np.array(dr.maximum(up, down)))

    def _u(self, v: Any) -> Any:
        return v if self.smoother is None else self.smoother.smooth(v)


def _opaque(like: Any, number: float) -> Any:
    return dr.opaque(dr.leaf_t(like), number)
