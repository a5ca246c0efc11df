"""Light that moves at the film's border is measured and warned of."""

from __future__ import annotations

import types
from typing import Any

import drjit as dr
import mitsuba as mi
import pytest
from conformance.moving import SIZE, Moving, camera
from conformance.moving_lamps import over_floor, surface

from reslrb_cli.integrators.protocol import Job
from reslrb_cli.measure.gradients import integrator
from reslrb_cli.optimization.moving import border_share, warn_of_border

pytestmark = pytest.mark.usefixtures("llvm")
RADIUS = 2.0  # of Mitsuba's gaussian filter, pixels


def moving(scale: float, film: dict[str, Any] | None = None, **things: Any) -> Moving:
    """A parallel lamp that lights a square of this size, straight below it, of a floor that is seen to 1.73."""
    lamp = surface("rectangle", "directionalarea")
    down = mi.ScalarTransform4f().translate([0, 4, 0]) @ mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    lamp["to_world"] = down @ mi.ScalarTransform4f().scale(scale)
    scene = over_floor(lamp, **things)
    scene["camera"] = scene["camera"] | {"film": camera(**(film or {}))["film"]}

    def place(params: mi.SceneParameters, latents: dict[str, Any]) -> None:
        shift = mi.AffineTransform4f().translate(mi.Vector3f(latents["x"], 0, 0))
        params["light.to_world"] = shift @ mi.AffineTransform4f((down @ mi.ScalarTransform4f().scale(scale)).matrix)

    return Moving(scene, {"x": 0.0}, place)


def tracked(case: Moving) -> None:
    """Have the lamp's place track derivatives."""
    x = dr.opaque(mi.Float, 0)
    dr.enable_grad(x)
    case.set({"x": x})


def share(case: Moving) -> float:
    """The measured share."""
    ours = integrator("reslrb", 2, estimator="stack")
    return border_share(ours, Job(case.loaded, case.loaded.sensors()[0], dr.opaque(mi.UInt32, 3), 64, case.params))


def test_light_that_covers_the_film_is_at_its_border_as_far_as_the_filter_reaches():
    case = moving(3)
    tracked(case)
    assert share(case) == pytest.approx(1 - (1 - 2 * RADIUS / SIZE) ** 2, rel=0.03)


def test_light_within_the_film_is_not():
    case = moving(1)
    tracked(case)
    assert share(case) == 0


def test_what_rests_does_not_count():
    case = moving(1, sun={"type": "directional", "direction": [0, -1, 0]})
    tracked(case)
    assert share(case) == 0


def test_nothing_moves():
    assert share(moving(3)) == 0


def test_a_crop_window_has_a_border_of_its_own():
    crop = {"crop_offset_x": 8, "crop_offset_y": 8, "crop_width": 16, "crop_height": 16}
    case = moving(3, crop)
    tracked(case)
    assert share(case) == pytest.approx(1 - (1 - 4 * RADIUS / SIZE) ** 2, rel=0.03)


@pytest.mark.parametrize(("scale", "lines"), [(3, 1), (1, 0)])
def test_a_run_is_told_once_a_view(scale: float, lines: int):
    case, said = moving(scale), []
    tracked(case)
    problem: Any = types.SimpleNamespace(
        integrator=integrator("reslrb", 2, estimator="stack"), scene=case.loaded, sensors=[0],
        config=types.SimpleNamespace(run=types.SimpleNamespace(seed=1)),
        selection=types.SimpleNamespace(params=case.params))  # fmt: skip
    warn_of_border(problem, said.append)
    assert len(said) == lines
    assert all(line.startswith("view 0: 2") and "% of the light that moves" in line for line in said)


def test_other_integrators_are_not_asked():
    problem: Any = types.SimpleNamespace(integrator=integrator("ptracer", 2))
    warn_of_border(problem, pytest.fail)
