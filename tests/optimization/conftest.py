"""The variant of these tests, and a gradient step that needs no scene."""

from __future__ import annotations

import types

import drjit as dr
import pytest

from reslrb_cli.integrators.step import Refused
from reslrb_cli.optimization import loop


@pytest.fixture(autouse=True)
def _variant(llvm):
    """LLVM variant, because these tests check arithmetic and not a device."""


@pytest.fixture
def steps(monkeypatch, request):
    """Replace the gradient step by a step whose image is the mean of the parameters. Return the state of the replaced
    step, which lists its calls.

    `steps.spoil(call, key)` returns the factor of a gradient. `steps.derivative(call)` returns the dL/dI whose
    non-finite entries are refused. `steps.loss(call)` returns a number that is added to the loss.
    """
    calls = []
    state = types.SimpleNamespace(calls=calls, problem=None, spoil=lambda call, key: 1.0)
    state.loss = lambda call: 0.0
    state.derivative = lambda call: dr.zeros(dr.llvm.ad.TensorXf, (2, 2, 3))

    def gradient_step(integrator, scene, sensor, objective, *, seed, spp, adjoint, params, on_samples):
        number = len(calls)
        calls.append(types.SimpleNamespace(sensor=sensor, seed=seed, spp=spp, adjoint=adjoint))
        factors = {key: state.spoil(number, key) for key in params}
        image = sum((dr.replace_grad(dr.detach(value), value * factors[key]) for key, value in params.items()), 0.0)
        image = image / len(params)
        loss = objective(image)
        dr.backward(loss)
        refused = Refused()
        refused.take(state.derivative(number))
        return types.SimpleNamespace(image=dr.detach(image), loss=dr.detach(loss) + state.loss(number), refused=refused)

    monkeypatch.setattr(loop, "gradient_step", gradient_step)
    return state
