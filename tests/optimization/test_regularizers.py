"""Regularizers: derivatives, small dependence on the resolution, and effect on a run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reslrb_cli.config.parameters import ParameterSpec, Thickness, TotalVariation
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.regularizers import Span, make_cost, spans_of

ALL = {
    "thickness": Thickness(thickness=0.3, least=0.4, weight=2),
    "total_variation": TotalVariation(),
}
WIDE, HIGH = 10.0, 7.0
WHOLE = Span(WIDE), Span(HIGH)


def waves(n, depth=0.3):
    """Return heights at the centres of n x n texels."""
    x, y = np.meshgrid(*[(np.arange(n) + 0.5) / n] * 2)
    return (depth * np.sin(5 * x + 0.4) * np.cos(4 * y + 1.3))[:, :, None]


def sheet(n):
    """Return positions of a flat grid of n x n vertices from edge to edge, and texture coordinates at the texels'
    centres.
    """
    x, y = np.meshgrid(np.linspace(0, WIDE, n), np.linspace(0, HIGH, n))
    u = (np.arange(n) + 0.5) / n
    uv = np.stack(np.meshgrid(u, u), axis=-1).reshape(-1, 2)
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3), uv


def test_the_weights_of_texels_add_up_to_the_surface():
    assert sum(spans_of(*sheet(97))[0].weights(97, 0.5, 96.5)) == pytest.approx(WIDE)


@pytest.mark.parametrize("name", ALL)
def test_derivatives_match_finite_differences(name):
    rng = np.random.default_rng(3)
    cost = make_cost(ALL[name], (Span(10, 0.02, 0.97), Span(7)))
    heights = rng.normal(size=(9, 11, 3 if name == "total_variation" else 1))
    value, gradient = cost(heights)
    assert value > 0
    for _ in range(3):
        way = rng.normal(size=heights.shape)
        slope = (cost(heights + 1e-6 * way)[0] - cost(heights - 1e-6 * way)[0]) / 2e-6
        assert np.sum(gradient * way) == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("name", ALL)
def test_refining_a_map_keeps_its_cost(name):
    cost = make_cost(ALL[name], WHOLE)
    coarse, fine = (cost(waves(n))[0] for n in (32, 128))
    assert coarse == pytest.approx(fine, rel=0.02)


def test_lengths_are_in_scene_units():
    """A ramp of slope 2 varies by 2 per length."""
    n = 64
    x, _ = np.meshgrid(*[((np.arange(n) + 0.5) / n - 0.5) * 2] * 2)
    spans = Span(2), Span(2)
    ramp = 2 * x[:, :, None]
    assert make_cost(TotalVariation(), spans)(ramp)[0] == pytest.approx(8, rel=1e-3)
    assert make_cost(Thickness(thickness=1, least=1.5), spans)(0 * ramp)[0] == pytest.approx(4 * 0.25)


def test_a_plate_keeps_a_tenth_of_its_least_thickness():
    text = {"heightmap": {"mesh": "a", "resolution": [4, 4]}}
    thick = {"type": "thickness", "thickness": 5.0, "least": 1.0}
    assert ParameterSpec(**text, regularizers=[thick]).settings().bounds == (pytest.approx(-4.9), np.inf)
    spec = ParameterSpec(**text, regularizers=[thick], bounds=[-1.0, 2.0])
    assert spec.settings().bounds == (-1.0, 2.0)
    assert ParameterSpec(**text).settings().bounds is None


# --- in a run ---------------------------------------------------------------------------------------------------------

ROOT = Path(__file__).parents[2]
HEAD = "heightmap: {mesh: face, resolution: [8, 8]}"


def regularized(tmp_path, listed, head=HEAD, sets=()):
    from reslrb_cli.config.loader import load
    from reslrb_cli.optimization.assemble import assemble_scene

    text = (ROOT / "configs/caustic_heightmap.yaml").read_text().replace("../", f"{ROOT}/")
    path = tmp_path / "c.yaml"
    path.write_text(text)
    spec = f"parameters=[{{{head}{', regularizers: ' + listed if listed else ''}}}]"
    return assemble_scene(load(path, [spec, *sets]))


def test_cost_and_gradient_are_added_once_per_step(tmp_path):
    listed = "[{type: total_variation, weight: 3}, {type: thickness, thickness: 0.05, least: 0.1}]"
    problem = regularized(tmp_path, listed)
    key = problem.selection.keys[0]
    problem.optimizer.set_value(key, type(problem.optimizer[key])(waves(8, 0.02).astype(np.float32)))
    told = problem.regularize()
    expected = {name: cost(waves(8, 0.02)) for name, cost in problem.regularizers[key].items()}
    assert told[key] == {name: pytest.approx(value, rel=1e-4) for name, (value, _) in expected.items()}
    found = np.array(problem.optimizer.gradient(key))
    assert np.allclose(found, sum(each for _, each in expected.values()), rtol=1e-3, atol=1e-6 * abs(found).max())
    assert problem.held() == {key: 0}


def test_heights_never_cross_the_back_and_are_counted(tmp_path):
    import drjit as dr

    problem = regularized(tmp_path, "[{type: thickness, thickness: 0.05, least: 0.1}]")
    key, pushed = "face.heightmap", np.zeros((8, 8, 1), np.float32)
    pushed[2, 1:4] = 1e6
    dr.set_grad(problem.optimizer[key], type(problem.optimizer[key])(pushed))
    problem.optimizer.step(1.0)
    problem.apply()
    heights = problem.selection.array(key)
    assert heights[2, 1:4] == pytest.approx(0.01 - 0.05)
    assert np.count_nonzero(heights) == 3
    assert problem.held() == {key: 3}


def test_a_bitmap_is_measured_in_its_texture_coordinates(tmp_path):
    import mitsuba as mi

    from reslrb_cli.optimization.problem import make_regularizers
    from reslrb_cli.scene.load import load_scene
    from reslrb_cli.scene.parameters import select_parameters

    ramp = np.tile(np.linspace(0.1, 0.9, 8, dtype=np.float32)[None, :, None], (8, 1, 3))
    mi.util.write_bitmap(str(tmp_path / "ramp.exr"), ramp, write_async=False)
    (tmp_path / "s.xml").write_text("""<scene version="3.0.0"><sensor type="perspective"/><emitter type="constant"/>
        <shape type="rectangle"><bsdf type="diffuse" id="wall"><texture type="bitmap" name="reflectance">
        <string name="filename" value="ramp.exr"/></texture></bsdf></shape></scene>""")
    costs = []
    for size in (8, 32):
        listed = [{"type": "total_variation"}]
        spec = ParameterSpec(key="*.reflectance.data", resolution=(size, size), regularizers=listed)
        selection = select_parameters(load_scene(tmp_path / "s.xml"), [spec], "c.yaml")
        [(key, made)] = make_regularizers(selection).items()
        costs.append(made["total_variation"](np.asarray(selection.array(key), np.float64))[0])
        assert made["total_variation"](np.ones((size, size, 3)))[0] == 0
    slope = 3**0.5 * 0.8 / 7 * 8
    assert costs[0] == pytest.approx(slope, rel=2e-3)
    assert costs[1] == pytest.approx(slope, rel=0.15)  # resampling makes the rim flat
    bad = ParameterSpec(key="*.reflectance.data", regularizers=[{"type": "thickness", "thickness": 1.0, "least": 0.5}])
    with pytest.raises(ConfigError, match="a bitmap; use total_variation"):
        select_parameters(load_scene(tmp_path / "s.xml"), [bad], "c.yaml")


@pytest.mark.parametrize("spp", [2, 8])
def test_a_run_records_it(tmp_path, spp):
    from reslrb_cli.optimization.loop import optimize

    sets = ["scene.size=[8,8]", "run.iterations=2", f"run.spp={spp}", "target={render: {spp: 4}}",
            "optimizer={type: sgd, learning_rate: 1.0e-30}"]  # fmt: skip
    listed = "[{type: thickness, thickness: 1, least: 1.5, weight: 1.0e+9}]"
    problem = regularized(tmp_path, listed, sets=sets)
    from reslrb_cli.optimization.targets import make_targets

    problem = replace(make_targets(problem, lambda line: None), truth={})
    records = list(optimize(problem))
    costs = [record.regularized.costs["face.heightmap"]["thickness"] for record in records]
    area, gradient = problem.regularizers["face.heightmap"]["thickness"](np.zeros((8, 8, 1)))
    assert costs == [pytest.approx(area)] * 2
    assert records[0].grad_norm == pytest.approx(np.linalg.norm(gradient), rel=1e-4)  # the image's is next to nothing
    assert json.loads(records[0].to_json())["regularized"]["held"] == {"face.heightmap": 0}


REFUSED = {
    "a colour": ("key: '*.reflectance.value'", "[{type: total_variation}]", "has no surface; heightmaps"),
    "a motion": ("motion: {of: face}", "[{type: total_variation}]", "has no surface"),
    "twice": (HEAD, "[{type: total_variation}, {type: total_variation}]", "regularizers[1].type: total_variation is"),
    "unknown": (HEAD, "[{type: smooth}]", "regularizers[0].type"),
    "through": (
        f"{HEAD}, initial: -3.0",
        "[{type: thickness, thickness: 2, least: 1}]",
        "initial: -3 leaves less than a tenth",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_meaningless_settings_are_refused_in_one_line(case, tmp_path):
    head, listed, expected = REFUSED[case]
    with pytest.raises(ConfigError) as error:
        regularized(tmp_path, listed, head)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
