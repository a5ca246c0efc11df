"""Test of fit: false alarms and power for noise of several kinds, the score test of further parameters, and whole runs
of a model that is right or wrong.
"""

from __future__ import annotations

import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import yaml
from optimization.families import CORNER, SURFACES
from optimization.judged import iterate_to_the_end
from scipy.ndimage import gaussian_filter

from reslrb_cli.config.loader import load
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.uncertainty import candidates, fit, measuring
from reslrb_cli.optimization.uncertainty.curvature import LossCurvature, ParameterDirection
from reslrb_cli.optimization.uncertainty.posterior import pseudo_inverse
from reslrb_cli.optimization.uncertainty.verdicts import CertaintyRecord, ParameterCertainty, with_misfit
from reslrb_cli.records.measurements import MISFIT

Random = np.random.Generator
NOISE: dict[str, Callable[[Random, tuple[int, ...]], np.ndarray]] = {
    "normal": lambda random, shape: random.normal(size=shape),
    "heavy": lambda random, shape: random.standard_t(3, size=shape),
    "skewed": lambda random, shape: random.lognormal(0, 1, size=shape) - np.exp(0.5),
    "colours": lambda random, shape: random.normal(size=(*shape[:2], 1)) * np.array([1, 0.8, 0.5]),
    "bright": lambda random, shape: random.normal(size=shape) * np.geomspace(0.01, 1, shape[1])[:, None],
}
#: Simulated images or models of each kind.
IMAGES = 80


@pytest.mark.parametrize("kind", NOISE)
def test_noise_is_no_misfit(kind: str):
    random = np.random.default_rng(1)
    found = [fit.compare(fit.cells_of(NOISE[kind](random, (12, 16, 3)), 1), random).p for _ in range(IMAGES)]
    assert np.sum(np.array(found) <= fit.LEVEL) <= 3  # 0.8 are expected
    assert np.sum(np.array(found) <= 0.1) <= 16  # 8 are expected
    assert 0.35 < np.mean(found) < 0.65


@pytest.mark.parametrize("kind", ["normal", "heavy"])
def test_a_constant_misfit_is_found(kind: str):
    """A misfit as large as the noise in a ninth of the image is found, and its energy is measured."""
    random, found = np.random.default_rng(2), []
    for _ in range(20):
        noise = NOISE[kind](random, (24, 24, 3))
        noise[:8, 8:16] += noise.std()
        found.append(fit.compare(fit.cells_of(noise, 1), random))
    assert np.mean([each.p <= fit.LEVEL for each in found]) >= 0.9


def test_no_random_signs_are_as_rare_as_a_large_misfit():
    random = np.random.default_rng(4)
    assert fit.compare(fit.cells_of(3 + random.normal(size=(16, 16, 3)), 1), random).p == 1 / (fit.FLIPS + 1)


@pytest.mark.parametrize("kind", NOISE)
def test_a_map_shows_a_misfit_and_no_noise(kind: str):
    """The middle of an image is too bright by as much as the noise of a pixel. The map has its place and its size."""
    random, shape, target = np.random.default_rng(5), (48, 64, 3), 5.0
    variance = np.mean([NOISE[kind](random, shape) ** 2 for _ in range(100)], axis=0)
    middle, far = np.s_[16:32, 20:44], np.ones(shape[:2], dtype=bool)
    far[8:40, 10:54] = False
    size = float(np.sqrt(variance[middle].mean()))
    alarms, shares, around = 0, [], []
    for _ in range(20):
        residual = NOISE[kind](random, shape)
        alarms += bool(np.any(fit.misfit_map(residual, variance, np.full(shape, target), 1)))
        residual[middle] += size
        found = fit.misfit_map(residual, variance, np.full(shape, target), 1)[:, :, 0]
        shares.append(np.median(found[middle]) * target / size)
        around.append(np.mean(found[far] != 0))
    assert alarms <= 1  # 0.2 are expected
    assert 0.8 < np.mean(shares) < 1.1
    assert np.mean(around) < 0.1


