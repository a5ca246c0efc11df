"""`optimize --dry-run` agrees with the run that follows, and writes no run folder."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from cli.tiny import done, read_metrics, settings, write_experiment

from reslrb_cli.config.integrators import passes_obstacle
from reslrb_cli.config.loader import load
from reslrb_cli.optimization import forecast
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.loop import optimize
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
    assert forecast.measure_steps(problem) == pytest.approx((10, 2, 3, record.peak_mib * 2**20), abs=1)
    assert taken == [0, 1, 2]


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
