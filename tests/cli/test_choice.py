"""Options set to `auto`, and the memory of paths, in whole runs of a small scene. The tests examine the command line
and the manifest.
"""

from __future__ import annotations

import logging
import re
import shutil
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from cli.test_optimize import CONFIG, KEY, SCENE
from turns import taking_turns

from reslrb_cli.cli import main
from reslrb_cli.config.loader import load
from reslrb_cli.estimators.stack import entry_bytes
from reslrb_cli.integrators import reslrb
from reslrb_cli.optimization import loop, sensitivity
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.autotune import race
from reslrb_cli.optimization.autotune.sampling import situation
from reslrb_cli.records.clock import StepClock
from reslrb_cli.records.decisions import key_of
from reslrb_cli.records.manifest import read_manifest

OWN = "{max_depth: 4, guiding: off, sequence: independent}"
AUTO = CONFIG.replace("{type: ptracer, max_depth: 3}", OWN).replace("iterations: 25", "iterations: 2, measuring: 1000")


@pytest.fixture
def experiment(llvm, tmp_path, monkeypatch):
    """Folder with a scene and a configuration. The folder is the working directory."""
    import mitsuba as mi

    mi.Bitmap(np.full((4, 4, 3), 0.6, dtype=np.float32)).write(str(tmp_path / "poster.exr"))
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "box.yaml").write_text(AUTO)
    monkeypatch.chdir(tmp_path)
    logging.getLogger("reslrb_cli").setLevel(logging.INFO)


def optimize(capsys, *settings: str, verbose: bool = False) -> tuple[int, str]:
    logging.getLogger("reslrb_cli").setLevel(logging.INFO)
    capsys.readouterr()
    sets = [text for setting in settings for text in ("--set", setting)]
    shutil.rmtree("runs", ignore_errors=True)
    with pytest.raises(SystemExit) as end:
        main([*(["--debug"] if verbose else []), "optimize", "box.yaml", *sets])
    return int(end.value.code or 0), capsys.readouterr().err


def test_a_short_run_measures_nothing_and_says_so(experiment, capsys, monkeypatch):
    """Without enough time for measuring in a tenth of the run, rules decide the `auto` options."""
    from reslrb_cli.optimization.autotune.race import Turns

    options = ["integrator={max_depth: 4}", "run.measuring=0.1", "run.iterations=3"]
    with monkeypatch.context() as patch:
        patch.setattr(Turns, "run", lambda *args: pytest.fail("measured"))
        code, err = optimize(capsys, *options)
    assert code == 0, err
    assert "measuring which" not in err
    because = "not measured (over 10 % of this run); "
    sequence = "sequence low_discrepancy: evenly spread numbers have been no loss in any scene"
    chosen = "sequence low_discrepancy, paths both, pixels even, guiding off"
    assert f"chosen without measuring: {chosen} (`reslrb --debug` gives the reasons)" in err.splitlines()
    manifest = read_manifest(Path("runs/box"))
    assert manifest["plan"]["estimator"] == "stack"
    assert [each["setting"] for each in manifest["decisions"]] == ["sequence", "paths", "pixels", "guiding"]
    page = Path("runs/box/report.html").read_text()
    assert f"guiding off: {because}it pays in long runs" in page
    assert sequence in page
    code, err = optimize(capsys, *options, "run.certainty=false", verbose=True)
    assert f"guiding off: {because}it pays in long runs" in err.splitlines()


@pytest.mark.long
def test_a_longer_run_measures_what_a_short_one_chose(experiment, capsys):
    options = ["integrator={max_depth: 4}", "run.iterations=3"]
    assert optimize(capsys, *options, "run.measuring=0.1")[0] == 0
    code, err = optimize(capsys, *options, "run.measuring=1000")
    assert code == 0, err
    assert "measuring which sampling is most efficient" in err  # the unmeasured decision is not stored as measured
    assert re.search("^chosen by measurement: .*paths (both|camera), ", err, re.MULTILINE)
    opening = err.splitlines()[: next(place for place, line in enumerate(err.splitlines()) if line.startswith("1/3: "))]
    assert 0 < len(opening) <= 6, opening


def test_other_settings_are_another_situation(experiment):
    """A setting that changes neither a step's samples nor its derivatives, for example the run's name, keeps the
    situation.
    """

    def key(*settings):
        return key_of(situation(assemble_scene(load("box.yaml", settings))))

    first = key()
    assert key("run.name=other", "run.iterations=3") == first
    others = ["run.spp=8", "integrator.max_depth=3", "parameters[0].resolution=[2, 2]", "run.adjoint=correlated"]
    assert len({first, *map(key, others)}) == 1 + len(others)