def test_a_map_leaves_out_pixels_without_a_residual_and_shows_the_sign():
    random, shape = np.random.default_rng(6), (24, 24, 3)
    residual = 0.01 * random.normal(size=shape) - 0.5
    residual[:, :8] = 0.0
    found = fit.misfit_map(residual, np.full(shape, 1e-4), np.ones(shape), 2)[:, :, 0]
    assert np.all(found[:, :8] == 0)
    np.testing.assert_allclose(found[:, 8:], -0.5, atol=0.02)


@pytest.mark.parametrize(("side", "lattice"), [(24, 1), (25, 1), (200, 1), (210, 3)])
def test_the_energy_is_that_of_the_misfit(side: int, lattice: int):
    """It does not depend on the size of the image, or on the lattice."""
    random, third = np.random.default_rng(6), side // 3
    noise = 0.1 * random.normal(size=(side, side, 3))
    noise[:third, third : 2 * third] += 0.5
    found = fit.compare(fit.cells_of(noise, lattice), random).energy
    assert found == pytest.approx(third * third * 3 * 0.25, rel=0.12)


@pytest.mark.parametrize("shape", [(2, 2, 3), (4, 40, 3), (1, 1, 1)])
def test_images_without_cells_show_no_misfit(shape: tuple[int, ...]):
    assert fit.compare(fit.cells_of(np.ones(shape), 8), np.random.default_rng(0)).p == 1.0


def test_directions_of_other_units_are_not_left_out():
    matrix, scale = np.array([[2.0, 0.5], [0.5, 1.0]]), np.diag([1.0, 1e-6])
    found = pseudo_inverse(scale @ matrix @ scale, 1e-3)
    np.testing.assert_allclose(scale @ found @ scale, np.linalg.inv(matrix))
    assert not pseudo_inverse(np.zeros((2, 2)), 1e-3).any()
    assert pseudo_inverse(np.ones((2, 2)), 1e-3) == pytest.approx(np.full((2, 2), 0.25))


def test_the_filter_of_the_film_correlates_no_cells(llvm):
    """Noise of a Gaussian filter is a misfit for cells of a pixel, and none for the lattice that the filter needs."""
    own = fit.correlations(mi.load_dict({"type": "gaussian"}))
    lattice = 1 + int(np.max(np.nonzero(own >= fit.UNCORRELATED)[0]))
    random = np.random.default_rng(3)
    alarms = {1: 0, lattice: 0}
    for _ in range(20):
        noise = gaussian_filter(random.normal(size=(36, 36, 3)), 0.5, axes=(0, 1))
        for side in alarms:
            alarms[side] += fit.compare(fit.cells_of(noise, side), random).p <= fit.LEVEL
    assert alarms[1] == 20
    assert alarms[lattice] <= 1


@pytest.mark.parametrize(
    ("name", "right"), [("box", [1.0]), ("gaussian", [1.0, np.exp(-1), np.exp(-4)]), ("tent", [1.0, 0.25])]
)
def test_correlations_of_filters(name: str, right: list[float], llvm):
    found = fit.correlations(mi.load_dict({"type": name}))
    np.testing.assert_allclose(found[: len(right)], right, atol=0.01)
    assert np.all(found[len(right) :] < 0.01)


def test_large_images_have_few_cells():
    assert fit.cells_of(np.ones((300, 500, 3)), 3).shape == (34, 56, 27)


def test_offsets_of_textures_explain_a_part():
    found = fit.FitRecord(0.002, 0.1, 4.0, True, [fit.Candidate("a", 0.001, 1.0, [1.0], [2.0])])
    part = found.without(3.0)
    assert (part.misfit, part.energy, part.is_significant) == (0.05, 1.0, True)
    assert len(part.candidates) == 1
    for energy in (4.0, 5.0):
        assert found.without(energy) == fit.FitRecord(0.002, 0.0, 0.0, False, [])


