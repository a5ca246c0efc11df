"""What goes on from runs whose cameras come from a file, and that recovered a relief: `render --run` and `export`."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from click.testing import CliRunner, Result

from reslrb_cli.cli import main
from reslrb_cli.cli.options import read_recovered
from reslrb_cli.config.loader import load
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.records.images import load_image
from reslrb_cli.records.run_folder import read_value

pytestmark = pytest.mark.usefixtures("llvm")
SIZE = 12
#: A sheet of 5x5 corners over a lamp's light; the cameras of the file replace this one.
SCENE = """<scene version="3.0.0">
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/>
        <string name="pixel_format" value="rgb"/><rfilter type="gaussian"/></film></sensor>
    <shape type="obj" id="sheet"><string name="filename" value="sheet.obj"/>
        <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.6, 0.5, 0.4"/></bsdf></bsdf></shape>
    <shape type="rectangle" id="lamp">
        <transform name="to_world"><rotate x="1" angle="180"/><scale value="0.4"/><translate x="1.5" z="2"/></transform>
        <emitter type="area"><rgb name="radiance" value="8, 8, 8"/></emitter>
    </shape>
</scene>
"""
CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml, cameras: transforms.json, sensors: all}
parameters:
  - {heightmap: {mesh: sheet, resolution: [4, 4]}, bounds: [-0.3, 0.3], learning_rate: 0.03}
  - {key: sheet.bsdf.brdf_0.reflectance.value, initial: 0.5, bounds: [0, 1], learning_rate: 0.05}
integrator: {type: reslrb, max_depth: 3, estimator: stack}
target: {exposure: [1, 0.9]}
run: {iterations: 6, spp: 16, reach_spp: 8, final_spp: 4, held_out: [right]}
"""
EYES = ((-0.8, 0.0, 3.5), (0.9, 0.5, 3.2))


def reslrb(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def look_at_origin(eye: tuple[float, ...]) -> list[list[float]]:
    """A camera's pose in `transforms.json`: it looks along its -z, with y upwards."""
    z = np.array(eye) / np.linalg.norm(eye)
    x = np.cross([0, 1, 0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.column_stack([x, np.cross(z, x), z, eye])
    return [[float(number) for number in row] for row in pose]


def write_sheet(path: Path) -> None:
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)))
    corners = [k for k in range(20) if k % 5 < 4]
    lines = [f"v {a:g} {b:g} 0" for a, b in zip(x, y, strict=True)]
    lines += [f"vt {(a + 1) / 2:g} {(b + 1) / 2:g}" for a, b in zip(x, y, strict=True)]
    faces = [face for k in corners for face in ((k, k + 1, k + 5), (k + 1, k + 6, k + 5))]
    lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in faces]
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, llvm: str) -> Path:
    """A finished run with two cameras, `left` and `right`, whose images are of a sheet that bulges."""
    folder = tmp_path_factory.mktemp("other-runs")
    write_sheet(folder / "sheet.obj")
    (folder / "scene.xml").write_text(SCENE)
    (folder / "box.yaml").write_text(CONFIG)
    frames = [
        {"file_path": f"{name}.exr", "transform_matrix": look_at_origin(eye)}
        for name, eye in zip(("left", "right"), EYES, strict=True)
    ]
    shared = {"w": SIZE, "h": SIZE, "fl_x": 18.0, "fl_y": 18.0, "cx": SIZE / 2, "cy": SIZE / 2}
    (folder / "transforms.json").write_text(json.dumps({**shared, "frames": frames}))
    shade = np.linspace(0.1, 0.6, SIZE, dtype=np.float32)[None, :, None]
    for name in ("left", "right"):
        mi.Bitmap(np.broadcast_to(shade, (SIZE, SIZE, 3)).copy()).write(str(folder / f"{name}.exr"))
    result = reslrb("optimize", folder / "box.yaml", "--set", f"run.output={folder}/runs")
    assert result.exit_code == 0, result.output
    return folder / "runs/box"


#: The second camera's view is held out; the first one's is as any other.
SENSORS = pytest.mark.parametrize("sensor", [pytest.param(0, marks=pytest.mark.long), 1])


@SENSORS
def test_each_camera_is_rendered_with_the_relief(run: Path, tmp_path: Path, sensor: int) -> None:
    heights = read_value(run, "sheet.heightmap")
    assert np.abs(heights).max() > 0.05, "it never rose, so this would show nothing"
    file = tmp_path / "image.exr"
    done = reslrb("render", "--run", run, "--sensor", sensor, "--spp", 256, "--set", "run.seed=3", "-o", file)
    assert done.exit_code == 0, done.output
    image = load_image(file)
    assert image.shape == (SIZE, SIZE, 3)
    recovered, begun = (assemble_scene(config) for config in (read_recovered(run, ()), load(run / "config.yaml")))
    own, first = (np.stack([one.render(sensor, 16, k, "test").mean() for k in range(16)]) for one in (recovered, begun))
    error = own.std(ddof=1) * np.sqrt(2 / len(own))  # the image has as many samples as all of these
    far = np.abs(np.array([own.mean(), first.mean()]) - image.mean()) / error
    assert far[0] < 3 < far[1], (image.mean(), own, first)


@pytest.mark.long
@SENSORS
def test_mitsuba_sees_the_relief_from_each_camera(run: Path, tmp_path: Path, sensor: int) -> None:
    done = reslrb("export", run, "-o", tmp_path / "exported")
    assert done.exit_code == 0, done.output
    theirs = mi.load_file(str(tmp_path / "exported/scene.xml"))
    assert len(theirs.sensors()) == 2
    recovered, begun = (assemble_scene(config) for config in (read_recovered(run, ()), load(run / "config.yaml")))
    own, first = (np.stack([one.render(sensor, 64, k, "test") for k in range(16)]) for one in (recovered, begun))
    found = np.stack([np.array(mi.render(theirs, sensor=sensor, spp=64, seed=seed)) for seed in range(16)])
    result = compare(own, found)
    assert result, result
    assert not compare(first, found)
