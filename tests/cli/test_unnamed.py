"""Scenes whose objects have no ids, from `inspect` to the page: the same keys everywhere, in each run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from turns import a_few

from reslrb_cli.cli import main

pytestmark = pytest.mark.usefixtures("llvm")

#: Three lamps of one kind and two of another over a floor.
LAMPS = """<scene version="3.0.0">
<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="8"/>
<rfilter type="box"/></film>
<transform name="to_world"><lookat origin="0, 4, 6" target="0, 0, 0" up="0, 1, 0"/></transform></sensor>
<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/></transform></shape>
<shape type="sphere"><point name="center" x="-2" y="1" z="0"/><float name="radius" value="0.3"/>
<emitter type="area"><rgb name="radiance" value="4, 1, 1"/></emitter></shape>
<shape type="sphere"><point name="center" x="0" y="1" z="0"/><float name="radius" value="0.3"/>
<emitter type="area"><rgb name="radiance" value="1, 4, 1"/></emitter></shape>
<shape type="sphere"><point name="center" x="2" y="1" z="0"/><float name="radius" value="0.3"/>
<emitter type="area"><rgb name="radiance" value="1, 1, 4"/></emitter></shape>
<emitter type="point"><point name="position" x="0" y="3" z="2"/></emitter>
<emitter type="point"><point name="position" x="1" y="3" z="2"/></emitter>
</scene>
"""
#: A corner as Mitsuba 0.6 wrote it, its light from a file of its own.
CORNER = """<scene version="0.6.0">
<integrator type="bdpt"/>
<sensor type="perspective"><float name="fov" value="50"/><sampler type="halton"/>
<transform name="toWorld"><lookAt origin="0, 1, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
<film type="ldrfilm"><integer name="width" value="10"/><integer name="height" value="10"/></film></sensor>
<include filename="light.xml"/>
<shape type="rectangle"><transform name="toWorld"><scale value="3"/><translate z="-1"/></transform>
<bsdf type="diffuse"><srgb name="reflectance" value="#c08040"/></bsdf></shape>
<shape type="rectangle"><transform name="toWorld"><rotate x="1" angle="-90"/><scale value="3"/><translate y="-1"/>
</transform>
<bsdf type="twosided"><bsdf type="diffuse"><spectrum name="reflectance" value="0.2, 0.4, 0.6"/></bsdf></bsdf></shape>
</scene>
"""
LIGHT = """<scene version="0.6.0"><shape type="rectangle">
<transform name="toWorld"><rotate x="1" angle="90"/><translate y="3"/></transform>
<emitter type="area"><rgb name="radiance" value="10"/></emitter></shape></scene>
"""
SCENES = {
    "lamps": (
        ["Rectangle_1.bsdf.reflectance.value", *(f"Sphere_{n}.emitter.radiance.value" for n in (1, 2, 3))]
        + [f"Point_{n}.intensity.value" for n in (1, 2)],
        "[{key: '*.emitter.radiance.value', initial: 2}, {key: Point_2.intensity.value, initial: 0.5}]",
        [*(f"Sphere_{n}.emitter.radiance.value" for n in (1, 2, 3)), "Point_2.intensity.value"],
    ),
    "corner": (
        [
            "Rectangle_1.emitter.radiance.value",
            "Rectangle_2.bsdf.reflectance.value",
            "Rectangle_3.bsdf.brdf_0.reflectance.value",
        ],
        "[{key: Rectangle_3.*, initial: 0.5}, {key: Rectangle_2.bsdf.reflectance.value, initial: 0.5}]",
        ["Rectangle_3.bsdf.brdf_0.reflectance.value", "Rectangle_2.bsdf.reflectance.value"],
    ),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    import mitsuba as mi

    for name, text in {"lamps": LAMPS, "corner": CORNER, "light": LIGHT}.items():
        (tmp_path / f"{name}.xml").write_text(text)
    for name, shape in {"lamps": (8, 12, 3), "corner": (10, 10, 3)}.items():
        mi.Bitmap(np.full(shape, 0.2, np.float32)).write(str(tmp_path / f"{name}.exr"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def reslrb(*arguments: str) -> str:
    """What a command prints; it must succeed."""
    result = CliRunner().invoke(main, list(arguments))
    assert result.exit_code == 0, result.output
    return result.stdout


def keys_of_run(folder: Path) -> dict[str, list[str]]:
    """The keys in each of a run's records, in their order."""
    with (
        np.load(folder / "checkpoint" / "state.npz") as state,
        np.load(folder / "parameters" / "parameters.npz") as found,
    ):
        checkpoint = [name.removeprefix("parameter/") for name in state if name.startswith("parameter/")]
        arrays = list(found)
    return {
        "parameters.json": list(json.loads((folder / "parameters" / "parameters.json").read_text())),
        "parameters.npz": arrays,
        "checkpoint": checkpoint,
    }


