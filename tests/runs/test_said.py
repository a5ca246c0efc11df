"""Everything that runs, sweeps, searches and loggers write (`said.check`), but for times."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from cli import tiny
from cli.tiny import reslrb, settings
from golden import said
from kit import work_in
from records.test_metrics import make_record

from reslrb_cli.cli import sweep
from reslrb_cli.records.manifest import PROGRAM, Status
from reslrb_cli.runs import loggers, recorder
from reslrb_cli.runs.callbacks import RunInfo

pytestmark = pytest.mark.usefixtures("llvm")


def check(name: str, folder: Path, *words: str, root: str = "runs") -> None:
    """Run a command, and check its exit code, its output and all files below `root` that changed."""
    before = {file: file.stat().st_mtime_ns for file in Path(root).rglob("*") if file.is_file()}
    result = reslrb(*words)
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    lines = said.lines_of(result.stderr)
    found = {
        "code": result.exit_code,
        "out": said.masked(result.stdout.splitlines(), folder),
        "err": said.masked(lines, folder),
    }
    for file in sorted(Path(root).rglob("*")):
        if file.is_symlink():
            found[str(file)] = f"link to {file.readlink()}"
        elif file.is_file() and before.get(file) != file.stat().st_mtime_ns:
            found[str(file)] = said.content(file, folder) if file.suffix != ".yaml" or "search" not in name else "text"
    said.check(name, found)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working directory with the tiny experiment from three sensors. Pages are not drawn."""
    logging.getLogger("reslrb_cli").handlers.clear()  # of other tests in this process
    tiny.write_experiment(tmp_path, tiny.scene_seen(*tiny.EYES, rfilter="gaussian"))
    work_in(tmp_path, monkeypatch)
    monkeypatch.setattr(recorder, "write_report", lambda folder, *now: (folder / "report.html").write_text("<html>"))
    return tmp_path


#: Two parameters of different kinds, three views of which one is held out, a regularizer, and a bound.
RICH = settings(
    f"parameters=[{{key: {tiny.KEY}, initial: 0.5, bounds: [0, 1], "
    "regularizers: [{type: total_variation, weight: 0.01}]}, "
    "{key: lamp.emitter.radiance.value, initial: [3, 4, 5], bounds: [0, 20]}]",
    "views=[{sensor: 0}, {sensor: 1, exposure: 2}, {sensor: 2}]", "run.held_out=[2]", "run.iterations=4",
    "run.checkpoint_every={iterations: 1}", "run.certainty=false", "run.final_spp=4", "target.render.spp=4",
)  # fmt: skip


