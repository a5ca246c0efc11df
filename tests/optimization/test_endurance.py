"""Long runs, in which neither memory nor time grows. Planted costs test the clock and the allocator's peak."""

from __future__ import annotations

import math
import os
import statistics
import sys
import time
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import read_metrics, write_experiment
from optimization.toy import make_problem
from turns import a_few

from reslrb_cli.cli import main
from reslrb_cli.config.loader import load
from reslrb_cli.estimators import ESTIMATORS
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.records.clock import MIB, StepClock, peak_mib, reset_peak
from reslrb_cli.runs import prepare
from reslrb_cli.runs import recorder as recording

# Long runs: memory and step time do not grow, and planted growth is detected.

#: Iterations of the toy by default, iterations of a block, and blocks of a window.
FEW, BLOCK, BLOCKS = 600, 2, 10

#: Growth that counts as a fault, as a share and as a number: of resident memory and of the allocator's peak in MiB, and
#: of the CPU seconds of an iteration.
ALLOWED = {"memory": (0.01, 2.0), "the allocator's peak": (0.01, 0.05), "steps": (0.1, 0.0)}


def growth(records: Iterable[Any], block: int = 10) -> list[str]:
    """Go through all records of a run, and return what grows. Medians of the second and the last tenth are compared.

    Each window keeps the shortest of its blocks, because other programs can only add time.
    """
    found: dict[str, list[float]] = {name: [] for name in ALLOWED}
    begin, seconds = time.process_time(), list[float]()
    for record in records:
        if (record.iteration + 1) % block:
            continue
        seconds.append((time.process_time() - begin) / block)
        if len(seconds) == BLOCKS:
            for name, value in zip(ALLOWED, (resident(), record.peak_mib, min(seconds)), strict=True):
                found[name].append(value)
            seconds.clear()
        begin = time.process_time()
    faults = []
    for name, (share, least) in ALLOWED.items():
        tenth = len(found[name]) // 10
        first, last = (statistics.median(found[name][part]) for part in (slice(tenth, 2 * tenth), slice(-tenth, None)))
        print(f"{name}: {first:.4g} to {last:.4g}")
        if last - first > max(share * first, least):
            faults.append(f"{name}: {first:.4g} to {last:.4g}")
    return faults


