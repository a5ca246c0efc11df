"""`optimize`, `render` and `inspect` on small scenes: one view and several, textures, and parameters that move
light.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from cli.tiny import done, outcome, read_metrics, reslrb, settings, write_experiment
from cli.tiny import manifest as manifest_of
from kit import POSTER_BSDF, area, diffuse, ref, scene, sensor, shape
from optimization import glass
from turns import a_few

# `reslrb optimize`, `render` and `inspect` on a scene of three surfaces, from the command line to the run folder.

SCENE = scene(
    sensor(size=16, id="camera"), sensor("1, 0, 4", size=(12, 8), id="second"),
    POSTER_BSDF, diffuse("0.5, 0.4, 0.3", "wall"), shape("rectangle", "poster_shape", ref("poster")),
    shape("rectangle", "wall_shape", ref("wall"), place='<scale value="4"/><translate z="-1"/>'),
    shape("rectangle", "lamp", area("8, 8, 8", "light"), place='<rotate x="1" angle="180"/><translate z="5"/>'),
)  # fmt: skip

CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {render: {spp: 512}}
parameters:
  - {key: poster.reflectance.data, initial: 0.5, bounds: [0, 1]}
integrator: {type: ptracer, max_depth: 3}
optimizer: {learning_rate: 0.05}
run: {iterations: 25, spp: 16}
"""

FOLDER = [
    "checkpoint", "config.yaml", "images", "manifest.json", "metrics.jsonl", "parameters", "report.html",
    "run.log",
]  # fmt: skip
KEY = "poster.reflectance.data"


def write_box(folder):
    """Write the scene and its configuration. Returns the scene's texture (4, 4, 3)."""
    import mitsuba as mi

    texture = np.random.default_rng(2).uniform(0.1, 0.9, (4, 4, 3)).astype(np.float32)
    mi.Bitmap(texture).write(str(folder / "poster.exr"))
    (folder / "scene.xml").write_text(SCENE)
    (folder / "box.yaml").write_text(CONFIG)
    return texture


@pytest.fixture
def experiment(llvm, tmp_path, monkeypatch):
    """Texture of shape (4, 4, 3). The working directory holds its scene and a configuration."""
    monkeypatch.chdir(tmp_path)
    return write_box(tmp_path)


def names(folder):
    return sorted(path.name for path in Path(folder).iterdir())


def test_a_texture_is_recovered(experiment):
    import mitsuba as mi

    sets = ["--set", "integrator.type=reslrb", "--set", "run.iterations=40", "--set", "optimizer.schedule=cosine"]
    sets += ["--set", "run.adjoint=independent"]  # at 16 spp the noise of `correlated` would bias the albedo
    code, out, err = outcome("optimize", "box.yaml", *sets)
    assert code == 0, err
    last = out.splitlines()[-1]
    assert "runs/box/report.html" in last
    assert "Traceback" not in err

    assert names("runs/box") == FOLDER
    records = read_metrics("runs/box")
    assert [record["iteration"] for record in records] == list(range(40))
    manifest = manifest_of("runs/box")
    assert (manifest["status"], manifest["variant"], manifest["seed"]) == ("finished", "llvm_ad_rgb", 0)
    errors = manifest["results"]["parameter_rmse"][KEY]
    assert errors["initial"] == pytest.approx(records[0]["parameter_rmse"])
    assert errors["final"] < 0.4 * errors["initial"]

    mask = np.load(f"runs/box/parameters/{KEY}.mask.npy")
    assert mask.shape == (4, 4)
    assert mask.all()
    recovered = np.array(mi.Bitmap(f"runs/box/parameters/{KEY}.exr"))
    rmse = np.sqrt(np.mean((recovered - experiment)[mask] ** 2))
    assert rmse == pytest.approx(errors["final"], rel=1e-4)
    images = [f"{name}.{suffix}" for name in ("final", "initial", "target") for suffix in ("exr", "png")]
    assert names("runs/box/images") == ["comparison.exr", "error.png", *images]
    assert np.array(mi.Bitmap("runs/box/images/final.exr")).shape == (16, 16, 3)