def test_an_error_does_not_lose_the_verdicts(caplog):
    certainty = object.__new__(measuring.Certainty)
    certainty.problem = types.SimpleNamespace()
    with caplog.at_level("WARNING"):
        assert certainty._test_fit(types.SimpleNamespace(first=None), 10.0, lambda: False) is None
    assert "the fit of the model was not tested: " in caplog.text


@pytest.mark.parametrize(("error", "value"), [(0.05, 0.45), (-0.3, 0.6)])
def test_a_newton_step_goes_to_the_optimum_within_the_bounds(error: float, value: float):
    changes, J, weight = [], np.ones((1, 4)), 2.0
    curvature = object.__new__(LossCurvature)
    curvature.slopes, curvature.thinned, curvature._picked = (J * weight, J), 1.0, None
    curvature._weights = [np.full((2, 2, 1), weight)]
    curvature.directions = [ParameterDirection("p", np.ones(1), None, 0)]
    settings = {"p": types.SimpleNamespace(bounds=(0.0, 0.6))}
    selection = types.SimpleNamespace(array=lambda key: np.array([0.5]), specs=settings)
    curvature.problem = types.SimpleNamespace(selection=selection)
    curvature._derivatives = lambda change: (changes.append(change), [[np.ones((2, 2, 1))], [np.zeros((2, 2, 1))]])[1]
    found = curvature.newton_change([np.full((2, 2, 1), weight * error)])
    np.testing.assert_allclose(changes[0].values["p"], [value])
    np.testing.assert_array_equal(found, np.full((1, 2, 2, 1), 0.5))


def test_a_misfit_unsettles_what_a_larger_one_would():
    def about(verdict: str, spread: float) -> ParameterCertainty:
        return ParameterCertainty(verdict, {verdict: 1.0}, [spread], [0.0])

    found = {key: about(verdict, 0.1) for key, verdict in (("a", "settled"), ("b", "settled"), ("c", "still moving"))}
    wider = {key: about(each.verdict, 0.2) for key, each in found.items()}
    widest = wider | {"b": about("below the noise", 0.4)}
    judged = with_misfit(found, wider, widest)
    assert {key: each.verdict for key, each in judged.items()} == {"a": "settled", "b": MISFIT, "c": "still moving"}
    assert judged["b"].shares == {MISFIT: 1.0}
    assert all(each.spread == [0.2] for each in judged.values())


def linear(random: Random, known: int, planted: float, moving: float = 0.0) -> tuple[candidates._Tests, np.ndarray]:
    """Return the tests of two further parameters of a linear model after its `known` parameters were recovered. The
    first one is wrong by `planted`, and the first recovered one still moves by `moving`. Return also the derivatives of
    its images.
    """
    size = 600
    J = random.normal(size=(known + 2, size))
    J[known] += 0.5 * J[0]  # a recovered parameter makes up for a part
    weights, noise = np.full(size, 2.0), 0.3
    residual = planted * J[known] + noise * random.normal(size=size)
    residual = residual - J[:known].T @ np.linalg.lstsq(J[:known].T, residual, rcond=None)[0] + moving * J[0]
    a, b = (J + 0.05 * random.normal(size=J.shape) for _ in range(2))
    variance = weights**2 * noise**2
    tests = candidates._Tests(
        (a[:known], b[:known]), (a[known:], b[known:]), weights, weights * residual, variance, np.ones(2)
    )
    return tests, J


@pytest.mark.parametrize("known", [0, 3])
def test_the_wrong_parameter_is_found(known: int):
    """The offset and the fall of the loss are those of a fit of all parameters."""
    tests, J = linear(np.random.default_rng(4), known, 0.2)
    fall, p, offset = tests.of([0])
    assert p < 1e-6
    assert offset[0] == pytest.approx(-0.2, rel=0.15)
    others = J[:known]
    left = J[known] - (others.T @ np.linalg.lstsq(others.T, J[known], rcond=None)[0] if known else 0)
    assert fall == pytest.approx(0.5 * 2 * 0.2**2 * left @ left, rel=0.3)
    assert tests.of([1])[1] > 1e-3


