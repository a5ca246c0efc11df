"""How the connections of a path enter its gradient: one file an estimator, a table from name to class."""

from __future__ import annotations

from reslrb_cli.estimators.base import Estimator
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
