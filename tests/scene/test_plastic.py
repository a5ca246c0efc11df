"""The derivatives of a `roughplastic` by its roughness and its index reach the tables that Mitsuba makes of them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.integrators.plugin import register
from reslrb_cli.integrators.step import known_step
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.scenes.small import rgb, room
from reslrb_cli.scene import plastic as plastic_tables
from reslrb_cli.scene.plastic import PlasticTables, tables, with_tables

pytestmark = pytest.mark.usefixtures("llvm")

#: Rounding of Mitsuba's tables, divided by the step.
STEP, ROUNDING = 0.02, 4e-3


def plastic(**options: Any) -> mi.BSDF:
    return mi.load_dict({"type": "roughplastic", "diffuse_reflectance": rgb(0.6, 0.3, 0.2), **options})


def value(bsdf: mi.BSDF) -> Any:
    """Return the sum of the BSDF's values for some pairs of directions."""
    si = dr.zeros(mi.SurfaceInteraction3f, 3)
    si.wi = dr.normalize(mi.Vector3f([0.1, 0.7, -0.9], 0.2, [0.9, 0.5, 0.1]))
    wo = dr.normalize(mi.Vector3f([0.3, -0.6, 0.2], [-0.3, 0.4, 0.8], [0.8, 0.2, 0.5]))
    return dr.sum(dr.sum(bsdf.eval(mi.BSDFContext(), si, wo)))


def differences(bsdf: mi.BSDF, name: str) -> float:
    params = mi.traverse(bsdf)
    now, found = float(params[name][0]), []
    for side in (1, -1, 0):
        params[name] = mi.Float(now + side * STEP)
        params.update()
        found.append(float(value(bsdf)[0]))
    return (found[0] - found[1]) / (2 * STEP)


@pytest.mark.parametrize(("name", "options"), [
    ("alpha", {"alpha": 0.4}),
    ("eta", {"alpha": 0.3}),
    ("alpha", {"alpha": 0.3, "nonlinear": True, "distribution": "ggx"}),
    ("eta", {"alpha": 0.2, "nonlinear": True, "distribution": "ggx"}),
])  # fmt: skip
def test_gradients_reach_the_tables(name: str, options: dict[str, Any]) -> None:
    bsdf = plastic(**options)
    params, expected = mi.traverse(bsdf), differences(bsdf, name)
    before = [np.array(table) for table in tables(bsdf)]
    leaf = dr.opaque(mi.Float, float(params[name][0]))
    dr.enable_grad(leaf)
    params[name] = leaf
    params.update()
    made = PlasticTables(params)
    made.place()
    assert all(np.array_equal(old, np.array(new)) for old, new in zip(before, tables(bsdf), strict=True))
    dr.backward(value(bsdf))
    plain = float(dr.grad(leaf)[0])
    made.collect()
    assert float(dr.grad(leaf)[0]) == pytest.approx(expected, rel=ROUNDING, abs=ROUNDING)
    assert plain != pytest.approx(expected, rel=0.05, abs=ROUNDING)  # Mitsuba's own derivative


@pytest.mark.parametrize(("name", "alpha", "eta", "step"), [
    ("alpha", 0.4, 1.5, 0.04), ("alpha", 0.05, 1.5, 0.0125), ("eta", 0.4, 1.5, 0.03), ("eta", 0.4, 1.04, 0.005),
    ("eta", 0.4, 0.96, 0.005),
])  # fmt: skip
def test_the_steps_of_the_slopes_are_small(
    monkeypatch: pytest.MonkeyPatch, name: str, alpha: float, eta: float, step: float
) -> None:
    """They never reach a roughness of 0, or an index of 1. The differences are exact for polynomials of degree 4."""
    ends: list[float] = []

    def pretended(node: mi.BSDF) -> tuple[mi.Float, mi.Float]:
        found = {key: float(mi.traverse(node)[key][0]) for key in ("alpha", "eta")}
        ends.append(found[name])
        return mi.Float(found["alpha"] * found["eta"]), mi.Float((found[name] / center) ** 4)

    center = {"alpha": alpha, "eta": eta}[name]
    monkeypatch.setattr(plastic_tables, "tables", pretended)
    slopes = plastic_tables._differences.__wrapped__("ggx", alpha, eta, name)
    assert ends == pytest.approx([center + side * step for side in (1, -1, 2, -2)], abs=1e-6)
    expected = [eta if name == "alpha" else alpha, 4 / center]
    assert [float(found[0]) for found in slopes] == pytest.approx(expected, rel=1e-3)


def test_slopes_ignore_the_waves_of_a_table() -> None:
    """Mitsuba's r has waves over short distances. A polynomial through many tables has the slope without the waves."""
    offsets = np.linspace(-0.05, 0.05, 16)
    made = [tables(plastic(alpha=0.1 + offset, distribution="ggx"))[1] for offset in offsets]
    expected = np.polyfit(offsets, [float(each[0]) for each in made], 3)[-2]
    slope = plastic_tables._differences.__wrapped__("ggx", 0.1, 1.5, "alpha")[1]
    assert float(slope[0]) == pytest.approx(expected, rel=0.04)


def test_without_derivatives_the_tables_are_mitsubas() -> None:
    bsdf = plastic(alpha=0.3)
    before = tables(bsdf)
    with with_tables(mi.traverse(bsdf)):
        assert dr.detail.collect_indices(tables(bsdf)) == dr.detail.collect_indices(before)


def test_users_loops_get_the_same_derivative() -> None:
    register()
    case = Case(room(floor={"type": "roughplastic", "alpha": 0.3}), ["floor.alpha"])
    ours = integrator("reslrb", 2, paths="camera", estimator="stack")
    expected = case.gradient(ours, 1, 16, step=case.known_step)[0]
    assert case.tangent(ours, np.ones(1), 1, 16) == pytest.approx(expected, rel=1e-3)
    params = mi.traverse(case.scene)
    leaf = dr.opaque(mi.Float, float(params["floor.alpha"][0]))
    dr.enable_grad(leaf)
    params["floor.alpha"] = leaf
    params.update()
    plugin = mi.load_dict({"type": "reslrb", "max_depth": 2, "rr_depth": 1000, "paths": "camera", "estimator": "stack"})
    image = mi.render(case.scene, params, integrator=plugin, spp=16, seed=1)
    dr.backward(dr.sum((image * case.adjoint).array))
    found = float(dr.grad(leaf)[0])
    assert found == pytest.approx(expected, rel=0.2)  # mi.render has samples of its own for the gradient


def test_each_pass_of_a_step_adds_the_same() -> None:
    """A mask over a plastic got another derivative of its opacity in the second pass of a step."""
    inside = {"type": "plastic", "diffuse_reflectance": rgb(0.6, 0.3, 0.2)}
    scene = room(floor={"type": "mask", "opacity": 0.6, "inside": inside})
    case = Case(scene, ["floor.opacity.value", "floor.nested_bsdf.diffuse_reflectance.value"])
    ours, leaves, sums = integrator("reslrb", 3, paths="camera", estimator="stack"), case.leaves(), [0.0]
    for _ in range(3):
        known_step(ours, case.scene, 0, case.adjoint, seed=1, spp=16, params=case.params)
        sums.append(float(dr.grad(leaves["floor.opacity.value"])[0]))
    first, *others = np.diff(sums)
    assert others == pytest.approx([first, first], rel=1e-4)
    # With one thread, the derivative is right even if the sampling weight has a derivative.
    [node] = {node for _, _, node, _ in case.params.properties.values() if node.class_name() == "SmoothPlastic"}
    assert plastic_tables._arrays(node)[-1] >> 32 == 0