def test_values_on_their_way_show_no_further_parameter():
    assert linear(np.random.default_rng(7), 3, 0.0, 0.3)[0].of([0])[1] > 1e-3


@pytest.mark.parametrize(("name", "file", "right"), [
    ("box", None, 1), ("gaussian", "a.exr", 3), ("mitchell", None, 3), ("gaussian", "a.JPG", 8),
])  # fmt: skip
def test_pixels_that_are_compared(name: str, file: str | None, right: int, llvm):
    film = types.SimpleNamespace(rfilter=lambda: mi.load_dict({"type": name}))
    scene = types.SimpleNamespace(sensors=lambda: [types.SimpleNamespace(film=lambda: film)])
    view = types.SimpleNamespace(sensor=0, file=file and Path(file))
    assert fit.lattice_of(types.SimpleNamespace(scene=scene), view)[0] == right


def test_a_model_that_fits_is_tested_no_further():
    """Neither scene nor curvature is needed."""
    found = candidates.judge_fit(None, fit.Fit(0.02, 1.0, 1.0, 1.0, [], [], []), None, lambda: True)
    assert (found.p, found.is_significant, found.candidates) == (0.02, False, [])


def test_parameters_that_explain_little_are_not_named(monkeypatch: pytest.MonkeyPatch):
    found = (("a", 5.0, 1e-9), ("b", 0.6, 1e-3), ("c", 0.4, 1e-9), ("d", 9.0, 0.02))
    tested = [(fall, p, fit.Candidate(key, p, 0.0, [1.0], [])) for key, fall, p in found]
    monkeypatch.setattr(candidates, "_find_candidates", lambda *_: tested)
    monkeypatch.setattr(candidates, "_test_response", lambda *_: [])
    known = types.SimpleNamespace(biases=[])
    record = candidates.judge_fit(None, fit.Fit(0.002, 20.0, 20.0, 20.0, [], [], []), known, lambda: True)
    assert {each.key: each.explained for each in record.candidates} == pytest.approx({"a": 0.5, "b": 0.06})


def test_an_error_in_one_test_does_not_lose_the_other_parameters(monkeypatch: pytest.MonkeyPatch, caplog):
    def fails(*_: Any) -> None:
        raise ValueError("no images")

    monkeypatch.setattr(candidates, "_find_candidates", lambda *_: [(5.0, 1e-9, fit.Candidate("a", 0, 0, [1.0], []))])
    monkeypatch.setattr(candidates, "_test_response", fails)
    known = types.SimpleNamespace(biases=[])
    record = candidates.judge_fit(None, fit.Fit(0.002, 20.0, 20.0, 20.0, [], [], []), known, lambda: True)
    assert [each.key for each in record.candidates] == ["a"]
    assert "no images" in caplog.text


def test_noise_shows_no_further_parameter():
    found = [linear(np.random.default_rng([5, number]), 3, 0.0)[0].of([0])[1] for number in range(IMAGES)]
    assert 0.35 < np.mean(found) < 0.65
    assert np.sum(np.array(found) < 0.01) <= 7  # 2 are expected


