"""Comparisons of two methods, and losses without the film's border."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.test_optimize import KEY
from measure import pretended_runs, pretended_steps
from measure.test_convergence import GAUSSIAN, problem

from reslrb_cli.config.loader import dump
from reslrb_cli.measure.convergence.setup import Role
from reslrb_cli.measure.methods import REFERENCE, parse_cases
from reslrb_cli.measure.optimization_benchmark import evaluate
from reslrb_cli.measure.references import leave_out_border
from reslrb_cli.optimization.autotune import race
from reslrb_cli.optimization.views import set_targets


def samples(sd, count, seed, entries=200):
    random = np.random.default_rng(seed)
    return [{KEY: (1 + sd * random.normal(size=entries)).astype(np.float32)} for _ in range(count)]


@pytest.mark.parametrize("entries", [3, 200])
def test_the_interval_holds_the_truth_as_often_as_it_says(entries):
    """Four times the variance at half the time; without what single times may be off, the level is the nominal one."""
    inside = 0
    for seed in range(200):
        own, other = samples(2.0, 8, 2 * seed, entries), samples(1.0, 8, 2 * seed + 1, entries)
        value, low, high = race.compare(own, [2.0] * 8, other, [4.0] * 8)
        low, high = low * race.TIMING_NOISE, high / race.TIMING_NOISE
        assert low < value < high
        inside += low < 2.0 < high
    # 190 of 200 are expected; fewer than 176 have a probability of 1e-4.
    assert inside >= 176


def test_equals_are_hardly_ever_called_better():
    better = sum(
        race.compare(samples(1.0, 8, 2 * seed), [3.0] * 8, samples(1.0, 8, 2 * seed + 1), [3.0] * 8)[1] > 1
        for seed in range(200)
    )
    assert better <= 13  # 5 are expected on this side without what times may be off


def test_no_noise_is_no_comparison():
    still = [{KEY: np.ones(4, np.float32)}] * 6
    assert race.compare(still, [1.0] * 6, samples(1.0, 6, 1, 4), [1.0] * 6) == (None, None, None)


def test_gradients_of_no_light_tell_nothing():
    none = [{KEY: np.zeros(3, dtype=np.float32)} for _ in range(8)]
    assert race.compare(none, [1.0] * 8, none, [1.0] * 8) == (None, None, None)


# Whole runs and light paths against camera paths: all are judged, and optimised, without the film's border.


@pytest.mark.parametrize("loss", ["l2", "log_l2"])
def test_pixels_along_the_border_count_nothing(llvm: None, tmp_path: Path, loss: str) -> None:
    """With a filter of a radius of two pixels; what is inside counts as before."""
    what = problem(tmp_path, GAUSSIAN, overrides=(f"loss.type={loss}",))
    target = mi.TensorXf(np.random.default_rng(1).uniform(0.5, 1.5, (8, 8, 3)).astype(np.float32))
    [view] = what.views
    view.see(np.array(target))
    change = np.zeros((8, 8, 3), np.float32)
    change[2:-2, 2:-2] = 0.3
    inner, outer = target + mi.TensorXf(change), target + mi.TensorXf(0.3 - change)
    expected = float(view.compare(inner)[0]) * 64 / 16  # the mean over what is inside
    assert leave_out_border(what)
    assert float(view.compare(inner)[0]) == pytest.approx(expected, rel=1e-5)
    assert float(view.compare(outer)[0]) == pytest.approx(0.0, abs=1e-9)
    gradient = what.image_gradient(view, np.array(target) + 0.3)
    assert (gradient[2:-2, 2:-2] != 0).all()
    gradient[2:-2, 2:-2] = 0
    assert not gradient.any()


def test_a_box_filter_has_no_border(llvm: None, tmp_path: Path) -> None:
    what = problem(tmp_path)
    what.views[0].see(np.ones((8, 8, 3), np.float32))
    assert not leave_out_border(what)
    assert what.views[0].weights is None


def test_what_a_mask_leaves_out_stays_out(llvm: None, tmp_path: Path) -> None:
    what = problem(tmp_path, GAUSSIAN)
    weights = np.ones((8, 8), np.float32)
    weights[3, 3] = 0
    what.views[0].see(np.ones((8, 8, 3), np.float32), weights)
    assert leave_out_border(what)
    kept = np.array(what.views[0].weights)[:, :, 0]
    assert np.count_nonzero(kept) == 15
    assert kept[3, 3] == 0
    assert kept.mean() == pytest.approx(1)


@pytest.mark.parametrize("camera", [True, False])
def test_all_processes_of_whole_runs_leave_it_out(llvm: None, tmp_path: Path, camera: bool) -> None:
    """The judge says so, also one that takes over; a run that is told so optimises without it."""
    what = problem(tmp_path, GAUSSIAN)
    first: dict[str, Any] = {"config": dump(what.config), "source": "tiny.yaml", "targets": str(tmp_path / "t.npz")}
    _, ask = evaluate.begin_judging(first)
    prepared = {"budget_s": 0.1, "image_s": 0.01, "camera": camera, "named": True}
    facts = ask({"prepare": prepared, "out": first["targets"]})
    assert facts["masked"] is camera
    _, again = evaluate.begin_judging(first)
    taken = again({"restore": {"spp": facts["spp"], "masked": camera}, "targets": first["targets"]})
    assert taken["loss"] == pytest.approx(facts["loss"], rel=1e-4)
    assert taken["error"] == pytest.approx(facts["error"], rel=1e-4)
    losses = {}
    for masked in (camera, not camera):
        other = problem(tmp_path, GAUSSIAN)
        with np.load(first["targets"]) as targets:
            set_targets(other.views, targets)
        if masked:
            leave_out_border(other)
        losses[masked] = evaluate.Judge(other, facts["spp"]).loss(evaluate.copies(other))
    assert facts["loss"] == pytest.approx(losses[camera], rel=1e-4)
    assert losses[True] != pytest.approx(losses[False], rel=1e-2)

    seen: list[bool] = []

    def optimize(what: Any, progress: Any) -> Any:
        image = mi.TensorXf(np.array(what.views[0].target))
        image[0] = 9.0
        seen.append(float(what.views[0].compare(image)[0]) == 0)
        return iter(())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "optimize", optimize)
        evaluate.begin_run(first | {"masked": camera})
    assert seen == [camera]
    dr.sync_thread()


CAMERA_CASES = [
    ("ptracer,reslrb:stack", "reslrb:stack", (False, True, True)),
    ("prb,reslrb:stack", "reslrb:stack", (True, True, True)),
    ("reslrb:stack", "prb", (True, True, True)),  # what errors are taken from is a side too
    ("reslrb:stack(paths=both),reslrb:event", "reslrb:stack", (True, True, True)),
    ("reslrb:stack", "reslrb:stack(paths=auto)", (True, True, True)),
    ("prb,reslrb:stack(paths=camera)", "reslrb:stack(paths=both)", (True, True, False)),  # all alike
]


@pytest.mark.parametrize(("cases", "reference", "expected"), CAMERA_CASES)
def test_camera_paths_are_seen_wherever_they_take_part(
    tmp_path: Path, cases: str, reference: str, expected: tuple[bool, bool, bool]
) -> None:
    changes: dict[str, Any] = {"reference": parse_cases(reference)[0]}
    stage = pretended_steps.Stage()
    pretended_steps.play(tmp_path, stage, pretended_steps.plan(cases, rounds=3, **changes))
    [ask] = [question["ask"] for question in stage.asked if "ask" in question]
    assert (ask["camera"], ask["named"], ask["light"]) == expected
    runs = pretended_runs.Stage()
    pretended_runs.play(tmp_path, runs, pretended_runs.plan(cases, runs=1, **changes))
    assert (runs.prepared["camera"], runs.prepared["named"], runs.prepared["light"]) == expected


@pytest.mark.parametrize(
    ("paths", "label", "share"),
    [("light", "reslrb:stack", None), ("camera", "reslrb:stack(paths=camera)", None),
     ("both", "reslrb:stack(paths=both,light_share=0.5)", 0.5)],
)  # fmt: skip
def test_errors_are_taken_from_all_light_that_the_scene_allows_for(
    tmp_path: Path, paths: str, label: str, share: float | None
) -> None:
    """Of the default list, what there are no paths for is left out, and said."""
    stage = pretended_steps.Stage(facts={"paths": paths})
    usual = pretended_steps.plan(
        "reslrb:stack,reslrb:stack(paths=both)", rounds=3, reference=parse_cases(REFERENCE)[0], default=True
    )
    session, results, said = pretended_steps.play(tmp_path, stage, usual)
    method = results.references[0].method
    assert (method.label, method.paths, method.light_share) == (label, paths, share)
    assert session.of(Role.REFERENCE)[0].config.integrator.options()["paths"] == paths
    left_out = "left out: reslrb:stack(paths=both): this scene has light paths alone"
    assert (left_out in said) == (paths == "light")


def test_of_the_default_list_camera_paths_may_be_left_out(tmp_path: Path) -> None:
    stage = pretended_steps.Stage()
    pretended_steps.play(tmp_path, stage, pretended_steps.plan("prb,reslrb:stack", rounds=3, default=True))
    [ask] = [question["ask"] for question in stage.asked if "ask" in question]
    assert (ask["camera"], ask["named"]) == (True, False)
