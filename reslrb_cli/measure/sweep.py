"""What `bench` varies, and over which values. Knows no Mitsuba."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from reslrb_cli.config import Config
from reslrb_cli.measure.cases import Case

#: What can be swept, and what it is called where a single value of it is named.
SWEPT = {"depth": "depth", "spp": "spp", "film": "film width", "texture": "texture width"}
#: Samples per pixel that are measured where the user names none, as shares of those of the experiment.
SHARES = (0.25, 0.5, 1, 2, 4)
#: Widths that are measured where the user names none, in pixels or texels.
WIDTHS = {"film": (32, 64, 128, 256), "texture": (16, 64, 256, 1024)}


def usual_values(swept: str, config: Config) -> list[int]:
    """What is measured of anything but depth, where the user names nothing."""
    if swept == "spp":
        return sorted({max(round(share * config.run.spp), 1) for share in SHARES})
    return list(WIDTHS[swept])


@dataclass(frozen=True)
class Sweep:
    """What is measured: at each of `values` of what is `swept`.

    `memory_limit` is of each process, None: none; `memory` is what the machine has, in bytes.

    `rounds` is None where `budget_s` decides their number; else there are so many, whatever time they take. Of the
    `cases`, those that cannot do what the scene asks for are left out where they are the `default` ones.
    """

    config: Config
    variant: str
    cases: Sequence[Case]
    baseline: Case
    values: Sequence[int]
    objective: str
    memory_limit: int | None
    memory: int
    budget_s: float
    rounds: int | None = None
    default: bool = False
    swept: str = "depth"

    def may_refuse(self, case: Case) -> bool:
        """Whether the rest goes on without this case, where it refuses the scene."""
        return self.default and case != self.baseline

    def at(self, case: Case, value: int) -> Config:
        """The experiment of one case, all but the sizes of film and textures. Raises ConfigError."""
        config, depth = self.config, self.config.integrator.max_depth
        if self.swept == "spp":
            config = config.model_copy(update={"run": config.run.model_copy(update={"spp": value})})
        return case.at(config, value if self.swept == "depth" else depth, known=self.objective == "fixed")

    def name(self, *values: int) -> str:
        """Some values of what is swept, in words: `depth 2, 4`."""
        return f"{SWEPT[self.swept]} {', '.join(map(str, values))}"

    def check(self) -> None:
        """Raise ConfigError where an integrator of the list cannot be."""
        for case in self.cases:
            for value in self.values if self.swept == "spp" else self.values[:1]:
                self.at(case, value)
