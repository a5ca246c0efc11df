"""Steps from a recording (`freeze`) equal plain steps. Image and gradient are the same, also after parameters
change.
"""

from __future__ import annotations

import gc
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance import gradient_cases
from conformance.gradient_cases import CASES, case
from turns import a_few, taking_turns

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.integrators import freezing
from reslrb_cli.integrators.step import render_image
from reslrb_cli.measure.gradients import Case, integrator, relative
from reslrb_cli.measure.scenes.case import SceneCase
from reslrb_cli.measure.scenes.catalogue import PRB
from reslrb_cli.measure.scenes.small import camera

pytestmark = pytest.mark.usefixtures("llvm")
BY_NAME = {case.name: case for case in CASES}
#: Mitsuba's thin lens keeps an array that a recording does not contain.
NOT_RECORDED = ("thin_lens",)
#: The cases of the default suite, one for each estimator.
FEWEST = ("texture", "glass", "mask", "visible_lamp")
ESTIMATORS = ("reservoir", "event", "gather", "stack")
#: Recorded functions, by the way in which a step obtains dL/dI.
KINDS = {
    "correlated": {"trace", "replay"},
    "independent": {"image", "trace and replay"},
    "batched": {"image", "fused"},
}


def gradients(case: SceneCase, adjoint: str, **options: object) -> tuple[list[np.ndarray], list[dict[str, int]]]:
    """Return the gradients of four steps, and the counts of recordings after each step. Seed and parameters change
    between the steps.
    """
    scene = Case(case.scene(), case.keys)
    own = {key: value for key, value in case.ours.items() if key != "samples_per_pass"}
    chosen = integrator("reslrb", **{**case.options, **own, **options})
    found, counts = [], []
    for step in range(4):
        factor = 1 - 0.1 * step
        scene.set({key: value * factor for key, value in scene.initial.items()})
        found.append(scene.gradient(chosen, 5 + step, 8, adjoint=adjoint))
        counts.append(chosen.preparation.recordings.counts())
    return found, counts


@taking_turns("case", [case for case in CASES if case.name not in NOT_RECORDED], "estimator", ESTIMATORS, FEWEST)
def test_a_recorded_step_equals_the_step(case: SceneCase, estimator: str) -> None:
    """Case and estimator determine the kind of dL/dI."""
    adjoint = list(KINDS)[(ESTIMATORS.index(estimator) + len(case.name)) % len(KINDS)]
    expected, none = gradients(case, adjoint, estimator=estimator, freeze=False)
    gc.collect()  # no other scene may be alive
    found, counts = gradients(case, adjoint, estimator=estimator, freeze=True)
    for step, (a, b) in enumerate(zip(found, expected, strict=True)):
        assert relative(a, b) < 1e-5, f"step {step}, {adjoint}"
    # The last steps must come from recordings. Otherwise the test would check nothing.
    assert none[-1] == {}
    assert set(counts[-1]) == KINDS[adjoint]
    assert counts[-1] == counts[-2]


def _software_texture() -> dict:
    """Return a scene whose floor has a bitmap texture that does not use CUDA's texture units."""
    texture = gradient_cases.texture(4, 4, 0.2, 0.8, 1, 3)
    return gradient_cases.floor({"type": "diffuse", "reflectance": texture | {"accel": False}})


#: Scenes whose recordings ended the process with CUDA.
TEXTURES = {
    "sky": case("sky", BY_NAME["envmap"].scene, ("floor.brdf_0.reflectance.value",), PRB),
    "software": case("software", _software_texture, ("floor.reflectance.data",), PRB),
}


@pytest.mark.long
@taking_turns("name", list(TEXTURES), "paths", ["both", "light"])
def test_recordings_of_scenes_with_textures(name: str, paths: str) -> None:
    case = TEXTURES[name]
    expected, _ = gradients(case, "batched", freeze=False, paths=paths)
    gc.collect()
    found, counts = gradients(case, "batched", freeze=True, paths=paths)
    for a, b in zip(found, expected, strict=True):
        assert relative(a, b) < 1e-4
    assert ("fused" in counts[-1]) == (name != "software" or not mi.variant().startswith("cuda"))


@pytest.mark.long
@taking_turns("estimator", ESTIMATORS, "adjoint", list(KINDS), ("reservoir", "event", "gather"))
def test_unrecordable_calls_are_computed_plainly(estimator: str, adjoint: str) -> None:
    case = BY_NAME["thin_lens"]
    expected, _ = gradients(case, adjoint, estimator=estimator, freeze=False)
    found, counts = gradients(case, adjoint, estimator=estimator, freeze=True)
    for a, b in zip(found, expected, strict=True):
        assert relative(a, b) < 1e-5
    assert not KINDS[adjoint] & set(counts[-1]) & {"trace", "image", "fused"}


def test_a_recording_does_not_evaluate_the_work_of_other_integrators() -> None:
    """A render leaves its path loop pending in the sampler's state. With CUDA, the loop used a freed scene."""
    case, spp = BY_NAME["texture"], 7
    scene = Case(case.scene(), case.keys)
    chosen = integrator("reslrb", estimator="stack", freeze=True)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for seed in range(5):  # recordings and steps from recordings
            dr.eval(render_image(integrator("ptracer"), scene.scene, 0, seed, spp))
            dr.kernel_history_clear()
            scene.gradient(chosen, seed, 8)
            paths = spp * dr.prod(scene.scene.sensors()[0].film().crop_size())
            assert paths not in [kernel["size"] for kernel in dr.kernel_history([dr.KernelType.JIT])]


