"""The rainbow of a prism: picture and derivatives against an independent tracer (`prism.py`), and recovery of the
glass.
"""

from __future__ import annotations

import functools
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from cli.tiny import done
from conformance.prism import FILM, B, C, image, index, picture, picture_of, sellmeier

from reslrb_cli.measure.gradients import smooth_weights
from reslrb_cli.records.images import write_file
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.run_folder import read_value
from reslrb_cli.scene.load import load_scene

ROOT = Path(__file__).resolve().parents[2]
#: True values of the glass F2, and steps of differences.
TRUE = {"glass.nd": float(index(np.array(587.5618))), "glass.Vd": 36.3696}
STEPS = {"glass.nd": 1e-4, "glass.Vd": 0.1}


@pytest.fixture
def prism(spectral: None) -> mi.Scene:
    """The shipped scene in the spectral variant."""
    return load_scene(ROOT / "scenes" / "prism" / "scene.xml")


def differences() -> dict[str, np.ndarray]:
    """Return the derivative (width, 3) of the tracer's picture by each parameter."""
    return {
        key: (picture(**{key[-2:]: TRUE[key] + step}) - picture(**{key[-2:]: TRUE[key] - step})) / (2 * step)
        for key, step in STEPS.items()
    }


def misfit(found: np.ndarray) -> dict[str, float]:
    """Return by how much the glass of a picture (H, W, 3) seems to differ from F2, by least squares."""
    rows = np.stack([each.ravel() for each in differences().values()], -1)
    answer = np.linalg.lstsq(rows, (found.sum(0) - picture()).ravel(), rcond=None)[0]
    return dict(zip(STEPS, answer, strict=True))


@pytest.mark.parametrize("kind", ["reslrb", pytest.param("ptracer", marks=pytest.mark.long)])
def test_the_rainbow_is_that_of_an_independent_tracer(kind: str, prism: mi.Scene) -> None:
    """The picture has the tracer's colours to 1 %. Fitted to it, n_d is exact to 5e-5, and V_d to 0.5 %."""
    integrator = mi.load_dict({"type": kind, "max_depth": 4, "rr_depth": 100})
    spp = 128 if kind == "reslrb" else 1024  # `ptracer` loses three of four wavelengths twice
    seen = np.mean([np.array(mi.render(prism, integrator=integrator, spp=spp, seed=seed)) for seed in range(4)], 0)
    known = picture()
    assert np.abs(seen.sum(0) - known).sum() < 0.015 * np.abs(known).sum()
    assert seen.sum((0, 1)) == pytest.approx(known.sum(0), rel=4e-3)
    errors = misfit(seen)
    assert abs(errors["glass.nd"]) < 5e-5
    assert abs(errors["glass.Vd"]) < 0.005 * TRUE["glass.Vd"]


@pytest.mark.long
@pytest.mark.parametrize("estimator", ["stack", "reservoir"])
def test_derivatives_by_the_glass_match_differences_of_the_tracer(estimator: str, prism: mi.Scene) -> None:
    check_derivatives(prism, differences(), estimator)


@pytest.mark.long
def test_derivatives_by_coefficients_match_differences_of_the_tracer(prism: mi.Scene, tmp_path: Path) -> None:
    wanted = {}
    for letter, coefficients in (("B", B), ("C", C)):
        for number, value in enumerate(coefficients[:2]):
            ends = []
            for factor in (1 + 1e-4, 1 - 1e-4):
                changed = list(coefficients)
                changed[number] *= factor
                ends.append(picture_of(functools.partial(sellmeier, **{letter: tuple(changed)})))
            wanted[f"glass.{letter}{number + 1}"] = (ends[0] - ends[1]) / (2e-4 * value)
    check_derivatives(load_scene(coefficients_scene(tmp_path)), wanted, "stack")


def coefficients_scene(folder: Path) -> Path:
    """Write the shipped scene with the glass by its coefficients, and return its file."""
    text = (ROOT / "scenes/prism/scene.xml").read_text()
    numbers = ", ".join(map(str, (*B, *C)))
    (folder / "scene.xml").write_text(text.replace('"material" value="F2"', f'"sellmeier" value="{numbers}"'))
    return folder / "scene.xml"


