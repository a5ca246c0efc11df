"""Gradcheck of parameters that move light: which references count, and which estimators take part."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from measure.faults import checked, room

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.gradcheck import Gradcheck
from reslrb_cli.measure.gradients import Case, moves_light, smooth_rows, smooth_weights
from reslrb_cli.measure.methods import all_estimators, parse_estimators
from reslrb_cli.measure.participants import Participants, Settings
from reslrb_cli.measure.references import Situation, prb_gradient, ptracer_gradient
from reslrb_cli.measure.scenes.small import camera, diffuse, lamp
from reslrb_cli.measure.scenes.small import room as corner
from reslrb_cli.records.measurements import Kind, Reference, Verdict

pytestmark = pytest.mark.usefixtures("llvm")
CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_a_lamp_that_moves():
    records = checked(room("lamp_over_floor.xml", "lamp.position"), "stack", 4)
    of = {record.reference: record for record in records if record.parameter is not None}
    assert of[Reference.WALK_AD].kind is Kind.EQUAL_SEEDS
    assert of[Reference.WALK_AD].holds
    assert of[Reference.FINITE_DIFFERENCE].holds
    assert of[Reference.FINITE_DIFFERENCE].relative_l2 < 5e-3
    assert of[Reference.PTRACER].verdict is Verdict.NO_REFERENCE
    assert "an emitter that moves" in of[Reference.PTRACER].message
    assert Reference.FORWARD_MODE not in of


def test_who_takes_part():
    config = room("lamp_over_floor.xml", "lamp.position")
    some = Gradcheck(Settings(config, all_estimators(config), 0, 3, named=False))
    assert [case.label for case in some.participants.listed] == ["reslrb:reservoir", "reslrb:stack"]
    assert {row.label for row in some.rows if row.key is not None} == {"reslrb:reservoir", "reslrb:stack"}
    with pytest.raises(ConfigError, match="gather has no derivatives of what moves light; take reservoir, stack"):
        Gradcheck(Settings(config, parse_estimators("gather,stack"), 0, 3))
    still = room("lamp_over_floor.xml", "floor.bsdf.reflectance.value")
    all_of_them = Gradcheck(Settings(still, all_estimators(still), 0, 3, named=False))
    assert len(all_of_them.participants.listed) == 4


def test_ways_to_differentiate_the_film():
    """Beside differences the filter's normalisation has its derivative, beside `ptracer` none; naive AD follows."""
    parts = Gradcheck(
        Settings(room("wavy_glass.xml", "top.vertex_positions"), parse_estimators("stack"), 0, 3)
    ).participants
    assert parts.stock == {"top.vertex_positions": Reference.PTRACER}
    assert parts.sampled("reslrb:stack", Reference.WALK_AD) == "reslrb:stack, as walk_ad"
    assert parts.sampled("reslrb:stack", Reference.FINITE_DIFFERENCE) == "reslrb:stack"
    assert parts.sampled("reslrb:stack", Reference.PTRACER) == "reslrb:stack, as ptracer"
    assert set(parts.integrators) >= {"reslrb:stack", "reslrb:stack, as walk_ad", "reslrb:stack, as ptracer"}
    assert parts.forward_mode


@pytest.mark.parametrize("name", ["caustic_heightmap", pytest.param("lens_pose", marks=pytest.mark.long)])
def test_forward_mode_of_what_is_a_function(name: str):
    """Heights and motions are not in the scene: tangents have to reach what is, as gradients come back from there."""
    small = ["scene.options={resx: 16, resy: 16}", "run.spp=4", "target.render.spp=4"]
    parts = Participants(Settings(load(CONFIGS / f"{name}.yaml", small), parse_estimators("stack"), 0, 3))
    [label] = (case.label for case in parts.listed)
    gradient, slices = parts.gradient(label, 1), parts.slices()
    for key in parts.case.keys:
        along = [gradient @ direction.vector for direction in parts.directions[key]]
        print(key, along, parts.tangents(label, key, 1))
        assert gradient[slices[key]].any()
        np.testing.assert_allclose(parts.tangents(label, key, 1), along, rtol=1e-3, atol=1e-4 * np.abs(along).max())


def test_references_of_what_moves():
    scene = corner(camera=camera("gaussian"), ball={"type": "sphere", "radius": 0.3, "bsdf": diffuse(0.5, 0.5, 0.5)},
                   lamp=lamp(radiance=1.0))  # fmt: skip
    case = Case(scene, [])

    def at(*moved: str) -> Situation:
        sensor = case.scene.sensors()[0]
        return Situation.of(case.scene, sensor, case.params, 4, True, True, moved)

    assert moves_light(case.params, "ball.to_world")
    assert moves_light(case.params, "lamp.translation")
    assert not moves_light(case.params, "ball.bsdf.reflectance.value")
    assert ptracer_gradient(at("ball.to_world"), "ball.to_world") is None
    assert "emitter" in (ptracer_gradient(at("lamp.to_world"), "lamp.to_world") or "")
    assert "emitter" in (ptracer_gradient(at("ball.to_world", "lamp.to_world"), "ball.translation") or "")
    assert "moves light" in (prb_gradient(at("ball.to_world"), "ball.to_world") or "")


def test_smooth_directions():
    """Neighbours move alike: otherwise the least step would fold a mesh."""
    points = np.stack(np.meshgrid(np.linspace(0, 1, 50), [0.0], np.linspace(0, 1, 50)), -1).reshape(-1)
    for row in smooth_rows("top.vertex_positions", points, 5.0, 3):
        field = row.reshape(50, 50, 3)
        assert 0.01 < np.abs(field).max() < 0.5
        assert np.abs(np.diff(field, axis=0)).max() < 0.1 * np.abs(field).max() + 1e-12
    [relief] = smooth_rows("top.heightmap", np.zeros((20, 30)), 5.0, 1)
    assert relief.shape == (600,)
    [turn] = smooth_rows("top.rotation", np.zeros(3), 5.0, 1)
    assert 5 <= np.abs(turn).max() <= 10
    weights = smooth_weights(16, 24)
    assert weights.mean() == pytest.approx(1)
    assert weights[0].max() == weights[:, -1].max() == 0
