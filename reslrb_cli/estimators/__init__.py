"""Estimators of a path's gradient: one file per estimator, and tables from name to class."""

from __future__ import annotations

from typing import Any

from reslrb_cli.estimators.attached import AttachedStack
from reslrb_cli.estimators.base import Estimator
from reslrb_cli.estimators.chain import AttachedReservoir
from reslrb_cli.estimators.event import EventEstimator
from reslrb_cli.estimators.gather import Gather
from reslrb_cli.estimators.reservoir import Reservoir
from reslrb_cli.estimators.stack import Stack

ESTIMATORS: dict[str, type[Estimator]] = {
    "reservoir": Reservoir,
    "gather": Gather,
    "event": EventEstimator,
    "stack": Stack,
}

#: The estimators of the same names for moving light.
ATTACHED: dict[str, type[Estimator]] = {"reservoir": AttachedReservoir, "stack": AttachedStack}


def options_of(name: str) -> dict[str, Any]:
    """Return the options of the estimators called `name`, with their defaults."""
    return {option: default for kind in _kinds(name) for option, default in kind.OPTIONS.items()}


def make_estimator(name: str, options: dict[str, Any]) -> Estimator:
    """Make an estimator by its name. Raises ValueError if an option has a wrong value."""
    kinds = [{key: options[key] for key in kind.OPTIONS if key in options} for kind in _kinds(name)]
    made, *attached = (kind(**own) for kind, own in zip(_kinds(name), kinds, strict=True))
    made.attached = attached[0] if attached else None
    return made


def _kinds(name: str) -> list[type[Estimator]]:
    return [ESTIMATORS[name], *([ATTACHED[name]] if name in ATTACHED else [])]
