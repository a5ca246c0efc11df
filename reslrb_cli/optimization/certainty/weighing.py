"""From gradients and curvature to spreads and verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from reslrb_cli.optimization.certainty.coordinates import Coordinates, judge_together
from reslrb_cli.optimization.certainty.curvature import smooth
from reslrb_cli.optimization.certainty.directions import Direction
from reslrb_cli.optimization.certainty.measured import Measured
from reslrb_cli.optimization.certainty.posterior import alone, driven_alone
from reslrb_cli.optimization.certainty.records import ParameterCertainty
from reslrb_cli.optimization.certainty.verdicts import OTHERS, TOLERANCE, Evidence, Verdict, judge, shares, summarise

Array = np.ndarray[Any, Any]
Gradients = dict[str, Array]


def weigh(
    measured: Mapping[str, Measured],
    directions: Sequence[Direction],
    curvature: Array,
    diagonal: Gradients,
    pixels: Mapping[str, int],
    fixed: Array,
    fixed_diagonal: Gradients,
) -> dict[str, ParameterCertainty]:
    """The certainty of each parameter, from the curvature along directions, and by entry for those of many entries.

    `pixels` is by how many values of images a texture is seen, where that is known: they tell no more entries. `fixed`
    and `fixed_diagonal` are of the noise of the targets what `curvature` and `diagonal` are of the curvature.
    """
    found = judge_together(measured, directions, curvature, fixed)
    places: dict[str, list[int]] = {}
    for place, direction in enumerate(directions):
        places.setdefault(direction.key, []).append(place)
    result = {}
    for key, own in measured.items():
        at = places.get(key, [])
        if at and directions[at[0]].entry is not None:
            result[key] = _small(own, at, found)
        else:
            result[key] = _large(own, diagonal.get(key), fixed_diagonal.get(key), at, found, pixels.get(key))
    return result


def _small(own: Measured, at: Sequence[int], found: Coordinates) -> ParameterCertainty:
    to_go, error = own.within(found.to_go[at]), found.error[at]
    of_run = np.hypot(to_go, error)
    spread = np.maximum(found.spread[at], of_run)  # bounds may have shortened the way
    alone_ = np.where([found.partners[place] is None for place in at], np.inf, found.alone[at])
    verdicts = judge(_evidence(own, spread, of_run, alone_, to_go, error))
    verdict = summarise(shares(verdicts))
    partners = [found.partners[place] for place, each in zip(at, verdicts, strict=True) if each is verdict]
    partner = next((name for name in partners if name), None) if verdict is Verdict.NOT_DETERMINED else None
    # What stands at a bound may be as far from the optimum as that is beyond it.
    known = np.where([each in (Verdict.AT_BOUND, Verdict.NO_EFFECT) for each in verdicts], np.nan, spread)
    return ParameterCertainty(
        verdict.value,
        _named(shares(verdicts)),
        _numbers(known),
        _numbers(np.where(np.isnan(known), np.nan, to_go)),
        partner,
        _numbers(np.where(np.isnan(known), np.nan, found.of_target[at])),
    )


def _large(
    own: Measured, diagonal: Array | None, fixed: Array | None, at: Sequence[int], found: Coordinates,
    pixels: int | None,
) -> ParameterCertainty:  # fmt: skip
    """By entry as if the others were known; all of it together may still be what another parameter makes up for."""
    touched = np.any(own.gradients, axis=0)
    prior = np.full(own.value.shape, own.prior)
    spread, of_run, to_go, error = prior.copy(), prior.copy(), np.zeros(own.value.shape), prior.copy()
    of_target = np.zeros(own.value.shape)
    if diagonal is not None and touched.any():
        h, B = np.zeros(own.value.shape), np.zeros(own.value.shape)
        h[touched] = smooth(diagonal[touched], own.noise[touched])
        if fixed is not None:
            B[touched] = smooth(fixed[touched], own.noise[touched])
        given = (own.response, prior, own.noise, own.mean)
        to_go, error = alone(h, *given, len(own.gradients), own.rates)
        whole, left = alone(h, *given, len(own.gradients), own.rates, B)
        of_target = driven_alone(h, own.response, own.rates) * np.sqrt(B)
        to_go = own.within(to_go)
        of_run = np.where(touched, np.hypot(to_go, error), prior)
        spread = np.where(touched, np.hypot(own.within(whole), left), prior)
    verdicts = judge(_evidence(own, spread, of_run, np.full(spread.shape, np.inf), to_go, error))
    if own.seen is not None:
        verdicts = [v if seen else Verdict.NOT_SEEN for v, seen in zip(verdicts, own.seen, strict=True)]
    found_shares = shares(verdicts)
    verdict, partner = summarise(found_shares), None
    for place in at if verdict in (Verdict.SETTLED, Verdict.BELOW_NOISE) else ():
        name = found.partners[place]
        if name is not None and found.alone[place] <= OTHERS * found.spread[place] and found.spread[place] > TOLERANCE:
            verdict, partner = Verdict.NOT_DETERMINED, name
    shown = touched if own.seen is None else touched & own.seen
    if verdict is Verdict.SETTLED and pixels is not None and int(shown.sum()) > pixels:
        verdict, partner = Verdict.NOT_DETERMINED, None
    kept = [each not in (Verdict.AT_BOUND, Verdict.NO_EFFECT, Verdict.NOT_SEEN) for each in verdicts]
    seen = diagonal is not None and any(kept)
    parts = (spread, to_go, of_target)
    sizes = [_numbers(np.array([np.sqrt(np.mean(np.square(part[kept]))) if seen else np.nan])) for part in parts]
    return ParameterCertainty(verdict.value, _named(found_shares), sizes[0], sizes[1], partner, sizes[2])


def _evidence(
    own: Measured, spread: Array, of_run: Array, alone_: Array, to_go: Array, error: Array
) -> Evidence:  # fmt: skip
    low, high = (np.full(own.value.shape, np.float32(bound), dtype=np.float64) for bound in own.bounds)
    touched, scale = np.any(own.gradients, axis=0), np.full(own.value.shape, own.scale)
    return Evidence(
        own.value, low, high, scale, touched, own.mean, own.error, own.step, spread, of_run, alone_,
        to_go, error
    )  # fmt: skip


def _named(found: Mapping[Verdict, float]) -> dict[str, float]:
    return {verdict.value: share for verdict, share in found.items()}


def _numbers(values: Array) -> list[float | None] | None:
    """As JSON has them; nothing where none is known."""
    return None if np.isnan(values).all() else [None if np.isnan(value) else float(value) for value in values]
