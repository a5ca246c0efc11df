"""Exposures that are recovered: their gradient, and where the images cannot tell them from parameters."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from cli.tiny import KEY, write_experiment

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.identifiability import check_exposures, find_ambiguous
from reslrb_cli.optimization.loop import optimize
from reslrb_cli.optimization.sensitivity import sample_gradient, take_gradient

#: Exposures that gradients are taken at.
AT = {"auto": [1.3], "per_channel": [1.3, 0.7, 2.0]}
ROUNDS = 200
LAMP = "lamp.emitter.radiance.value"


@pytest.fixture
def folder(tmp_path):
    write_experiment(tmp_path)
    return tmp_path


def make(folder, *sets):
    return assemble(load(folder / "tiny.yaml", list(sets)))


def set_exposure(problem, values):
    slot = problem.selection.slot("exposure")
    slot.set(np.array(values, np.float32).reshape(slot.get().shape))
    leaf = problem.optimizer["exposure"]
    problem.optimizer._scene["exposure"] = type(leaf)(problem.selection.value("exposure"))
    dr.enable_grad(problem.optimizer["exposure"])


@pytest.mark.parametrize("kind", AT)
@pytest.mark.parametrize("adjoint", ["batched", "independent", "correlated"])
def test_the_gradient_is_that_of_the_mean_image(folder, kind, adjoint):
    """dL/dE of `l2` is the sum of 2 (E I - T) I over all entries, over their number; I is the mean image.

    With the samples of dL/dI the noise of I would add its variance, which `correlated` shows.
    """
    problem = make(folder, f"target.exposure={kind}", f"run.adjoint={adjoint}", "run.spp=8")
    set_exposure(problem, AT[kind])
    rows = []
    for round in range(ROUNDS):
        sample_gradient(problem, problem.integrator, round, "exposure", 8)
        rows.append(take_gradient(problem)["exposure"])
    image, target = problem.render(0, 8192, 0, "mean").astype(np.float64), np.array(problem.views[0].target)
    exact = 2 * (np.array(AT[kind]) * image - target) * image / image.size
    exact = exact.sum((0, 1)) if kind == "per_channel" else np.array([exact.sum()])
    reference = np.stack([exact, exact])  # without noise to speak of
    found = compare(np.array(rows, np.float64)[:, None, None], reference[:, None, None], 1)
    assert found.holds == (adjoint != "correlated"), found


@pytest.mark.parametrize("views", ["auto", "[auto]"])
def test_what_the_images_cannot_tell_apart_is_refused(folder, views):
    """All light, or all that it falls on directly, scales the image as the exposure does."""
    wall = make(folder, f"target.exposure={views}", "integrator.max_depth=2")
    with pytest.raises(ConfigError, match=f"cannot tell `exposure.*` from `{KEY}`") as error:
        check_exposures(wall)
    assert error.value.key == "target.exposure"
    lamp = make(folder, f"target.exposure={views}", f"parameters=[{{key: {LAMP}, initial: 5}}]")
    found = find_ambiguous(lamp)
    assert found is not None
    assert found.parameters == [LAMP]
    known = make(folder, "target.exposure=2", f"parameters=[{{key: {LAMP}, initial: 5}}]")
    check_exposures(known)


def test_a_colour_beside_a_known_one_is_recovered_with_the_exposure(folder):
    scene = folder / "scene.xml"
    scene.write_text(scene.read_text().replace("</scene>", """
        <shape type="rectangle" id="side">
            <transform name="to_world"><scale value="0.3"/><translate x="0.6" z="0.5"/></transform>
            <bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.6, 0.3"/></bsdf>
        </shape></scene>"""))  # fmt: skip
    plain = make(folder, "parameters[0].initial=scene")
    image = 0.6 * plain.render(0, 4096, 0, "photo")
    side = "side.bsdf.reflectance.value"
    mi.Bitmap(image.astype(np.float32)).write(str(folder / "photo.exr"))
    problem = make(
        folder, "target={file: photo.exr, exposure: auto}",
        f"parameters=[{{key: {side}, initial: 0.3, bounds: [0, 1]}}]",
        "run.iterations=100", "run.spp=256", "optimizer.schedule=cosine", "integrator.max_depth=3",
    )  # fmt: skip
    values = [problem.selection.array("exposure").copy() for _ in optimize(problem)]
    assert abs(float(values[-1]) - 0.6) < 0.02
    np.testing.assert_allclose(problem.selection.array(side), [0.1, 0.6, 0.3], atol=0.04)
