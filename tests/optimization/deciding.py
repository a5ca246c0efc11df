"""Common code for tests of decisions by steps taken in two ways, with simulated worlds and runs of given times."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from cli import tiny
from kit import work_in

from reslrb_cli.cli import main
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.autotune import race
from reslrb_cli.optimization.autotune.race import (
    FEW_ENTRIES,
    ROUNDS,
    ROUNDS_OF_FEW,
    Finding,
    Sizes,
    Step,
    StepTrial,
    Turns,
)
from reslrb_cli.optimization.autotune.sampling import GUIDING_LONGER
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.decisions import Decision

SMALL = ["scene.size=[32, 32]", "run.spp=64", "run.iterations=2", "run.certainty=false"]
SMALL += ["run.measuring=1000"]  # despite so few iterations
SIZES = Sizes(step=64, call=16, part=16, alone=False, rounds=ROUNDS, lessons=1 / 7, longer=GUIDING_LONGER)


@dataclass
class World:
    """Simulated steps with given times and variances for each sample. The second kind of step has `variance` and `time`
    times the values of the first kind. The variance of its images is `image` times as large. A walk for learning
    takes `walk` ms for each sample, and `python` ms in addition. With `sparse`, only a thirtieth of the paths
    contribute to a gradient.
    """

    variance: float = 1.0
    time: float = 1.0
    image: float | None = None
    image_time: float = 1.0
    walk: float = 1.0
    python: float = 1.0
    overhead: float = 0.1
    sparse: bool = False
    seed: int = 0
    entries: int = 200
    alone: bool = False
    calls: list[Any] = field(default_factory=list)
    spent_s: float = 0.0

    def learn(self, spp: int) -> Step:
        self.calls.append(("learn", 0, spp))
        self.spent_s += 1e-3 * (self.walk * spp + self.python + 5.0)
        return Step(kernel_ms=self.walk * spp, wall_ms=self.walk * spp + self.python, compile_ms=5.0)

    def take(self, other: bool, round: int, spp: int) -> Step:
        self.calls.append((other, round, spp))
        random = np.random.default_rng([self.seed, round, other])
        factor = self.variance if other else 1.0
        picture = factor if self.image is None else (self.image if other else 1.0)
        kernel = spp * (self.time if other else 1.0)
        apart = spp * (self.image_time if other else 1.0) if self.alone else 0.0
        self.spent_s += 1e-3 * (kernel + apart + self.overhead)
        return Step(
            {"a": self._noisy(random, factor / spp), "b": 1000 * self._noisy(random, factor / spp)},
            {"0": self._noisy(random, picture / spp)},
            kernel, apart, kernel + apart + self.overhead, 0.0,
        )  # fmt: skip

    def _noisy(self, random: np.random.Generator, variance: float) -> np.ndarray:
        # Sparse noise also has variance 1. It comes from a random number of paths with equal contributions.
        noise = (random.poisson(4, self.entries) - 4) / 2 if self.sparse else random.normal(size=self.entries)
        return 1 + np.sqrt(variance) * noise

    def race(self, sizes: Sizes = SIZES, limit_s: float = 1e6, guides: bool = True) -> Finding:
        """Return the result of a race between both kinds of steps."""
        rounds = ROUNDS_OF_FEW if self.entries < FEW_ENTRIES else ROUNDS
        sizes = replace(sizes, rounds=rounds, alone=self.alone)
        return Turns(self.take, sizes, limit_s, self.learn, guides).run()

    @property
    def rounds(self) -> int:
        """The number of rounds of the race, after the step of the other kind that compiles kernels."""
        return [call[0] for call in self.calls].count(True) - 1


def begin(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Write the tiny experiment to `folder`, make it the working directory, and set a cache of its own."""
    tiny.write_experiment(folder)
    work_in(folder, monkeypatch)
    logging.getLogger("reslrb_cli").setLevel(logging.INFO)
    return folder


def fix_times(monkeypatch: pytest.MonkeyPatch, other_ms: Mapping[str, float]) -> None:
    """Fix the times of steps. A step and a walk for learning take 1 ms each. A step of the other kind takes the time
    that `other_ms` gives for the decided option.
    """
    monkeypatch.setattr(race, "timed", lambda times: Step(kernel_ms=1.0, wall_ms=1.0))
    take = StepTrial.take

    def timed(self: StepTrial, other: bool, round: int, spp: int) -> Step:
        taken = take(self, other, round, spp)
        if other:
            taken.kernel_ms = taken.image_ms = other_ms[self._what]
        return taken

    monkeypatch.setattr(StepTrial, "take", timed)


def decision(problem: Problem, setting: str) -> Decision | None:
    """Return the decision on a setting, or None if there is none."""
    return next((each for each in problem.decisions if each.setting == setting), None)


def is_even(problem: Problem) -> bool:
    """Return whether paths use low-discrepancy numbers."""
    return problem.integrator.plan(problem.scene, problem.scene.sensors()[0]).sequence is not None


def operations(problem: Problem) -> list[int]:
    """Return the operation counts of the kernels of the run's second step."""
    clock = StepClock()
    for iteration in range(2):
        with clock.step():
            loss, squares, *_ = loop.gradient(problem, iteration)
            dr.eval(loss, squares)
        problem.apply()
    return [kernel["operation_count"] for kernel in clock.history if kernel["type"] == dr.KernelType.JIT]


def inspected(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        main.main(["inspect", *words])
    assert end.value.code == 0
    return capsys.readouterr().out.splitlines()
