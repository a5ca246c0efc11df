"""How the connections of a path enter its gradient: one file an estimator, a table from name to class."""

from reslrb_cli.estimators.base import Estimator
from reslrb_cli.estimators.reservoir import Reservoir

ESTIMATORS: dict[str, type[Estimator]] = {"reservoir": Reservoir}

__all__ = ["ESTIMATORS", "Estimator"]