def test_a_run_that_is_interrupted_and_continued(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    records = recorder.Recording.records
    with monkeypatch.context() as patch:
        patch.setattr(recorder.Recording, "records", lambda self, stop: records(self, lambda: self.done == 2))
        check("run that is interrupted", folder, "optimize", "tiny.yaml", *RICH)
    check("run that goes on", folder, "optimize", "--resume", "runs/tiny", *settings("run.iterations=3"))
    check("run that is done", folder, "optimize", "--resume", "runs/tiny")


# Sweeps and searches of pretended runs.


def pretend(ends: dict[str, tuple[int, str]], told: list[Any]) -> Any:
    """Return a replacement of `jobs.call`. `ends` has the exit code and the line of runs. If the line says so, somebody
    interrupts the sweep.
    """

    def call(arguments: list[str], interrupts: Any, slot: Any = None, fresh: bool = False) -> tuple[int, str]:
        sets = dict(word.partition("=")[::2] for word in arguments if word.startswith("run."))
        name = json.loads(sets["run.name"]) if sets else Path(arguments[2]).name
        told.append([*arguments, fresh])
        code, line = next((end for part, end in ends.items() if part in name), (0, "finished"))
        run = Path("s") / name
        run.mkdir(exist_ok=True)
        digits = [float(number) for number in re.findall(r"\d+\.?\d*", name)]
        results = {
            "iterations": 3,
            "elapsed_s": 1.5,
            "image_loss": {"final": sum(digits)},
            "rmse": {"final": digits[0]},
        }
        status = Status.FINISHED if code == 0 else Status.FAILED
        content = {"program": PROGRAM, "status": status, "results": results, "error": None if code == 0 else line,
                   "variant": "a variant", "device": "a device", "seed": 3}  # fmt: skip
        (run / "manifest.json").write_text(json.dumps(content))
        interrupts.requested |= "interrupted" in line
        return code, line

    return call


SEARCH = ("--search", "optuna", "--trials", "3", "--vary", "optimizer.learning_rate={low: 0.01, high: 0.3, log: true}",
          "--vary", "run.spp={low: 2, high: 40}", "--vary", "optimizer.type=[adam, sgd]")  # fmt: skip


@pytest.mark.parametrize(
    ("name", "words", "ends", "again"),
    [
        ("sweep", ("--vary", "run.spp=[4, 8]", "--seeds", "2"), {}, ("--seeds", "3")),
        ("sweep with a failure", ("--vary", "run.spp=[4, 8]"), {"spp=8": (5, "loss is nan")}, ()),
        ("sweep that is interrupted", ("--vary", "run.spp=[4, 8, 6]"), {"spp=8": (130, "interrupted")}, ()),
        ("sweep that is interrupted at an end", ("--vary", "run.spp=[4, 8]"), {"spp=4": (0, "interrupted late")}, ()),
        ("sweep that is interrupted at its end", ("--vary", "run.spp=[4, 8]"), {"spp=8": (0, "interrupted late")}, ()),
        ("sweep that is interrupted at a failure", ("--vary", "run.spp=[4, 8]"), {"spp=4": (5, "interrupted")}, ()),
        ("sweep without a backend", (), {"seed": (3, "no libLLVM")}, ()),
        ("sweep on a full disk", ("--vary", "run.max_seconds=[2]"), {"seed": (6, "s/x: the disk is full")}, ()),
        ("search", (*SEARCH, "--seeds", "2"), {}, ("--trials", "4")),
        ("search with a failure", SEARCH, {"spp=21": (5, "loss is nan")}, ()),
        ("search that fails", SEARCH, {"type": (5, "loss is nan")}, ()),
    ],
)  # fmt: skip
def test_sweeps(
    name: str, words: tuple[str, ...], ends: Any, again: tuple[str, ...], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "--search" in words:
        pytest.importorskip("optuna")
    told: list[Any] = []
    monkeypatch.setattr(sweep, "call", pretend(ends, told))
    check(name, folder, "sweep", "tiny.yaml", *words, "-o", "s", root="s")
    monkeypatch.setattr(sweep, "call", pretend({}, told))
    check(f"{name}, again", folder, "sweep", "--resume", "s", *again, root="s")
    said.check(f"{name}, calls", said.masked(told, folder))
    if name == "sweep":
        check("report of a sweep", folder, "report", "s", root="s")


# Loggers, with packages that only remember their calls.


def remembered(value: Any) -> Any:
    """Return arguments of a call for comparison."""
    if isinstance(value, dict):
        return {str(key): remembered(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [remembered(each) for each in value]
    return said.plain(value) if isinstance(value, (int, float, str, np.ndarray, type(None))) else "..."


@pytest.mark.parametrize("status", ["finished", "interrupted", "failed"])
@pytest.mark.parametrize("active", [False, True])
@pytest.mark.parametrize("name", loggers.LOGGERS)
def test_loggers(name: str, active: bool, status: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake = MagicMock()
    fake.run = fake.active if active else None
    fake.active_run.return_value = fake.active if active else None
    monkeypatch.setattr(loggers, "package", lambda *_: fake)
    monkeypatch.setattr(loggers, "time", SimpleNamespace(time=lambda: 12.5))
    monkeypatch.setenv("WANDB_PROJECT", "mine")
    logger = loggers.LOGGERS[name]()
    values = {"a": np.float32([0.1, 0.2, 0.3]), "b": np.float32(2), "c": np.float32(range(5)),
              "slab.heightmap": np.float32([[[1], [3]]]), "d.data": np.full((2, 2, 3), 0.25, np.float32)}  # fmt: skip
    long = {"run.spp": 4, "a(b)": "x" * 7000}
    others = ((0, "mine"), (3, "other")) if status == "finished" else ()
    for done, called in ((0, "mine"), (3, "mine"), *others):
        shapes = {key: value.shape for key, value in values.items()}
        run = RunInfo(called, tmp_path / "runs/tiny", long, 9, done, shapes, values.__getitem__)
        logger.begin(run)
        logger.image(run, "target-1", np.full((2, 3, 3), 0.1, np.float32), 2.0)
        logger.iteration(
            run, make_record(iteration=done, parameter_rmse=0.5, parameter_errors={"a": 0.1}, held_out=0.2)
        )
        logger.image(run, "final", np.full((2, 3, 1), 0.1, np.float32), 1.0)
        logger.end(run, status)
    logger.end(run, status)  # nothing is logged after the end
    calls = [f"{call[0]} {json.dumps(remembered([call[1], call[2]]))}" for call in fake.mock_calls]
    said.check(f"{name}, {active}, {status}", said.masked([re.sub("x{20,}", lambda m: f"x * {len(m[0])}", each)
                                                        for each in calls], tmp_path))  # fmt: skip
