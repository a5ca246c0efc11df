"""Values that a configuration may hold, its defaults, its paths, and the way back to YAML."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest

from reslrb_cli.config.integrators import Prb, Reslrb
from reslrb_cli.config.loader import FREE_MAPPINGS, dump, load
from reslrb_cli.config.optimizers import Adam, RMSProp
from reslrb_cli.config.parameters import ImageFile
from reslrb_cli.config.schema import Config

GOOD = """\
scene: {file: scene.xml}
target: {render: {}}
parameters:
  - {key: floor.reflectance.data}
"""

FULL = """\
variant: llvm_ad_rgb
scene:
  file: ../scenes/a b.xml
  options: {resx: 64, fast: true, scale: 1e-3, text: "1e-3", country: no, day: 2024-01-01, octal: 010, time: "12:30"}
  sensors: [2, 0]
target:
  file: [t0.exr, /abs/t1.png]
  color_space: linear
parameters:
  - {key: "*.reflectance.data", initial: 1, bounds: [-.inf, 1E0], learning_rate: 5e-2, resolution: [64, 32]}
  - {key: white.reflectance.value, initial: [.5, +0.5, 1], bounds: [0, .inf]}
  - {key: floor.data, initial: {file: floor.png, color_space: srgb}}
  - {key: lamp.emitter.radiance.value}
