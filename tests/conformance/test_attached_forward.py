"""Forward mode where light moves, against the gradient at equal seeds: <weights, J v> = <J^T weights, v>."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.moving import rippled, under_glass
from measure.moving_light import SCENES
from measure.test_mutations import plant
from turns import taking_turns

from reslrb_cli import register
from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.measure.gradients import integrator, relative

pytestmark = pytest.mark.usefixtures("llvm")
ROUNDING = 3e-5
QUICK = ("slab", "bounce")
SAMPLING = ("follow", "stay")


def distance(name: str, sampling: str) -> float:
    """The largest deviation of all derivatives, relative to the largest of them."""
    case, options = SCENES[name].case(), dict(SCENES[name].options)
    options |= {"attached_sampling": sampling}
    tracer = integrator("reslrb", **options, estimator="stack")
    gradient = case.gradient(tracer, 100, 16)
    tangents = np.array([case.tangent(tracer, direction, 100, 16) for direction in np.eye(len(gradient))[:3]])
    assert np.abs(gradient[:3]).min() > 0
    return float(np.abs(tangents - gradient[:3]).max() / np.abs(gradient).max())


@taking_turns("name", QUICK, "sampling", SAMPLING)
def test_forward_against_backward(name: str, sampling: str):
    assert_forward_is_backward(name, sampling)


@pytest.mark.long
@pytest.mark.parametrize("sampling", SAMPLING)
@pytest.mark.parametrize("name", ["rough_surface", "mirror", "sphere_lens", "moved_receiver", "rough_surface_alpha"])
def test_forward_against_backward_in_other_scenes(name: str, sampling: str):
    assert_forward_is_backward(name, sampling)


def assert_forward_is_backward(name: str, sampling: str) -> None:
    """Up to rounding."""
    found = distance(name, sampling)
    print(name, sampling, found)
    assert found < ROUNDING


@dataclass(frozen=True)
class Fault:
    """As `plant` takes it."""

    right: str
    wrong: str
    where: str = "integrators.forward:AttachedTangentSplat.scattering"


FAULTS = {
    "slab": Fault("dr.set_grad(ray.d, state.d_direction)", "pass"),
    "mirror": Fault(" + dk * C", ""),
    "rough_surface": Fault("state.d_product * c + P * dc", "P * dc"),
}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS)
def test_it_fits_the_code(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    plant(fault, monkeypatch)


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n == "slab" else pytest.mark.long) for n in FAULTS])
def test_fault(name: str, monkeypatch: pytest.MonkeyPatch):
    plant(FAULTS[name], monkeypatch)
    assert distance(name, "stay") > 30 * ROUNDING


class Script:
    """As Mitsuba's users write it: a slab under `mi.render`, whose ripples grow by an amplitude."""

    def __init__(self, normalization: str) -> None:
        register()
        self.scene = mi.load_dict(under_glass())
        self.params = mi.traverse(self.scene)
        self.shared = {"max_depth": 5, "hide_emitters": True, "filter_normalization": normalization}

    def render(self, **plugin: Any) -> tuple[mi.Float, mi.TensorXf]:
        """The amplitude, which tracks derivatives, and the image."""
        positions, rest = (mi.Float(rippled(2.0, 12, ripples).astype(np.float32).ravel()) for ripples in (1.0, 0.0))
        amplitude = mi.Float(1)
        dr.enable_grad(amplitude)
        self.params["slab.vertex_positions"] = rest + (positions - rest) * amplitude
        self.params.update()
        integrator = mi.load_dict(plugin | self.shared)
        return amplitude, mi.render(self.scene, self.params, integrator=integrator, spp=16, seed=1)

    def tangent(self, **plugin: Any) -> np.ndarray:
        """The image's derivative."""
        amplitude, image = self.render(**plugin)
        dr.forward(amplitude)
        return np.array(dr.grad(image))


@pytest.mark.parametrize("normalization", ["attached", pytest.param("detached", marks=pytest.mark.long)])
def test_as_a_plugin(normalization: str):
    """`dr.forward` of a script against its `dr.backward`, for a random dL/dI: a wrong pixel shows."""
    script, plugin = Script(normalization), {"type": "reslrb", "estimator": "stack"}
    tangent = np.float64(script.tangent(**plugin))
    weights = np.random.default_rng(1).uniform(-1, 1, tangent.shape)
    amplitude, image = script.render(**plugin)
    dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None))
    assert np.abs(tangent).max() > 0
    assert abs(np.sum(tangent * weights) - dr.grad(amplitude)[0]) < ROUNDING * np.linalg.norm(tangent)


@pytest.mark.long  # forward mode of naive AD is compiled for a minute
@pytest.mark.parametrize("normalization", ["attached", "detached"])
def test_as_a_plugin_every_pixel_is_that_of_naive_ad(normalization: str):
    script = Script(normalization)
    ours, naive = script.tangent(type="reslrb", estimator="stack"), script.tangent(type="walk_ad", attached=True)
    assert np.abs(naive).max() > 0
    assert relative(ours, naive) < ROUNDING


def test_a_lamp_that_moves_is_refused():
    case = SCENES["moved_point"].case()
    with pytest.raises(UnsupportedScene, match="forward mode has no derivatives of emitters that move"):
        case.tangent(integrator("reslrb", 2, estimator="stack"), np.array([1.0, 0, 0]), 1, 4)
