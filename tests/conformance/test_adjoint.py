"""Which samples delta comes from.

With one set for image and gradient an L2 gradient is biased by the image's noise; with an independent set, or in
batches, it is not.
"""

from __future__ import annotations

import numpy as np
import pytest
from agreement import Agreement, compare
from conformance.gradient_cases import FLOOR, floor
from turns import a_few

from reslrb_cli.integrators.step import gradient_step, known_step, render_image, sample_sets
from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.scenes.small import texture

pytestmark = pytest.mark.usefixtures("llvm")
SPP = 4
COUNT = 64
ADJOINTS = {
    "correlated": {"adjoint": "correlated"},
    "independent": {"adjoint": "independent"},
    "two batches": {"adjoint": "batched", "batches": 2},
    "four batches": {"adjoint": "batched", "batches": 4},
    "first batch again": {"adjoint": "batched", "batches": 2, "first_batch": "again"},
}


@pytest.fixture(scope="module")
def case() -> Case:
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": texture(3, 4)}}
    return Case(floor(bsdf), [FLOOR])


@pytest.fixture(scope="module")
def reference(case: Case) -> tuple:
    """Target, and the gradient of the L2 loss: delta at the mean image, over many samples."""
    import mitsuba as mi

    tracer = integrator("reslrb")
    mean = np.mean([render_image(tracer, case.scene, 0, 50_000 + i, 1024) for i in range(8)], axis=0)
    target = mi.TensorXf((mean * np.random.default_rng(3).uniform(0.7, 1.2, mean.shape)).astype(np.float32))
    delta = 2 * (mi.TensorXf(mean.astype(np.float32)) - target) / mean.size
    exact = integrator("reslrb", estimator="gather")

    def step(seed: int) -> np.ndarray:
        return case.gradient(exact, seed, 256, step=lambda *args, **options: known_step(
            *args[:3], delta, seed=options["seed"], spp=options["spp"], params=options["params"]))  # fmt: skip

    return target, np.stack([step(seed) for seed in seeds(16, 70)])


def l2(target):
    """Mean square difference from the target."""
    import drjit as dr

    return lambda image: dr.mean(dr.square(image - target), axis=None)


def agreement(case: Case, reference: tuple, name: str, estimator: str = "stack") -> Agreement:
    target, expected = reference
    tracer = integrator("reslrb", estimator=estimator)
    objective = l2(target)
    ours = [case.gradient(tracer, seed, SPP, objective, **ADJOINTS[name]) for seed in seeds(COUNT)]
    return compare(np.stack(ours), expected, block=None)


@pytest.mark.parametrize(
    "name",
    a_few(["independent", "two batches", "four batches", "first batch again"], ["two batches", "first batch again"]),
)
def test_l2_gradient_is_unbiased(case: Case, reference: tuple, name: str):
    result = agreement(case, reference, name)
    print(name, result)
    assert result


def test_correlated_samples_are_measurably_biased(case: Case, reference: tuple):
    result = agreement(case, reference, "correlated")
    print("correlated", result)
    assert not result
    assert np.abs(result.z).max() > 2 * result.threshold


@pytest.mark.long
@pytest.mark.parametrize("estimator", ["reservoir", "gather", "event"])
def test_batches_serve_every_estimator(case: Case, reference: tuple, estimator: str):
    result = agreement(case, reference, "four batches", estimator)
    print(estimator, result)
    assert result


@pytest.mark.long
@pytest.mark.parametrize("name", ["ptracer", "walk_ad", "prb"])
def test_batches_serve_the_baselines(case: Case, reference: tuple, name: str):
    target, expected = reference
    tracer, objective = integrator(name), l2(target)
    ours = [case.gradient(tracer, seed, SPP, objective, **ADJOINTS["four batches"]) for seed in seeds(COUNT)]
    result = compare(np.stack(ours), expected, block=None)
    print(name, result)
    assert result


@pytest.mark.parametrize("batches", [1, 3])
def test_batches_that_do_not_divide_are_refused(case: Case, reference: tuple, batches: int):
    with pytest.raises(
        ValueError, match='"batches" must be a whole number from 2' if batches < 2 else "multiple of the batches"
    ):
        case.gradient(integrator("reslrb"), 1, SPP, l2(reference[0]), adjoint="batched", batches=batches)


@pytest.mark.parametrize("name", ["correlated", "independent", "four batches"])
def test_sample_sets_are_those_of_a_step(case: Case, name: str):
    tracer, results = integrator("reslrb", estimator="stack"), []

    def step(*args, **options):
        results.append(gradient_step(*args, **options))

    gradient = case.gradient(tracer, 3, SPP, step=step, **ADJOINTS[name])
    sets = [(int(seed[0]), spp) for _, seed, spp in sample_sets(3, {"spp": SPP, "batches": 4, **ADJOINTS[name]})]
    images = [np.array(render_image(tracer, case.scene, 0, seed, spp)) for seed, spp in sets]
    expected = np.mean(images, axis=0) if name == "four batches" else images[0]
    np.testing.assert_allclose(np.array(results[0].image), expected, rtol=1e-4, atol=1e-5)
    # the objective is linear, so that dL/dI is the same for all samples; the first batch gives an image alone
    own = [case.gradient(tracer, seed, spp) for seed, spp in (sets[1:] or sets)]
    np.testing.assert_allclose(gradient, np.mean(own, axis=0), rtol=1e-3, atol=1e-5 * np.abs(gradient).max())
