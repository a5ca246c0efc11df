"""Non-finite values in each image and each gradient that a run measures. Scene and parameters are real, and images are
computed from the parameters without rendering.
"""

from __future__ import annotations

import sys
import traceback
import types
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from optimization.judged import POSTER, WALL, write_scene

import reslrb_cli.integrators.step as real
from reslrb_cli.config.loader import load
from reslrb_cli.errors import NonFinite
from reslrb_cli.optimization import assemble, identifiability, loop, sensitivity
from reslrb_cli.optimization.nonfinite import fill_gaps
from reslrb_cli.optimization.state import standing
from reslrb_cli.optimization.uncertainty import measuring

#: Width of film and texture, and planted values.
SIZE, TEXELS, BAD = 16, 4, (np.nan, np.inf, -np.inf)
TRUTH = {WALL: np.array([0.6, 0.4, 0.25]), POSTER: np.linspace(0.3, 0.7, TEXELS**2 * 3).reshape(TEXELS, TEXELS, 3)}
START = "initial: 0.5, bounds: [0, 1]"
PARAMETERS = f"parameters=[{{key: {WALL}, {START}}}, {{key: {POSTER}, {START}}}]"
#: Settings of a run for each way to measure.
WAYS = {
    "auto": ["optimizer={type: auto}", "run.iterations=16"],
    "auto, moving": ["optimizer={type: auto}", "run.iterations=16"],
    "sgd": ["optimizer={type: sgd, learning_rate: 0.5, scale: curvature}", "run.iterations=16"],
    "exposure": ["optimizer={type: adam, learning_rate: 0.05}", "run.iterations=16", "target.exposure=auto"],
}