def resident() -> float:
    """Return this process's resident memory in MiB."""
    status = Path("/proc/self/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]) / 1024


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.long
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_ten_thousand_iterations(tmp_path: Path, estimator: str) -> None:
    write_experiment(tmp_path)
    sets = [f"integrator={{estimator: {estimator}, max_depth: 3}}", "run.iterations=10000", "optimizer.schedule=cosine"]
    problem = assemble(load(tmp_path / "tiny.yaml", sets), to_run=True)
    assert growth(loop.optimize(problem)) == []


@pytest.fixture
def toy(tmp_path: Path, steps: Any) -> Iterator[Any]:
    """Toy step, whose parts a test can change, with its problem."""
    steps.problem = make_problem(tmp_path, sets=[f"run.iterations={FEW}"])
    yield steps
    steps.calls.clear()


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_loop_does_not_grow(toy: Any) -> None:
    """The test checks only memory, because the time of so few iterations is unreliable on a machine with varying
    load.
    """
    assert [fault for fault in growth(loop.optimize(toy.problem), BLOCK) if not fault.startswith("steps")] == []


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_leak_is_found(toy: Any) -> None:
    kept = []

    def leak(call: int) -> float:
        kept.append(dr.opaque(mi.Float, call, 8192))  # 32 kB: some 15 MiB from the second tenth to the last
        return 0.0

    toy.loss = leak
    found = growth(loop.optimize(toy.problem), BLOCK)
    assert any(fault.startswith("the allocator's peak: ") for fault in found), found


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_leak_outside_the_allocator_is_found(toy: Any) -> None:
    kept = []

    def leak(call: int) -> float:
        kept.append(np.full(2**18, call % 7, np.uint8))  # 256 kB of written memory, more than the process had free
        return 0.0

    toy.loss = leak
    fault, *_ = growth(loop.optimize(toy.problem), BLOCK)
    assert fault.startswith("memory: ")


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_slowdown_is_found(toy: Any) -> None:
    def slow(call: int) -> float:
        until = time.process_time() + 1e-3 * call / FEW  # about a fifth of a step at the end
        while time.process_time() < until:
            pass
        return 0.0

    toy.loss = slow
    assert any(fault.startswith("steps: ") for fault in growth(loop.optimize(toy.problem), BLOCK))


# The clock and the allocator's peak, tested with planted costs: a kernel, a sleep, slow files, a leak.

#: Lanes of the kernels, and loop turns of the cheaper kernel. Without optimisations, a turn takes several times as
#: long. The longest measurement takes about 2 ms, so that a busy machine rarely interrupts it.
LANES, TURNS = 2**12, 256 if os.environ.get("RESLRB_TEST_OPTIMISED") else 12
SLEEP_S = 0.2


def chain(turns: int) -> None:
    """Launch a kernel whose only cost is a chain of `turns` dependent operations in each lane."""

    def turn(number: mi.UInt, value: mi.Float) -> tuple[mi.UInt, mi.Float]:
        return number + 1, dr.fma(value, mi.Float(0.999), mi.Float(0.5))

    end = dr.opaque(mi.UInt, turns)
    state = (mi.UInt(0), dr.arange(mi.Float, LANES))
    _, value = dr.while_loop(state, lambda number, value: number < end, turn, mode="symbolic")
    dr.eval(value)


def test_a_kernel_of_known_cost() -> None:
    """Time grows in proportion to the number of operations, in the kernel history and in wall time. Two launches take
    twice the time of one.

    The test keeps the shortest of several interleaved repetitions, which excludes the machine's other work. A busy
    machine needs more repetitions. All launches use the same kernel.
    """
    clock = StepClock()
    kernel_ms: dict[int, float] = {}
    wall_ms: dict[int, float] = {}
    for repetition in range(64):
        for turns, launches in ((TURNS, 1), (16 * TURNS, 1), (16 * TURNS + 1, 2)):
            time.sleep(0.001)  # the system rarely interrupts a process that has just slept
            with clock.step() as step:
                for _ in range(launches):
                    chain(turns)
            assert step.kernel_ms + step.codegen_ms <= 1.01 * step.wall_ms + 0.1
            if repetition == 0:  # the first one compiles
                continue
            assert step.new_kernels == 0
            kernel_ms[turns] = min(step.kernel_ms, kernel_ms.get(turns, math.inf))
            wall_ms[turns] = min(step.wall_ms, wall_ms.get(turns, math.inf))
        if repetition >= 7 and _as_expected(kernel_ms, wall_ms):
            return
    raise AssertionError((kernel_ms, wall_ms))


def _as_expected(kernel_ms: dict[int, float], wall_ms: dict[int, float]) -> bool:
    short, long, twice = kernel_ms.values()
    wall = wall_ms[16 * TURNS]
    return bool(
        long / short == pytest.approx(16, rel=0.35)
        and twice / long == pytest.approx(2, rel=0.25)
        and long == pytest.approx(wall, rel=0.25)  # other work takes hardly any time
    )


def test_time_of_python_does_not_count_as_kernels() -> None:
    clock = StepClock()
    with clock.step():
        chain(TURNS)
    with clock.step() as times:
        chain(TURNS)
        time.sleep(SLEEP_S)
    assert times.wall_ms > 1e3 * SLEEP_S
    assert times.kernel_ms < 0.5e3 * SLEEP_S
    before = clock.elapsed_s
    time.sleep(SLEEP_S)  # between steps
    with clock.counted():
        pass
    assert clock.elapsed_s - before < 0.5 * SLEEP_S


@pytest.mark.parametrize("what", a_few(["MetricsWriter.write", "save_checkpoint"], ["save_checkpoint"]))
def test_writing_files_is_not_timed(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each written line or checkpoint takes 0.2 s. Both are written after each iteration here."""
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    holder: Any = recording.MetricsWriter if what == "MetricsWriter.write" else prepare
    name = what.rpartition(".")[2]
    written, slept = getattr(holder, name), []

    def slowly(*arguments: Any, **options: Any) -> Any:
        slept.append(SLEEP_S)
        time.sleep(SLEEP_S)
        return written(*arguments, **options)

    monkeypatch.setattr(holder, name, slowly)
    with pytest.raises(SystemExit) as ended:
        main.main(["optimize", "tiny.yaml", "--set", "run={iterations: 8, spp: 4, checkpoint_every: {iterations: 1}}"])
    assert not ended.value.code
    assert len(slept) >= 8
    times = [record["elapsed_s"] for record in read_metrics(Path("runs/tiny"))]
    warm = [after - before for before, after in pairwise(times[2:])]
    assert statistics.median(warm) < 0.5 * SLEEP_S


def test_temporary_arrays_of_a_step_count_in_the_peak() -> None:
    backend = dr.backend_v(mi.Float)
    reset_peak()
    before = peak_mib(backend)
    array = dr.full(mi.Float, 1, 4 * 2**20)
    dr.make_opaque(array)
    assert peak_mib(backend) - before == pytest.approx(4 * 4 * 2**20 / MIB, rel=0.01)
    del array
    assert peak_mib(backend) - before == pytest.approx(16, rel=0.01)
    reset_peak()
    assert peak_mib(backend) == pytest.approx(before, abs=0.1)


def test_a_leak_shows_in_the_peak_of_a_run(tmp_path: Path, steps: Any) -> None:
    """Each iteration leaves 2 MiB allocated. Without the leak, the peak is flat."""
    peaks: dict[bool, list[float]] = {}
    for leaks in (False, True):
        reset_peak()
        left = []
        problem = steps.problem = make_problem(tmp_path, sets=["run.iterations=6"])
        peaks[leaks] = []
        for record in loop.optimize(problem):
            peaks[leaks].append(record.peak_mib)
            if leaks:
                left.append(dr.full(mi.Float, 1, 2**19))
                dr.make_opaque(left[-1])
        del left
    sound, leaking = (np.diff(peaks[leaks])[1:] for leaks in (False, True))
    assert (np.abs(sound) < 0.1).all()
    assert leaking == pytest.approx(np.full(len(leaking), 2.0), rel=0.05)
