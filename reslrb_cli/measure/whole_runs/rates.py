"""Several learning rates for each method of whole runs: which is the best, and how methods compare at theirs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from reslrb_cli.config import Config
from reslrb_cli.config.moving import ByWord
from reslrb_cli.config.parameters import ParameterSpec
from reslrb_cli.records.convergence import Range

#: Fewer seeds than these say nothing of how far a median of theirs may be off.
LEAST_SEEDS = 5
#: Times that seeds are drawn anew, and what they are drawn by: the same runs have the same interval.
RESAMPLES, RESAMPLED_BY = 4000, 15
#: What share of the resamples an interval holds.
CONFIDENCE = 0.95


def at_rate(config: Config, factor: float) -> Config:
    """The experiment with every learning rate, the optimiser's and those of single parameters, times `factor`."""
    optimizer = config.optimizer.model_copy(update={"learning_rate": config.optimizer.learning_rate * factor})
    parameters = [_at_rate(spec, factor) for spec in config.parameters]
    return config.model_copy(update={"optimizer": optimizer, "parameters": parameters})


def _at_rate(spec: ParameterSpec, factor: float) -> ParameterSpec:
    rate: Any = spec.learning_rate
    if rate is None:  # the optimiser's
        return spec
    if isinstance(rate, ByWord):
        rate = rate.model_copy(update={word: value * factor for word, value in rate.words().items()})
    else:
        rate = rate * factor
    return spec.model_copy(update={"learning_rate": rate})


def best_of(values: Mapping[str, Sequence[float]], rates: Mapping[str, str]) -> dict[str, str]:
    """By method the label, a key of `values`, of its rate of the lowest median; `rates` has each label's method."""
    best: dict[str, str] = {}
    for label in values:
        name = rates[label]
        if name not in best or np.median(values[label]) < np.median(values[best[name]]):
            best[name] = label
    return best


def ratio(own: Sequence[Sequence[float]], base: Sequence[Sequence[float]]) -> Range | None:
    """The median over the seeds at the best of one method's rates, over that of another, and its 95 % interval.

    One row of values a rate, one column a seed, the same seeds for all. The interval is the bootstrap's: seeds are
    drawn anew for all rates of both, and each time the best rates are chosen anew, so that the luck of the best of
    several is in it. None of fewer than LEAST_SEEDS, and where a median is not finite, or 0.
    """
    seeds = min((len(values) for values in (*own, *base)), default=0)
    if seeds < LEAST_SEEDS or not (own and base):
        return None
    drawn = np.random.default_rng(RESAMPLED_BY).integers(seeds, size=(RESAMPLES, seeds))
    sides = [np.array([values[:seeds] for values in side], dtype=np.float64) for side in (own, base)]
    found = [float(np.median(side, axis=1).min()) for side in sides]
    if not all(math.isfinite(value) and value > 0 for value in found):
        return None
    lowest = [np.median(side[:, drawn], axis=2).min(axis=0) for side in sides]
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = lowest[0] / lowest[1]
    if np.isnan(ratios).any():
        return None
    low, high = np.quantile(ratios, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2], method="nearest")
    return Range(found[0] / found[1], float(low), float(high))
