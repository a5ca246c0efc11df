#!/usr/bin/env python3
"""Check the pilot of `estimator: auto` on the shipped configurations: what it costs, and whether it chooses well.

    scripts/make_pilot.py [--seeds 32] [--pilots 3] [CONFIG ...]

Each candidate's efficiency, 1 / (variance * time), is measured at the samples per pixel of the run: variance by the
gradients of many seeds, which all candidates share, summed over the parameters, each divided by its own gradient's mean
square; time is the median of a step's kernels, in turns. Pilots follow, without the memory of earlier ones. Needs the
environment that `scripts/setup` makes: run it with `.venv/bin/python`, on a machine that does nothing else.
"""

from __future__ import annotations

import argparse
import statistics
from pathlib import Path
from typing import Any

import numpy as np

import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before Mitsuba
from reslrb_cli.backend.variant import set_variant
from reslrb_cli.config.loader import load
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.estimators import Candidate, find_options, run_pilot, sample_variance
from reslrb_cli.optimization.autotune.race import ITERATIONS, Gradients, measured_step
from reslrb_cli.records.clock import StepClock
from reslrb_cli.statistics import sum_of_squares

ROOT = Path(__file__).resolve().parent.parent
CONFIGS = ("furnace", "caustic_slab", "cornell_floor", "grey_room")
#: Steps of each candidate that are not measured.
WARM_UPS = 2


def efficiencies(problem: Any, options: list[Candidate], seeds: int) -> dict[str, float]:
    """Efficiency of each candidate, by its label, over that of the best."""
    clock, spp = StepClock(), problem.config.run.spp
    times: dict[str, list[float]] = {}
    gradients: dict[str, list[Gradients]] = {}
    for round in range(seeds + WARM_UPS):
        for option in options:
            option.integrator.freeze = False
            label = option.label
            step = measured_step(problem, option.integrator, clock, round, spp)
            if round >= WARM_UPS:
                times.setdefault(label, []).append(step.kernel_ms)
                gradients.setdefault(label, []).append(step.gradients)
    found = {
        label: 1 / (variance(gradients[label], gradients["stack"]) * statistics.median(times[label])) for label in times
    }
    return {label: value / max(found.values()) for label, value in found.items()}


def variance(own: list[Gradients], exact: list[Gradients]) -> float:
    """Variance of a gradient, in units of the exact one's mean square, summed over the parameters."""
    total = 0.0
    for key in exact[0]:
        scale = np.mean([sum_of_squares(g[key]) for g in exact])
        if scale > 0:
            total += sample_variance([g[key] for g in own]) / scale
    return max(float(total), 1e-12)


def report(path: Path, seeds: int, pilots: int) -> None:
    """Print the candidates' efficiencies, and what pilots chose and cost."""
    problem = assemble(load(path, ("integrator.estimator=auto",)))
    options = find_options(problem)
    found = efficiencies(problem, options, seeds)
    ranked = sorted(found.items(), key=lambda item: -item[1])
    print(f"{path.stem}: " + ", ".join(f"{label} {value:.2f}" for label, value in ranked), flush=True)
    for _ in range(pilots):
        outcome = run_pilot(problem, options, problem.allowance)
        worth, share = found[outcome.label], 100 * outcome.share
        print(
            f"  pilot: {outcome.label}, {worth:.2f} of the best; {share:.1f} % of {ITERATIONS} iterations", flush=True
        )


def main() -> None:
    """Parse arguments and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("configs", nargs="*", type=Path, metavar="CONFIG")
    parser.add_argument("--seeds", type=int, default=32)
    parser.add_argument("--pilots", type=int, default=3)
    arguments = parser.parse_args()
    set_variant("auto")
    for path in arguments.configs or [ROOT / "configs" / f"{name}.yaml" for name in CONFIGS]:
        report(path, arguments.seeds, arguments.pilots)


if __name__ == "__main__":
    main()
