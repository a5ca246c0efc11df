"""How much more efficient one way of sampling a gradient is than another, by steps of both, and how sure that is.

    gain = (variance * time of the one) / (variance * time of the other)

Variance is summed over the parameters, each over its gradient's mean square. The interval is that of the logarithm of
the variances' quotient by the jackknife over the steps, and of times by what a single one may be off.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from typing import Any

import numpy as np

from reslrb_cli.optimization.pilot import TIMING_NOISE
from reslrb_cli.optimization.pilot_records import Gradients, square

Array = np.ndarray[Any, Any]

CONFIDENCE = 0.95
#: What is left of a sum where nothing should be, as a share of it.
ROUNDING = 1e-12
#: A gain and the ends of its interval; nothing where it cannot be told.
Gain = tuple[float, float, float] | tuple[None, None, None]


def compare(
    own: Sequence[Gradients],
    own_ms: Sequence[float],
    other: Sequence[Gradients],
    other_ms: Sequence[float],
    confidence: float = CONFIDENCE,
) -> Gain:
    """The efficiency of the other over that of the own, and its interval; nothing where one has no noise.

    Gradients are those of each step by parameter (three steps or more), times those of steps in any unit.
    """
    scales = {key: float(np.mean([square(g[key]) for g in (*own, *other)])) for key in own[0]}
    scales = {key: scale for key, scale in scales.items() if scale > 0}
    if not scales:  # of no light, say
        return None, None, None
    logs, variance = [], 0.0
    for gradients in (own, other):
        values = _log_variances(gradients, scales)
        if values is None:
            return None, None, None
        whole, without = values
        logs.append(whole)
        count = len(gradients)
        variance += (count - 1) / count * float(np.sum(np.square(without - without.mean())))
    from scipy.special import stdtrit  # late: every run imports this module, and few come here

    times = statistics.median(own_ms) / max(statistics.median(other_ms), 1e-6)
    advantage = math.exp(logs[0] - logs[1]) * times
    quantile = float(stdtrit(min(len(own), len(other)) - 1, (1 + confidence) / 2))
    half = quantile * math.sqrt(variance)
    factor = math.exp(min(half, 50.0)) * TIMING_NOISE
    return advantage, advantage / factor, advantage * factor


def _log_variances(gradients: Sequence[Gradients], scales: dict[str, float]) -> tuple[float, Array] | None:
    """The logarithm of the variance of all parameters, and that without each of the rounds in turn."""
    rows = np.array([
        np.concatenate([g[key].astype(np.float64) / math.sqrt(scale) for key, scale in scales.items()])
        for g in gradients
    ])  # fmt: skip
    count = len(rows)
    squares = np.square(rows - rows.mean(axis=0)).sum(axis=1) if rows.size else np.zeros(count)
    whole = float(squares.sum())
    # What a row takes with it is its own distance, and that of the mean of the others from that of all.
    without = whole - squares * count / (count - 1)
    if not without.min() > ROUNDING * whole:
        return None
    return math.log(whole / (count - 1)), np.log(without / (count - 2))
