"""What `convergence --runs` measures. Knows no Mitsuba."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from reslrb_cli.config import Config
from reslrb_cli.config.base import SEED_END
from reslrb_cli.measure.cases import Case
from reslrb_cli.measure.convergence.plan import Plan
from reslrb_cli.measure.whole_runs.rates import at_rate
from reslrb_cli.records.convergence import Method

#: What is compared where the user names nothing.
DEFAULT = "ptracer,prb,reslrb:stack,reslrb:auto"


@dataclass(frozen=True)
class Side:
    """What has runs of its own: a case, samples per pixel, and what learning rates are multiplied by, None: nothing."""

    case: Case
    spp: int
    rate: float | None = None


@dataclass(frozen=True)
class RunsPlan(Plan):
    """What is measured; see `Plan`. `runs` is the number of seeds, which all methods have in common.

    `reference` is what renders the images that losses are taken of. Each method has runs with all its learning rates
    times each of `rates`, of which its best then counts; without any, with those of the configuration.
    """

    runs: int = 3
    rates: Sequence[float] = ()

    @property
    def sides(self) -> list[Side]:
        """What has runs of its own, all rates of a method beside each other."""
        return [Side(case, spp, rate) for case, spp in self.entries for rate in self.rates or (None,)]

    @property
    def names(self) -> dict[str, str]:
        """The method's label by that of each of its rates."""
        return {self.method_of(side).label: self.method_of(replace(side, rate=None)).label for side in self.sides}

    @property
    def seeds(self) -> list[int]:
        """`run.seed` of each run: that of the configuration, and those after it."""
        return [(self.config.run.seed + number) % SEED_END for number in range(self.runs)]

    def config_of(self, case: Case, spp: int) -> Config:
        """The experiment with the integrator of a case, which may be `auto`, and so many samples per pixel.

        Raises ConfigError.
        """
        run = self.config.run.model_copy(update={"spp": spp})
        config = self.config.model_copy(update={"run": run})
        return case.at(config, config.integrator.max_depth, False, auto=True)

    def seeded(self, config: Config, seed: int) -> Config:
        """The same experiment with another `run.seed`."""
        return config.model_copy(update={"run": config.run.model_copy(update={"seed": seed})})

    def config_at(self, side: Side) -> Config:
        """The experiment as a side has it. Raises ConfigError."""
        config = self.config_of(side.case, side.spp)
        return config if side.rate is None else at_rate(config, side.rate)

    def method_of(self, side: Side) -> Method:
        """How a side stands in records."""
        config = self.config_of(side.case, side.spp)
        method = self.method(side.case, config, side.spp, known=False, reference=False)
        return method if side.rate is None else replace(method, label=f"{method.label}, rates x {side.rate:g}")