integrator: {type: walk_ad, max_depth: -1, rr_depth: 3, hide_emitters: true, samples_per_pass: 8}
loss: {type: log_l2, epsilon: 1e-3}
optimizer: {type: adamw, learning_rate: 1e-1, schedule: cosine, final_fraction: 1e-2, weight_decay: 0}
run: {name: "Floor: red/blue", output: out, iterations: 3, spp: 16, seed: 4294967295, adjoint: independent}
"""


def load_text(folder: Path, text: str, *overrides: str, name: str = "x.yaml") -> Config:
    path = folder / name
    path.write_text(text)
    return load(path, overrides)


def test_defaults(tmp_path: Path) -> None:
    config = load_text(tmp_path, GOOD, name="my floor.yaml")
    assert config.source == tmp_path / "my floor.yaml"
    assert (config.variant, config.scene.sensors, config.scene.options) == ("auto", [0], {})
    assert config.target.file is None
    assert config.target.render is not None
    assert config.target.render.spp == 1024
    assert config.parameters[0].initial == "scene"
    assert isinstance(config.integrator, Reslrb)
    assert config.integrator.options() == {
        "max_depth": 8, "rr_depth": 5, "hide_emitters": False, "estimator": "auto", "freeze": True,
        "attached": "auto", "attached_sampling": "auto", "filter_normalization": "attached", "guiding": "auto",
        "sequence": "auto",
    }  # fmt: skip
    assert config.loss.type == "l2"
    assert config.loss.options() == {}
    assert isinstance(config.optimizer, Adam)
    assert config.optimizer.own_options() == {"beta_1": 0.9, "beta_2": 0.999, "epsilon": 1e-8}
    assert (config.run.name, config.run.folder_name) == ("my floor", "my-floor")
    assert (config.run.iterations, config.run.spp, config.run.seed) == (200, 16, 0)


def test_values_and_paths(tmp_path: Path) -> None:
    config = load_text(tmp_path, FULL)
    assert config.scene.file == tmp_path / "../scenes/a b.xml"
    assert config.scene.options == {
        "resx": 64, "fast": True, "scale": 1e-3, "text": "1e-3", "country": "no", "day": "2024-01-01", "octal": 10,
        "time": "12:30",
    }  # fmt: skip
    assert config.target.file == [tmp_path / "t0.exr", Path("/abs/t1.png")]
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
    assert config.run.output == Path.cwd() / "out"  # the one path that is not the config file's


def test_paths_do_not_depend_on_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "configs").mkdir()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs/x.yaml").write_text(GOOD)
    config = load("configs/x.yaml", ["target={file: ../t.exr}"])
    assert str(config.source) == "configs/x.yaml"
    assert config.scene.file == tmp_path / "configs/scene.xml"
    assert config.target.file == [tmp_path / "configs/../t.exr"]
    assert config.run.output == tmp_path / "runs"


@pytest.mark.parametrize(
    ("text", "overrides"),
    [
        (GOOD, ()),
        (FULL, ()),
        (GOOD, ("scene.sensors=all", "optimizer={type: sgd, momentum: 0.5, schedule: exponential}", "run.name='1e3'")),
        (FULL, ("integrator={type: prb}", "loss={type: l1}", "optimizer={type: rmsprop}", "run.name='null'")),
        (GOOD, ("integrator={estimator: stack, stack_size: 8}",)),
        (GOOD, ("integrator={estimator: gather}",)),
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
    assert again == config
    assert dump(again) == written


def test_configs_differ_where_a_setting_does(tmp_path: Path) -> None:
    assert load_text(tmp_path, GOOD) == load_text(tmp_path, GOOD)
    assert load_text(tmp_path, GOOD) != load_text(tmp_path, GOOD, "run.seed=1")


def test_overrides_are_typed_as_yaml_and_the_last_one_wins(tmp_path: Path) -> None:
    config = load_text(
        tmp_path,
        GOOD,
        "run.spp=2",
        "run.spp=0x10",
        "optimizer.learning_rate=1e-3",
        "optimizer.type=rmsprop",
        "integrator={type: prb, hide_emitters: true}",
        "parameters[0].bounds=[0, .inf]",
        "parameters.0.initial=[1, 0.5, 0]",
        "parameters[1].key='*.radiance.value'",
        "scene.options.a.b=x=y",
        "target.render.parameters.floor.reflectance.value={file: f.exr}",
        "run.name='007'",
    )
    assert config.run.spp == 16
    assert config.optimizer == RMSProp(learning_rate=1e-3)
    assert config.integrator == Prb(hide_emitters=True)
    assert config.parameters[0].bounds == (0.0, math.inf)
    assert config.parameters[0].initial == [1.0, 0.5, 0.0]
    assert config.parameters[1].key == "*.radiance.value"
    assert config.scene.options == {"a.b": "x=y"}
    assert config.target.render is not None
    assert list(config.target.render.parameters) == ["floor.reflectance.value"]
    assert config.run.name == "007"


def test_overrides_alone_can_make_a_configuration(tmp_path: Path) -> None:
    config = load_text(tmp_path, "", "scene.file=a.xml", "target.file=b.exr", "parameters[0].key=c")
    assert config.target.file == [tmp_path / "b.exr"]
    assert [spec.key for spec in config.parameters] == ["c"]


def test_sections_that_are_commented_out_have_their_defaults(tmp_path: Path) -> None:
    assert load_text(tmp_path, GOOD + "run:\n  # spp: 3\noptimizer:\n") == load_text(tmp_path, GOOD)


def test_merge_keys_and_byte_order_mark(tmp_path: Path) -> None:
    text = (
        "\ufeff"
        + GOOD.replace("{render: {}}", "{render: {integrator: &i {type: prb}}}")
        + "integrator: {<<: *i, rr_depth: 2}\n"
    )
    path = tmp_path / "x.yaml"
    path.write_text(text, encoding="utf-8")
    assert load(path).integrator == Prb(rr_depth=2)


def test_free_mappings_are_those_of_the_schema() -> None:
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


def test_configuration_loads_no_mitsuba() -> None:
    code = "import sys, reslrb_cli.config; sys.exit(any(m in sys.modules for m in ('mitsuba', 'drjit', 'numpy')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(
    ("sets", "adjoint"),
    [
        ([], "batched"),
        (["run.spp=6"], "independent"),
        (["run.spp=6", "run.batches=3"], "batched"),
        (["run.spp=24", "integrator.samples_per_pass=4"], "independent"),  # batches of 6
        (["run.spp=32", "integrator.samples_per_pass=4"], "batched"),
        (["run.adjoint=correlated"], "correlated"),
    ],
)
def test_adjoint_auto_takes_batches_where_they_divide_the_samples(
    tmp_path: Path, sets: list[str], adjoint: str
) -> None:
    config = load_text(tmp_path, GOOD, *sets)
    assert config.adjoint == config.step_options()["adjoint"] == adjoint
    assert ("batches" in config.step_options()) is (adjoint == "batched")
    assert load_text(tmp_path, dump(config)) == config
