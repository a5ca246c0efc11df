"""What was measured of one parameter at the end of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from reslrb_cli.optimization.certainty.verdicts import at_bound

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Measured:
    """One parameter of N entries at the end of a run: its values (N,), bounds, scale, and K gradients (K, N).

    `response` is how far a step moves an entry per unit of gradient, at the factor 1, and `rates` are the schedule's
    factors of all iterations. `seen` (N,) says which entries of a texture some view shows; None of what is no texture.
    """

    value: Array
    bounds: tuple[float, float]
    scale: float
    gradients: Array
    response: Array
    rates: Sequence[float]
    is_small: bool
    #: The mean square of the gradients of the run's last iterations, (N,), where the optimiser kept it.
    recent: Array | None = None
    seen: Array | None = None
    mean: Array = field(init=False)
    noise: Array = field(init=False)

    def __post_init__(self) -> None:
        noise = np.var(self.gradients, axis=0, ddof=1)
        if self.is_small and self.recent is None:  # few samples: those of all entries
            noise = np.where(noise > 0, noise.mean(), 0.0)
        mean = self.gradients.mean(axis=0)
        if self.recent is not None:  # more of them, which few samples of heavy-tailed ones understate
            noise = np.maximum(noise, self.recent - mean**2)
        object.__setattr__(self, "mean", mean)
        object.__setattr__(self, "noise", noise)

    @property
    def prior(self) -> float:
        """The standard deviation of the offset of an entry at the start: between bounds, at most that of any place."""
        low, high = self.bounds
        return min(self.scale, (high - low) / np.sqrt(12))

    def within(self, to_go: Array) -> Array:
        """Ways to the optimum, cut off at the bounds: what is far off is not as the curvature here has it."""
        low, high = self.bounds
        return np.clip(to_go, np.minimum(self.value - high, 0), np.maximum(self.value - low, 0)).astype(np.float64)

    @property
    def error(self) -> Array:
        """The standard error of the mean gradient, (N,)."""
        return np.sqrt(self.noise / len(self.gradients))

    @property
    def step(self) -> Array:
        """How far noise moved an entry in the last iteration, (N,)."""
        return self.response * self.rates[-1] * np.sqrt(self.noise)

    @property
    def at_bound(self) -> Array:
        """Which entries stand at a bound, (N,)."""
        (low, high), scale = self.bounds, np.full(self.value.shape, self.scale)
        return at_bound(self.value, np.float32(low), np.float32(high), scale, self.mean, self.error, self.step)
