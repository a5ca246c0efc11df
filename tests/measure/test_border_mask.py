"""Whole runs and light paths against camera paths: all are judged, and optimised, without the film's border."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from measure import pretended_runs, pretended_steps
from measure.test_convergence_survey import GAUSSIAN, problem

from reslrb_cli.config import dump
from reslrb_cli.measure.border_mask import leave_out_border
from reslrb_cli.measure.cases import parse_cases
from reslrb_cli.measure.whole_runs import judge, runner


@pytest.mark.parametrize("loss", ["l2", "log_l2"])
def test_pixels_along_the_border_count_nothing(llvm: None, tmp_path: Path, loss: str) -> None:
    """With a filter of a radius of two pixels; what is inside counts as before."""
    what = problem(tmp_path, GAUSSIAN, overrides=(f"loss.type={loss}",))
    target = mi.TensorXf(np.random.default_rng(1).uniform(0.5, 1.5, (8, 8, 3)).astype(np.float32))
    own, change = what.loss, np.zeros((8, 8, 3), np.float32)
    change[2:-2, 2:-2] = 0.3
    inner, outer = target + mi.TensorXf(change), target + mi.TensorXf(0.3 - change)
    expected = float(own(inner, target)[0])
    assert leave_out_border(what)
    assert float(what.compare(inner, target)[0]) == pytest.approx(expected, rel=1e-5)
    assert float(what.compare(outer, target)[0]) == pytest.approx(0.0, abs=1e-9)
    gradient = what.image_gradient(np.array(target) + 0.3, target)
    assert (gradient[2:-2, 2:-2] != 0).all()
    gradient[2:-2, 2:-2] = 0
    assert not gradient.any()


def test_a_box_filter_has_no_border(llvm: None, tmp_path: Path) -> None:
    what = problem(tmp_path)
    own = what.loss
    assert not leave_out_border(what)
    assert what.loss is own


@pytest.mark.parametrize("camera", [True, False])
def test_all_processes_of_whole_runs_leave_it_out(llvm: None, tmp_path: Path, camera: bool) -> None:
    """The judge says so, also one that takes over; a run that is told so optimises without it."""
    what = problem(tmp_path, GAUSSIAN)
    first: dict[str, Any] = {"config": dump(what.config), "source": "tiny.yaml", "targets": str(tmp_path / "t.npz")}
    _, ask = judge.begin(first)
    prepared = {"budget_s": 0.1, "image_s": 0.01, "camera": camera, "named": True}
    facts = ask({"prepare": prepared, "out": first["targets"]})
    assert facts["masked"] is camera
    _, again = judge.begin(first)
    taken = again({"restore": {"spp": facts["spp"], "masked": camera}, "targets": first["targets"]})
    assert taken["loss"] == pytest.approx(facts["loss"], rel=1e-4)
    assert taken["error"] == pytest.approx(facts["error"], rel=1e-4)
    losses = {}
    for masked in (camera, not camera):
        other = problem(tmp_path, GAUSSIAN)
        with np.load(first["targets"]) as targets:
            other.targets = [mi.TensorXf(targets["target-0"])]
        if masked:
            leave_out_border(other)
        losses[masked] = judge.Judge(other, facts["spp"]).loss(runner.copies(other))
    assert facts["loss"] == pytest.approx(losses[camera], rel=1e-4)
    assert losses[True] != pytest.approx(losses[False], rel=1e-2)

    seen: list[bool] = []

    def optimize(what: Any) -> Any:
        image = mi.TensorXf(np.array(what.targets[0]))
        image[0] = 9.0
        seen.append(float(what.compare(image, what.targets[0])[0]) == 0)
        return iter(())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "optimize", optimize)
        runner.begin(first | {"masked": camera})
    assert seen == [camera]
    dr.sync_thread()


CAMERA_CASES = [
    ("ptracer,reslrb:stack", "reslrb:stack", (False, True)),
    ("prb,reslrb:stack", "reslrb:stack", (True, True)),
    ("reslrb:stack", "prb", (True, True)),  # what errors are taken from is a side too
]


@pytest.mark.parametrize(("cases", "reference", "expected"), CAMERA_CASES)
def test_camera_paths_are_seen_wherever_they_take_part(
    tmp_path: Path, cases: str, reference: str, expected: tuple[bool, bool]
) -> None:
    changes: dict[str, Any] = {"reference": parse_cases(reference)[0]}
    stage = pretended_steps.Stage()
    pretended_steps.play(tmp_path, stage, pretended_steps.plan(cases, rounds=3, **changes))
    [ask] = [question["ask"] for question in stage.asked if "ask" in question]
    assert (ask["camera"], ask["named"]) == expected
    runs = pretended_runs.Stage()
    pretended_runs.play(tmp_path, runs, pretended_runs.plan(cases, runs=1, **changes))
    assert (runs.prepared["camera"], runs.prepared["named"]) == expected


def test_of_the_default_list_camera_paths_may_be_left_out(tmp_path: Path) -> None:
    stage = pretended_steps.Stage()
    pretended_steps.play(tmp_path, stage, pretended_steps.plan("prb,reslrb:stack", rounds=3, default=True))
    [ask] = [question["ask"] for question in stage.asked if "ask" in question]
    assert (ask["camera"], ask["named"]) == (True, False)
