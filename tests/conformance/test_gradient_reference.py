"""The reservoir estimator's gradient against `ptracer`, `prb` and finite differences: equal in expectation."""

from __future__ import annotations

import numpy as np
import pytest
from agreement import Agreement, compare
from conformance.gradient_cases import CASES, IN_EXPECTATION, GradientCase
from turns import a_few

from reslrb_cli.measure.gradients import Case, integrator, seeds

pytestmark = pytest.mark.usefixtures("llvm")

#: The noise of a comparison may be so much of the gradient, else it could not see a wrong one.
RESOLUTION = 0.1


def agreement(case: GradientCase, count: int) -> Agreement:
    """Compare gradients over `count` seeds each."""
    scene = Case(case.scene(), case.keys)
    ours = scene.gradients(integrator("reslrb", **case.both | case.options), seeds(count), case.spp)
    if case.reference == "fd":
        image = integrator("reslrb", **case.both)
        directions = scene.directions(max(2, count // 16))
        ours = ours @ directions.T
        reference = np.array([
            [scene.difference(image, direction, seed, case.spp, case.step, case.sides) for direction in directions]
            for seed in seeds(count, 1)
        ])  # fmt: skip
    else:
        reference = scene.gradients(integrator(case.reference, **case.both), seeds(count, 1), case.spp)
    size = np.linalg.norm(reference.mean(0))
    noise = np.linalg.norm(np.hypot(ours.std(0), reference.std(0))) / np.sqrt(count)
    assert noise < RESOLUTION * size, f"{case.name}: standard error {noise / size:.1%} of the gradient"
    return compare(ours, reference, block=None)


@pytest.mark.parametrize("case", a_few(CASES, IN_EXPECTATION))
def test_gradient(case: GradientCase):
    result = agreement(case, 16)
    print(case.name, case.reference, result)
    assert result


@pytest.mark.long
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_gradient_over_64_seeds(case: GradientCase):
    result = agreement(case, 64)
    print(case.name, case.reference, result)
    assert result
