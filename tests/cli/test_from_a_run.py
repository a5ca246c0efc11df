"""Uses of a finished run: `initial: {run: RUN}`, `render RUN`, `optimize RUN --free KEY`, `export`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from cli import tiny
from cli.tiny import reslrb
from turns import a_few

import reslrb_cli as rl
from reslrb_cli.api.experiment import called
from reslrb_cli.cli.render import _of_sensor, check_image_path
from reslrb_cli.config.loader import Override, load
from reslrb_cli.config.parameters import ParameterSpec, RunValue
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization import loading
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.records import run_folder
from reslrb_cli.records.checkpoint import STATE_FILE, save_checkpoint
from reslrb_cli.records.images import load_image, read_parameters
from reslrb_cli.records.run_folder import read_value, recovered
from reslrb_cli.report import run_summary
from reslrb_cli.runs import export
from reslrb_cli.runs.export import choose_integrator
from reslrb_cli.scene.load import load_scene
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.values import resample

pytestmark = pytest.mark.usefixtures("llvm", "compared")


LAMP = "lamp.emitter.radiance.value"
#: A texture, a colour and a motion: all shapes that a value can have.
PARAMETERS = f"""[{{key: {tiny.KEY}, initial: 0.5, bounds: [0, 1]}}, {{key: {LAMP}, initial: [3, 4, 5]}},
  {{motion: {{of: wall, free: [translation, scale]}}, learning_rate: 0.01}}]"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, llvm: str) -> Path:
    """Folder with an experiment and its run in `runs/tiny`."""
    folder = tmp_path_factory.mktemp("from-a-run")
    tiny.write_experiment(folder)
    config = (folder / "tiny.yaml").read_text()
    scene = (folder / "scene.xml").read_text().replace('<rfilter type="box"/>', '<rfilter type="gaussian"/>')
    (folder / "scene.xml").write_text(scene)
    (folder / "tiny.yaml").write_text(config + "optimizer: {learning_rate: 0.05}\n")
    tiny.done("optimize", folder / "tiny.yaml", *tiny.settings(f"parameters={PARAMETERS}", f"run.output={folder}/runs"))
    return folder


def start(folder: Path, parameters: str) -> dict[str, np.ndarray]:
    """Return the values with which an optimisation of these `parameters` would begin."""
    return assemble_scene(load(folder / "tiny.yaml", [f"parameters={parameters}"])).values()


def test_every_kind_of_value_starts_at_the_result_of_the_run(folder: Path) -> None:
    warm = PARAMETERS.replace("initial: 0.5", "initial: {run: runs/tiny}").replace("[3, 4, 5]", "{run: runs/tiny}")
    warm = warm.replace("scale]}", "scale]}, initial: {run: runs/tiny}")
    left, begun = (read_parameters(folder / "runs/tiny/parameters" / place) for place in ("", "initial"))
    taken = start(folder, warm)
    assert set(left) == set(taken) == {tiny.KEY, LAMP, "wall.translation", "wall.scale"}
    for key, value in left.items():
        assert not np.array_equal(value, begun[key]), f"{key} never moved, so this would show nothing"
        assert np.array_equal(value, taken[key]), key


def test_a_texture_of_another_size_is_resampled_on_request(folder: Path) -> None:
    spec = f"[{{key: {tiny.KEY}, initial: {{run: runs/tiny}}, resolution: [8, 6]}}]"
    left = read_value(folder / "runs/tiny", tiny.KEY)
    finer = start(folder, spec)[tiny.KEY]
    assert np.array_equal(finer, resample(left, (8, 6)))
    with pytest.raises(ConfigError, match=r"initial.run: .* has .* with 4x4 texels, the texture has 8x6"):
        read_into(folder, "runs/tiny", finer)


def test_values_of_a_run_respect_the_bounds(folder: Path) -> None:
    left = read_value(folder / "runs/tiny", tiny.KEY)
    spec = f"[{{key: {tiny.KEY}, initial: {{run: runs/tiny}}, bounds: [0, {float(left.max()) - 1e-6}]}}]"
    with pytest.raises(ConfigError, match=r"parameters\[0\].bounds: exclude the initial value of `poster"):
        start(folder, spec)


