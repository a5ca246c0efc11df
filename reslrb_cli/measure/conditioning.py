"""How far apart the sensitivities of an experiment's parameters lie, where they start."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from reslrb_cli.measure.chain_conditions import ChainConditions, measure_chains
from reslrb_cli.optimization import Problem
from reslrb_cli.optimization.sensitivity import Sensitivity, measure_sensitivities

#: What a spread is taken of.
QUANTITIES = ("gradient", "change", "curvature", "length")


@dataclass(frozen=True)
class Conditioning:
    """What was measured of each parameter, from `samples` gradients of `spp` samples per pixel, of the run's `seed`.

    `chains` are those of Jacobians, where parameters move light.
    """

    rows: list[Sensitivity]
    samples: int
    spp: int
    seed: int
    chains: list[ChainConditions] = field(default_factory=list)

    def spread(self, quantity: str) -> float | None:
        """The largest value of one of QUANTITIES over its smallest, of those above 0; None of fewer than two.

        That of `curvature` is the condition number of the Gauss-Newton matrix's diagonal, by parameters.
        """
        values = [getattr(row, quantity) for row in self.rows]
        positive = [value for value in values if value is not None and value > 0]
        return max(positive) / min(positive) if len(positive) > 1 else None

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        return {
            "samples": self.samples,
            "spp": self.spp,
            "seed": self.seed,
            "parameters": [row.to_json() for row in self.rows],
            "spread": {quantity: self.spread(quantity) for quantity in QUANTITIES},
            "chains": [chain.to_json() for chain in self.chains],
        }


def measure_conditioning(problem: Problem, samples: int) -> Conditioning:
    """Measure every parameter of `problem`, which has its targets, where it stands; at least 2 `samples`."""
    run = problem.config.run
    return Conditioning(measure_sensitivities(problem, samples), samples, run.spp, run.seed, measure_chains(problem))
