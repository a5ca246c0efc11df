"""Rectangles turned into grids, so that heightmaps can displace them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reslrb_cli.errors import ConfigError
from reslrb_cli.records.run_folder import read_value

ROOT = Path(__file__).parents[2]
QUAD = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
property float u
property float v
element face 2
property list uchar int vertex_indices
end_header
-1 -1 0 0 0
3 -1 0 1 0
3 1 0 1 1
-1 1 0 0 1
3 1 2 3
3 1 3 0
"""


def configured(tmp_path, heightmap, scene=None, sets=()):
    from reslrb_cli.config.loader import load

    text = (ROOT / "configs/caustic_heightmap.yaml").read_text().replace("../", f"{ROOT}/")
    path = tmp_path / "c.yaml"
    path.write_text(text)
    named = [f"scene.file={scene}"] if scene else []
    return load(path, [f"parameters=[{{heightmap: {{{heightmap}}}}}]", "target={render: {spp: 4}}", *named, *sets])


def positions(problem):
    return np.array(problem.selection.params["back.vertex_positions"]).reshape(-1, 3)


def test_a_rectangle_becomes_a_grid_from_edge_to_edge(tmp_path):
    from reslrb_cli.optimization.assemble import assemble_scene, load_for_rendering

    plain = load_for_rendering(configured(tmp_path, "mesh: face, resolution: [4, 4]"), initial=False)[0]
    [before] = [shape for shape in plain.shapes() if shape.id() == "back"]
    problem = assemble_scene(configured(tmp_path, "mesh: back, resolution: [5, 4], grid: [9, 7]"))
    [back] = [shape for shape in problem.scene.shapes() if shape.id() == "back"]
    assert back.vertex_count() == 63
    assert np.allclose([back.bbox().min, back.bbox().max], [before.bbox().min, before.bbox().max], atol=1e-5)
    assert np.allclose(back.surface_area(), before.surface_area(), rtol=1e-5)
    assert back.bsdf().id() == before.bsdf().id()
    uv = np.array(back.vertex_texcoords_buffer()).reshape(7, 9, 2)
    assert np.allclose(uv[0, :, 0], (np.arange(9) + 0.5) / 9)
    assert np.allclose(uv[:, 0, 1], (np.arange(7) + 0.5) / 7)
    flat = positions(problem)
    problem.selection.set_arrays({"back.heightmap": np.full((4, 5, 1), 0.01, np.float32)})
    import mitsuba as mi

    outward = np.array(mi.traverse(plain)["back.to_world"].matrix).reshape(4, 4)[:3, 2]
    assert np.allclose(positions(problem) - flat, 0.01 * outward / np.linalg.norm(outward), atol=1e-5)


@pytest.fixture
def with_quad(tmp_path):
    (tmp_path / "quad.ply").write_text(QUAD)
    xml = (ROOT / "scenes/caustic_heightmap/scene.xml").read_text()
    begin = xml.index('<shape type="rectangle" id="back">')
    end = xml.index("</shape>", begin)
    quad = """<shape type="ply" id="back"><string name="filename" value="quad.ply"/>
        <transform name="to_world"><scale x="2"/><translate z="-1"/></transform><ref id="glass"/>"""
    path = tmp_path / "scene.xml"
    folder = ROOT / "scenes/caustic_heightmap"
    xml = (xml[:begin] + quad + xml[end:]).replace('value="face', f'value="{folder}/face')
    path.write_text(xml)
    return path


def test_other_shapes_are_refused_and_missing_grids_reported(tmp_path, with_quad):
    from reslrb_cli.optimization.assemble import assemble_scene

    with pytest.raises(ConfigError, match=r"parameters\[0\].heightmap.grid: `back` is not a `rectangle`"):
        assemble_scene(configured(tmp_path, "mesh: back, resolution: [4, 4], grid: 9", with_quad))
    with pytest.raises(ConfigError, match=r"`back` is a Rectangle.*`grid: 257`"):
        assemble_scene(configured(tmp_path, "mesh: back, resolution: [4, 4]"))
    with pytest.raises(ConfigError, match=r"heightmap.grid: must be at least 2"):
        configured(tmp_path, "mesh: back, resolution: [4, 4], grid: 1")


@pytest.mark.long
def test_a_run_on_a_grid_is_exported_and_continued(tmp_path, monkeypatch):
    import mitsuba as mi
    from click.testing import CliRunner

    from reslrb_cli.cli import main

    monkeypatch.chdir(tmp_path)
    configured(tmp_path, "mesh: back, resolution: [4, 4], grid: 5")  # writes the file
    sets = ["parameters=[{heightmap: {mesh: back, resolution: [4, 4], grid: 5}, "
            "regularizers: [{type: total_variation, weight: 1e-3}, {type: thickness, thickness: 0.05, least: 0.1}]}]",
            "target={render: {spp: 4}}", "scene.size=[8,8]", "run.spp=4", "run.final_spp=4",
            "optimizer={type: sgd, learning_rate: 0.003}"]  # fmt: skip

    def call(*words):
        result = CliRunner().invoke(main, [str(word) for word in words])
        assert result.exit_code == 0, result.output
        return result.output

    def optimize(name, iterations):
        options = [word for line in [*sets, f"run.iterations={iterations}"] for word in ("--set", line)]
        return call("optimize", "c.yaml", *options, "--set", f"run.name={name}")

    told = optimize("run", 2)
    assert "thickness of back.heightmap" in told
    assert "regularizer of back.heightmap" in (tmp_path / "runs/run/report.html").read_text()
    optimize("whole", 4)
    call("optimize", "--resume", "runs/run", "--set", "run.iterations=4")
    heights = [read_value(tmp_path / "runs" / name, "back.heightmap") for name in ("run", "whole")]
    assert np.array_equal(*heights)
    assert np.ptp(heights[0]) > 0
    call("export", "runs/run", "-o", "out")
    scene = mi.load_file(str(tmp_path / "out/scene.xml"), optimize=False)
    [back] = [shape for shape in scene.shapes() if shape.id() == "back"]
    assert back.vertex_count() == 25
    assert not list((tmp_path / "out").rglob("grid_*"))