@pytest.mark.long  # test_going_on.py has runs with scale and transform
def test_a_texture_is_recovered_with_a_transform(experiment):
    sets = ["run.iterations=40", "run.adjoint=independent", "optimizer={type: sgd, scale: curvature}"]
    sets += ["parameters[0].transform=sigmoid", "integrator={type: reslrb, max_depth: 3, estimator: stack}"]
    code, _, err = outcome("optimize", "box.yaml", *(word for each in sets for word in ("--set", each)))
    assert code == 0, err
    assert f"scale curvature: {KEY} moves by about" in err
    manifest, records = manifest_of("runs/box"), read_metrics("runs/box")
    errors = manifest["results"]["parameter_rmse"][KEY]
    assert errors["initial"] == pytest.approx(np.sqrt(np.mean((experiment - 0.5) ** 2)), rel=1e-5)
    assert errors["final"] < 0.4 * errors["initial"]
    [scaling] = manifest["scaling"]
    assert (scaling["key"], scaling["value"]) == (KEY, 0.5)
    # The elapsed time includes the measurements before the first iteration
    assert records[0]["elapsed_s"] > 1e-3 * records[0]["step_ms"] * 2
    # All written values are in the scene's units
    with np.load("runs/box/checkpoint/state.npz") as state, np.load("runs/box/parameters/parameters.npz") as values:
        np.testing.assert_array_equal(state[f"parameter/{KEY}"], values[KEY])
        assert np.sqrt(np.mean((values[KEY] - experiment) ** 2)) == pytest.approx(errors["final"], rel=1e-4)
        assert f"optimizer/{KEY}/variable" in state


def test_saved_files_of_a_run_agree(experiment):
    assert outcome("optimize", "box.yaml", "--set", "run.iterations=3")[0] == 0
    with np.load("runs/box/checkpoint/state.npz") as state, np.load("runs/box/parameters/parameters.npz") as values:
        np.testing.assert_array_equal(state[f"parameter/{KEY}"], values[KEY])
        assert int(state["iteration"]) == 3
    page = Path("runs/box/report.html").read_text()
    for text in ("<svg", "data:image/png;base64", "finished", "target", "llvm_ad_rgb"):
        assert text in page
    # The resolved configuration can be run again from any folder
    again = ("optimize", "runs/box/config.yaml", "--set", "run.iterations=1", "--quiet")
    assert outcome(*again)[0] == 0
    first, repeated = (read_metrics(folder)[0]["loss"] for folder in ("runs/box", "runs/box-2"))
    assert first == pytest.approx(repeated, rel=1e-5)  # threads add values in any order
    assert names("runs") == ["box", "box-2", "latest"]
    assert os.readlink("runs/latest") == "box-2"


def test_a_target_without_light_is_refused(experiment):
    """If one of two sensors looks away, the run prints a warning. If all sensors look away, the program refuses the
    run.
    """
    away = SCENE.replace('origin="1, 0, 4" target="0, 0, 0"', 'origin="1, 0, 4" target="9, 0, 4"')
    Path("scene.xml").write_text(away.replace('<float name="fov" value="50"/>', '<float name="fov" value="20"/>'))
    sets = ["--set", "run.iterations=1", "--set"]
    code, _, err = outcome("optimize", "box.yaml", *sets, "views=[{sensor: 0}, {sensor: 1}]")
    assert code == 0
    assert "the target of sensor 1 is black everywhere" in err
    code, _, err = outcome("optimize", "box.yaml", *sets, "views=[{sensor: 1}]")
    assert code == 2
    assert err.splitlines()[-1].startswith("box.yaml: target: the image of sensor 1 is black everywhere: no light")


def test_a_target_file_gives_no_parameter_error(experiment):
    assert outcome("render", "box.yaml", "--scene", "-o", "target.exr", "--set", "run.spp=64")[0] == 0
    Path("file.yaml").write_text(CONFIG.replace("{render: {spp: 512}}", "{file: target.exr}"))
    assert outcome("optimize", "file.yaml", "--set", "run.iterations=2")[0] == 0
    records = read_metrics("runs/file")
    assert records[0]["parameter_rmse"] is None
    assert manifest_of("runs/file")["results"]["parameter_rmse"] == {}


@pytest.mark.long  # test_kernels.py counts the kernels of later steps
def test_later_iterations_compile_nothing(experiment):
    import drjit as dr

    from reslrb_cli.config.loader import load
    from reslrb_cli.optimization import loop
    from reslrb_cli.optimization.assemble import assemble
    from reslrb_cli.records.clock import StepClock

    problem = assemble(load("box.yaml", ["run.iterations=1", "integrator={type: reslrb}"]))
    misses, clock = [], StepClock()
    for iteration in range(4):
        with clock.step() as step:
            dr.eval(loop.gradient(problem, iteration))
        with clock.step() as update:
            problem.optimizer.step(0.9**iteration)
            problem.apply()
        misses.append((step.new_kernels, update.new_kernels))
    # The recordings left zeros in the gradients, and the first step added to these zeros. This addition needs two
    # one-line kernels.
    assert misses.pop(1)[0] <= 2
    assert misses[1:] == [(0, 0)] * 2


