"""Steps in which no light path meets anything: their gradient is zero, and nothing fails."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.integrators.step import gradient_step, make_integrator

pytestmark = pytest.mark.usefixtures("llvm")


def lit_from_behind() -> mi.Scene:
    """A wall, and a lamp that shines the other way."""
    lamp = mi.ScalarTransform4f().translate([0, 0, 5])
    return mi.load_dict({
        "type": "scene",
        "sensor": {
            "type": "perspective", "fov": 50.0,
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 4], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
        },
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area"}},
    }, optimize=False)  # fmt: skip


@pytest.mark.parametrize("adjoint", ["correlated", "independent", "batched"])
@pytest.mark.parametrize("name", ["ptracer", "reslrb"])
def test_the_gradient_is_zero(name: str, adjoint: str) -> None:
    scene = lit_from_behind()
    params = mi.traverse(scene)
    [key] = [key for key in params.keys() if key.startswith("wall") and key.endswith("reflectance.value")]  # noqa: SIM118
    dr.enable_grad(params[key])
    params.update()
    options: dict[str, Any] = {"batches": 2} if adjoint == "batched" else {}

    def loss(image: Any) -> Any:
        return dr.mean(dr.square(image - 0.5).array)

    integrator = make_integrator(name, max_depth=3)
    step = gradient_step(integrator, scene, 0, loss, spp=4, seed=1, adjoint=adjoint, params=params, **options)
    dr.eval(step.loss)
    assert np.array(step.loss) == pytest.approx(0.25)
    assert (np.array(dr.grad(params[key])) == 0).all()
