"""What `convergence` measures, and what it takes its errors from. Knows no Mitsuba."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from reslrb_cli.config import Config
from reslrb_cli.measure.cases import ADJOINT, Case
from reslrb_cli.records.convergence import Method

#: What is estimated: the gradient with dL/dI held, the gradient of the configuration's loss, or the image.
OBJECTIVES = ("fixed", "loss", "image")
#: What is compared where the user names nothing, by objective.
DEFAULTS = {
    "fixed": "ptracer,prb,reslrb:reservoir,reslrb:event,reslrb:gather,reslrb:stack",
    "loss": "reslrb:stack(adjoint=correlated),reslrb:stack(adjoint=independent),reslrb:stack(adjoint=batched)",
    "image": "ptracer,prb,reslrb:stack",
}
#: What errors are taken from where the user names nothing.
REFERENCE = "reslrb:stack"
#: A depth at which roulette never begins.
NEVER = 1_000_000
#: Images that dL/dI is held at in turn where the loss is the configuration's: the noise of a single one would look like
#: a bias of those that take dL/dI from images of their own.
IMAGES = 8
#: All parameters together.
ALL = "all"


@dataclass(frozen=True)
class Plan:
    """What is measured; `memory_limit` is of each process, None: none; `memory` is what the machine has, in bytes.

    Of the `cases` those that cannot do what the scene asks for are left out where they are the `default` ones. `rounds`
    is None where `budget_s` decides their number; `spps` are samples per pixel of a step, nothing for those of `run`.
    """

    config: Config
    variant: str
    cases: Sequence[Case]
    reference: Case
    objective: str
    memory_limit: int | None
    memory: int
    budget_s: float
    rounds: int | None = None
    default: bool = False
    spps: Sequence[int] = ()

    @property
    def known(self) -> bool:
        """Whether dL/dI is known before the image, or not asked for."""
        return self.objective != "loss"

    @property
    def camera(self) -> dict[str, bool]:
        """Whether paths from the `camera` take part, and whether that is so in any case, `named`, as `survey` asks."""
        named = self.reference.type == "prb"  # what errors are taken from is a side too
        return {"camera": named or any(case.type == "prb" for case in self.cases), "named": named or not self.default}

    @property
    def entries(self) -> list[tuple[Case, int]]:
        """What is compared: cases, each with its samples per pixel."""
        return [(case, spp) for case in self.cases for spp in self.spps or [self.config.run.spp]]

    def config_of(self, case: Case, spp: int) -> Config:
        """The experiment with the integrator of a case, and so many samples per pixel. Raises ConfigError."""
        run = self.config.run.model_copy(update={"spp": spp})
        config = self.config.model_copy(update={"run": run})
        return case.at(config, config.integrator.max_depth, self.known)

    @property
    def reference_config(self) -> Config:
        """The experiment with the integrator that errors are taken from, dL/dI known. Raises ConfigError."""
        return self.reference.at(self.config, self.config.integrator.max_depth, True)

    def independent_config(self, name: str) -> Config:
        """The experiment with a stock integrator: without roulette, which naive AD does not differentiate rightly."""
        depth = self.config.integrator.max_depth
        roulette = depth < 0 or self.config.integrator.rr_depth <= depth
        case = Case(
            name, name, {"rr_depth": NEVER} if name == "ptracer" and roulette else {}, "the independent reference"
        )
        return case.at(self.config, depth, True)

    def check(self) -> None:
        """Raise ConfigError where an integrator of the list, or the reference, cannot be."""
        for case, spp in self.entries:
            self.config_of(case, spp)
        _ = self.reference_config

    def method(self, case: Case, config: Config, spp: int, known: bool, reference: bool) -> Method:
        """How a case, or a `reference`, stands in records."""
        options: dict[str, Any] = config.integrator.options()
        adjoint = None if known else config.adjoint
        own = {name: value for name, value in case.options.items() if name not in ADJOINT}
        estimator = replace(case, options=own).estimator
        label = f"{case.label}, {spp} spp" if self.spps and not reference else case.label
        return Method(label, case.type, estimator, options.get("capacity"), adjoint, spp)