BAD = [
    ("run.output=blocked", "run.output"),
    ("views=[{sensor: 7}]", "views[0].sensor"),
    ("parameters[0].key=poster.reflectance.dta", "parameters[0].key"),
    ("parameters[0].key=poster_shape.to_world", "parameters[0].key"),
    ("parameters[0].initial=[0.1, 0.2]", "parameters[0].initial"),
    ("parameters[0].bounds=[0.6, 1]", "parameters[0].initial"),
    ("target={file: scene.xml}", "target.file"),
    ("target={file: poster.exr}", "target.file"),
    ("target.render.parameters={nothing.value: 1}", "target.render.parameters.nothing.value"),
]


def refused(setting):
    """Return the only line of a run that is refused and makes no folder."""
    code, out, err = outcome("optimize", "box.yaml", "--set", setting, "--quiet")
    lines = [line for line in err.splitlines() if not line.startswith("variant ")]
    assert (code, out, len(lines)) == (2, "", 1), err
    assert not Path("runs").exists()
    return lines[0]


@pytest.mark.parametrize(("setting", "where"), BAD)
def test_bad_input_is_one_located_line_and_no_run_folder(experiment, setting, where):
    Path("blocked").write_text("a file, not a folder")
    assert where in refused(setting)
    assert Path("blocked").is_file()


