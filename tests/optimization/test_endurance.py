"""Long runs: neither memory nor the time of a step grows; and what grows is seen."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import write_experiment
from optimization.endurance import watch
from optimization.toy import make_problem

from reslrb_cli.config.loader import load
from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.assemble import assemble

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

#: Iterations of the toy, by default, and of a block of these.
FEW, BLOCK = 600, 2


@pytest.mark.long
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_ten_thousand_iterations(tmp_path: Path, estimator: str) -> None:
    write_experiment(tmp_path)
    sets = [f"integrator={{estimator: {estimator}, max_depth: 3}}", "run.iterations=10000", "optimizer.schedule=cosine"]
    problem = assemble(load(tmp_path / "tiny.yaml", sets), to_run=True)
    watched = watch(loop.optimize(problem))
    print(f"{estimator}: {watched}")
    assert watched.faults() == []


@pytest.fixture
def toy(tmp_path: Path, steps: Any) -> Iterator[Any]:
    """The toy's step, whose parts can be spoilt, and its problem."""
    steps.problem = make_problem(tmp_path, sets=[f"run.iterations={FEW}"])
    yield steps
    steps.calls.clear()


def test_the_loop_does_not_grow(toy: Any) -> None:
    """Its memory: so few iterations say little of time on a machine whose load changes."""
    watched = watch(loop.optimize(toy.problem), BLOCK)
    print(watched)
    assert [fault for fault in watched.faults() if not fault.startswith("steps")] == []


def test_a_leak_is_seen(toy: Any) -> None:
    kept = []

    def leak(call: int) -> float:
        kept.append(dr.opaque(mi.Float, call, 8192))  # 32 kB: some 15 MiB from the second tenth to the last
        return 0.0

    toy.loss = leak
    found = watch(loop.optimize(toy.problem), BLOCK).faults()
    assert any(fault.startswith("the allocator's peak grows by ") for fault in found), found


def test_a_leak_beside_the_allocator_is_seen(toy: Any) -> None:
    kept = []

    def leak(call: int) -> float:
        kept.append(np.full(2**18, call % 7, np.uint8))  # 256 kB, written to: more than was free within the process
        return 0.0

    toy.loss = leak
    fault, *_ = watch(loop.optimize(toy.problem), BLOCK).faults()
    assert fault.startswith("memory grows by ")


def test_a_slowdown_is_seen(toy: Any) -> None:
    def slow(call: int) -> float:
        until = time.process_time() + 1e-3 * call / FEW  # a fifth of a step or so, at the end
        while time.process_time() < until:
            pass
        return 0.0

    toy.loss = slow
    watched = watch(loop.optimize(toy.problem), BLOCK)
    print(watched)
    assert any(fault.startswith("steps grow by ") for fault in watched.faults())
