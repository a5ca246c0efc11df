"""Planted faults that give non-finite values, and the behaviour of the run."""

from __future__ import annotations

import json
import re
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from cli.tiny import manifest, outcome, settings
from kit import TEXTURE, area, ref, scene, sensor, shape

from reslrb_cli.optimization import losses

SCENE = scene(
    '<default name="format" value="rgb"/> <default name="power" value="8"/> <default name="wall" value="wall.exr"/>',
    sensor(id="camera", pixels="$format"), '<bsdf type="diffuse" id="poster">REFLECTANCE</bsdf>',
    f'<bsdf type="diffuse" id="wall">{TEXTURE.format("$wall")}</bsdf>',
    shape("rectangle", "poster_shape", ref("poster"), place='<translate z="0"/>'),
    shape("rectangle", "wall_shape", ref("wall"), place='<scale value="4"/><translate z="-1"/>'),
    shape("rectangle", "lamp", area("$power, $power, $power", "light"),
          place='<rotate x="1" angle="180"/><translate z="5"/>'),
)  # fmt: skip
PLAIN = '<rgb name="reflectance" value="0.6, 0.5, 0.4"/>'

CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {file: target.exr}
parameters: [{key: poster.reflectance.value, initial: 0.5, bounds: [0, 1]}]
integrator: {type: reslrb, max_depth: 4, estimator: stack}
optimizer: {learning_rate: 0.01}
run: {iterations: 3, spp: 16, seed: 5, adjoint: correlated}
"""
KEY = "poster.reflectance.value"


def write_spoilt(folder):
    """Write a scene, textures, a target and a configuration."""
    import mitsuba as mi

    wall = np.full((8, 8, 3), 0.5, np.float32)
    mi.Bitmap(wall).write(str(folder / "wall.exr"))
    wall[4, 1, 1] = np.nan
    mi.Bitmap(wall).write(str(folder / "spoilt.exr"))
    mi.Bitmap(np.full((8, 8, 3), 0.2, np.float32)).write(str(folder / "target.exr"))
    (folder / "scene.xml").write_text(SCENE.replace("REFLECTANCE", PLAIN))
    (folder / "config.yaml").write_text(CONFIG)


@pytest.fixture
def spoilt_experiment(llvm, tmp_path, monkeypatch):
    """Working directory with a scene, textures, a target and a configuration."""
    write_spoilt(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def optimize(*sets, code=5):
    """Run `optimize`, check the exit code, and return its output and errors."""
    found, out, err = outcome("optimize", "config.yaml", *settings(*sets))
    assert found == code, err
    assert "Traceback" not in err
    return out, err


STOP = "run.on_nonfinite=stop"


def test_a_nan_texel(spoilt_experiment):
    _, err = optimize(STOP, "scene.options={wall: spoilt.exr, format: rgba}")
    assert re.search(r"not finite in iteration 0: .*the first at pixel \(\d, \d\), channel 1, of sensor 0", err)


def test_a_non_finite_derivative(spoilt_experiment):
    """The reflectance is 0.5 + sqrt(x), and x is 0."""
    _register_root()
    Path("scene.xml").write_text(SCENE.replace("REFLECTANCE", '<texture type="root" name="reflectance"/>'))
    _, err = optimize(STOP, "parameters=[{key: poster.reflectance.x, initial: 0.0, bounds: [0, 1]}]")
    assert "the gradient of poster.reflectance.x in 1 entry" in err


def _register_root():
    import mitsuba as mi

    class Root(mi.Texture):
        def __init__(self, props):
            super().__init__(props)
            self.x = mi.Float(0)

        def eval(self, si, active=True):
            return mi.Color3f(0.5 + dr.sqrt(self.x))

        def traverse(self, callback):
            callback.put("x", self.x, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys):
            pass

        def mean(self):
            return mi.Float(0.5)

    mi.register_texture("root", Root)


def root_of_pixel(image, target, weights=None):
    """Return a loss with a finite value. One entry of its derivative is not finite."""
    import drjit as dr

    index = (3 * 8 + 5) * 3 + 1
    entry = dr.gather(type(image.array), image.array, index, True, dr.ReduceMode.Permute)
    return losses.l2(image, target) + dr.sum(dr.sqrt(entry - dr.detach(entry)))


@pytest.mark.parametrize("kind", ["stop", "skip", "zero"])
def test_a_loss_with_a_non_finite_derivative(spoilt_experiment, monkeypatch, kind):
    monkeypatch.setitem(losses.LOSSES, "l2", root_of_pixel)
    out, err = optimize(f"run.on_nonfinite={kind}", code=5 if kind == "stop" else 0)
    assert "dL/dI in 1 entry, the first at pixel (5, 3), channel 1, of sensor 0" in err
    assert kind == "stop" or "3 values not finite in 3 iterations" in out.splitlines()[-1]
    assert err.count("not finite in iteration") == 1, "only the first is printed"
    moved = np.load("runs/config/parameters/parameters.npz")[KEY] != 0.5
    assert moved.all() if kind == "zero" else not moved.any()


def test_finished_work_is_kept(spoilt_experiment, monkeypatch):
    """After a fault in the second iteration, the run folder is complete and holds the parameters of that iteration."""
    calls = []

    def sometimes(image, target, weights=None):
        calls.append(1)
        # The first call is for the saved initial image, and the third and fourth for a black image and the target.
        return root_of_pixel(image, target) if len(calls) == 5 else losses.l2(image, target)

    monkeypatch.setitem(losses.LOSSES, "l2", sometimes)
    _, err = optimize(STOP)
    folder = Path("runs/config")
    result = manifest("runs/config")
    assert (result["status"], result["results"]["iterations"]) == ("failed", 2)
    assert result["error"] == err.splitlines()[-1]
    assert result["results"]["nonfinite"] == {"iterations": 1, "values": 1, "by_parameter": {}}
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [record["nonfinite"] for record in records] == [0, 1]
    with np.load(folder / "parameters/parameters.npz") as last:
        assert (last[KEY] != 0.5).all()
    assert "1 values were not finite" in (folder / "report.html").read_text()
