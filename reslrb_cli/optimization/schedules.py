"""Learning-rate schedules: the factor of iteration i of n, from 1 at the first to `final_fraction` at the last."""

from __future__ import annotations

import math
from collections.abc import Callable


def constant(progress: float, final_fraction: float) -> float:
    """1 throughout."""
    return 1.0


def cosine(progress: float, final_fraction: float) -> float:
    """Half a period of a cosine (Loshchilov and Hutter 2017, without restarts)."""
    return final_fraction + (1.0 - final_fraction) * 0.5 * (1.0 + math.cos(math.pi * progress))


def exponential(progress: float, final_fraction: float) -> float:
    """The same factor from each iteration to the next."""
    return float(final_fraction**progress)


SCHEDULES: dict[str, Callable[[float, float], float]] = {
    "constant": constant,
    "cosine": cosine,
    "exponential": exponential,
}


def learning_rate_factor(
    schedule: str, iteration: int, iterations: int, final_fraction: float, least: float = 0.0
) -> float:
    """Return the factor of `iteration` (0-based) of `iterations`. Raises KeyError for an unknown schedule.

    `least` (0 to 1) is how far a run is at least, of which less than all iterations will be made.
    """
    return SCHEDULES[schedule](max(iteration / max(iterations - 1, 1), least), final_fraction)