CAMERA = '<sensor type="perspective" id="camera">\n        <float name="fov" value="50"/>'
PARALLEL = '<sensor type="orthographic" id="camera">'
LIGHT = '<emitter type="area" id="light"><rgb name="radiance" value="8, 8, 8"/></emitter>'
POSTER = '<shape type="rectangle" id="poster_shape">'
PANE = '<shape type="cube"><transform name="to_world"><translate z="4"/></transform><bsdf type="dielectric"/></shape>'
FOG = '<shape type="sphere"><bsdf type="null"/><medium name="interior" type="homogeneous"/></shape>'
#: For each name: the replaced text of the scene, the new text, the integrator, and a part of the error line.
BAD_SCENES = {
    "orthographic": (CAMERA, PARALLEL, "{type: reslrb, paths: light}", "OrthographicCamera"),
    "glass alone": (POSTER, PANE + POSTER, "{type: reslrb, paths: light}", "specular"),
    "light for prb": ('type="area" id="light"', 'type="directionalarea" id="light"', "{type: prb}", "directionalarea"),
    "no light": (LIGHT, "", "{type: reslrb}", "no emitters"),
    "medium": (POSTER, FOG + POSTER, "{type: reslrb}", "medium"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_SCENES)
def test_scenes_that_cannot_work_are_refused_before_rendering(experiment, name):
    part, other, setting, reason = BAD_SCENES[name]
    assert part in SCENE
    Path("scene.xml").write_text(SCENE.replace(part, other))
    line = refused(f"integrator={setting}")
    assert line.startswith("box.yaml: scene.file: ") or "/scene.xml: " in line
    assert reason in line


@pytest.mark.parametrize("name", a_few(["orthographic", "glass alone"], ["orthographic"]))
def test_camera_paths_render_scenes_that_light_paths_cannot(experiment, name):
    """The default `paths: auto` then selects `camera` or `both`."""
    part, other, *_ = BAD_SCENES[name]
    Path("scene.xml").write_text(SCENE.replace(part, other))
    small = settings("run.iterations=2", "run.certainty=false", "integrator={type: reslrb, max_depth: 4}")
    done("optimize", "box.yaml", *small, "--quiet")


def test_a_render_is_written_and_bad_outputs_are_refused(experiment):
    import mitsuba as mi

    code, out, _ = outcome("render", "box.yaml", "-o", "small.png", "--sensor", 1, "--set", "run.spp=8")
    assert code == 0
    assert "small.png: 12x8" in out
    assert np.array(mi.Bitmap("small.png")).dtype == np.uint8
    for output in ("image.tiff3", "nowhere/image.exr", "."):
        code, _, err = outcome("render", "box.yaml", "-o", output)
        assert (code, len(err.splitlines())) == (2, 1)
    assert outcome("render", "box.yaml", "-o", "x.exr", "--sensor", 9)[0] == 2
    assert not Path("x.exr").exists()


# Whole runs with several views, from the command line to the manifest and the page.


def test_a_run_reports_its_views(llvm, tmp_path, monkeypatch):
    """The manifest, `images/` and the page contain the mask, the exposure and the shares."""
    import mitsuba as mi

    write_experiment(tmp_path)
    pixels = np.random.default_rng(3).integers(20, 200, (8, 8, 3), dtype=np.uint8)
    pixels[2, 3] = 255
    mi.Bitmap(pixels).write(str(tmp_path / "photo.png"))
    monkeypatch.chdir(tmp_path)
    sets = settings(
        "target={file: photo.png, color_space: linear, exposure: 0.8}", "run.iterations=1", "run.final_spp=4"
    )
    said = done("optimize", "tiny.yaml", *sets).stderr
    [view] = manifest_of("runs/tiny")["views"]
    assert (view["kinds"], view["left_out"], view["exposure"]) == ({"clipped": 1}, 1, 0.8)
    assert "view 0: 1 of 64 pixels (1.6%) are left out: 1 are clipped" in said
    target = np.array(mi.Bitmap("runs/tiny/images/target.exr"))
    assert np.allclose(target[:, :, :3], pixels / 255, atol=2e-3)
    weights = np.array(mi.Bitmap("runs/tiny/images/weights.exr"))
    assert np.argwhere(weights[:, :, 0] == 0).tolist() == [[2, 3]]
    page = Path("runs/tiny/report.html").read_text()
    assert "1 of 64" in page
    assert "black is left out of the loss" in page
    assert "0.8" in page[page.index("pixels left out") :]


# Runs whose parameters move light, from the command line to the run folder.

PARAMETERS = (
    "parameters=[{motion: {of: lamp, free: [translation]}, learning_rate: 0.02}, {key: slab.vertex_positions, "
    "learning_rate: 1e-3}, {heightmap: {mesh: slab, resolution: [3, 2]}}]"
)


def test_moving_parameters_are_recorded_by_name(tmp_path, llvm):
    motion = "{motion: {of: lamp, free: [translation]}, learning_rate: 0.02, bounds: [-0.01, 0.01]}"
    heightmap = "{heightmap: {mesh: slab, resolution: [3, 2]}, learning_rate: 1e-3}"
    sets = settings(f"run.output={tmp_path / 'runs'}", f"parameters=[{motion}, {heightmap}]")
    done("optimize", glass.write_experiment(tmp_path), "--quiet", *sets)
    folder = tmp_path / "runs" / "glass"
    stored = json.loads((folder / "parameters" / "parameters.json").read_text())
    assert list(stored) == ["lamp.translation", "slab.heightmap"]
    assert np.abs(stored["lamp.translation"]["value"]).max() == pytest.approx(0.01)  # the motion's bounds
    assert stored["slab.heightmap"] == {"shape": [2, 3, 1], "file": "slab.heightmap.exr"}
    true = json.loads((folder / "parameters" / "true" / "parameters.json").read_text())
    assert np.allclose(true["lamp.translation"]["value"], [0.05, 0.1, -0.05])
    records = read_metrics(folder)
    assert list(records[-1]["parameter_errors"]) == ["lamp.translation", "slab.heightmap"]
    assert records[-1]["parameter_errors"]["lamp.translation"] < records[0]["parameter_errors"]["lamp.translation"]
    assert records[-1]["nonfinite"] == 0
    page = (folder / "report.html").read_text()
    assert "lamp.<wbr>translation" in page or "lamp.translation" in page


@pytest.mark.parametrize(
    ("override", "line"),
    [
        (PARAMETERS, "parameters[2].heightmap.mesh: `slab.vertex_positions` is already recovered by parameters[1]"),
        ("integrator.estimator=event", "integrator.estimator: estimator event has no derivatives of moving light"),
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
    result = reslrb("optimize", path, "--set", override)
    assert result.exit_code == 2
    assert line in result.output
    assert "Traceback" not in result.output


def test_inspect_marks_moving_edges(tmp_path, llvm):
    path = glass.write_experiment(tmp_path)
    parameters = "parameters=[{motion: {of: [slab, lamp]}}]"
    output = done("inspect", path, "--set", parameters).output
    assert "can be moved: 5" in output
    assert "by motion and heightmap: slab" in output
    assert "silhouettes and shadow edges move with slab" in output
    assert "edges move with lamp" not in output
