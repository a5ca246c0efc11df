"""Kept results of an experiment depend on the contents of all files that the experiment reads, not on their times and
sizes.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from cli.tiny import KEY

import reslrb_cli as rl
from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble, assemble_scene
from reslrb_cli.optimization.autotune.sampling import situation
from reslrb_cli.records.decisions import DecisionCache, key_of
from reslrb_cli.runs.sweep import make_plan, resumed, started
from reslrb_cli.scene.files import files_of

#: Each text contains a number that tests change from 0.25 to 0.75, so that the size stays the same.
LIGHTS = """<scene version="3.0.0">
    <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
    <emitter type="point"><point name="position" x="0" y="1" z="3"/><rgb name="intensity" value="0.25"/></emitter>
    <shape type="obj"><string name="filename" value="parts/quad.obj"/>
        <bsdf type="diffuse"><spectrum name="reflectance" filename="parts/grey.spd"/></bsdf></shape>
    <shape type="sphere"><point name="center" x="-1" y="-1" z="1"/><float name="radius" value="0.25"/>
        <bsdf type="diffuse"><texture name="reflectance" type="volume">
            <volume name="volume" type="gridvolume"><string name="filename" value="parts/grid.vol"/></volume>
        </texture></bsdf></shape>
    <shape type="sphere"><point name="center" x="1" y="-1" z="1"/><float name="radius" value="0.25"/>
        <bsdf type="roughconductor"><string name="material" value="Cu"/></bsdf></shape>
</scene>
"""
SPD = "400 {0}\n700 {0}\n"
OWN = """import drjit as dr


def own(image, target, weights):
    return 0.25 * dr.mean(dr.square(image - target), axis=None)
