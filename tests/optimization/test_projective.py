"""Mitsuba's projective integrators as integrator types, with outlines and shadow edges of a moving box."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from kit import area, diffuse, scene, sensor, shape

from reslrb_cli.cli import main
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError, ExitCode
from reslrb_cli.integrators.baselines import Projective
from reslrb_cli.integrators.step import known_step
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.identifiability import find_reached
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.problem import Problem

SPOT = """<emitter type="spot" id="spot">
        <rgb name="intensity" value="0.001"/>
        <transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="1, 0, 0"/></transform>
    </emitter>"""
FLOOR = shape("rectangle", "floor", diffuse("0.8, 0.7, 0.5"), place='<scale value="3"/>')
BOX = shape("obj", "box", '<string name="filename" value="box.obj"/> <boolean name="face_normals" value="true"/>',
            diffuse("0.2, 0.3, 0.6"), place='<scale value="0.3"/> <translate z="0.3"/>')  # fmt: skip
LAMP = shape("rectangle", "lamp", area("20, 18, 16"),
             place='<scale value="0.3"/> <rotate x="1" angle="180"/> <translate x="-1" y="0.5" z="3"/>')  # fmt: skip
CAMERA = sensor("0, -2.6, 2.6", "0, 0, 0.1", up="0, 0, 1", size=16, fov=45, id="camera", rfilter="gaussian")
SCENE = scene(
    '<default name="sensor" value="perspective"/>', CAMERA.replace('"perspective"', '"$sensor"'), FLOOR, BOX, LAMP, SPOT
)
FACES = ("1 3 2", "1 4 3", "5 6 7", "5 7 8", "1 2 6", "1 6 5", "2 3 7", "2 7 6", "3 4 8", "3 8 7", "4 1 5", "4 5 8")
CORNERS = [f"v {x} {y} {z}" for z in (-1, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {render: {spp: 512, integrator: {type: prb, max_depth: 3}, parameters: {box.translation: [0.22, -0.12, 0]}}}
parameters:
  - motion: {of: box, free: [translation]}
    learning_rate: 0.03
integrator: {type: prb_projective, max_depth: 3}
run: {iterations: 6, spp: 16, final_spp: 16}
"""
MOVED = "box.translation"


def write_mesh(folder: Path) -> None:
    (folder / "box.obj").write_text("\n".join([*CORNERS, *(f"f {face}" for face in FACES)]))


def write_experiment(folder: Path, spot: bool = False) -> Path:
    (folder / "scene.xml").write_text(SCENE if spot else SCENE.replace(SPOT, ""))
    write_mesh(folder)
    (folder / "box.yaml").write_text(CONFIG)
    return folder / "box.yaml"


def unguided(problem: Problem) -> Problem:
    """Return the problem with an integrator that builds no octree. Here the octree takes 20 s per step, and 2.7 GB."""
    plugin: Any = problem.integrator
    plugin.plugin.guiding = "none"
    return problem


def gradient(problem: Problem, spp: int = 4) -> np.ndarray:
    """Return the gradient of the box's place, of shape (3,), for a fixed dL/dI and seed."""
    weights = mi.TensorXf(np.random.default_rng(1).normal(size=(16, 16, 3)).astype(np.float32))
    known_step(problem.integrator, problem.scene, 0, weights, seed=3, spp=spp, params=problem.selection.params)
    found = np.array(problem.gradients()[MOVED]).ravel()
    problem.optimizer.clear_gradient(MOVED)
    return found


@pytest.mark.long
def test_a_box_moves_to_its_place(tmp_path: Path) -> None:
    """Camera paths render the picture. Light paths alone move the box the other way."""
    problem = find_reached(unguided(assemble(load(write_experiment(tmp_path), []))))
    records = list(optimize(problem))
    errors = [records[0].parameter_rmse, problem.selection.array(MOVED) - [0.22, -0.12, 0]]
    assert records[-1].loss < 0.5 * records[0].loss
    assert np.sqrt(np.mean(np.square(errors[1]))) < 0.8 * errors[0]


def test_steps_keep_no_memory(tmp_path: Path) -> None:
    path = write_experiment(tmp_path)

    def found(threshold: float) -> np.ndarray:
        problem = unguided(assemble_scene(load(path)))
        plugin: Any = problem.integrator
        plugin.plugin.octree_contruction_thres = threshold
        result = gradient(problem, 4)
        assert plugin.plugin.octree_contruction_thres == 0  # the step resets the earlier value
        return result

    assert np.array_equal(found(7.0), found(0.0))


#: Settings, whether a spot lamp exists, the location of the error, and a part of its text.
REFUSED = {
    "prb": (["integrator.type=prb"], False, "integrator.type", "prb_projective"),
    "lens": (["scene.options.sensor=orthographic"], False, "integrator.type", "only for perspective sensors, and"),
    "rectangle": (
        ["parameters=[{motion: {of: lamp}}]", "target.render.parameters={}"], False, "integrator.type",
        "wrong outlines of rectangles such as lamp",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_cases_of_mitsuba_are_refused(case: str, tmp_path: Path) -> None:
    sets, spot, key, what = REFUSED[case]
    with pytest.raises(ConfigError) as error:
        assemble_scene(load(write_experiment(tmp_path, spot), sets))
    assert error.value.key == key
    assert what in error.value.message


def test_correct_cases_of_mitsuba_are_accepted(tmp_path: Path) -> None:
    assert type(assemble_scene(load(write_experiment(tmp_path, True))).integrator) is Projective


def test_measurements_accept_it_like_prb(tmp_path: Path) -> None:
    [case] = parse_cases("prb_projective")
    made = case.at(load(write_experiment(tmp_path)), 2, known=False)
    assert made.integrator.type == "prb_projective"


@pytest.mark.long
def test_commands_accept_it_like_prb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The parameter is a colour, which has no silhouettes. With so few samples, a check may fail."""
    kind = "prb_projective"
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    sets = ["parameters=[{key: floor.bsdf.reflectance.value}]", "target.render.parameters={}", "integrator.max_depth=2"]
    common = ["box.yaml", *(word for each in sets for word in ("--set", each))]

    def call(command: str, *words: str) -> int:
        with pytest.raises(SystemExit) as end:
            main.main([command, *common, *words])
        return int(end.value.code or 0)

    own, passes = ["--set", f"integrator.type={kind}"], (0, ExitCode.CHECK_FAILED)
    assert call("render", *own, "-o", "a.exr", "--set", "run.spp=4") == 0
    assert call("bench", "--max-depth", "2", "--integrators", f"{kind},prb", "--json", "b.json") == 0
    words = ["--rounds", "4", "--integrators", f"{kind},prb", "--json", "c.jsonl"]
    assert call("convergence", *words) in passes
    lines = [json.loads(line) for line in Path("c.jsonl").read_text().splitlines()]
    assert kind in [line.get("label") for line in lines if line["kind"] == "method"]
    assert call("gradcheck", *own, "--integrators", "reslrb:stack", "--seeds", "3", "--spp", "16") in passes
