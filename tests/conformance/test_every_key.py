"""Every recoverable parameter of every plugin has the derivative of the image (every_key.py)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli.every_plugin import write_files
from conformance.every_key import (
    LIMITS,
    UNMEASURED,
    Form,
    Outcome,
    forms,
    identity,
    load,
    measure,
    recoverable,
    stored,
)
from turns import a_few

from reslrb_cli.measure.gradients import Case, integrator, seeds

pytestmark = pytest.mark.usefixtures("llvm", "combined")

#: Forms that the default suite measures, the paths, points and parameters, and the stages.
FEW = {
    "roughplastic": ("camera", ("inside",), r"\.(alpha|eta)$", slice(1)),
    "principled as exported": ("light", ("low",), "(sheen|clearcoat|spec_trans|metallic).value", slice(1)),
}
#: Parameters whose differences are too noisy to find a derivative that is 10 % off: samples change between the mirrored
#: light and other light. `test_singular_lobes_in_closed_form` tests these.
NOISY = ("ThinDielectric.eta", "SmoothPlastic.specular_reflectance")


@pytest.fixture(scope="module")
def folder(llvm: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the files that scenes name."""
    made = tmp_path_factory.mktemp("files")
    write_files(made)
    return made


def test_every_key_has_an_outcome(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`python tests/conformance/every_key.py FORM` measures the keys of a form."""
    monkeypatch.chdir(folder)
    known = {(one.form, one.key, one.owner) for one in stored()}
    measured = {form for form, _, _ in known}
    found = set()
    for form in forms():
        scene = load(form.stages[0][0], folder)
        params = mi.traverse(scene)
        keys = [info.key for info in recoverable(scene) if form.owns(info.key)]
        assert not keys or (form.name in measured) != (form.name in UNMEASURED), form.name
        found |= {(form.name, key, identity(params, key)) for key in keys if form.name in measured}
    assert found == known


def check(outcome: Outcome) -> None:
    assert outcome.holds, outcome
    assert outcome.resolved or outcome.owner.startswith(NOISY), outcome


def test_outcomes_hold_and_would_show_a_fault() -> None:
    for outcome in stored():
        check(outcome)
    lasting = [one for one in stored() if not one.vanishes and not one.owner.startswith(NOISY)]
    assert not any(replace(one, ad=0.0).holds for one in lasting)
    sharp = [one for one in lasting if not any(replace(one, ad=factor * one.fd).holds for factor in (0.9, 1.1))]
    known = {(one.form, one.key) for one in stored() if not one.owner.startswith(NOISY)}
    assert known == {(one.form, one.key) for one in sharp}, "a parameter whose derivative may be 10 % off"


def test_false_alarms_are_rare() -> None:
    for count, limit in LIMITS.items():
        t = np.random.default_rng(1).standard_t(count - 1, 10**7)
        assert np.count_nonzero(np.abs(t) > limit) < 30  # one in a million expected


@pytest.mark.parametrize("form", a_few(forms(), FEW))
def test_derivatives_are_those_of_the_image(form: Form, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    paths, points, only, stages = FEW.get(form.name, ("", ("inside", "low", "high"), "", slice(None)))
    for kind in [paths] if paths else form.paths:
        for outcome in measure(form, folder, kind, points, only=only, stages=stages):
            check(outcome)


def thin_glass(eta: float) -> tuple[dict, str, float]:
    """Thin glass mirrors R = 2 r / (1 + r) of the light, and lets 0.3 (1 - R) through."""
    ends = [((index - 1) / (index + 1)) ** 2 for index in (eta - 1e-4, eta + 1e-4)]
    below, above = (2 * r / (1 + r) for r in ends)
    glass = {"type": "thindielectric", "int_ior": eta, "ext_ior": 1.0, "specular_transmittance": 0.3}
    return glass, "eta", 0.7 * (above - below) / 2e-4


def masked_plastic(opacity: float) -> tuple[dict, str, float]:
    """A plastic of index 1.5 mirrors 0.04 times its colour. The light of its diffuse lobe is another term."""
    plastic = {"type": "plastic", "int_ior": 1.5, "ext_ior": 1.0, "specular_reflectance": 0.8}
    mask = {"type": "mask", "opacity": opacity, "inside": plastic}
    return mask, "nested_bsdf.specular_reflectance.value", 0.04 * opacity


@pytest.mark.parametrize(("bsdf", "key", "expected"), [thin_glass(1.3), thin_glass(2.5), masked_plastic(0.6)])
def test_singular_lobes_in_closed_form(bsdf: dict, key: str, expected: float) -> None:
    """The surface lies before a sky of radiance 1."""
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 2, "film": {"type": "hdrfilm", "width": 4, "height": 4},
                   "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])},
        "sky": {"type": "constant", "radiance": 1.0},
        "pane": {"type": "rectangle", "bsdf": bsdf},
    }  # fmt: skip
    case = Case(scene, [f"pane.bsdf.{key}"])
    case.weigh(np.full(case.weights.shape, 1 / np.prod(case.weights.shape)))
    ours = integrator("reslrb", 2, paths="camera", estimator="stack")
    found = np.array([case.gradient(ours, seed, 2**12, step=case.known_step)[0] for seed in seeds(8)])
    error = found.std(ddof=1) / np.sqrt(len(found))
    assert error < 0.02 * expected
    assert found.mean() == pytest.approx(expected, abs=6 * error)


@pytest.mark.parametrize("fault", [0.0, 0.9])
def test_a_wrong_derivative_is_found(fault: float, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    [form] = [form for form in forms() if form.name == "diffuse"]
    [outcome] = measure(form, folder, "light", ("inside",), fault=fault, stages=slice(1))
    assert not outcome.holds
