"""Single steps of every estimator on one device: what they compile, take and hold, and whether recordings equal them.

Run by scripts/gpu_check in a process of its own; writes one JSON object. `problems` names what did not hold.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import statistics
import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before Mitsuba
from reslrb_cli.backend.variant import set_variant
from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config

ROOT = Path(__file__).resolve().parent.parent
MIB = 2**20
#: Steps after the first, each with another seed; from the second on, nothing may be compiled.
STEPS = 3
#: Of the peak over the depths; and, relative L2, between a recorded step and one that was not.
FLAT, SAME = 1.03, 1e-5
#: What is stepped through: an experiment, its estimators, depths, and whether it is taken when time is short.
ROOM = ("configs/cornell_floor.yaml", ("reservoir", "event", "gather", "stack"), (4, 16, 64))
GLASS = ("configs/caustic_heightmap.yaml", ("reservoir", "stack"), (4, 16))


@dataclass
class Steps:
    """One estimator at one depth. `scratch_bytes` is thread-local memory of one thread, as the kernels declare it.

    `device_mib` is by how much the device's free memory fell with the first step, beyond what the allocator holds:
    thread-local memory of all threads, and code. None on a CPU, which has no such number.
    """

    config: str
    estimator: str
    max_depth: int
    cold_ms: float
    step_ms: float
    kernel_ms: float
    peak_mib: float
    scratch_bytes: int
    device_mib: float | None
    new_kernels: list[int] = field(default_factory=list)
    recorded_apart: float | None = None


def main(arguments: list[str]) -> int:
    """Step, and write what came of it; 1 where something did not hold."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--variant", required=True)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args(arguments)
    set_variant(options.variant)
    plans = [(ROOM[0], ("reservoir", "stack"), (4,))] if options.quick else [ROOM, GLASS]
    found: list[Steps] = []
    problems: list[str] = []
    for file, estimators, depths in plans:
        for estimator in estimators:
            try:
                config = load(str(ROOT / file), _overrides(options.variant, options.quick))
                rows = [_steps(config, estimator, depth, depth == depths[0]) for depth in depths]
            except Exception as error:  # what one estimator cannot do says nothing of the next
                problems.append(f"{file}, {estimator}: {type(error).__name__}: {error}".splitlines()[0])
                continue
            found += rows
            problems += _problems(rows)
            # Written as they come: a process that is killed loses what it had not written.
            text = json.dumps({"steps": [asdict(row) for row in found], "problems": problems}, indent=1)
            options.out.write_text(text + "\n", encoding="utf-8")
            for row in rows:
                print(asdict(row), flush=True)
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems or not found else 0


def _overrides(variant: str, quick: bool) -> list[str]:
    size = ["run.spp=4", "scene.options={resx: 24, resy: 24}"] if quick else ["run.spp=64"]
    return [f"variant={variant}", *size, "target.render.spp=16"]


def _steps(config: Config, estimator: str, depth: int, compare: bool) -> Steps:
    from reslrb_cli.measure.methods import parse_cases
    from reslrb_cli.measure.stepper import Stepper

    [case] = parse_cases(f"reslrb:{estimator}")
    held, before = _held(), free_bytes()
    stepper = Stepper(case.at(config, depth, known=True), "fixed")
    cold = stepper.step(0, True, True)
    more, after = _held() - held, free_bytes()
    device = None if before is None or after is None else (before - after - more) / MIB
    rest = [stepper.step(number, False, False) for number in range(1, STEPS + 1)]
    return Steps(
        config=Path(config.source).stem,
        estimator=estimator,
        max_depth=depth,
        cold_ms=cold["step_ms"],
        step_ms=statistics.median(step["step_ms"] for step in rest),
        kernel_ms=statistics.median(step["kernel_ms"] for step in rest),
        peak_mib=cold["peak_mib"],
        scratch_bytes=cold["scratch_bytes"],
        device_mib=device,
        new_kernels=[step["new_kernels"] for step in rest],
        recorded_apart=_recorded_apart(config, case, depth) if compare else None,
    )


def _recorded_apart(config: Config, case: Any, depth: int) -> float:
    """The relative L2 distance of the gradients of three steps by recordings from those without any; the largest."""
    import dataclasses

    import numpy as np

    from reslrb_cli.measure.stepper import Stepper

    found: list[list[np.ndarray]] = []
    for freeze in (False, True):
        own = dataclasses.replace(case, options=case.options | {"freeze": freeze})
        stepper, taken = Stepper(own.at(config, depth, known=True), "fixed"), []
        for number in range(STEPS):
            stepper.step(number, number == 0, False)
            taken.append(
                np.concatenate([np.array(g, np.float64).ravel() for g in stepper.problem.gradients().values()])
            )
        found.append(taken)
    return max(float(np.linalg.norm(a - b) / np.linalg.norm(a)) for a, b in zip(*found, strict=True))


def _problems(rows: list[Steps]) -> list[str]:
    problems = []
    for row in rows:
        name = f"{row.config}, {row.estimator}, depth {row.max_depth}"
        if any(row.new_kernels[1:]):
            problems.append(f"{name}: later steps compile kernels: {row.new_kernels}")
        if row.recorded_apart is not None and not row.recorded_apart < SAME:
            problems.append(f"{name}: a recorded step is {row.recorded_apart:.1e} from one that was not")
    peaks = {row.max_depth: row.peak_mib for row in rows}
    if max(peaks.values()) > FLAT * min(peaks.values()):
        problems.append(f"{rows[0].config}, {rows[0].estimator}: the peak grows with depth: {peaks} MiB")
    return problems


def _held() -> int:
    """Bytes that arrays take; what the allocator had kept for reuse is given back."""
    import drjit as dr
    import mitsuba as mi

    from reslrb_cli.records.clock import reset_peak

    reset_peak()
    return int(dr.detail.malloc_watermark(dr.backend_v(mi.Float)))


def free_bytes() -> int | None:
    """Free memory of the current CUDA device; None on a CPU."""
    import drjit as dr
    import mitsuba as mi

    if dr.backend_v(mi.Float) != dr.JitBackend.CUDA:
        return None
    dr.eval(mi.Float(0))  # makes the context, where there is none yet
    dr.sync_thread()
    free, total = ctypes.c_size_t(), ctypes.c_size_t()
    if ctypes.CDLL("libcuda.so.1").cuMemGetInfo_v2(ctypes.byref(free), ctypes.byref(total)):
        return None
    return free.value


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