@pytest.mark.parametrize("name", a_few(SCENES, ["corner"]))
def test_keys_are_the_same_from_inspect_to_the_page(folder, name):
    listed, parameters, chosen = SCENES[name]
    report = json.loads(reslrb("inspect", f"{name}.xml", "--json"))
    assert [entry["key"] for entry in report["parameters"] if entry["obstacle"] is None] != []
    assert {entry["key"] for entry in report["parameters"]} >= set(listed)
    assert not [entry["key"] for entry in report["parameters"] if entry["key"].startswith("object_")]
    pages = []
    for target in ("{render: {spp: 8}}", f"{{file: {name}.exr}}"):
        (folder / f"{name}.yaml").write_text(
            f"scene: {{file: {name}.xml}}\ntarget: {target}\nparameters: {parameters}\n"
            "integrator: {type: ptracer, max_depth: 2}\nrun: {iterations: 1, spp: 2, reach_spp: 1}\n"
        )
        for _ in range(2 if "render" in target else 1):
            reslrb("optimize", f"{name}.yaml", "--quiet")
    for number in range(1, 4):
        run = folder / "runs" / (name if number == 1 else f"{name}-{number}")
        for record, found in keys_of_run(run).items():
            assert found == chosen, record
        manifest = json.loads((run / "manifest.json").read_text())
        assert manifest["status"] == "finished"
        if number <= 2:  # the true values are known by the same names
            assert set(manifest["results"]["parameter_rmse"]) <= set(chosen)
            assert json.loads((run / "parameters" / "true" / "parameters.json").read_text()).keys() == set(chosen)
        pages.append((run / "report.html").read_text())
    assert not any("object_" in page for page in pages)
    assert all(chosen[0] in page.replace("<wbr>", "") for page in pages)


def test_strict_refuses_what_is_mended(folder, capsys):
    for setting, code in (("false", 0), ("true", 2)):
        with pytest.raises(SystemExit) as end:
            main.main(["inspect", "corner.xml", "--set", f"scene.strict={setting}"])
        assert end.value.code == code
        said = capsys.readouterr().err.splitlines()[1:]
        assert said[0].startswith(f"{folder}/corner.xml:3: there is no sampler `halton` in Mitsuba 3")
        assert len(said) == (1 if code else 5)


@pytest.mark.long
def test_the_other_commands_know_the_names(folder):
    key = "Sphere_2.emitter.radiance.value"
    (folder / "lamps.yaml").write_text(
        f"scene: {{file: lamps.xml}}\ntarget: {{render: {{spp: 8, parameters: {{{key}: [2, 3, 4]}}}}}}\n"
        f"parameters: [{{key: {key}}}]\nintegrator: {{max_depth: 2, estimator: stack}}\n"
        "run: {iterations: 1, spp: 2, reach_spp: 2}\n"
    )
    reslrb("render", "lamps.yaml", "-o", "image.exr")
    assert f"* {key}" in reslrb("inspect", "lamps.yaml", "--no-counts")
    assert key in reslrb("gradcheck", "lamps.yaml", "--seeds", "3")
    reslrb("bench", "lamps.yaml", "--max-depth", "2", "--rounds", "1", "--integrators", "reslrb:stack")
    reslrb("optimize", "lamps.yaml", "--quiet")
    truth = json.loads((folder / "runs" / "lamps" / "parameters" / "true" / "parameters.json").read_text())
    assert truth[key]["value"] == [2, 3, 4]
