#!/usr/bin/env python3
"""Print what `run.adjoint` and `run.shards` do to the variance of a step's gradient, and to its time (docs/method.md).

    scripts/make_adjoints.py [--seeds 100] [--size 64] [--spp 64] [CONFIG]

Every way has equal samples per pixel. Variance is that of all entries of all parameters, each parameter in units of its
gradient's square, both over seeds; times are medians, all ways in turn, of a step with all that it does beside tracing.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import numpy as np

import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before Mitsuba
from reslrb_cli.backend.variant import set_variant
from reslrb_cli.config.loader import load
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.loop import Split, gradient
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import take_gradient

WAYS = [
    ("batched", 1), ("independent", 1), ("batched", 2), ("batched", 4), ("batched", 16),
    ("independent", 4), ("independent", 16), ("others", 2), ("others", 4), ("others", 16),
]  # fmt: skip
WARM_UPS = 3


def timed_step(problem: Problem, iteration: int) -> tuple[float, dict[str, np.ndarray]]:
    """Milliseconds of one gradient, and what it is."""
    start = time.perf_counter()
    gradient(problem, iteration, Split())
    found = take_gradient(problem)  # waits for it
    return 1e3 * (time.perf_counter() - start), found


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", nargs="?", default=Path(__file__).parents[1] / "configs" / "cornell_floor.yaml")
    for name, default in (("seeds", 100), ("size", 64), ("spp", 64)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    set_variant("auto")
    shared = [f"scene.size=[{options.size}, {options.size}]", f"run.spp={options.spp}", "integrator.estimator=stack"]
    shared += ["integrator.guiding=off", "integrator.sequence=independent", "integrator.paths=light"]
    problems = [assemble(load(options.config, [*shared, f"run.adjoint={a}", f"run.shards={n}"])) for a, n in WAYS]
    times: list[list[float]] = [[] for _ in WAYS]
    taken: list[list[dict[str, np.ndarray]]] = [[] for _ in WAYS]
    for seed in range(options.seeds + WARM_UPS):
        for place, problem in enumerate(problems):
            took, found = timed_step(problem, seed)
            if seed >= WARM_UPS:
                times[place].append(took)
                taken[place].append(found)
    keys = problems[0].selection.keys
    mean = {key: np.mean([found[key] for each in taken for found in each], axis=0) for key in keys}
    print("| `run.adjoint` | `run.shards` | variance | ms a step | 1 / (variance * time) |\n|---|---|---|---|---|")
    first = None
    for (adjoint, count), own, steps in zip(WAYS, taken, times, strict=True):
        rows = {key: np.array([found[key] for found in own], np.float64) for key in keys}
        variance = sum(float(rows[key].var(0, ddof=1).sum() / np.square(mean[key]).sum()) for key in keys)
        took = statistics.median(steps)
        first = first or (variance, variance * took)
        print(f"| `{adjoint}` | {count} | {variance / first[0]:.2f} | {took:.0f} | {first[1] / variance / took:.2f} |")


if __name__ == "__main__":
    main()