def test_an_outdated_recording_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Stale:
        """Replacement for `drjit.freeze` that fails after its first two calls, which are the trial."""

        def __init__(self, function: object, **options: object) -> None:
            self.n_recordings, self.calls = 1, 0

        def __call__(self, *inputs: object) -> None:
            self.calls += 1
            if self.calls > 2:
                raise RuntimeError("the inputs are others")

    monkeypatch.setattr("drjit.freeze", Stale)
    case = BY_NAME["texture"]
    with pytest.raises(UnsupportedScene, match=r"the inputs are others.*KernelFreezing"):
        Case(case.scene(), case.keys).gradient(integrator("reslrb", freeze=True), 3, 8)


@pytest.mark.parametrize("adjoint", a_few(KINDS, ("batched",)))
def test_sensors_have_their_own_recordings(adjoint: str, capfd: pytest.CaptureFixture[str]) -> None:
    """A single recording for all sensors was made again for each of three sensors in each step. Dr.Jit warned every
    time.
    """
    case = BY_NAME["texture"]
    cameras = {f"camera_{n}": camera(sensor="thinlens" if n == 3 else "perspective") for n in range(4)}
    scene = Case({**case.scene(), "camera": cameras.pop("camera_0"), **cameras}, case.keys)
    chosen = integrator("reslrb", estimator="stack", freeze=True)
    plain = integrator("reslrb", estimator="stack", freeze=False)
    counts = []
    for step in range(8):
        for sensor in range(4):
            scene.sensor = sensor
            found = scene.gradient(chosen, step, 4, adjoint=adjoint)
            if step == 7:
                assert relative(found, scene.gradient(plain, step, 4, adjoint=adjoint)) < 1e-5
        counts.append(chosen.preparation.recordings.counts())
    assert KINDS[adjoint] & set(counts[-1])
    assert counts[-1] == counts[2]
    assert "frozen function" not in capfd.readouterr().err


def test_frequently_recorded_calls_are_no_longer_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    class Restless:
        """Replacement for `drjit.freeze` that makes a recording in each call."""

        calls = 0

        def __init__(self, function: Callable[..., object], **options: object) -> None:
            self.function, self.n_recordings = function, 0

        def __call__(self, *inputs: object) -> object:
            self.n_recordings += 1
            Restless.calls += 1
            return self.function(*inputs)

    monkeypatch.setattr("drjit.freeze", Restless)
    case = BY_NAME["texture"]
    scene, chosen = Case(case.scene(), case.keys), integrator("reslrb", estimator="event", freeze=True)
    plain = integrator("reslrb", estimator="event", freeze=False)
    for seed in range(12):
        assert relative(scene.gradient(chosen, seed, 4), scene.gradient(plain, seed, 4)) < 1e-5
    assert Restless.calls == len(KINDS["correlated"]) * freezing.MOST_RECORDINGS
    assert chosen.preparation.recordings.counts() == {}


def test_unlimited_sensors_are_not_all_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(freezing, "MOST_CALLS", 2)
    case = BY_NAME["texture"]
    cameras = {f"camera_{n}": camera() for n in range(3)}
    scene = Case({**case.scene(), **cameras}, case.keys)
    chosen = integrator("reslrb", estimator="event", freeze=True)
    for sensor in range(4):
        scene.sensor = sensor
        scene.gradient(chosen, 3, 4)
    assert set(chosen.preparation.recordings.counts()) == KINDS["correlated"]
    assert len(chosen.preparation.recordings._functions) == 2


def test_another_scene_has_another_recording() -> None:
    case = BY_NAME["texture"]
    chosen = integrator("reslrb", estimator="stack", freeze=True)
    plain = integrator("reslrb", estimator="stack", freeze=False)
    for change in ({}, {"side": None, "side_shape": None}, {}):
        kept = {key: value for key, value in (case.scene() | change).items() if value is not None}
        scene = Case(kept, case.keys)
        assert relative(scene.gradient(chosen, 3, 8), scene.gradient(plain, 3, 8)) < 1e-5


def test_other_sample_counts_have_other_recordings() -> None:
    case = BY_NAME["texture"]
    scene, chosen = Case(case.scene(), case.keys), integrator("reslrb", estimator="event", freeze=True)
    plain = integrator("reslrb", estimator="event", freeze=False)
    for spp in (4, 16, 4):
        assert relative(scene.gradient(chosen, 3, spp), scene.gradient(plain, 3, spp)) < 1e-5


def test_large_steps_are_not_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    case = BY_NAME["texture"]
    scene, chosen = Case(case.scene(), case.keys), integrator("reslrb", estimator="event", freeze=True)
    paths = 8 * scene.weights.shape[0] * scene.weights.shape[1]
    for most, recorded in ((paths - 1, False), (paths, True)):
        monkeypatch.setattr(freezing, "MOST_PATHS", most)
        scene.gradient(chosen, 3, 8)
        assert bool(chosen.preparation.recordings.counts()) == recorded


def test_an_image_is_the_same_alone_and_in_a_step() -> None:
    """The walk of an image ignores what derivatives require. Otherwise, the image would carry these requirements and be
    recorded twice.
    """
    case = BY_NAME["texture"]
    scene, chosen = Case(case.scene(), case.keys), integrator("reslrb", estimator="stack", freeze=True)
    scene.image(chosen, 3, 8)
    scene.gradient(chosen, 3, 8, adjoint="independent")
    calls = [kind for kind, *_ in chosen.preparation.recordings._functions]
    assert sorted(calls) == ["image", "trace and replay"]