def test_measuring_does_not_change_the_run(experiment):
    def first_step(*settings):
        # A target with the integrator of the run would depend on its sequence.
        target = "target.render.integrator={max_depth: 4, estimator: stack}"
        problem = assemble(load("box.yaml", [target, *settings]))
        assert not np.any(np.array(problem.optimizer.gradient(KEY)))
        value = problem.selection.array(KEY).copy()
        loss, *_ = loop.gradient(problem, 0)
        dr.eval(loss)
        return value, float(loss[0]), problem

    value, loss, problem = first_step("integrator={max_depth: 4, paths: light}")
    assert any(each.setting == "guiding" and each.gain is not None for each in problem.decisions)
    decided = ", ".join(f"{each.setting}: {each.value}" for each in problem.decisions)
    named = first_step(f"integrator={{max_depth: 4, estimator: stack, paths: light, {decided}}}")
    assert named[2].decisions == []
    np.testing.assert_array_equal(value, named[0])
    assert loss == pytest.approx(named[1], rel=1e-5)


def test_measuring_has_its_own_seeds(experiment, monkeypatch):
    drawn = []

    def spy(run_seed, iteration, view, purpose):
        drawn.append((run_seed, iteration, view, purpose))
        return len(drawn)

    monkeypatch.setattr(sensitivity, "seed", spy)
    monkeypatch.setattr(sensitivity, "gradient_step", lambda *args, **options: pytest.fail("stop", pytrace=False))
    problem = assemble_scene(load("box.yaml", ["run.seed=7"]))

    for round in (0, 1, 0):
        with pytest.raises(pytest.fail.Exception):
            race.measured_step(problem, problem.integrator, StepClock(), round, 4)
    assert drawn == [(7, 0, 0, "pilot"), (7, 1, 0, "pilot"), (7, 0, 0, "pilot")]


def test_a_weight_with_the_adjoint_works_in_a_whole_run(experiment, capsys):
    """Renderings and derivatives outside the steps, for example for the mask or saved images, must also support
    `weight: adjoint`.
    """
    code, err = optimize(capsys, "integrator={max_depth: 4, estimator: reservoir, weight: adjoint}")
    assert code == 0, err
    assert np.load(f"runs/box/parameters/{KEY}.mask.npy").all()


@taking_turns("estimator", ["reservoir", "gather", "event", "stack"], "zeros", [True, False])
def test_counted_memory_of_a_path_matches_its_stored_state(experiment, monkeypatch, estimator, zeros):
    states, forward = [], reslrb.forward

    def spy(*args):
        states.append(forward(*args))
        return states[-1]

    monkeypatch.setattr(reslrb, "forward", spy)
    value = 0.0 if zeros else 0.5
    settings = [f"integrator={{max_depth: 4, estimator: {estimator}}}", f"parameters[0].initial={value}"]
    for adjoint in ("correlated", "independent"):
        problem = assemble(load("box.yaml", [*settings, f"run.adjoint={adjoint}"]))
        loop.gradient(problem, 0)
        sensor = problem.scene.sensors()[0]
        plan = problem.integrator.plan(problem.scene, sensor, problem.selection.params)
        counted, kept = sum(entry_bytes(problem.integrator.estimator.kept(plan))), sum(entry_bytes(states.pop()))
        assert plan.track_zeros == zeros
        assert kept == counted if estimator in ("reservoir", "event") else kept <= counted <= kept + 128


@taking_turns(
    "estimator", ["reservoir", "gather", "event", "stack"], "adjoint", ["batched", "correlated"], ["event", "stack"]
)
def test_all_sample_counts_share_kernels(experiment, estimator, adjoint):
    """Otherwise, a measurement would compile kernels that the run does not use."""
    settings = [f"integrator={{max_depth: 4, estimator: {estimator}}}", f"run.adjoint={adjoint}"]
    problem = assemble(load("box.yaml", settings))
    clock, launched = StepClock(), []
    for spp in (12, 32, 64):
        race.measured_step(problem, problem.integrator, clock, 0, spp)
        launched.append({entry["hash"] for entry in clock.history if "hash" in entry})
    assert launched[1] | launched[2] <= launched[0]