def recovered(
    folder: Path, right: str, wrong: str, parameters: list[str], **settings: str
) -> tuple[CertaintyRecord, dict[int, np.ndarray]]:
    """Recover `parameters` of the corner whose picture has the text `right` where the model has `wrong`. Return the
    certainty and the misfit maps.
    """
    config = {
        "variant": "llvm_ad_rgb", "scene": {"file": "scene.xml"}, "target": {"render": {"spp": 1024}},
        "integrator": {"type": "reslrb", "max_depth": 3}, "optimizer": {"type": "auto"},
        "parameters": [{"key": key, "initial": 0.4, "bounds": [0, 1]} for key in parameters],
        "run": {"iterations": 30, "spp": 16} | settings,
    }  # fmt: skip
    assert wrong in CORNER
    (folder / "scene.xml").write_text(CORNER.replace(wrong, right))
    (folder / "true.yaml").write_text(yaml.safe_dump(config))
    target = assemble(load(folder / "true.yaml")).trained[0].target
    mi.Bitmap(target).write(str(folder / "target.exr"))
    (folder / "scene.xml").write_text(CORNER)
    (folder / "run.yaml").write_text(yaml.safe_dump(config | {"target": {"file": "target.exr"}}))
    problem = assemble(load(folder / "run.yaml"), to_run=True)
    before = {key: np.array(value) for key, value in mi.traverse(problem.scene) if "alpha" in key}
    certainty, last = iterate_to_the_end(problem)
    found = certainty.measure(last.iteration + 1, last.elapsed_s, lambda: False)
    assert found is not None
    after = {key: np.array(value) for key, value in mi.traverse(problem.scene) if "alpha" in key}
    assert before
    assert before == after  # the tests of further parameters change none of them
    return found, certainty.misfits


ALPHA = 'name="alpha" value="0.2"'


def test_a_wrong_roughness_is_named(tmp_path, llvm):
    found, maps = recovered(tmp_path, ALPHA.replace("0.2", "0.5"), ALPHA, SURFACES[:1])
    assert found.parameters[SURFACES[0]].verdict == MISFIT
    assert found.fit is not None
    first = found.fit.candidates[0]
    assert first.key == "ball.bsdf.alpha"
    assert first.value == pytest.approx([0.2])
    assert 0.35 < first.proposed[0] < 0.75
    assert list(maps) == [0]
    assert 0.01 < np.mean(maps[0] != 0) < 0.5  # the ball
    right, maps = recovered(tmp_path, ALPHA, ALPHA, SURFACES[:1])
    assert right.parameters[SURFACES[0]].verdict == "settled"
    assert right.fit is not None
    assert not right.fit.is_significant
    assert not right.fit.candidates
    assert not maps


def found_fit(p: float) -> fit.Fit:
    return fit.Fit(p, 0.0, 1.0, 1.0, [], [], [])


@pytest.mark.parametrize(("ps", "looks", "right"), [
    ([0.004, 1.0], 1, 0.008), ([0.006, 0.004], 2, 0.008), ([0.19, 0.5], 2, 0.38), ([0.21, 0.002], 1, 0.42),
    ([0.9], 1, 1.0),
])  # fmt: skip
def test_an_unclear_result_is_judged_again(ps: list[float], looks: int, right: float):
    """Both looks count."""
    left = iter(ps)
    assert fit.repeat_unclear(lambda: found_fit(next(left)), lambda: True).p == pytest.approx(right)
    assert len(ps) - len(list(left)) == looks


def test_without_time_there_is_no_second_look():
    left = iter([0.006, 0.004])
    assert fit.repeat_unclear(lambda: found_fit(next(left)), lambda: False).p == pytest.approx(0.012)


@pytest.mark.parametrize(("size", "count", "least", "most"), [(0.0, 60, 0.0, 0.04), (0.5, 40, 0.75, 1.0)])
def test_false_alarms_and_power_of_two_looks(size: float, count: int, least: float, most: float):
    """The second look has a quarter of the noise's variance. Of 100 images with the misfit, one look finds 36, and both
    find 88. Of 300 without it, both find 1.
    """
    found = []
    for number in range(count):
        random, looks = np.random.default_rng([8, number]), []
        parts = random.standard_t(3, size=(fit.MORE, 16, 16, 3))
        parts[:, :6, :6] += size * 3**0.5

        def judge(parts: np.ndarray = parts, random: Random = random, looks: list[int] = looks) -> fit.Fit:
            looks.append(1 if not looks else fit.MORE)
            return found_fit(fit.compare(fit.cells_of(parts[: looks[-1]].mean(0), 1), random).p)

        found.append(fit.repeat_unclear(judge, lambda: True).p <= fit.LEVEL)
    assert least <= np.mean(found) <= most


