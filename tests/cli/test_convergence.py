"""`reslrb convergence` from the command line."""

from __future__ import annotations

import json
import logging
from pathlib import Path

import pytest
from cli.tiny import KEY, write_experiment

from reslrb_cli.cli import main
from reslrb_cli.measure.processes import Process
from reslrb_cli.records.measurements import TARGETS

pytestmark = pytest.mark.usefixtures("llvm")


# `reslrb convergence` from the command line, on a poster of 8x8 pixels.


def call(*args: str) -> int:
    logging.getLogger("reslrb_cli").handlers.clear()
    with pytest.raises(SystemExit) as ended:
        main(["convergence", *args], prog_name="reslrb")
    return int(ended.value.code or 0)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def read(path: Path) -> list[dict]:
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[0]["kind"] == "origin"
    return lines[1:]


def test_a_scene_end_to_end(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The bias of each method stays below its limit, and the error of averages falls at the expected rate."""
    names = ["ptracer", "reslrb:reservoir(capacity=2)"]
    args = ["--integrators", ",".join(names), "--reference", "ptracer", "--rounds", "16", "--json", "out/c.jsonl"]
    args += ["--set", "run.spp=16"]
    (folder / "out").mkdir()
    assert call("tiny.yaml", *args) == 0
    lines = read(folder / "out/c.jsonl")
    methods = [line for line in lines if line["kind"] == "method"]
    assert [(line["label"], line["parameter"]) for line in methods] == [(n, k) for n in names for k in (KEY, "all")]
    assert [line["capacity"] for line in methods[::2]] == [None, 2]
    for line in methods:
        assert (line["status"], line["spp"], line["adjoint"], line["biased"]) == ("ok", 16, None, False)
        assert abs(line["bias_z"]) < line["bias_z_limit"]
        assert line["efficiency"]["low"] < line["efficiency"]["value"] < line["efficiency"]["high"]
        assert line["efficiency"]["value"] == pytest.approx(1 / (line["relative_rmse"] ** 2 * line["step_s"]))
        assert abs(line["slope"]["value"] + 0.5) < 2 * (line["slope"]["high"] - line["slope"]["low"])
        assert list(line["seconds_to"]) == [f"{target:g}" for target in TARGETS]
        assert line["cold_s"] > line["step_s"] > 0
    points = [line for line in lines if line["kind"] == "point" and line["label"] == "ptracer"]
    assert {(line["parameter"], line["reference_rmse"] > 0) for line in points} == {(KEY, True), ("all", True)}
    assert [line["steps"] for line in points[: len(points) // 2]] == [2**k for k in range(len(points) // 2)]
    for line in points:
        assert line["elapsed_s"] == pytest.approx(line["steps"] * points[0]["elapsed_s"])
    reference = next(line for line in lines if line["kind"] == "reference")
    assert (reference["label"], reference["bias_reference"], reference["biased"]) == (
        "reslrb:stack(paths=both,light_share=0.5)", "prb", False
    )  # fmt: skip
    printed = capsys.readouterr().out.splitlines()
    assert printed[-1].startswith("Best for this scene: ")
    assert sum("16 rounds " in line for line in printed) == len(names)  # one row for each method
    assert any(line.startswith("ptracer: first step") for line in printed)  # compilation has its own line
    # Samples that are already in the file are not taken again.
    monkeypatch.setattr(Process, "__init__", None)
    assert call("tiny.yaml", *args) == 0
    assert read(folder / "out/c.jsonl") == lines
    again = capsys.readouterr().out.splitlines()
    assert "using the samples in out/c.samples.npz" in again
    assert again[-1] == printed[-1]


@pytest.mark.long
def test_the_loss_reveals_correlated_samples(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["--objective", "loss", "--rounds", "64", "--json", "c.jsonl", "--set", "run.spp=4", "--set", "loss.type=l2"]
    cases = "reslrb:stack(adjoint=correlated),reslrb:stack(adjoint=independent)"
    assert call("tiny.yaml", *args, "--integrators", cases) == 0
    methods = [line for line in read(folder / "c.jsonl") if line["kind"] == "method" and line["parameter"] == "all"]
    assert [(line["adjoint"], line["biased"]) for line in methods] == [("correlated", True), ("independent", False)]
    assert methods[0]["slope"]["low"] > -0.4
    assert methods[1]["slope"]["low"] < -0.5 < methods[1]["slope"]["high"]
    assert methods[0]["bias"] > 0.1
    sentence = capsys.readouterr().out.splitlines()[-1]
    assert "Best for this scene: reslrb:stack(adjoint=independent); of all others a bias was found." in sentence


def test_a_too_small_budget_is_reported(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call("tiny.yaml", "--budget", "1", "--integrators", "reslrb:stack") == 1
    printed = capsys.readouterr()
    assert "the budget of 1 s was spent before dL/dI was known" in printed.out
    assert "Traceback" not in printed.err


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (("--integrators", "reslrb:stack(adjoint=batched)"), "adjoint: has no effect if dL/dI is known"),
        (("--reference", "ptracer,prb"), "--reference: errors are relative to one method; name one"),
        (("--reference", "walk"), "--reference walk: integrator.type: must be one of"),
        (("--json", "no/such/folder.jsonl"), "--json: cannot write no/such/folder.jsonl"),
        (("--objective", "gradient"), "'gradient' is not one of 'fixed', 'loss', 'image'"),
        (("--spp", "4,0"), "0 is not in the range"),
        (("--spp", "4,4"), "`4,4` has a number twice"),
        (("--spp", "3", "--set", "integrator.samples_per_pass=2"), "integrator.samples_per_pass: 2 does not divide"),
        (("--runs", "3"), "--runs was removed; compare whole runs with `reslrb sweep CONFIG --seeds N --set run.max"),
        (
            ("--rates=1,3",),
            "--rates was removed; compare rates with `reslrb sweep CONFIG --vary 'optimizer.learning",
        ),
        (("--integrators", "reslrb:auto"), "`auto` is for whole runs; use `stack`"),
    ],
)
def test_bad_input_is_one_located_line(
    folder: Path, args: tuple[str, ...], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call("tiny.yaml", *args) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert line in printed.err
    assert len(printed.err.splitlines()) == 1


def test_steps_that_cannot_be_continued(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "c.jsonl").write_text("kept\n")
    (folder / "c.samples.npz").write_bytes(b"PK\x03\x04 cut off")
    assert call("tiny.yaml", "--json", "c.jsonl") == 2
    assert "c.samples.npz: " in capsys.readouterr().err
    assert (folder / "c.jsonl").read_text() == "kept\n"


@pytest.mark.long
def test_the_image(folder: Path) -> None:
    assert call("tiny.yaml", "--objective", "image", "--rounds", "4", "--json", "c.jsonl", "--integrators", "prb") == 0
    methods = [line for line in read(folder / "c.jsonl") if line["kind"] == "method"]
    assert [(line["label"], line["parameter"], line["biased"]) for line in methods] == [("prb", "image", False)]


@pytest.mark.long
def test_continuing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    args = ["--integrators", "reslrb:stack", "--rounds", "4"]
    assert call("tiny.yaml", *args, "--json", "c.jsonl") == 0
    assert call("tiny.yaml", *args[:-1], "8", "--json", "c.jsonl") == 0
    assert {line["repeats"] for line in read(folder / "c.jsonl") if line["kind"] == "method"} == {16}
    capsys.readouterr()
    assert call("tiny.yaml", *args[:-1], "9", "--json", "c.jsonl", "--set", "run.spp=8") == 2
    reason = "run.spp is 4 there, 8 here; remove the file, or use another one"
    assert capsys.readouterr().err == f"--json: c.jsonl belongs to another measurement: {reason}\n"
    assert len(read(folder / "c.jsonl")) > 2  # file is unchanged
