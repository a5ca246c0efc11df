"""Tests of the contents of a configuration: values, defaults, paths, options, parameters, and the reference in
docs/.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import pytest
from config.test_config_bad_input import GOOD, PARAMETER, changed
from make_reference import DOCS, EXAMPLE

from reslrb_cli.config.integrators import AUTO_VALUES, ESTIMATOR_OPTIONS, PLAIN, Prb, ReslrbConfig
from reslrb_cli.config.loader import FREE_MAPPINGS, dump, load
from reslrb_cli.config.optimizers import SGD, Adam
from reslrb_cli.config.parameters import ImageFile, ParameterSpec
from reslrb_cli.config.schema import Config
from reslrb_cli.estimators import ESTIMATORS, options_of

# Valid values of a configuration, its defaults, its paths, and its conversion back to YAML.

FULL = """\
variant: llvm_ad_rgb
scene:
  file: ../scenes/a b.xml
  options: {resx: 64, fast: true, scale: 1e-3, text: "1e-3", country: no, day: 2024-01-01, octal: 010, time: "12:30"}
target:
  color_space: linear
views:
  - {sensor: 2, target: t0.exr}
  - {sensor: 0, target: /abs/t1.png, mask: weights.png}
parameters:
  - {key: "*.reflectance.data", initial: 1, bounds: [-.inf, 1E0], learning_rate: 5e-2, resolution: [64, 32]}
  - {key: white.reflectance.value, initial: [.5, +0.5, 1], bounds: [0, .inf]}
  - {key: floor.data, initial: {file: floor.png, color_space: srgb}}
  - {key: lamp.emitter.radiance.value}
