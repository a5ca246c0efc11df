"""`optimize --dry-run` agrees with the run that follows, and writes no run folder."""

from __future__ import annotations

import os
import re
import types
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from cli.tiny import done, read_metrics, settings, write_experiment
from optimization.toy import make_problem
from records.test_metrics import make_record

from reslrb_cli.cli.optimize import Progress
from reslrb_cli.config.integrators import passes_obstacle
from reslrb_cli.config.loader import load
from reslrb_cli.optimization import forecast, loop
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.problem import ErrorMeter
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.metrics import Record

pytestmark = pytest.mark.usefixtures("llvm")
SETS = ["scene.size=[96, 64]", "run.iterations=8", "run.final_spp=4", "run.adjoint=batched"]


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def call(*words: str) -> str:
    """Run the experiment, and return standard output."""
    return done("optimize", "tiny.yaml", *settings(*SETS), *words).stdout


@pytest.mark.long
def test_memory_matches_the_run(experiment: Path) -> None:
    before = sorted(os.listdir(experiment))
    printed = call("--dry-run")
    assert sorted(os.listdir(experiment)) == before
    told = re.search(r"memory of the iterations: at most ([\d.]+) MiB", printed)
    assert told is not None, printed
    assert "time of the iterations: " in printed
    call("--quiet")
    peak = read_metrics(experiment / "runs" / "tiny")[-1]["peak_mib"]
    assert peak > 0.5
    assert float(told[1]) == pytest.approx(peak, rel=0.15)