@pytest.mark.parametrize(("factor", "right"), [(-1.0, 1.0), (-0.5, 1.0), (-4.0, 0.25), (2.0, 0.0), (0.0, 0.0)])
def test_a_newton_step_that_is_too_long_is_shortened(factor: float, right: float):
    residuals = [np.random.default_rng(number).normal(size=(4, 4, 3)) for number in range(2)]
    changes, weights = [factor * each for each in residuals], [np.full((4, 4, 3), size) for size in (1.0, 3.0)]
    assert fit.useful_part(residuals, changes, weights) == pytest.approx(right)
    assert fit.useful_part([residuals[0], 0 * residuals[1]], changes, weights) <= right


@pytest.mark.parametrize(("kind", "z", "right"), [("exponential", 5.0, 6.0), ("standard_normal", 3.0, 6.6)])
def test_the_probability_of_a_sum_includes_its_skewness(kind: str, z: float, right: float):
    noise = getattr(np.random.default_rng(0), kind)(size=(200000, 1))
    found = fit.surprisals(np.array([z]), (noise - noise.mean()) / noise.std())
    assert found[0] == pytest.approx(right, abs=0.2)


def stub(**more: Any) -> types.SimpleNamespace:
    """Return a problem with one view, whose target is black."""
    view = types.SimpleNamespace(judge=None, share=1.0, target=np.zeros((12, 12, 3)), kept=lambda image: image)
    run = types.SimpleNamespace(spp=8, seed=0)
    return types.SimpleNamespace(trained=[view], config=types.SimpleNamespace(run=run), **more)


def test_the_residual_lacks_a_useful_step_only(monkeypatch: pytest.MonkeyPatch):
    """A step that is 30 times too long would leave a misfit."""
    monkeypatch.setattr(fit, "slope", lambda judge, image: image)
    monkeypatch.setattr(fit, "second_derivative", lambda view, image: np.ones_like(image))
    monkeypatch.setattr(fit, "lattice_of", lambda problem, view: (1, 1.0))
    random = np.random.default_rng(3)
    noise, offset = 0.01 * random.normal(size=(12, 12, 3)), 0.05 * np.ones((12, 12, 3))
    images = types.SimpleNamespace(means=lambda: ([noise + offset], [np.full_like(noise, 1e-4)]))
    for step, right in ((-offset, True), (-30 * offset, True), (0 * offset, False)):
        curvature = types.SimpleNamespace(biases=False, newton_change=lambda slopes, step=step: [step])
        assert (fit._judge(stub(), curvature, images, random).p > fit.LEVEL) == right


def test_the_second_look_has_four_times_the_images(monkeypatch: pytest.MonkeyPatch):
    counts: list[int] = []
    monkeypatch.setattr(fit, "see_images", lambda problem, spp, number, purpose: [np.full((12, 12, 3), number)])
    monkeypatch.setattr(fit, "_judge", lambda problem, curvature, images, random: (counts.append(images.count),
                                                                                   found_fit(0.1))[1])  # fmt: skip
    fit.measure_fit(stub(), types.SimpleNamespace(), lambda: True)
    assert counts == [fit.IMAGES, fit.MORE * fit.IMAGES]


def test_images_have_half_of_the_time(monkeypatch: pytest.MonkeyPatch):
    seconds: list[float] = []
    monkeypatch.setattr(measuring, "measure_fit", lambda problem, curvature, go_on: (seconds.append(go_on._seconds),
                                                                                     found_fit(0.1))[1])  # fmt: skip
    monkeypatch.setattr(candidates, "judge_fit", lambda problem, fit, known, go_on: seconds.append(go_on._seconds))
    certainty = object.__new__(measuring.Certainty)
    certainty.problem = stub()
    certainty.problem.trained = []
    certainty._test_fit(types.SimpleNamespace(first=None), 10.0, lambda: False)
    assert seconds == [5.0, 10.0]
