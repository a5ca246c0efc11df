"""`reslrb inspect` shows the plan for a step."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli.tiny import done, outcome

from reslrb_cli.cli.inspect import _counted, _reasons, _sized, _value, next_step, run_words
from reslrb_cli.scene.catalog import ParameterInfo, SensorSummary, Value

pytestmark = pytest.mark.usefixtures("llvm", "compared")
CONFIG = Path(__file__).resolve().parents[2] / "configs" / "cornell_floor.yaml"
TINY = ["--set", "scene.options={resx: 16, resy: 16}", "--set", "integrator.max_depth=4"]


def inspect(*arguments: str) -> str:
    """Return the output of `inspect`."""
    return done("inspect", CONFIG, *TINY, *arguments).stdout


def plan_lines(text: str) -> list[str]:
    """Return the lines below `plan`."""
    lines = text.splitlines()
    return lines[lines.index("plan") + 1 : lines.index("parameters")]


def test_the_plan_lists_needed_and_omitted_features():
    lines = plan_lines(inspect())
    assert any(line.split()[:3] == ["needed", "derivatives", "of"] for line in lines)
    assert any("left out" in line and "delta lobes" in line for line in lines)
    rows = {row["feature"]: row for row in json.loads(inspect("--json"))["plan"]["rows"]}
    assert rows["derivatives of BSDFs"]["needed"]
    assert not rows["derivatives of null surfaces"]["needed"]


def test_a_missing_plan_has_a_reason():
    [line] = plan_lines(inspect("--set", "integrator.type=ptracer"))
    assert "none" in line
    assert "ptracer" in line
    [line] = plan_lines(inspect("--set", "parameters=[{key: no.such.key}]"))
    assert "parameters[0].key" in line


SCENE = """<scene version="3.0.0">
<default name="power" value="5"/>
<sensor type="perspective">
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/></film>
<transform name="to_world"><lookat origin="0, 0, 6" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
<bsdf type="diffuse" id="wall"><texture type="bitmap" name="reflectance"><string name="filename" value="8bit.png"/>
</texture></bsdf>
<bsdf type="diffuse" id="floor"><texture type="bitmap" name="reflectance"><string name="filename" value="floor.exr"/>
<boolean name="raw" value="true"/></texture></bsdf>
<shape type="rectangle"><ref id="wall"/></shape>
<shape type="rectangle"><ref id="floor"/></shape>
<shape type="sphere"><emitter type="area"><rgb name="radiance" value="$power, 2, 0.25"/></emitter></shape>
<shape type="sphere"><bsdf type="roughconductor"><float name="alpha" value="0.2"/></bsdf></shape>
<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
</scene>
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """Path of a scene file in the working directory. Its shapes and lights have no ids."""
    import mitsuba as mi

    mi.Bitmap(np.full((4, 4, 3), 99, np.uint8)).write(str(tmp_path / "8bit.png"))
    mi.Bitmap(np.linspace(0, 1, 4 * 6 * 3, dtype=np.float32).reshape(4, 6, 3)).write(str(tmp_path / "floor.exr"))
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(tmp_path / "sky.exr"))
    (tmp_path / "scene.xml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    return tmp_path / "scene.xml"


def lines_of(*arguments: str) -> list[str]:
    """Return the output lines of `inspect`, with single blanks."""
    return [" ".join(line.split()) for line in done("inspect", *arguments).stdout.splitlines()]


def test_a_scene_file_by_itself(scene):
    found = lines_of("scene.xml", "--set", "scene.options.power=7")
    start = found.index("parameters") + 1
    assert found[start : start + 9] == [
        "can be recovered: 8",
        "wall.reflectance.data 4x4 texels of 3, mean 0.1248, 0.1248 to 0.1248; 8 bits, read as floats if recovered",
        "floor.reflectance.data 6x4 texels of 3, mean 0.5, 0 to 1",
        "Sphere_1.bsdf.reflectance.value 0",
        "Sphere_1.emitter.radiance.value [7, 2, 0.25]",
        "Sphere_2.bsdf.alpha.value 0.2",
        "Sphere_2.bsdf.eta.value 0",
        "Envmap_1.scale 1",
        "Envmap_1.data 8x4 texels of 3, mean 1, 1 to 1",
    ]
    assert found[-3:-1] == ["can be moved: 4", "by motion: Rectangle_1, Rectangle_2, Sphere_1, Sphere_2"]
    others = found[start + 9 : -3]
    assert others[0] == "others: 26; --all lists them"
    assert "1 has no effect while `Sphere_2.bsdf.eta` is 0" in others  # its k
    assert "4 is recovered as a motion" in others
    assert sum(int(line.split()[0]) for line in others[1:]) == 26
    assert found[-1] == "next: `reslrb init scene.xml --target PHOTO` writes a configuration"
    assert "plan" not in found


def test_a_long_list_is_cut(scene):
    scene.write_text(SCENE.replace("</scene>", '<shape type="sphere"/>' * 60 + "</scene>"))
    short = lines_of("scene.xml")
    assert "can be recovered: 68" in short
    assert "and 38 more; --all lists them" in short
    assert len(short) < 60
    full = lines_of("scene.xml", "--all")
    assert "Sphere_62.bsdf.reflectance.value 0.5" in full
    moved = "Rectangle_2.to_world AffineTransform4f differentiable, discontinuous is recovered as a motion"
    assert f"{moved} (`motion: {{of: Rectangle_2}}`)" in full


def test_everything_as_json(scene):
    report = json.loads(done("inspect", "scene.xml", "--json").stdout)
    assert (report["plan"], report["run"]) == (None, None)
    parameters = {entry["key"]: entry for entry in report["parameters"]}
    assert len(parameters) == 34
    assert parameters["Sphere_1.emitter.radiance.value"]["value"] == {
        "numbers": [5, 2, 0.25], "mean": pytest.approx(29 / 12), "low": 0.25, "high": 5,
    }  # fmt: skip
    assert parameters["Envmap_1.data"]["shape"] == [4, 8, 3]
    assert parameters["Envmap_1.data"]["value"]["numbers"] is None
    wall = parameters["wall.reflectance.data"]
    assert (wall["obstacle"], wall["bits"], wall["type"]) == (None, 8, "TensorXu8")


def test_a_selected_8_bit_texture_is_shown_as_floats(scene):
    config = scene.with_name("c.yaml")
    config.write_text('scene: {file: scene.xml}\nparameters: [{key: "wall.*"}]')
    found = lines_of("c.yaml")
    assert "* wall.reflectance.data 4x4 texels of 3, mean 0.1248, 0.1248 to 0.1248" in found
    assert any(line.startswith("needed derivatives of BSDFs") for line in found)


@pytest.mark.parametrize(
    ("text", "next_step"),
    [
        ("", 'add `target: {file: IMAGE}` and `parameters: [{key: "wall.reflectance.data"}]` to c.yaml'),
        ("parameters: [{key: Sphere_1.*}]", "add `target: {file: IMAGE}` to c.yaml"),
        ("parameters:\ntarget:\nrun: {iterations: 3}", "add `target: {file: IMAGE}` and `parameters: "),
        ("parameters: [{key: Sphere_1.*}]\ntarget: {render: {}}", "`reslrb optimize c.yaml` runs it"),
    ],
)
def test_an_incomplete_configuration_is_accepted(scene, text, next_step):
    Path("c.yaml").write_text(f"scene: {{file: scene.xml}}\n{text}\n")
    found = lines_of("c.yaml")
    assert found[-1].startswith(f"next: {next_step}")
    has_parameters = "Sphere_1.*" in text
    assert ("plan" in found) is has_parameters
    assert ("* Sphere_1.emitter.radiance.value [5, 2, 0.25]" in found) is has_parameters
    assert ("can be recovered: 8 (* in `parameters`)" in found) is has_parameters


def test_a_run_folder_shows_its_progress(scene):
    Path("c.yaml").write_text(
        "scene: {file: scene.xml}\ntarget: {render: {spp: 4}}\nparameters: [{key: Sphere_1.emitter.radiance.value}]\n"
        "integrator: {type: ptracer, max_depth: 2}\nrun: {iterations: 2, spp: 1}\n"
    )
    done("optimize", "c.yaml", "--quiet")
    for path in ("runs/c", "runs/c/config.yaml"):
        found = lines_of(path)
        assert found[0] == f"run {path}: finished, 2 iterations"
        assert "* Sphere_1.emitter.radiance.value [5, 2, 0.25]" in found
        assert found[-1] == "next: `reslrb optimize runs/c/config.yaml` runs it again"


def test_an_edited_decision_is_one_located_line(scene):
    Path("run").mkdir()
    text = "scene: {file: ../scene.xml}\nparameters: [{key: Sphere_1.emitter.radiance.value}]\n"
    Path("run/config.yaml").write_text(text)

    def decide(**decision: str) -> None:
        content = {"program": "reslrb", "decisions": [{"setting": "paths", **decision}]}
        Path("run/manifest.json").write_text(json.dumps(content))

    for decision, said in (
        ({"value": "sideways", "why": "edited"}, "paths is `sideways`; possible are light, camera, both"),
        ({"value": "camera"}, "no Decision: "),
    ):
        decide(**decision)
        code, _, err = outcome("inspect", "run")
        assert (code, f"run/manifest.json: decisions: {said}" in err) == (2, True), err
    decide(value="camera", why="edited by hand")
    assert "paths: auto, edited by hand" in " ".join(lines_of("run"))


@pytest.mark.parametrize(
    ("crop", "text"),
    [
        (((0, 0), (8, 6)), "8x6"),
        (((0, 0), (4, 6)), "8x6, crop 4x6 at (0, 0)"),
        (((2, 1), (8, 6)), "8x6, crop 8x6 at (2, 1)"),
    ],
)
def test_a_crop_is_shown(crop, text):
    sensor = SensorSummary(0, "a", "perspective", "hdrfilm", (8, 6), crop, "box", 3, None, None, None)
    assert _sized(sensor) == text


def info(kind: str = "bsdf", type: str = "Float", shape: tuple[int, ...] = (), **values: Any) -> ParameterInfo:
    return ParameterInfo("a.b", kind, type, shape, True, False, values.pop("obstacle", None), **values)


RANGE = Value(None, 0.25, 0.125, 3.0)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (info(value=Value([0.123456], 0, 0, 0)), "0.1235"),
        (info(shape=(1,), value=Value([0.5], 0, 0, 0)), "[0.5]"),
        (info(shape=(3,), value=Value([1, 2, 0.5], 0, 0, 0)), "[1, 2, 0.5]"),
        (info(shape=(4, 8, 1), value=RANGE), "8x4 texels, mean 0.25, 0.125 to 3"),
        (info(shape=(4, 8, 3), value=RANGE), "8x4 texels of 3, mean 0.25, 0.125 to 3"),
        (info(shape=(90,), value=RANGE), "90 numbers, mean 0.25, 0.125 to 3"),
        (info(shape=(4, 4), type="AffineTransform3f", value=RANGE), "4x4 numbers"),
        (info("shape", shape=(90,), value=RANGE), "90 numbers"),
        (info(shape=(90,)), "90 numbers"),
        (info(type="Texture"), "Texture"),
    ],
)
def test_a_value_is_short(given: ParameterInfo, text: str) -> None:
    assert _value(given) == text