def test_few_long_steps_suffice(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first step takes 13 s, of which 3 s compile kernels, the second 12 s, and all others 10 s."""
    problem, taken = replace(assemble(load(experiment / "tiny.yaml", SETS)), truth={}), list[int]()
    [record, *_] = optimize(problem)

    def steps(problem: object) -> Iterator[Record]:
        for number, elapsed_s in enumerate((13.0, 25.0, 35.0, 45.0)):
            taken.append(number)
            yield replace(record, iteration=number, elapsed_s=elapsed_s, codegen_ms=3e3 if number == 0 else 0.0)

    monkeypatch.setattr(forecast, "optimize", steps)
    pace, *others = forecast.measure_steps(problem)
    assert (pace.step_s, pace.seconds(0, 8)) == (pytest.approx(10), pytest.approx(80))
    assert others == pytest.approx([2, 3, record.peak_mib * 2**20], abs=1)
    assert taken == [0, 1, 2]


#: Which parameters `auto` has, and after which iteration the joint curvature is known.
KINDS = {"large": (True, False, 0), "small": (False, True, 1000), "small, known": (False, True, 30),
         "both": (True, True, 1000), "both, known": (True, True, 30)}  # fmt: skip


def simulated(kind: str, iterations: int) -> tuple[types.SimpleNamespace, list[Record]]:
    """Return the optimiser and the records of a run with `auto`. A step takes 4 s, of which the gradient takes 3 s. A
    joint measurement takes 9 s. The first iteration compiles kernels for 20 s in the step, and as long in measuring.
    """
    has_large, has_small, known = KINDS[kind]
    optimizer = types.SimpleNamespace(measures_curvature=True, has_large=has_large)
    optimizer.block = types.SimpleNamespace(at={"colour": slice(0, 3)} if has_small else {})
    records, elapsed_s = [], 0.0
    for number in range(iterations):
        curvature_s = 3.0 * loop.bends_large(optimizer, number)
        if has_small and number < known and loop.joint_cost(number, 9 / 4) is not None:
            curvature_s += 9.0
        curvature_s, new_s = (curvature_s + 20, 20.0) if number == 0 else (curvature_s, 0.0)
        elapsed_s += 4 + curvature_s + new_s
        step_ms = 1e3 * (3 + new_s)
        records.append(make_record(iteration=number, step_ms=step_ms, codegen_ms=1e3 * new_s, elapsed_s=elapsed_s,
                                   curvature_s=curvature_s))  # fmt: skip
    return optimizer, records


@pytest.mark.parametrize("kind", KINDS)
def test_the_forecast_of_auto_counts_what_it_measures(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A few slow steps suffice, although the first ones measure more often than the others."""
    optimizer, records = simulated(kind, 150)
    monkeypatch.setattr(forecast, "optimize", lambda problem: iter(records))
    run = types.SimpleNamespace(iterations=150, model_copy=lambda update: None)
    config = types.SimpleNamespace(run=run, model_copy=lambda update: None)
    monkeypatch.setattr(forecast, "replace", lambda problem, config: problem)
    problem = types.SimpleNamespace(config=config, optimizer=optimizer)
    pace, start_s, compile_s, _ = forecast.measure_steps(problem)
    total = records[-1].elapsed_s
    assert (start_s, compile_s) == pytest.approx((20, 20), abs=0.1)
    assert pace.seconds(0, 150) + 40 >= 0.99 * total  # at most: the joint curvature may be known before
    assert pace.seconds(0, 150) + 40 <= (1.01 if "known" not in kind else 1.35) * total
    assert pace.seconds(0, 20) + 40 == pytest.approx(records[19].elapsed_s, rel=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_the_bar_agrees_with_the_forecast(kind: str) -> None:
    optimizer, records = simulated(kind, 150)
    problem = types.SimpleNamespace(optimizer=optimizer, limit_s=None)
    progress = Progress(150, quiet=True, meter=ErrorMeter({}, {}, None), problem=problem)
    progress._bar = types.SimpleNamespace(format_interval=str)
    for number, record in enumerate(records):
        text = progress._left(record)
        assert (text[:8], text[-5:]) == ("at most ", " left")
        left = float(text[8:-5])
        true = records[-1].elapsed_s - record.elapsed_s
        assert left >= (0.95 if number else 0.9) * true - 1e-6
        sure = number > 0 and ("known" not in kind or number > 40)
        assert left <= (1.05 if sure else 1.4) * true + 1e-6


@pytest.mark.parametrize(
    ("sets", "expected"),
    [
        (["optimizer={type: adam, learning_rate: 0.02}"], "50 s (100 x 500 ms)"),
        (["optimizer={type: auto}"], "at most 1 min 7 s (100 x 500 ms + 2.4 s to measure curvature + 15 s); `auto` "
         "usually ends after 20 to 50 iterations (26.6 s to 42 s)"),
        (["optimizer={type: auto}", "run.iterations=20"], "26.6 s (20 x 500 ms + 1.6 s to measure curvature + 15 s)"),
        (["optimizer={type: auto}", "run.max_seconds=30"], "at most 29.6 s (26 x 500 ms + 1.6 s to measure curvature + "
         "15 s); `auto` usually ends after 20 to 26 iterations (26.6 s to 29.6 s)"),
    ],
)  # fmt: skip
def test_the_time_in_words(sets: list[str], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem(tmp_path, sets=["run.iterations=100", *sets])
    is_auto = problem.optimizer.measures_curvature
    pace = forecast.IterationTimes(0.5, 0.4, 0.0) if is_auto else forecast.IterationTimes(0.5)
    monkeypatch.setattr(forecast, "assemble", lambda *given: problem)
    monkeypatch.setattr(forecast, "measure_steps", lambda problem: (pace, 15.0 * is_auto, 2.0, 2**20))
    lines = forecast.forecast_lines(problem.config, lambda line: None)
    assert lines[2:] == [
        f"time of the iterations: {expected}", "time to compile kernels: 2 s, which is done now and stored"
    ]  # fmt: skip


@pytest.mark.long
def test_work_before_the_iterations_is_measured_once(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dry run measures the decisions and stores them for the run that follows."""
    monkeypatch.setenv("RESLRB_CACHE", str(experiment / "cache"))
    auto = ["--set", "integrator={type: reslrb, max_depth: 3, paths: light}", "--set", "run.certainty=false"]
    auto += ["--set", "run.measuring=1000", "--set", "scene.size=[16, 16]"]
    call("--dry-run", *auto)
    call(*auto)
    manifest = read_manifest(experiment / "runs" / "tiny")
    assert manifest is not None
    assert [each["cached"] for each in manifest["decisions"] if each["gain"] is not None] == [True]


@pytest.mark.parametrize(
    ("spp", "per_pass", "pixels", "said"),
    [
        (2**20, None, 2**12, None),  # four passes of 2^18 samples
        (2**20, None, 2**14 + 1, "set integrator.samples_per_pass to at most 262128, or lower"),
        (2**20, 2**17, 2**15 + 1, "set integrator.samples_per_pass to at most 131068, or lower"),
        (2**20, 4, 2**12, "makes 262144 passes of a step, above the limit of 65536; raise integrator.samples_per"),
    ],
)
def test_passes(spp: int, per_pass: int | None, pixels: int, said: str | None) -> None:
    obstacle = passes_obstacle(spp, per_pass, pixels)
    assert (obstacle is None) if said is None else (obstacle is not None and said in obstacle)