"""
CONFIG = f"""variant: llvm_ad_rgb
scene: {{file: scene.xml, options: {{bright: 8}}}}
parameters: [{{key: {KEY}, initial: {{file: start.exr, color_space: linear}}, bounds: [0, 1]}}]
integrator: {{max_depth: 3, estimator: stack, paths: light, sequence: independent}}
run: {{iterations: 1, spp: 4, certainty: false}}
"""
PHOTO = """loss: {type: custom, file: own.py:own}
target: {file: photo.exr, mask: {file: weights.exr, kinds: [specular, clipped, alpha]}}
"""
CAMERAS = PHOTO.replace("file: photo.exr, ", "")

#: The setting that leads to each file.
FILES = {
    "scene.xml": "scene.file",
    "lights.xml": "scene.file (lights.xml)",
    "sky.exr": "scene.file (sky.exr)",
    "poster.exr": "scene.file (poster.exr)",
    "parts/quad.obj": "scene.file (parts/quad.obj)",
    "parts/grey.spd": "scene.file (parts/grey.spd)",
    "parts/grid.vol": "scene.file (parts/grid.vol)",
    "data/ior/Cu.k.spd": "scene.file (data/ior/Cu.k.spd)",
    "start.exr": "parameters[0].initial.file",
    "weights.exr": "target.mask.file",
    "own.py": "loss.file",
}
OF_PHOTO = FILES | {"photo.exr": "target.file"}
OF_CAMERAS = FILES | {"shots/transforms.json": "scene.cameras", "shots/a.exr": "scene.cameras (a.exr)"}


def write_image(path: Path, size: int, seed: int) -> None:
    mi.Bitmap(np.random.default_rng(seed).uniform(0.1, 0.9, (size, size, 3)).astype(np.float32)).write(str(path))


@pytest.fixture
def folder(llvm: str, workplace: Path) -> Path:
    """Folder with `photo.yaml` and `cameras.yaml`, which together read a file of every kind."""
    for name in ("parts", "shots", "data/ior"):
        (workplace / name).mkdir(parents=True)
    scene = tiny.SCENE.replace('value="8, 8, 8"', 'value="$bright"')
    texts = {
        "scene.xml": scene.replace("</scene>", '<include filename="lights.xml"/><!-- 0.25 -->\n</scene>'),
        "lights.xml": LIGHTS,
        "parts/quad.obj": "v 1 0 0.25\nv 1.5 0 0\nv 1 0.5 0\nf 1 2 3\n",
        "parts/grey.spd": SPD.format("0.25"),
        "data/ior/Cu.eta.spd": SPD.format("0.25"),
        "data/ior/Cu.k.spd": SPD.format("0.25"),
        "own.py": OWN,
        "shots/transforms.json": json.dumps({"frames": [{
            "file_path": "a.exr", "w": 8, "h": 8, "camera_angle_x": 0.8725,
            "transform_matrix": [[1, 0, 0, 0.25], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]],
        }]}),
        "photo.yaml": CONFIG + PHOTO,
        "cameras.yaml": (CONFIG + CAMERAS).replace("scene: {", "scene: {cameras: shots/transforms.json, "),
    }  # fmt: skip
    for name, text in texts.items():
        Path(name).write_text(text)
    for seed, (name, size) in enumerate((("sky", 4), ("poster", 4), ("start", 4), ("weights", 8), ("photo", 8))):
        write_image(Path(f"{name}.exr"), size, seed)
    write_image(Path("shots/a.exr"), 8, 9)
    head = b"VOL\3" + struct.pack("<5i6f", 1, 2, 2, 2, 1, 0, 0, 0, 1, 1, 1)
    Path("parts/grid.vol").write_bytes(head + np.full(8, 0.25, np.float32).tobytes())
    return workplace


def change(path: Path) -> Callable[[], object]:
    """Change a file, and return a function that restores the file. The change keeps the file's time, and also its size
    unless the file is an image.
    """
    data, times = path.read_bytes(), (path.stat().st_atime_ns, path.stat().st_mtime_ns)
    if path.suffix == ".exr":
        write_image(path, len(mi.TensorXf(mi.Bitmap(str(path)))), 99)
    else:
        pairs = [(b"0.25", b"0.75")] if path.suffix != ".vol" else [(struct.pack("<f", 0.25), struct.pack("<f", 0.75))]
        path.write_bytes(data.replace(*pairs[0], 1))
        assert path.stat().st_size == len(data)
    assert path.read_bytes() != data
    os.utime(path, ns=times)
    return lambda: (path.write_bytes(data), os.utime(path, ns=times))


CASES = [("photo.yaml", OF_PHOTO), ("cameras.yaml", OF_CAMERAS)]


@pytest.mark.parametrize(("name", "files"), CASES)
def test_each_file_is_another_experiment(folder: Path, name: str, files: dict[str, str]) -> None:
    config = load(name).with_code()
    problem = assemble_scene(config)
    assert {str(path.relative_to(folder)): key for key, path in files_of(config).items()} == {
        **files, "data/ior/Cu.eta.spd": "scene.file (data/ior/Cu.eta.spd)"}  # fmt: skip
    key = key_of(situation(problem))
    for file in files:
        restore = change(folder / file)
        assert key_of(situation(problem)) != key, file
        restore()
    assert key_of(situation(problem)) == key


@pytest.mark.long
def test_a_run_continues_with_its_original_files(folder: Path) -> None:
    """A resumed run refuses changed files, except files of initial values, which its state has."""
    list(rl.optimize("photo.yaml", folder="first", overrides={"run.measuring": 0}, allow_code=True))
    for file in ("scene.xml", "parts/grid.vol", "own.py", "start.exr", "photo.exr"):
        place, restore = OF_PHOTO[file], change(folder / file)
        if ".initial." not in place:
            with pytest.raises(ConfigError) as caught:
                rl.optimize(resume="first", overrides={"run.iterations": 2}, allow_code=True)
            assert f": {place}: " in str(caught.value)
            assert "has changed since first began; put it back" in str(caught.value)
            restore()
    assert len(list(rl.optimize(resume="first", overrides={"run.iterations": 2}, allow_code=True))) == 1


def test_a_sweep_continues_with_its_original_files(folder: Path) -> None:
    with started(Path("s"), make_plan(Path("photo.yaml"), ["run.spp=[4, 8]"], 1, [], allow_code=True)):
        pass
    for file in OF_PHOTO:
        restore = change(folder / file)
        with pytest.raises(ConfigError, match="has changed since the sweep in s began") as caught:
            resumed(Path("s"), allow_code=True).__enter__()
        assert caught.value.source == str(folder / file)
        restore()
    with resumed(Path("s"), allow_code=True) as kept:
        assert list(kept.codes) == [str(folder / "own.py")]


@pytest.mark.long
def test_decisions_of_another_experiment_are_not_used(folder: Path) -> None:
    sets = ["run.measuring=1000", "integrator.guiding=auto"]
    cache = DecisionCache(folder / "cache")

    def is_known() -> bool:
        decisions = assemble(load("photo.yaml", sets).with_code(), cache=cache, to_run=True).decisions
        return decisions[-1].cached

    assert [is_known(), is_known()] == [False, True]
    for file in OF_PHOTO:
        restore = change(folder / file)
        assert not is_known(), file
        restore()
    assert is_known()
