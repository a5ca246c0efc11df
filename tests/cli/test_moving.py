"""Runs whose parameters move light, from the command line to the run folder."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from optimization import glass

from reslrb_cli.cli import main

PARAMETERS = (
    "parameters=[{motion: {of: lamp, free: [translation]}, learning_rate: 0.02}, {key: slab.vertex_positions, "
    "learning_rate: 1e-3}, {heightmap: {mesh: slab, resolution: [3, 2]}}]"
)


def optimize(tmp_path, *sets):
    path = glass.write_experiment(tmp_path)
    sets = [word for override in (f"run.output={tmp_path / 'runs'}", *sets) for word in ("--set", override)]
    return main.main(["optimize", str(path), "--quiet", *sets], standalone_mode=False)


def test_what_moves_is_recorded_by_its_names(tmp_path, llvm, capsys):
    motion = "{motion: {of: lamp, free: [translation]}, learning_rate: 0.02, bounds: [-0.01, 0.01]}"
    heightmap = "{heightmap: {mesh: slab, resolution: [3, 2]}, learning_rate: 1e-3}"
    assert optimize(tmp_path, f"parameters=[{motion}, {heightmap}]") == 0
    folder = tmp_path / "runs" / "glass"
    stored = json.loads((folder / "parameters" / "parameters.json").read_text())
    assert list(stored) == ["lamp.translation", "slab.heightmap"]
    assert np.abs(stored["lamp.translation"]["value"]).max() == pytest.approx(0.01)  # its bounds
    assert stored["slab.heightmap"] == {"shape": [2, 3, 1], "file": "slab.heightmap.exr"}
    true = json.loads((folder / "parameters" / "true" / "parameters.json").read_text())
    assert np.allclose(true["lamp.translation"]["value"], [0.05, 0.1, -0.05])
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert list(records[-1]["parameter_errors"]) == ["lamp.translation", "slab.heightmap"]
    assert records[-1]["parameter_errors"]["lamp.translation"] < records[0]["parameter_errors"]["lamp.translation"]
    assert records[-1]["nonfinite"] == 0
    page = (folder / "report.html").read_text()
    assert "lamp.<wbr>translation" in page or "lamp.translation" in page


@pytest.mark.long
def test_vertices_are_a_parameter_like_others(tmp_path, llvm):
    key = "slab.vertex_positions"
    sets = (f"parameters=[{{key: {key}}}]", "target.render.parameters={}", "optimizer.learning_rate=1e-3")
    assert optimize(tmp_path, *sets) == 0
    with np.load(tmp_path / "runs" / "glass" / "parameters" / "parameters.npz") as last:
        moved = last[key]
    with np.load(tmp_path / "runs" / "glass" / "parameters" / "initial" / "parameters.npz") as first:
        assert 1e-4 < np.abs(moved - first[key]).max() < 0.1


@pytest.mark.parametrize(
    ("override", "line"),
    [
        (PARAMETERS, "parameters[2].heightmap.mesh: `slab.vertex_positions` is what parameters[1] recovers"),
        ("integrator.estimator=event", "integrator.estimator: estimator event has no derivatives of what moves light"),
        ("scene.options.filter=box", "scene.file: sensor camera has a box filter"),
        ("parameters[0].motion.of=nothing", "parameters[0].motion.of: there is no `nothing` in the scene"),
        (
            "target.render.parameters={lamp.rotation: 3}",
            "parameters.lamp.rotation: `lamp.rotation` belongs",
        ),
    ],
)
def test_errors_are_one_located_line(tmp_path, llvm, override, line):
    path = glass.write_experiment(tmp_path)
    result = CliRunner().invoke(main, ["optimize", str(path), "--set", override])
    assert result.exit_code == 2
    assert line in result.output
    assert "Traceback" not in result.output


def test_inspect_says_whose_edges_move(tmp_path, llvm):
    path = glass.write_experiment(tmp_path)
    parameters = "parameters=[{motion: {of: [slab, lamp]}}]"
    output = CliRunner().invoke(main, ["inspect", str(path), "--no-counts", "--set", parameters]).output
    assert "can be moved: 5" in output
    assert "by motion and heightmap: slab" in output
    assert "silhouettes and shadow edges of slab are not in its derivatives" in output
    assert "edges of lamp" not in output
