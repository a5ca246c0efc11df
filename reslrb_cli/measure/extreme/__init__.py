"""The extreme suite: cases in which gradients of light paths break, each with its reference."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import takewhile

from reslrb_cli.measure.extreme import geometry, light
from reslrb_cli.measure.extreme.suite import run_case
from reslrb_cli.records.measurements import GradcheckRecord

LISTED = (
    *light.COLOURS_CASES,
    *light.LIGHTS_CASES,
    *geometry.PLACES_CASES,
    *geometry.ROUGHNESS_CASES,
    *light.FILMS_CASES,
    *geometry.GLASS_CASES,
    *light.LOSSES_CASES,
    *geometry.MOTION_CASES,
    *light.UNFOUND_CASES,
)

#: By name; no two cases have the same name.
CASES = {case.name: case for case in LISTED}


def case_records(
    stop: Callable[[], bool], name: str, estimators: Iterable[str] | None, seeds: int | None
) -> list[GradcheckRecord]:
    """Return the records of one case. Some records are missing if `stop()` became true."""
    return list(takewhile(lambda _: not stop(), run_case(CASES[name], estimators, seeds)))
