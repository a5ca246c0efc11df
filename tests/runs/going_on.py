"""Helpers that make a run, make a copy as a kill would leave it, and compare two runs."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
from cli import tiny
from kit import work_in

from reslrb_cli.cli import main
from reslrb_cli.cli.optimize import Progress
from reslrb_cli.optimization import loop, optimizers, problem, sensitivity, targets
from reslrb_cli.optimization.uncertainty import curvature, measuring
from reslrb_cli.records.metrics import Record
from reslrb_cli.runs import recorder as recording

#: Metrics that differ between two runs of one experiment: times, and the allocator's peak.
TIMES = ("step_ms", "codegen_ms", "elapsed_s", "peak_mib", "curvature_s")
#: A texture and a colour. Cases can add a place and a size, and heights.
LAMP = "lamp.emitter.radiance.value"
PARAMETERS = (
    f"[{{key: {tiny.KEY}, initial: 0.5, bounds: [0, 1]}}, {{key: {LAMP}, initial: [3, 4, 5], bounds: [0, 20]}}]"
)
MOTION = "{motion: {of: wall, free: [translation, scale]}, learning_rate: 0.01}"


def write_experiment(folder: Path) -> None:
    """Write the experiment of `tiny` with three sensors, a smooth filter, and parameters of two shapes."""
    eyes = [f"{x}, 0, 4" for x in (0, 1, -1)]
    tiny.write_experiment(folder, tiny.scene_seen(*eyes, rfilter="gaussian"))
    config = tiny.CONFIG.replace(f"\n  - {{key: {tiny.KEY}, initial: 0.5, bounds: [0, 1]}}", f" {PARAMETERS}")
    (folder / "tiny.yaml").write_text(config)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread, which fixes the order of a kernel's sums."""
    dr.sync_thread()
    before = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.sync_thread()
        dr.set_thread_count(before)


def work_alone(patch: pytest.MonkeyPatch) -> None:
    """Make one thread compute the measurements before the first iteration, every step, and the results of the steps.

    The sums then have a fixed order. The rest of the program keeps its threads. With one thread, Mitsuba never finishes
    reading or writing an EXR file.
    """

    def alone(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            dr.sync_thread()
            before = dr.thread_count()
            dr.set_thread_count(1)
            try:
                result = function(*args, **options)
                dr.eval(result)
                return result
            finally:
                dr.sync_thread()
                dr.set_thread_count(before)

        return call

    places = [(loop, "gradient"), (sensitivity, "sample_gradient"), (sensitivity, "see_images"),
              (curvature, "see_images"), (measuring, "sample_gradient"), (problem, "render_in_passes"),
              (targets, "render_in_passes")]  # fmt: skip
    for module, name in places:
        patch.setattr(module, name, alone(getattr(module, name)))
    patch.setattr(optimizers.Optimizer, "step", alone(optimizers.Optimizer.step))


def begin_alone(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Prepare the experiment in the working directory for runs that must be equal bit by bit. Reports are not drawn,
    because drawing takes longer than the runs.
    """
    write_experiment(folder)
    work_alone(monkeypatch)
    work_in(folder, monkeypatch)
    monkeypatch.setattr(recording, "write_report", lambda folder, *now: (folder / "report.html").write_text("<html>"))
    monkeypatch.setattr(recording, "seen_errors", lambda folder, views: {})


def optimize(*args: str) -> int:
    """Run `reslrb optimize` in this process, and return its exit code."""
    with pytest.raises(SystemExit) as end:
        main.main(["optimize", *args])
    logger = logging.getLogger("reslrb_cli")
    logger.handlers.clear()
    logger.setLevel(logging.NOTSET)
    return int(end.value.code or 0)


def run_and_kill(
    monkeypatch: pytest.MonkeyPatch, at: int, *args: str, act: Callable[[Path], object] = lambda run: None
) -> tuple[Path, Path]:
    """Return the folder of a complete run, and a copy of the folder that a process killed after iteration `at` would
    leave.
    """
    show = Progress.show
    run, left = Path("runs/tiny"), Path("runs/killed")

    def copying(self: Progress, record: Record) -> None:
        show(self, record)
        if record.iteration + 1 == at and not left.exists():
            shutil.copytree(run, left)
            with (left / "metrics.jsonl").open("a") as file:
                file.write('{"iteration": ')  # in the middle of a line

    with monkeypatch.context() as patch:
        patch.setattr(Progress, "show", copying)
        assert optimize("tiny.yaml", "--quiet", *args) == 0
    act(left)
    return run, left


def state_of(run: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Return the arrays of the newest state."""
    with np.load(run / "checkpoint/state.npz") as arrays:
        return {name: arrays[name] for name in arrays.files if name != "state"}


def records_of(run: Path) -> list[dict[str, Any]]:
    """Return the metrics without times and peak memory."""
    lines = (run / "metrics.jsonl").read_text().splitlines()
    return [{key: value for key, value in json.loads(line).items() if key not in TIMES} for line in lines]


def found_of(run: Path) -> dict[str, Any]:
    """Return the results in the manifest. Times are left out, and so are the measurements that several threads make
    after the last iteration.
    """
    results = json.loads((run / "manifest.json").read_text())["results"]
    return {key: value for key, value in results.items() if key not in ("elapsed_s", "certainty", "error_maps")}


def differences(first: Path, second: Path) -> list[str]:
    """Return the names of all entries in which two runs differ in any bit."""
    one, other = state_of(first), state_of(second)
    found = [f"entry {name}" for name in sorted(set(one) ^ set(other))]
    found += [
        name
        for name in sorted(set(one) & set(other))
        if one[name].dtype != other[name].dtype or one[name].tobytes() != other[name].tobytes()
    ]
    for what in (records_of, found_of):
        if what(first) != what(second):
            found.append(what.__name__)
    values = [(run / "parameters/parameters.npz") for run in (first, second)]
    if [path.exists() for path in values] == [True, True]:
        arrays = [np.load(path) for path in values]
        found += [key for key in arrays[0] if arrays[0][key].tobytes() != arrays[1][key].tobytes()]
    return found


def left_over(run: Path) -> list[str]:
    """Return all empty files and all files that were never finished."""
    names = [path for path in run.rglob("*") if path.is_file()]
    return [os.fspath(path) for path in names if path.stat().st_size == 0 or path.name.startswith(".")]
