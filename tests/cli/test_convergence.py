"""`reslrb convergence` from the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli.tiny import KEY, done, measured, outcome, write_experiment

from reslrb_cli.records.measurements import TARGETS

pytestmark = pytest.mark.usefixtures("llvm")


# `reslrb convergence` from the command line, on a poster of 8x8 pixels.


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.long
def test_a_scene_end_to_end(folder: Path) -> None:
    """The bias of each method stays below its limit, and the error of averages falls at the expected rate. `ptracer` is
    also the independent reference, so three processes are enough.
    """
    names = ["ptracer"]
    args = ["--integrators", ",".join(names), "--rounds", "16", "--json", "out/c.jsonl", "--set", "run.spp=16",
            "--reference", "reslrb:stack"]  # fmt: skip
    (folder / "out").mkdir()
    printed = done("convergence", "tiny.yaml", *args).stdout.splitlines()
    lines = measured(folder / "out/c.jsonl")
    methods = [line for line in lines if line["kind"] == "method"]
    assert [(line["label"], line["parameter"]) for line in methods] == [(n, KEY) for n in names]
    for line in methods:
        assert (line["status"], line["spp"], line["adjoint"], line["biased"]) == ("ok", 16, None, False)
        assert abs(line["bias_z"]) < line["bias_z_limit"]
        assert line["efficiency"]["low"] < line["efficiency"]["value"] < line["efficiency"]["high"]
        assert line["efficiency"]["value"] == pytest.approx(1 / (line["relative_rmse"] ** 2 * line["step_s"]))
        assert list(line["seconds_to"]) == [f"{target:g}" for target in TARGETS]
        assert line["cold_s"] > line["step_s"] > 0
    points = [line for line in lines if line["kind"] == "point" and line["label"] == names[0]]
    assert {(line["parameter"], line["reference_rmse"] > 0) for line in points} == {(KEY, True)}
    assert [line["steps"] for line in points] == [2**k for k in range(len(points))]
    for line in points:
        assert line["elapsed_s"] == pytest.approx(line["steps"] * points[0]["elapsed_s"])
    reference = next(line for line in lines if line["kind"] == "reference")
    assert (reference["label"], reference["bias_reference"], reference["biased"]) == ("reslrb:stack", "ptracer", False)
    assert printed[-1].startswith("Best for this scene: ")
    assert sum("16 rounds " in line for line in printed) == len(names)  # one row for each method
    assert any(line.startswith(f"{names[0]}: first step") for line in printed)  # compilation has its own line


@pytest.mark.long
def test_the_loss_reveals_correlated_samples(folder: Path) -> None:
    args = ["--objective", "loss", "--rounds", "256", "--json", "c.jsonl"]
    args += ["--set", "run.spp=4", "--set", "loss.type=l2"]
    cases = "reslrb:stack(adjoint=correlated),reslrb:stack(adjoint=independent)"
    sentence = done("convergence", "tiny.yaml", *args, "--integrators", cases).stdout.splitlines()[-1]
    methods = [line for line in measured(folder / "c.jsonl") if line["kind"] == "method"]
    assert [(line["adjoint"], line["biased"]) for line in methods] == [("correlated", True), ("independent", False)]
    assert methods[0]["bias"] > 0.1
    assert "Best for this scene: reslrb:stack(adjoint=independent); of all others a bias was found." in sentence


def test_a_too_small_budget_is_reported(folder: Path) -> None:
    code, out, err = outcome("convergence", "tiny.yaml", "--budget", "0.001", "--integrators", "reslrb:stack")
    assert (code, "Traceback" in err) == (1, False)
    assert "dL/dI was not computed: the budget was spent; allow more with --budget" in out


@pytest.mark.long
def test_the_image(folder: Path) -> None:
    words = ("--objective", "image", "--rounds", "4", "--json", "c.jsonl", "--integrators", "prb")
    done("convergence", "tiny.yaml", *words)
    methods = [line for line in measured(folder / "c.jsonl") if line["kind"] == "method"]
    assert [(line["label"], line["parameter"], line["biased"]) for line in methods] == [("prb", "image", False)]