integrator: {type: walk_ad, max_depth: -1, rr_depth: 3, hide_emitters: true, samples_per_pass: 8}
loss: {type: relative_l2, epsilon: 1e-3}
optimizer: {type: adam, learning_rate: 1e-1, schedule: cosine, final_fraction: 1e-2}
run: {name: "Floor: red/blue", output: out, iterations: 3, spp: 16, seed: 4294967295, adjoint: independent}
"""


def load_text(folder: Path, text: str, *overrides: str, name: str = "x.yaml") -> Config:
    path = folder / name
    path.write_text(text)
    return load(path, overrides)


def test_defaults(tmp_path: Path) -> None:
    assert load_text(tmp_path, GOOD + "run:\n  # spp: 3\noptimizer:\n") == load_text(tmp_path, GOOD)
    config = load_text(tmp_path, GOOD, name="my floor.yaml")
    assert config.source == tmp_path / "my floor.yaml"
    assert (config.variant, config.views, config.scene.options) == ("auto", None, {})
    assert config.target.file is None
    assert config.target.render is not None
    assert config.target.render.spp == 1024
    assert config.parameters[0].initial == "scene"
    assert isinstance(config.integrator, ReslrbConfig)
    assert config.integrator.options() == {
        "max_depth": 8, "rr_depth": 5, "hide_emitters": False, "estimator": "auto",
        "attached": "auto", "attached_sampling": "auto", "filter_normalization": "attached", "light_share": 0.5,
        **dict.fromkeys(AUTO_VALUES, "auto"),
    }  # fmt: skip
    assert config.loss.type == "l2"
    assert config.loss.options() == {}
    assert isinstance(config.optimizer, Adam)
    assert config.optimizer.own_options() == {"beta_1": 0.9, "beta_2": 0.9, "epsilon": 1e-8}
    assert (config.run.name, config.run.folder_name) == ("my floor", "my-floor")
    assert (config.run.iterations, config.run.spp, config.run.seed) == (200, 16, 0)


def test_values_and_paths(tmp_path: Path) -> None:
    config = load_text(tmp_path, FULL)
    assert config.scene.file == tmp_path / "../scenes/a b.xml"
    assert config.scene.options == {
        "resx": 64, "fast": True, "scale": 1e-3, "text": "1e-3", "country": "no", "day": "2024-01-01", "octal": 10,
        "time": "12:30",
    }  # fmt: skip
    assert config.views is not None
    assert [view.target for view in config.views] == [tmp_path / "t0.exr", Path("/abs/t1.png")]
    masks = [view.mask and (view.mask.file, "clipped" in view.mask.kinds) for view in config.views]
    assert masks == [None, (tmp_path / "weights.png", False)]
    first, second, third, fourth = config.parameters
    assert first.initial == 1.0
    assert first.bounds == (-math.inf, 1.0)
    assert first.learning_rate == 5e-2
    assert first.resolution == (64, 32)
    assert second.initial == [0.5, 0.5, 1.0]
    assert third.initial == ImageFile(file=tmp_path / "floor.png", color_space="srgb")
    assert fourth.initial == "scene"
    assert config.integrator.options()["samples_per_pass"] == 8
    assert config.loss.options() == {"epsilon": 1e-3}
    assert config.optimizer.final_fraction == 1e-2
    assert config.run.folder_name == "Floor-red-blue"
    assert config.run.output == Path.cwd() / "out"  # the only path relative to the working directory


def test_paths_do_not_depend_on_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "configs").mkdir()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs/x.yaml").write_text(GOOD)
    config = load("configs/x.yaml", ["target={file: ../t.exr}"])
    assert str(config.source) == "configs/x.yaml"
    assert config.scene.file == tmp_path / "configs/scene.xml"
    assert config.target.file == tmp_path / "configs/../t.exr"
    assert config.run.output == tmp_path / "runs"


@pytest.mark.parametrize(
    ("text", "overrides"),
    [
        (GOOD, ()),
        (FULL, ()),
        (GOOD, ("views=[{sensor: 1, mask: none}]", "optimizer={type: sgd, schedule: exponential}", "run.name='1e3'")),
        (GOOD, ("integrator={estimator: event, capacity: 4, weight: adjoint}", "run.adjoint=independent")),
        (GOOD, ("target.render={parameters: {a.b: 1e-3, c: {file: x.exr}}, integrator: {type: ptracer}}",)),
    ],
)
def test_round_trip(tmp_path: Path, text: str, overrides: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    config = load_text(tmp_path, text, *overrides)
    written = dump(config)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    again = load_text(tmp_path / "elsewhere", written, name="config.yaml")
    assert again == config != load_text(tmp_path, text, *overrides, "run.seed=1")
    assert dump(again) == written


def test_overrides_are_typed_as_yaml_and_the_last_one_wins(tmp_path: Path) -> None:
    config = load_text(
        tmp_path,
        GOOD,
        "run.spp=2",
        "run.spp=0x10",
        "optimizer.learning_rate=1e-3",
        "optimizer.type=sgd",
        "integrator={type: prb, hide_emitters: true}",
        "parameters[0].bounds=[0, .inf]",
        "parameters.0.initial=[1, 0.5, 0]",
        "parameters[1].key='*.radiance.value'",
        "scene.options.a.b=x=y",
        "target.render.parameters.floor.reflectance.value={file: f.exr}",
        "run.name='007'",
    )
    assert config.run.spp == 16
    assert config.optimizer == SGD(learning_rate=1e-3)
    assert config.integrator == Prb(hide_emitters=True)
    assert config.parameters[0].bounds == (0.0, math.inf)
    assert config.parameters[0].initial == [1.0, 0.5, 0.0]
    assert config.parameters[1].key == "*.radiance.value"
    assert config.scene.options == {"a.b": "x=y"}
    assert config.target.render is not None
    assert list(config.target.render.parameters) == ["floor.reflectance.value"]
    assert config.run.name == "007"


def test_overrides_alone_make_a_configuration(tmp_path: Path) -> None:
    config = load_text(tmp_path, "", "scene.file=a.xml", "target.file=b.exr", "parameters[0].key=c")
    assert config.target.file == tmp_path / "b.exr"
    assert [spec.key for spec in config.parameters] == ["c"]


def test_merge_keys_and_byte_order_mark(tmp_path: Path) -> None:
    text = (
        "\ufeff"
        + GOOD.replace("{render: {}}", "{render: {integrator: &i {type: prb}}}")
        + "integrator: {<<: *i, rr_depth: 2}\n"
    )
    path = tmp_path / "x.yaml"
    path.write_text(text, encoding="utf-8")
    assert load(path).integrator == Prb(rr_depth=2)


def test_free_mappings_match_the_schema() -> None:
    found = []

    def visit(schema: dict, location: tuple[str, ...]) -> None:
        if "$ref" in schema:
            schema = top["$defs"][schema["$ref"].rsplit("/", 1)[1]]
        if isinstance(schema.get("additionalProperties"), dict):
            found.append(location)
        for key, value in schema.get("properties", {}).items():
            for option in (value, *value.get("anyOf", ())):
                visit(option, (*location, key))

    top = Config.model_json_schema()
    visit(top, ())
    assert sorted(found) == sorted(FREE_MAPPINGS)


@pytest.mark.parametrize(
    ("sets", "adjoint"),
    [
        ([], "batched"),
        (["run.spp=6"], "independent"),
        (["run.spp=24", "integrator.samples_per_pass=4"], "independent"),  # batches of 6 samples
        (["run.spp=32", "integrator.samples_per_pass=4"], "batched"),
        (["run.adjoint=correlated"], "correlated"),
    ],
)
def test_adjoint_auto_uses_batches_that_divide_the_samples(tmp_path: Path, sets: list[str], adjoint: str) -> None:
    config = load_text(tmp_path, GOOD, *sets)
    assert config.adjoint == config.step_options()["adjoint"] == adjoint
    assert ("batches" in config.step_options()) is (adjoint == "batched")
    assert load_text(tmp_path, dump(config)) == config


# Recovered parameters in a configuration: tied keys, heightmaps and motions.

POSE = """\
motion: {of: [lens, cap], free: [translation, rotation, scale]}
    initial: {translation: [0, 0.1, 0], rotation: 5}
    bounds: {rotation: [-10, 10], scale: [0.5, 2]}
    transform: {scale: sigmoid}
    learning_rate: {rotation: 0.5}"""


def test_a_motion_has_settings_by_part(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(changed(PARAMETER, POSE))
    config = load(path)
    [spec] = config.parameters
    assert spec.names == ["lens.translation", "lens.rotation", "lens.scale"]
    assert (spec.settings("translation").initial, spec.settings("translation").bounds) == ([0, 0.1, 0], None)
    assert (spec.settings("rotation").initial, spec.settings("rotation").bounds) == (5, (-10, 10))
    assert (spec.settings("rotation").learning_rate, spec.settings("scale").learning_rate) == (0.5, None)
    assert (spec.settings("scale").initial, spec.settings("scale").transform) == ("scene", "sigmoid")
    again = tmp_path / "again.yaml"
    again.write_text(dump(config))
    assert load(again).parameters == config.parameters


def test_a_learning_rate_and_transform_apply_to_all_parts() -> None:
    spec = ParameterSpec(motion={"of": "lamp"}, learning_rate=0.1, transform="none")  # type: ignore[arg-type]
    assert spec.names == ["lamp.translation", "lamp.rotation"]
    assert spec.settings("rotation").learning_rate == spec.settings("translation").learning_rate == 0.1


def test_each_axis_has_its_own_settings(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    axes = "motion: {of: lens, free: [x, y]}\n    initial: {y: 0.1}\n    bounds: {x: [-1, 1], y: [0, 2]}"
    path.write_text(changed(PARAMETER, axes))
    [spec] = load(path).parameters
    assert spec.names == ["lens.x", "lens.y"]
    assert (spec.settings("x").initial, spec.settings("x").bounds) == ("scene", (-1, 1))
    assert (spec.settings("y").initial, spec.settings("y").bounds) == (0.1, (0, 2))


def test_a_heightmap_has_its_own_resolution() -> None:
    spec = ParameterSpec(heightmap={"mesh": ["slab", "other"], "resolution": [8, 4]}, bounds=(-0.1, 0.1))  # type: ignore[arg-type]
    assert spec.names == ["slab.heightmap"]
    assert (spec.settings().resolution, spec.settings().bounds) == ((8, 4), (-0.1, 0.1))


# The options of `reslrb` in a configuration are the options of its estimators.


def test_the_table_names_every_estimator() -> None:
    names = list(ESTIMATORS)
    assert list(ESTIMATOR_OPTIONS) == ["auto", *names]
    assert list(get_args(ReslrbConfig.model_fields["estimator"].annotation)) == ["auto", *names]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_options_and_defaults_match_the_estimators(name: str) -> None:
    options = ReslrbConfig(estimator=name).options()  # type: ignore[arg-type]
    shared = {"max_depth", "rr_depth", "hide_emitters", "estimator"}
    shared |= {"attached", "filter_normalization", "attached_sampling", *PLAIN}
    #: Options that are constant in every run.
    constants = {"stack_size", "jacobian_damping"}
    known = {key: value for key, value in options_of(name).items() if key not in constants}
    assert {key: value for key, value in options.items() if key not in shared} == known


def test_paths_unsupported_by_the_named_estimator() -> None:
    assert (ReslrbConfig().paths, ReslrbConfig().light_share) == ("auto", 0.5)
    assert ReslrbConfig(estimator="stack").paths == "light"
    named = ReslrbConfig(estimator="stack", paths="both")
    assert (named.paths, named.light_share) == ("both", 0.5)
    again = ReslrbConfig(**ReslrbConfig(paths="camera").model_dump())  # as the run folder stores it
    assert again.paths == "camera"
    written = ReslrbConfig().model_dump(exclude_none=True)
    assert (ReslrbConfig(**written).paths, ReslrbConfig(**written).pixels) == ("auto", "auto")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"paths": "camera", "estimator": "gather"}, "needs the connections of light paths"),
        ({"paths": "light", "light_share": 0.3}, "has no effect with paths: light, only with both"),
        ({"paths": "both", "light_share": 1.5}, "less than or equal to 1"),
        ({"paths": "sideways"}, "'auto', 'light', 'camera' or 'both'"),
    ],
)
def test_impossible_paths(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ReslrbConfig(**options)


def test_auto_is_stack() -> None:
    assert ReslrbConfig(max_depth=4).plain().options() == ReslrbConfig(estimator="stack", max_depth=4).options()


@pytest.mark.parametrize(
    ("name", "off", "on"), [("guiding", "off", "on"), ("sequence", "independent", "low_discrepancy")]
)
def test_measured_options_if_the_estimator_is_measured(name: str, off: str, on: str) -> None:
    def given(**options: Any) -> str:
        return str(getattr(ReslrbConfig(**options), name))

    assert given() == "auto"
    assert given(estimator="stack") == off
    assert given(estimator="stack", **{name: "auto"}) == "auto"
    assert given(**{name: off}) == off
    # Objects that are made before any measurement have the plain value.
    for own in (ReslrbConfig(), ReslrbConfig(**{name: "auto", "estimator": "reservoir"})):
        assert getattr(own.plain(), name) == off
    asked = ReslrbConfig(**{name: on})
    assert getattr(asked.plain(), name) == on


# The reference pages in docs/ agree with the schema.


REFERENCE = (DOCS / "config.md").read_text(encoding="utf-8")


def test_pages_are_up_to_date(tmp_path: Path) -> None:
    """The script runs in its own process, because it must import the sections itself."""
    script = DOCS.parent / "scripts" / "make_reference.py"
    subprocess.run([sys.executable, script, tmp_path], check=True, timeout=120)
    for name in ("config.md", "config.schema.json", "python.md"):
        here = (DOCS / name).read_text(encoding="utf-8")
        assert here == (tmp_path / name).read_text(encoding="utf-8"), "run `python scripts/make_reference.py`"


def test_example_loads(tmp_path: Path) -> None:
    assert EXAMPLE in REFERENCE
    (tmp_path / "example.yaml").write_text(EXAMPLE)
    config = load(tmp_path / "example.yaml")
    assert (DOCS.parent / "configs" / config.scene.file.relative_to(tmp_path)).is_file()


def test_every_key_is_described() -> None:
    schema = json.loads((DOCS / "config.schema.json").read_text(encoding="utf-8"))
    for name, section in [("Config", schema), *schema["$defs"].items()]:
        assert section["description"]
        for key, value in section["properties"].items():
            assert value.get("description"), f"{name}.{key}"
            assert f"`{key}`" in REFERENCE
