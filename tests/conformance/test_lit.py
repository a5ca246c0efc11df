"""Sensors for which some lamps are off: images and gradients are those of a scene without these lamps."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from conformance.operations import LARGE
from conformance.scenes import WHITE, ball, bitmap, images, lamp, rgb, stage
from turns import taking_turns

from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.step import known_step, render_image

pytestmark = pytest.mark.usefixtures("samples")

#: The lamps, in the order of `mi.Scene.emitters()`. The camera sees the panel and the sky, and the globe in part.
LAMPS = ("globe", "panel", "bulb", "sky")
LIT = [("bulb",), ("panel", "bulb"), ("globe", "sky"), ("sky",), ("globe", "panel", "sky")]
OPTIONS = {"max_depth": 4, "rr_depth": 100}
SEEDS = 8


def room(lit: tuple[str, ...]) -> Any:
    """Return the stage with the lamps `lit`. The other lamps are dark shapes, or missing."""
    globe = ball(WHITE, (-1, 1.4, 0.3), 0.3) | {"emitter": {"type": "area", "radiance": rgb(2, 3, 2)}}
    panel = lamp(position=(0.4, 1.6, -0.8), target=(0, 0.3, 2))
    for name, shape in (("globe", globe), ("panel", panel)):
        if name not in lit:
            del shape["emitter"]
    others = {
        "bulb": {"type": "point", "position": [1, 1.5, 1], "intensity": rgb(3, 2, 1), "sampling_weight": 2.0},
        "sky": {"type": "constant", "radiance": rgb(0.3, 0.4, 0.8)},
    }
    floor = {"type": "diffuse", "reflectance": bitmap(4, 4)}
    flat = mi.ScalarTransform4f().rotate([1, 0, 0], -90) @ mi.ScalarTransform4f().scale(2)
    return stage({name: others[name] for name in others if name in lit}, globe=globe, panel=panel,
                 floor={"type": "rectangle", "bsdf": floor, "to_world": flat})  # fmt: skip


def names(scene: Any) -> list[str]:
    """Return the name of each emitter of `room`."""
    return [emitter.id() if (shape := emitter.get_shape()) is None else shape.id() for emitter in scene.emitters()]


def lit_by(lit: tuple[str, ...], scene: Any, **options: Any) -> Any:
    """Return the tracer for which only the lamps `lit` of `scene` are on."""
    tracer = make_integrator("reslrb", **OPTIONS, **options)
    return tracer.lit_by({0: tuple(index for index, name in enumerate(names(scene)) if name in lit)})


@pytest.fixture(scope="module")
def whole(llvm: str) -> Any:
    """The stage with all lamps."""
    return room(LAMPS)


FEW = ("('panel', 'bulb')", "('globe', 'sky')", "('globe', 'panel', 'sky')")
IN_TURNS = taking_turns("lit", LIT, "paths", ("light", "camera", "both"), FEW)


@IN_TURNS
def test_images_lack_the_light_of_lamps_that_are_off(whole: Any, lit: tuple[str, ...], paths: str) -> None:
    tracer = lit_by(lit, whole, paths=paths, estimator="stack")
    ours = np.stack([np.array(render_image(tracer, whole, 0, seed, 64), np.float64) for seed in range(SEEDS)])
    theirs = images(room(lit), "path", range(100, 100 + SEEDS), 64, **OPTIONS)
    inner = slice(1, -1)  # light paths alone leave the border darker
    result = compare(ours[:, inner, inner], theirs[:, inner, inner])
    assert result, result


def test_a_lamp_that_is_never_sampled_is_still_met(llvm: str) -> None:
    bulbs = {f"bulb {k}": {"type": "point", "position": [k, 1.5, 1]} for k in range(2)}
    scene = stage({**bulbs, "lamp": lamp(position=(0.4, 1.6, -0.8), target=(0, 0.3, 2), sampling_weight=0.0)})
    seen = [render_image(lit_by(lit, scene, paths="camera", estimator="stack"), scene, 0, 1, 16).array
            for lit in (("bulb 0", "lamp"), ("bulb 0",))]  # fmt: skip
    assert float(dr.max(seen[0])[0]) > 5 > float(dr.max(seen[1])[0])


def gradients(tracer: Any, scene: Any, keys: list[str], seeds: range) -> np.ndarray:
    """Return the gradients of the mean image for each seed, as one flat array (N, P)."""
    params, found = mi.traverse(scene), []
    film = scene.sensors()[0].film().size()
    ones = dr.ones(mi.TensorXf, (int(film[1]), int(film[0]), 3))
    for seed in seeds:
        for key in keys:
            params[key] = type(params[key])(dr.detach(params[key]))
            dr.enable_grad(params[key])
        params.update()
        known_step(tracer, scene, 0, ones, seed=seed, spp=64, params=params)
        found.append(np.concatenate([np.array(dr.grad(params[key])).ravel() for key in keys]))
    return np.stack(found)


@IN_TURNS
def test_gradients_lack_the_light_of_lamps_that_are_off(whole: Any, lit: tuple[str, ...], paths: str) -> None:
    floor, radiance = "floor.bsdf.reflectance.data", "panel.emitter.radiance.value"
    found = gradients(lit_by(lit, whole, paths=paths, estimator="stack"), whole, [floor, radiance], range(SEEDS))
    if "panel" not in lit:
        assert not found[:, -3:].any()  # the radiance of a lamp that is off has no effect
    alone = room(lit)
    keys = [floor, radiance] if "panel" in lit else [floor]
    plain = make_integrator("reslrb", **OPTIONS, paths=paths, estimator="stack")
    wanted = gradients(plain, alone, keys, range(100, 100 + SEEDS))
    result = compare(found[:, : wanted.shape[1]], wanted, block=None)
    assert result, result


def test_views_with_other_lamps_of_one_kind_share_kernels(whole: Any) -> None:
    scene = stage({f"bulb {k}": {"type": "point", "position": [k, 1.5, 1]} for k in range(3)})
    seen = []
    for lit in (0, 2):
        tracer = make_integrator("reslrb", **OPTIONS, paths="both", estimator="stack").lit_by({0: (lit,)})
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            render_image(tracer, scene, 0, 1, 4)
            kernels = dr.kernel_history((dr.KernelType.JIT,))
            seen.append({kernel["hash"] for kernel in kernels if kernel["operation_count"] >= LARGE})
    assert seen[0]
    assert seen[1] == seen[0]