class Renderer:
    """Substitute for rendering. The left half of an image shows the wall, and the right half the poster.

    `spoiled` is the number of the call whose result has NaN and infinity. `places` has the functions that made each
    call.
    """

    def __init__(self, spoiled: int = -1) -> None:
        self.problem, self.spoiled, self.places = None, spoiled, []

    def image(self, seed: int, values: dict) -> mi.TensorXf:
        at = dr.arange(mi.UInt32, SIZE * SIZE * 3)
        channel, x, y = at % 3, at // 3 % SIZE, at // (3 * SIZE)
        texel = (y * TEXELS // SIZE * TEXELS + x * TEXELS // SIZE) * 3 + channel
        wall = values[WALL]
        own = dr.select(channel == 0, wall.x, dr.select(channel == 1, wall.y, wall.z))
        poster = dr.gather(mi.Float, values[POSTER].array, texel)
        noise = 1 + 0.02 * np.random.default_rng(seed).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
        return mi.TensorXf(dr.select(x < SIZE // 2, own, poster), (SIZE, SIZE, 3)) * mi.TensorXf(noise)

    def _is_spoiled(self) -> bool:
        names = [frame.name for frame in traceback.extract_stack() if "/reslrb_cli/" in frame.filename]
        self.places.append(" ".join([name for name in names if not name.startswith("<")][-3:]))
        return len(self.places) - 1 == self.spoiled

    def _with_fault(self, image: mi.TensorXf) -> mi.TensorXf:
        fault = np.zeros((SIZE, SIZE, 3), np.float32)
        fault[3, 5, 1], fault[4, 12, 2], fault[9, 13, 0] = BAD
        return image + mi.TensorXf(fault)

    def render_image(self, integrator, scene, sensor, seed, spp) -> mi.TensorXf:
        image = dr.detach(self.image(seed, {key: self.problem.selection.params[key] for key in TRUTH}))
        return self._with_fault(image) if self._is_spoiled() else image

    def gradient_step(self, integrator, scene, sensor, objective, *, seed, params, **others) -> types.SimpleNamespace:
        refused, image = real.Refused(), self.image(seed, params)
        bad = self._is_spoiled()
        loss, delta = real.derivative_of(objective, dr.detach(self._with_fault(image) if bad else image), refused)
        dr.backward(dr.sum((image * delta).array))
        self._spoil(params if bad else {})
        return types.SimpleNamespace(image=dr.detach(image), loss=loss, refused=refused)

    def known_step(self, integrator, scene, sensor, gradient, *, seed, params, **others) -> None:
        dr.backward(dr.sum((self.image(seed, params) * gradient).array))
        self._spoil(params if self._is_spoiled() else {})

    def _spoil(self, params: dict) -> None:
        fault = np.zeros((TEXELS, TEXELS, 3), np.float32)
        fault[1, 2:], fault[2, 3:] = np.nan, np.inf
        for key, value in {WALL: mi.Color3f(BAD), POSTER: mi.TensorXf(fault)}.items():
            if key in params:
                dr.accum_grad(params[key], value)


@pytest.fixture
def render(llvm, tmp_path, monkeypatch):
    """Function that makes a run and returns its `Renderer`, its problem, its records and its certainty. All modules of
    the package use the renderer. The certainty is measured only if its calls are to be counted or spoiled.
    """
    write_scene(tmp_path)
    monkeypatch.setattr(measuring, "LEAST_ITERATIONS", 1)
    monkeypatch.setattr(measuring, "MOST_ENTRIES", 16)  # the texture has more, so it is measured as a large one

    def run(way: str, spoiled: int = -1, policy: str = "skip") -> tuple:
        own = Renderer(spoiled)
        sets = [
            PARAMETERS,
            "run.spp=16",
            "target.render.spp=64",
            "run.certainty=true",
            f"run.on_nonfinite={policy}",
            *WAYS[way],
        ]
        problem = own.problem = assemble.assemble_scene(load(Path(tmp_path / "toy.yaml"), sets))
        for view in problem.views:
            view.see(np.array(Renderer().image(0, {WALL: mi.Color3f(TRUTH[WALL]), POSTER: mi.TensorXf(TRUTH[POSTER])})))
        with monkeypatch.context() as patch:
            for name, module in list(sys.modules.items()):
                for function in ("render_image", "gradient_step", "known_step"):
                    if name.startswith("reslrb_cli.optimization") and hasattr(module, function):
                        patch.setattr(module, function, getattr(own, function))
            if way == "auto, moving":
                problem.optimizer.extents = {WALL: 1.0}
            if way == "exposure":
                assert identifiability.find_ambiguous(problem) == (["exposure"], [WALL, POSTER])
            certainty, state, records = measuring.Certainty(problem), standing(problem), []
            for _, record in loop.iterate(problem, state):
                certainty.rates.append(1.0)
                records.append(record)
            measured = spoiled < 0 or spoiled >= len(own.places)
            found = certainty.measure(len(records), 100.0, lambda: False) if measured else None
        return own, problem, records, found

    return run


#: Functions that see the images of a curvature, first at the values and then along directions.
SEEN = "see_at see see_images"
#: Functions that measure an image or a gradient in a run of each way, apart from those of the ways before.
PLACES = {
    "auto": {
        "iterate step gradient", "step measure_curvature gradient", SEEN, "measure sample_gradient",
        "target_noises _noises render_in_passes",
        "by_entry _two_probes _probe", "_by_entry_of_target _two_probes _probe", "products _two_probes _probe",
        "measure_fit render see_images",
    },
    "auto, moving": {"step update exposed_images"},
    "sgd": {
        "measure_curvatures _gradients_at sample_gradient", "measure_curvatures _steepest see_images",
        "_steepest _gradients_at sample_gradient", "step measure_curvatures see_images",
    },
    "exposure": {"find_ambiguous _row see_images"},
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_a_non_finite_value_in_a_measurement_is_left_out_and_counted(render, way):
    """Values are planted in the second call of each place. The run ends with about the same values and verdicts."""
    clean, problem, records, certainty = render(way)
    assert not any(record.nonfinite for record in records)
    expected = problem.values()
    calls = {place: [number for number, other in enumerate(clean.places) if other == place] for place in clean.places}
    earlier = {place for name in list(WAYS)[: list(WAYS).index(way)] for place in PLACES[name]}
    assert set(calls) - earlier == PLACES[way]
    planted = [(place, calls[place][:2][-1]) for place in PLACES[way]]
    planted += [(SEEN, calls[SEEN][3])] if SEEN in PLACES[way] else []  # along a direction
    # For another parameter, or in the measurement after the last iteration.
    planted += [(place, calls[place][-1]) for place in PLACES[way] if way == "sgd" or "_images" in place]
    for place, call in planted:
        _, problem, records, found = render(way, call)
        assert sum(record.nonfinite for record in records) + sum(problem.left_out.values()) >= 2, place
        for key, value in problem.values().items():
            np.testing.assert_allclose(value, expected[key], atol=0.003, err_msg=f"{place}: {key}")
        for about in found.parameters.values() if found is not None else ():
            assert np.isfinite(about.spread).all(), place
        if found is not None:  # a verdict on so few texels is close to a threshold
            assert found.parameters[WALL].spread == pytest.approx(certainty.parameters[WALL].spread, rel=0.2), place


@pytest.mark.parametrize("policy", ["stop", "skip", "zero"])
def test_the_policy_covers_measured_images(render, policy):
    """Only `stop` ends the run. The error names the image."""
    call = render("auto")[0].places.index(SEEN) + 2  # along a direction
    if policy == "stop":
        with pytest.raises(
            NonFinite, match=r"iteration 0: a measured image of sensor 0 in 3 entries; run\.on_nonfinite"
        ):
            render("auto", call, policy)
    else:
        assert [record.nonfinite for record in render("auto", call, policy)[2]] == [3] + [0] * 15


def test_the_certainty_leaves_a_spoiled_gradient_out(render, monkeypatch):
    samples, weigh = [], measuring.weigh

    def record(measured, *others):
        samples.append(measured[WALL].gradients)
        return weigh(measured, *others)

    monkeypatch.setattr(measuring, "weigh", record)
    own, *_ = render("auto")
    render("auto", own.places.index("measure sample_gradient"))
    (_, *others), (first, *kept) = samples
    np.testing.assert_array_equal(kept, others)
    np.testing.assert_allclose(first, np.mean(others, axis=0))


def test_losses_before_and_after_a_step_lack_the_same_pixels(render):
    """Otherwise, infinity in one of the images would shorten the step."""
    _, problem, _, _ = render("auto, moving")
    before, after = (np.random.default_rng(number).uniform(0.2, 0.8, (SIZE, SIZE, 3)) for number in range(2))
    seen = np.ones_like(before)
    expected = []
    for place, bad in zip(((0, 1, 2), (5, 5, 0), (7, 8, 1)), BAD, strict=True):
        seen[place] = 0
        (before if bad > 0 else after)[place] = bad
    target = np.array(problem.views[0].target)
    for image in (before, after):
        expected.append(np.mean(np.where(seen == 1, image - target, 0) ** 2))
    found = loop.blurred_losses(problem, 0, *([mi.TensorXf(image.astype(np.float32))] for image in (before, after)))
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("module", [loop, sensitivity])
def test_excluded_pixels_may_hold_any_value(module, render, monkeypatch):
    """They are neither counted, nor do they end a run with `stop`."""
    _, problem, _, _ = render("auto, moving")
    view, weights = problem.views[0], np.ones((SIZE, SIZE), np.float32)
    weights[2, 3] = weights[5, 1] = 0
    image = np.array(view.target)
    image[2, 3, 1], image[5, 1, 0] = np.nan, np.inf
    monkeypatch.setattr(module, "render_image", lambda *given: mi.TensorXf(image))
    measure = {loop: lambda: loop.exposed_images(problem, 0), sensitivity: lambda: sensitivity.see_images(problem)}
    for kept, count in ((weights, 0), (None, 2)):
        view.weigh(kept)
        measure[module]()
        assert sum(problem.take_left_out().values()) == count


def test_samples_with_gaps_keep_the_mean_of_the_others():
    rows = np.array([[1.0, np.nan, np.inf], [3.0, 5.0, np.nan], [np.nan, 7.0, -np.inf]])
    np.testing.assert_array_equal(fill_gaps(rows), [[1, 6, 0], [3, 5, 0], [2, 7, 0]])
