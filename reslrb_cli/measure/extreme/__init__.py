"""The extreme suite: cases in which gradients of light paths break, each with its reference."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from reslrb_cli.measure.extreme import geometry, light
from reslrb_cli.measure.extreme.suite import ExtremeCase, run_cases
from reslrb_cli.records.measurements import GradcheckRecord


def registry(cases: Iterable[ExtremeCase]) -> dict[str, ExtremeCase]:
    """Cases by name. Raises ValueError where two have the same."""
    found: dict[str, ExtremeCase] = {}
    for case in cases:
        if case.name in found:
            raise ValueError(f"two cases are named {case.name}")
        found[case.name] = case
    return found


CASES = registry(
    [
        *light.COLOURS_CASES,
        *light.LIGHTS_CASES,
        *geometry.PLACES_CASES,
        *geometry.ROUGHNESS_CASES,
        *light.FILMS_CASES,
        *geometry.GLASS_CASES,
        *light.LOSSES_CASES,
        *geometry.MOTION_CASES,
        *light.UNFOUND_CASES,
    ]
)


def run_suite(
    names: Iterable[str] | None = None, estimators: Iterable[str] | None = None, seeds: int | None = None
) -> Iterator[GradcheckRecord]:
    """Run the cases of these names (all by default), one record for each comparison.

    Raises KeyError where there is no such case.
    """
    chosen = list(CASES.values()) if names is None else [CASES[name] for name in names]
    return run_cases(chosen, estimators, seeds)