def test_obstacles_are_counted_with_the_most_frequent_first() -> None:
    reasons = ["rare", "often (16 bits)", "often (8 bits)", "also; as it is", "often", "also; otherwise"]
    assert [line.split(maxsplit=1) for line in _reasons([info(obstacle=each) for each in reasons])] == [
        ["3", "often"], ["2", "also"], ["1", "rare"],
    ]  # fmt: skip
    assert (_counted({"mesh": 2, "sphere": 1}), _counted({})) == ("2 mesh, 1 sphere", "none")


@pytest.mark.parametrize(
    ("run", "words"),
    [
        ({"status": "running"}, "running"),
        ({"status": "finished", "results": {"iterations": 0}, "error": None}, "finished, 0 iterations"),
        ({"status": "failed", "results": {"iterations": 3}, "error": "full"}, "failed, 3 iterations, full"),
    ],
)
def test_a_run_in_words(run: dict[str, Any], words: str) -> None:
    assert run_words(run) == words


@pytest.mark.parametrize(
    ("obstacles", "keys", "missing", "is_scene", "run", "step"),
    [
        ([("dark", "dark")], ["a.b"], [], False, None, "change the scene so that it can be rendered"),
        ([("dark", "dark"), (None, None)], ["a.b"], [], False, None, "`reslrb optimize a.yaml` runs it"),
        ([("dark", "other")], ["a.b"], [], False, None, "`reslrb optimize a.yaml` runs it"),
        ([], ["a.b"], [], False, None, "`reslrb optimize a.yaml` runs it"),
        ([], ["a.b"], [], False, {}, "`reslrb optimize a.yaml` runs it"),
        ([], ["a.b"], [], False, {"status": "finished"}, "`reslrb optimize a.yaml` runs it again"),
        ([], [], ["target"], True, None, "no parameter can be recovered"),
        ([], ["a.b", "c"], ["target", "parameters"], True, None, "`reslrb init a --target PHOTO` writes"),
        ([], ["a.b", "c"], ["target"], False, None, "add `target: {file: IMAGE}` to a, then run `reslrb optimize a`"),
        ([], ["a.b", "c"], ["target", "parameters"], False, None,
         'add `target: {file: IMAGE}` and `parameters: [{key: "a.b"}]` to a, then run `reslrb optimize a`'),
    ],
)  # fmt: skip
def test_the_next_step(
    obstacles: list[tuple[str | None, str | None]], keys: list[str], missing: list[str], is_scene: bool,
    run: dict[str, Any] | None, step: str,
) -> None:  # fmt: skip
    sensors = [SimpleNamespace(obstacle=light, camera_obstacle=camera) for light, camera in obstacles]
    infos = [SimpleNamespace(key=key, obstacle=None if key in keys else "a reason") for key in ("none", *keys)]
    config = SimpleNamespace(source="a.yaml")
    subject: Any = SimpleNamespace(missing=missing, is_scene=is_scene, path="a", run=run, config=config)
    summary: Any = SimpleNamespace(sensors=sensors, parameters=infos)
    found = next_step(subject, summary)
    assert found == step if step.endswith(("it", "again", "a`")) else found.startswith(step)