def test_a_new_run_recovers_one_parameter_more(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It starts from the values that the run found. `latest` is a link, which leads to the new run later."""
    monkeypatch.setattr(run_summary, "free_command", lambda manifest, run: f"{run} {sorted(manifest['results'])[0]}")
    common = tiny.settings("run.iterations=2", f"run.output={tmp_path}", "run.final_spp=4")
    first = f"parameters=[{{key: {LAMP}, initial: [3, 4, 5]}}]"
    tiny.done("optimize", folder / "tiny.yaml", *common, *tiny.settings(first))
    result = tiny.done("optimize", tmp_path / "latest", "--free", tiny.KEY, *tiny.settings("run.iterations=1"))
    last = result.stdout.splitlines()[-1]
    assert last.startswith(f"next: `{os.path.relpath(tmp_path / 'tiny-2')} elapsed_s` starts from these values")
    left, begun = (read_parameters(tmp_path / place) for place in ("tiny/parameters", "tiny-2/parameters/initial"))
    assert np.array_equal(begun[LAMP], left[LAMP])
    assert not np.array_equal(left[LAMP], [3, 4, 5])
    assert np.array_equal(begun[tiny.KEY], load_image(folder / "poster.exr"))
    config = load(tmp_path / "tiny-2/config.yaml")
    assert [(spec.key, spec.bounds) for spec in config.parameters] == [(LAMP, None), (tiny.KEY, (0, 1))]
    assert config.parameters[0].initial == RunValue(run=tmp_path / "tiny")
    assert (config.parameters[1].initial, config.run.iterations) == ("scene", 1)


def test_free_in_a_script(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    settings = {"parameters": [{"key": tiny.KEY, "initial": 0.5}]}
    run = rl.optimize("tiny.yaml", overrides=settings, free=[LAMP, LAMP])
    assert {key: value.ravel()[0] for key, value in run.parameters.items()} == {tiny.KEY: 0.5, LAMP: 8}
    assert run.config.parameters[1].bounds == (0, np.inf)
    for free, line in (
        (f"{LAMP}s", f"free: `{LAMP}s` matches no parameter of the scene; did you mean `{LAMP}`"),
        ([tiny.KEY], f"free: `{tiny.KEY}` is already matched by parameters[0]"),
        (["lamp.*"], "free: `lamp.*` is a glob; name each parameter"),
        (["wall.to_world"], "free: `wall.to_world` is recovered as a motion"),
        ([3], "free: is 3; give a key that `reslrb inspect` lists"),
    ):
        with pytest.raises(rl.ConfigError) as error:
            rl.optimize("tiny.yaml", overrides=settings, free=free)
        assert str(error.value).startswith(line)
    with pytest.raises(rl.ConfigError, match=r"^free: starts a new run, .* give experiment='runs/tiny' in place"):
        rl.optimize(resume="runs/tiny", free=[LAMP])
    with pytest.raises(rl.ConfigError, match=r"^tiny.yaml: parameters\[0\].key: `nothing` matches no parameter"):
        rl.optimize("tiny.yaml", overrides={"parameters": [{"key": "nothing"}]}, free=[LAMP])


def read_into(folder: Path, run: str, texture: np.ndarray) -> None:
    """Load a scene, set its texture to `texture`, and start from a run."""
    scene = load_scene(folder / "scene.xml")
    params = mi.traverse(scene)
    params[tiny.KEY] = mi.TensorXf(texture)
    spec = ParameterSpec(key=tiny.KEY, initial=RunValue(run=folder / run))
    select_parameters(scene, [spec], "c.yaml")


def test_rendering_a_run_renders_its_recovered_values(folder: Path) -> None:
    left = read_parameters(folder / "runs/tiny/parameters")
    by_hand = (
        f"[{{key: {tiny.KEY}, initial: {{file: {folder}/runs/tiny/parameters/{tiny.KEY}.exr}}}},"
        f"{{key: {LAMP}, initial: {left[LAMP].tolist()}}}, {{motion: {{of: wall, free: [translation, scale]}}, "
        f"initial: {{translation: {left['wall.translation'].tolist()}, scale: {left['wall.scale']}}}}}]"
    )
    common = ("--set", "run.spp=16", "--sensor", 0, "--set", "run.seed=3", "-o")
    tiny.done("render", folder / "tiny.yaml", "--set", f"parameters={by_hand}", *common, folder / "a.exr")
    tiny.done("render", folder / "runs/tiny", *common, folder / "b.exr")
    # The samples are equal, but a CPU adds them in any order.
    assert np.allclose(load_image(folder / "a.exr"), load_image(folder / "b.exr"), rtol=1e-5)
    tiny.done("render", folder / "runs/tiny/config.yaml", *common, folder / "c.exr")
    assert not np.allclose(load_image(folder / "a.exr"), load_image(folder / "c.exr"), rtol=1e-2)


def rendered(*words: object, image: str = "x.exr") -> np.ndarray:
    """Render with these words of the command line, and return the image."""
    tiny.done("render", *words, "-o", image)
    return load_image(Path(image))


#: A scene with a kind of parameter each: textures, colours, numbers, a mesh attribute and a mesh.
RELIT = tiny.scene_seen("0, 0, 4").replace(
    "</scene>",
    """
<emitter type="point" id="spark"><point name="position" x="0.4" y="0.2" z="1.5"/>
  <rgb name="intensity" value="0.3, 0.2, 0.1"/></emitter>
<texture type="bitmap" id="wood"><string name="filename" value="wood.png"/></texture>
<bsdf type="roughconductor" id="metal"><float name="alpha" value="0.3"/>
  <rgb name="eta" value="0.2, 0.9, 1.1"/><rgb name="k" value="3.9, 2.4, 2.1"/></bsdf>
<shape type="rectangle" id="sheet"><transform name="to_world"><scale value="0.4"/><translate z="0.5"/></transform>
  <bsdf type="diffuse"><ref name="reflectance" id="wood"/></bsdf></shape>
<shape type="rectangle" id="mirror"><ref id="metal"/>
  <transform name="to_world"><scale value="0.4"/><translate x="1" z="0.5"/></transform></shape></scene>""",
)


def test_any_key_that_inspect_lists_can_be_set(llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`render --value` shows the same image as a scene in which Mitsuba has set the value."""
    monkeypatch.chdir(tmp_path)
    tiny.write_experiment(tmp_path, RELIT)
    tiny.write_photo(tmp_path / "wood.png", np.full((4, 4, 3), 0.4, np.float32))
    listed = json.loads(tiny.done("inspect", "scene.xml", "--json").stdout)["parameters"]
    infos = [each for each in listed if each["obstacle"] is None and each["kind"] != "shape"]
    keys = {each["key"]: each["shape"] for each in infos}
    wood = "sheet.bsdf.reflectance.data"
    assert {"spark.position", "spark.intensity.value", "metal.alpha.value", wood, tiny.KEY} <= set(keys)
    common = ("tiny.yaml", "--set", "run.spp=4", "--set", "integrator.paths=camera", "--scene")
    before = rendered(*common)
    for key, shape in keys.items():
        value = [0.2, 0.3, 0.6][: shape[-1]] if shape else 0.6
        scene = load_scene("scene.xml", keys=[key])
        params = mi.traverse(scene)
        params[key] = type(params[key])(np.broadcast_to(np.float32(value), shape) if len(shape) == 3 else value)
        params.update()
        config = rl.load("tiny.yaml", {"integrator.paths": "camera"}, scene=scene)
        now = rendered(*common, "--value", f"{key}={value}")
        np.testing.assert_allclose(now, rl.render(config, initial=False)[0], rtol=1e-5, err_msg=key)
        assert not np.array_equal(now, before), key
    run = rl.optimize("tiny.yaml", free=[wood])  # its 8 bits are read as floats
    assert run.parameters[wood].shape == (4, 4, 3)


def test_a_run_is_relit_with_its_recovered_values(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run, spp = folder / "runs/tiny", ("--set", "run.spp=16", "--set", "run.seed=3")
    recovered_values = rendered(run, *spp)
    lamp = read_value(run, LAMP)
    brighter = rendered(run, *spp, "--value", f"{LAMP}={(2 * lamp).tolist()}")
    np.testing.assert_allclose(brighter, 2 * recovered_values, rtol=1e-4)
    tiny.write_photo(tmp_path / "w.png", np.full((4, 5, 3), 0.4, np.float32))
    white = rendered(run, *spp, "--value", "poster.reflectance.*=0.9", "--value", "wall.translation=[0, 0, 0]")
    assert white.mean() > 1.1 * recovered_values.mean()
    for words, line in (
        (["--set", "parameters[1].initial=4"], "--set parameters[1].initial=4: parameters[1].initial: has no effect, "
         "because the run's recovered value replaces it; use `render --value KEY=VALUE`"),
        (["--set", f"parameters[1]={{key: {LAMP}, initial: 4}}"], f"--set parameters[1]={{key: {LAMP}, initial: 4}}: "
         "parameters[1]: has no effect"),
        (["--set", f"parameters=[{{key: {LAMP}, initial: 4}}]"], f"--set parameters=[{{key: {LAMP}, initial: 4}}]: "
         "parameters: has no effect"),
        (["--set", "parameters=initial"], "--set parameters=initial: parameters: must be a list"),
        (["--value", "lamp=4"], f"--value: lamp: `lamp` matches no parameter of the scene; did you mean `{LAMP}`"),
        (["--value", "4"], "--value 4: must be KEY=VALUE, such as"),
        (["--value", f"{LAMP}=4", "--value", f"{LAMP}=5"], f"--value {LAMP}=5: is given twice"),
        (["--value", f"{LAMP}=[1, 2]"], f"--value: {LAMP}: is of shape (2,); it must have the parameter's shape (3,)"),
        (["--value", f"{tiny.KEY}={{file: w.png}}"], f"--value: {tiny.KEY}: {tmp_path}/w.png is 5x4, the texture "
         "4x4; use an image of this size"),
        (["--value", "wall.to_world=0"], "--value: wall.to_world: `wall.to_world` is recovered as a motion"),
    ):  # fmt: skip
        result = reslrb("render", run, *words, "-o", "x.exr")
        said = [line for line in result.output.splitlines() if not line.startswith("variant ")]
        assert (result.exit_code, len(said), said[0].startswith(line)) == (2, 1, True), said
    with pytest.raises(ConfigError, match="give `values` to `render`"), called():
        recovered(run, [Override("overrides", ("parameters", 1, "initial"), 4)])


@pytest.mark.parametrize("exposure", a_few(["per_channel", "0.6"], ["per_channel"]))
def test_renderings_use_the_exposure_and_the_exported_scene_names_it(
    folder: Path, exposure: str, tmp_path: Path
) -> None:
    spec = "[{motion: {of: wall, free: [translation]}, learning_rate: 0.01}]"  # a colour cannot be told from exposure
    given = tiny.settings(f"target.exposure={exposure}", f"parameters={spec}", f"run.output={tmp_path}/runs")
    tiny.done("optimize", folder / "tiny.yaml", *given, *tiny.settings("optimizer.learning_rate=0.2"))
    run = tmp_path / "runs/tiny"
    factor = read_value(run, "exposure") if exposure == "per_channel" else np.float32(exposure)
    assert np.all(np.abs(factor - 1) > 0.01)
    if exposure == "per_channel":  # what starts from the run's values also starts at its exposure
        np.testing.assert_allclose(recovered(run, ()).target.exposure["per_channel"], factor, rtol=1e-6)
        for given in ("target.exposure=auto", "target={render: {spp: 4}, exposure: auto}"):
            assert recovered(run, [given]).target.exposure == "auto"
    words = " ".join(f"{value:.4g}" for value in np.ravel(factor))
    for suffix in (".exr", ".png"):
        result = reslrb("render", run, "--set", "run.spp=4", "-o", tmp_path / f"with{suffix}")
        assert f"times {words}, the run's exposure (--exposure 1 ignores it)" in result.output
        plain = reslrb("render", run, "--set", "run.spp=4", "--exposure", 1, "-o", tmp_path / f"without{suffix}")
        assert plain.exit_code == 0
        assert "times" not in plain.output
    light, shown = (load_image(tmp_path / f"{name}.exr") for name in ("without", "with"))
    assert np.allclose(shown, light * factor, rtol=1e-5)
    lit = rl.render(run, spp=4, values={LAMP: 9.0}, exposure=True)[0]
    tiny.done("render", run, "--set", "run.spp=4", "--value", f"{LAMP}=9", "-o", tmp_path / "lit.exr")
    assert np.allclose(load_image(tmp_path / "lit.exr"), lit, rtol=1e-5)
    assert np.allclose(lit, 9 / 8 * shown, rtol=1e-4)  # the lamp has a radiance of 8
    assert load_image(tmp_path / "with.png").mean() != load_image(tmp_path / "without.png").mean()
    assert "--exposure is for PNG" in reslrb("render", run, "--exposure", 2, "-o", tmp_path / "a.exr").output
    result = reslrb("export", run, "-o", tmp_path / "exported")
    line = f"multiply renderings by the exposure, {words}, to match the photographs"
    assert line in result.output.splitlines()
    assert line in (tmp_path / "exported/scene.xml").read_text()
    assert "exposure" not in reslrb("export", folder / "runs/tiny", "-o", tmp_path / "plain").output


@pytest.mark.parametrize(
    ("sets", "found", "start"),
    [
        (["target.exposure=per_channel"], 0.5, {"per_channel": [0.5] * 3}),  # an image of one channel
        (["target.exposure=auto"], 0.5, {"auto": 0.5}),
        (["target.exposure=auto"], np.nan, "auto"),
        (["target={file: a.png, exposure: auto, response: {curve: auto}}"], 0.5, "auto"),  # both start anew
    ],
)
def test_an_exposure_starts_from_a_run_if_it_can(
    folder: Path, monkeypatch: pytest.MonkeyPatch, sets: list[str], found: float, start: object
) -> None:
    config = load(folder / "tiny.yaml", sets)
    monkeypatch.setattr(run_folder, "_manifest_of", lambda run: {"views": [{"sensor": 0, "exposure": "exposure"}]})
    monkeypatch.setattr(run_folder, "read_value", lambda run, key: np.float32(found))
    assert run_folder._from_exposures(config, folder).target.exposure == start


def test_mitsuba_renders_the_export_like_the_run(folder: Path) -> None:
    assert "rendered by ptracer" in tiny.done("export", folder / "runs/tiny", "-o", folder / "exported").output
    theirs = mi.load_file(str(folder / "exported/scene.xml"))
    problem = assemble_scene(recovered(folder / "runs/tiny", ("integrator.rr_depth=9",)))
    found = np.stack([np.array(mi.render(theirs, spp=64, seed=seed)) for seed in range(16)])
    result = compare(np.stack([problem.render(0, 64, seed, "test") for seed in range(16)]), found)
    assert result, result
    begun = assemble_scene(load(folder / "runs/tiny/config.yaml"))
    assert not compare(np.stack([begun.render(0, 64, seed, "test") for seed in range(16)]), found)
    again = reslrb("export", folder / "runs/tiny", "-o", folder / "exported")
    assert again.exit_code == 2
    assert "exported exists" in again.output


def test_missing_or_bad_values_of_a_run_are_refused_in_one_line(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "checkpoint").mkdir(parents=True)
    for name in ("manifest.json", "config.yaml"):
        (run / name).write_bytes((folder / "runs/tiny" / name).read_bytes())

    def refusal() -> str:
        result = reslrb("render", run, "-o", tmp_path / "x.exr")
        assert result.exit_code == 2, result.output
        assert "Traceback" not in result.output
        return result.output

    assert "has no checkpoint/state.npz" in refusal()
    values = {tiny.KEY: np.full((4, 4, 3), 0.5, np.float32), LAMP: np.ones(3, np.float32)}

    def save(**changes: np.ndarray) -> None:
        save_checkpoint(run / "checkpoint", 1, {f"parameter/{key}": value for key, value in (values | changes).items()})

    save()
    assert "did not recover `wall.translation`; it has" in refusal()
    values |= {"wall.translation": np.zeros(3, np.float32), "wall.scale": np.array(1, np.float32)}
    save(**{LAMP: np.ones(2, np.float32)})
    assert f"`{LAMP}` of shape 2, but in the scene of shape 3" in refusal()
    save(**{LAMP: np.full(3, np.nan, np.float32)})
    assert "all values must be finite" in refusal()
    save(**{tiny.KEY: np.full((4, 4, 3), 2, np.float32)})
    assert "exclude the initial value" in refusal()
    (run / "checkpoint" / STATE_FILE).write_bytes(b"PK\x03\x04 and then nothing")
    assert "is damaged, cut off, or not written by reslrb" in refusal()


def test_an_exported_scene_names_path_if_ptracer_is_wrong(tmp_path: Path) -> None:
    tiny.write_experiment(tmp_path)
    sky = """<emitter type="envmap"><string name="filename" value="poster.exr"/><transform name="to_world">
<rotate y="1" angle="40"/></transform></emitter></scene>"""
    (tmp_path / "scene.xml").write_text(tiny.SCENE.replace("</scene>", sky))
    config = load(tmp_path / "tiny.yaml")
    scene = load_scene(config.scene.file)
    integrator, why = choose_integrator(config, scene, mi.traverse(scene), "light")
    assert integrator == {"type": "path", "max_depth": 3, "rr_depth": 5, "hide_emitters": False}
    assert why == ", since ptracer has wrong emission from a rotated environment map"
    own = load(tmp_path / "tiny.yaml", ["integrator={type: ptracer}"])  # its users have accepted its errors
    integrator, why = choose_integrator(own, scene, mi.traverse(scene), "light")
    assert (integrator["type"], why) == ("ptracer", "")
    by_prb = load(tmp_path / "tiny.yaml", ["integrator={type: prb, max_depth: 4}"])
    integrator, why = choose_integrator(by_prb, scene, mi.traverse(scene), "camera")
    assert (integrator["type"], integrator["max_depth"], why) == ("path", 4, "")


def test_an_export_says_what_path_renders_wrongly(tmp_path: Path) -> None:
    """A mirror is blended with a diffuse surface, for which all stock integrators are wrong."""
    tiny.write_experiment(tmp_path)
    blend = """<shape type="rectangle"><bsdf type="blendbsdf"><float name="weight" value="0.3"/><bsdf type="diffuse"/>
<bsdf type="conductor"/></bsdf></shape></scene>"""
    (tmp_path / "scene.xml").write_text(tiny.SCENE.replace("</scene>", blend))
    config = load(tmp_path / "tiny.yaml")
    scene = load_scene(config.scene.file)
    for paths, since in (
        ("light", "since ptracer renders blends of singular and smooth lobes wrongly, "),
        ("both", ""),
    ):
        integrator, why = choose_integrator(config, scene, mi.traverse(scene), paths)
        assert integrator["type"] == "path"
        assert why == f", {since}but path renders blends of singular and smooth lobes wrongly"


@pytest.mark.parametrize(
    ("found", "words"),
    [
        ({}, None),
        ({0: 1.0, 2: [1.0]}, None),
        ({0: 1.0, 2: 0.25}, "1 (sensor 0), 0.25 (sensor 2)"),
        ({0: 0.25, 2: 0.25}, "0.25"),
        ({0: [1, 2, 0.123456]}, "1 2 0.1235"),
    ],
)
def test_the_line_with_the_exposures(monkeypatch: pytest.MonkeyPatch, found: dict[int, Any], words: str | None) -> None:
    monkeypatch.setattr(export, "exposures", lambda run: found)
    said = "" if words is None else f"multiply renderings by the exposure, {words}, to match the photographs"
    assert export.exposure_line(Path("run")) == said


@pytest.mark.parametrize(("sensor", "lamps"), [(0, ["lamp"]), (2, None), (1, None)])
def test_one_view_keeps_its_lamps(
    folder: Path, monkeypatch: pytest.MonkeyPatch, sensor: int, lamps: list[str] | None
) -> None:
    monkeypatch.setattr(loading, "read_sensor_ids", lambda config: ["a", "b", "c"])
    monkeypatch.setattr(loading, "view_sensors", lambda config, ids: [0, 2])
    views = "views=[{sensor: 0, lamps: [lamp]}, {sensor: 2}]"
    config = load(folder / "tiny.yaml", [views, "run.held_out=[1]", "target.exposure=2", "run.views_per_iteration=1"])
    found = _of_sensor(config, sensor)
    assert [(view.sensor, view.lamps) for view in found.views or ()] == [(sensor, lamps)]
    assert (found.target.exposure, found.run.held_out, found.run.views_per_iteration) == (1.0, [], None)


@pytest.mark.parametrize("name", ["a.exr", "A.PNG", "here/a.jpeg"])
def test_the_file_of_an_image_is_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("here").mkdir()
    check_image_path(Path(name))
    assert not Path(name).exists()
