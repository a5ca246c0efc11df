"""What `convergence --runs` measures. Knows no Mitsuba."""

from __future__ import annotations

from dataclasses import dataclass

from reslrb_cli.config import Config
from reslrb_cli.config.base import SEED_END
from reslrb_cli.measure.cases import Case
from reslrb_cli.measure.convergence.plan import Plan
from reslrb_cli.records.convergence import Method

#: What is compared where the user names nothing.
DEFAULT = "ptracer,prb,reslrb:stack,reslrb:auto"


@dataclass(frozen=True)
class RunsPlan(Plan):
    """What is measured; see `Plan`. `runs` is the number of seeds, which all methods have in common.

    `reference` is what renders the images that losses are taken of.
    """

    runs: int = 3

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

    def method_of(self, case: Case, spp: int) -> Method:
        """How a case stands in records."""
        return self.method(case, self.config_of(case, spp), spp, known=False, reference=False)