def check_derivatives(scene: mi.Scene, derivatives: dict[str, np.ndarray], estimator: str) -> None:
    """Assert that derivatives of the picture equal `derivatives` (width, 3), for weights that vary over the film."""
    columns = np.stack([np.sin(np.arange(FILM[0]) / s) + 1 for s in (9.0, 14.0, 11.0)], -1).astype(np.float32)
    wanted = [float((derivative * columns).sum()) for derivative in derivatives.values()]
    params, weights = mi.traverse(scene), mi.TensorXf(np.broadcast_to(columns, (FILM[1], *columns.shape)).copy())
    for key in derivatives:
        dr.enable_grad(params[key])
    params.update()
    integrator, found = mi.load_dict({"type": "reslrb", "estimator": estimator, "max_depth": 4}), []
    for seed in range(8):
        seen = mi.render(scene, params, integrator=integrator, spp=64, seed=seed)
        for key in derivatives:
            dr.set_grad(params[key], 0)
        dr.backward(dr.sum(seen * weights, axis=None))
        found.append([float(dr.grad(params[key])[0]) for key in derivatives])
    mean, error = np.mean(found, 0), np.std(found, 0, ddof=1) / np.sqrt(len(found))
    print(mean, error, wanted)
    assert (error < 0.02 * np.abs(wanted)).all()
    assert (np.abs(mean - wanted) < 4 * error + 0.005 * np.abs(wanted)).all(), (mean, error, wanted)


@pytest.mark.long
def test_the_glass_is_recovered_from_the_picture_of_the_tracer(prism: mi.Scene, tmp_path: Path) -> None:
    """The picture is a file that neither the package nor Mitsuba rendered."""
    write_file(tmp_path / "rainbow.exr", image().astype(np.float32), linear=True)
    done("optimize", ROOT / "configs/prism.yaml", "--set", f"run.output={tmp_path}", "--set", "run.name=it",
         "--set", f"target={{file: {tmp_path}/rainbow.exr, mask: none}}")  # fmt: skip
    assert read_manifest(tmp_path / "it")["status"] == "finished"
    values = {key: float(read_value(tmp_path / "it", key)) for key in TRUE}
    assert values["glass.nd"] == pytest.approx(TRUE["glass.nd"], abs=1e-4)
    assert values["glass.Vd"] == pytest.approx(TRUE["glass.Vd"], rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize(
    "steps", [{"glass.nd": 5e-3, "glass.Vd": 2.0, "glass.alpha": 4e-3}, {"glass.B1": 0.015, "glass.C2": 0.002}]
)
def test_derivatives_of_rough_glass_match_finite_differences(
    steps: dict[str, float], prism: mi.Scene, tmp_path: Path
) -> None:
    """The weights vanish at the film's border, because derivatives lack the light that crosses it."""
    path = ROOT / "scenes/prism/scene.xml" if "glass.nd" in steps else coefficients_scene(tmp_path)
    text = path.read_text().replace(
        '<bsdf type="dispersivedielectric" id="glass">',
        '<bsdf type="dispersivedielectric" id="glass"><float name="alpha" value="0.1"/>',
    )
    (tmp_path / "rough.xml").write_text(text)
    scene = load_scene(tmp_path / "rough.xml")
    params = mi.traverse(scene)
    weights = mi.TensorXf((smooth_weights(*FILM[::-1]) * [1.0, 0.3, -0.8]).astype(np.float32))
    integrator = mi.load_dict({"type": "reslrb", "estimator": "stack", "max_depth": 4, "rr_depth": 100})
    start = {key: float(params[key][0]) for key in steps}

    def objective(seed: int) -> mi.TensorXf:
        return dr.sum(mi.render(scene, params, integrator=integrator, spp=512, seed=seed) * weights, axis=None)

    def at(key: str, value: float, seed: int) -> float:
        params[key] = mi.Float(value)
        params.update()
        return float(np.array(objective(seed)).sum())

    z = []
    for key, step in steps.items():
        ours, differences = [], []
        for seed in range(6):
            value = mi.Float(start[key])
            dr.enable_grad(value)
            params[key] = value
            params.update()
            dr.backward(objective(seed))
            ours.append(float(dr.grad(params[key])[0]))
            dr.disable_grad(params[key])
            differences.append((at(key, start[key] + step, seed) - at(key, start[key] - step, seed)) / (2 * step))
        at(key, start[key], 0)
        error = np.hypot(*(np.std(each, ddof=1) / np.sqrt(6) for each in (ours, differences)))
        assert error < 0.1 * abs(np.mean(differences)), key
        z.append((np.mean(ours) - np.mean(differences)) / error)
    assert np.abs(z).max() < 4, z
