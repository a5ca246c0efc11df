"""Estimators of a path's gradient: one file per estimator, and tables from name to class."""

from __future__ import annotations

import inspect
from typing import Any

from reslrb_cli.config.integrators import ESTIMATOR_OPTIONS, OWN_ESTIMATORS
from reslrb_cli.errors import ConfigError, one_line
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


def register_estimator(name: str, kind: type[Estimator]) -> None:
    """Add an estimator of your own to the integrator `reslrb`, in this process.

    `name` is then a value of `estimator`: in `mi.load_dict({"type": "reslrb", "estimator": name})`, in
    `integrator.estimator` of an experiment, and in lists such as `gradcheck(..., integrators="reslrb:NAME")`. `kind` is
    a class derived from `reslrb_cli.estimators.base.Estimator` (docs/your_estimator.md). Its options have their
    defaults in an experiment. The same name may be registered again. Other processes, such as those of `convergence`,
    do not know the name; name the file there.

    `check_estimator` checks the gradients of the estimator. Raises ConfigError for a wrong name or class.
    """
    if not isinstance(name, str) or not name.isidentifier() or name in ESTIMATOR_OPTIONS:
        reason = f"is {one_line(repr(name), 60)}; it must be an identifier, and none of {', '.join(ESTIMATOR_OPTIONS)}"
        raise ConfigError("name", "", reason)
    check_own(kind, "kind")
    add_own(name, kind)


def add_own(name: str, kind: type[Estimator]) -> None:
    """Add a user's class to the tables."""
    ESTIMATORS[name] = kind
    OWN_ESTIMATORS.add(name)


def check_own(kind: Any, source: object, key: str = "") -> None:
    """Raise ConfigError, located by `source` and `key`, if a user's class is no estimator."""
    if not (inspect.isclass(kind) and issubclass(kind, Estimator)):
        reason = f"is {one_line(repr(kind), 60)}, which is no class derived from reslrb_cli.estimators.base.Estimator"
        raise ConfigError(source, key, reason)
    if missing := sorted(kind.__abstractmethods__):
        raise ConfigError(source, key, f"{kind.__name__} lacks {', '.join(missing)}")


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
