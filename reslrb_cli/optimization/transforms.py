"""Reparameterisations: the optimiser moves an unconstrained variable u, the scene gets x = T(u).

    none      x = u
    sigmoid   x = low + (high - low) / (1 + exp(-u))     between the bounds, which it never reaches
    log       x = exp(u)                                 positive; a step is a relative change
    softplus  x = log(1 + exp(u))                        positive; relative well below 1, absolute well above

By the chain rule dL/du = dL/dx T'(u), which is applied to the gradient once it is there: a step's kernels know nothing
of it. T is increasing, entry by entry.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

Bounds = tuple[float, float] | None

#: Where u ends: x keeps off the sigmoid's bounds by 1e-7 of their distance, and neither under- nor overflows.
SIGMOID_END, EXPONENT_END = 16.0, 80.0


@dataclass(frozen=True)
class Transform:
    """T, its inverse and its derivative T'(u), on arrays of any Dr.Jit type, and the least and greatest u."""

    forward: Callable[[Any], Any]
    inverse: Callable[[Any], Any]
    derivative: Callable[[Any], Any]
    low: float
    high: float


def make_transform(name: str, bounds: Bounds) -> Transform | None:
    """The transform of that name; None for `none`. `bounds` are those of x. Raises KeyError for an unknown name."""
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
    forward, inverse, derivative, end = {
        "log": (dr.exp, dr.log, dr.exp, EXPONENT_END),
        "softplus": (_softplus, _inverse_softplus, _logistic, math.inf),
    }[name]
    least = -EXPONENT_END if low <= 0 else max(float(inverse(low)), -EXPONENT_END)
    return Transform(forward, inverse, derivative, least, end if math.isinf(high) else min(float(inverse(high)), end))


def _logistic(u: Any) -> Any:
    return 1 / (1 + dr.exp(-u))


def _softplus(u: Any) -> Any:
    small = dr.exp(-dr.abs(u))
    return dr.maximum(u, 0.0) + 2 * dr.atanh(small / (2 + small))  # log(1 + s), exact for a small s too


def _inverse_softplus(x: Any) -> Any:
    half = 0.5 * dr.minimum(x, 60.0)  # beyond, the logarithm of exp(x) - 1 = 2 sinh(x/2) exp(x/2) is x
    return x + dr.log(2 * dr.sinh(half)) - half


@dataclass
class Variable:
    """What the optimiser moves in place of a parameter x: v, with x = T(length * v), x within its bounds.

    The gradient that it is given is `gain` times dL/dv. Both numbers are 1 until they are measured (`scaling.py`), and
    reach kernels as data, so that their values compile nothing.
    """

    transform: Transform | None
    bounds: Bounds
    length: float = 1.0
    gain: float = 1.0

    def to_scene(self, v: Any) -> Any:
        """x of v."""
        u = v * _opaque(v, self.length)
        x = u if self.transform is None else self.transform.forward(u)
        return x if self.bounds is None else dr.clip(x, self.bounds[0], self.bounds[1])  # rounding may have left them

    def from_scene(self, x: Any) -> Any:
        """v of x."""
        u = x if self.transform is None else self.transform.inverse(x)
        return self.clamp(u * _opaque(x, 1 / self.length))

    def clamp(self, v: Any) -> Any:
        """v where its x is within the bounds, else the nearest that is."""
        ends = self.bounds if self.transform is None else (self.transform.low, self.transform.high)
        if ends is None:
            return v
        return dr.clip(v, *(_opaque(v, end / self.length) for end in ends))

    def chain(self, v: Any, gradient: Any) -> Any:
        """`gain` times dL/dv, of dL/dx."""
        result = gradient * _opaque(v, self.length) * _opaque(v, self.gain)
        if self.transform is None:
            return result
        return result * self.transform.derivative(v * _opaque(v, self.length))


def _opaque(like: Any, number: float) -> Any:
    return dr.opaque(dr.leaf_t(like), number)
