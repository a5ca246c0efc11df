"""Blends of singular and smooth lobes, which stock Mitsuba 3.9.1 renders wrongly.

Each path of up to three segments meets a flat sheet at most once. Image and gradient are therefore linear in the BSDF
of the sheet, and the halves of a blend, each alone, give closed forms: the image is (1 - w) A + w B, and its derivative
by the weight is B - A.
"""

from __future__ import annotations

import functools
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from agreement import compare
from turns import a_few

from reslrb_cli.measure.gradients import Case, integrator, seeds
from reslrb_cli.measure.references import Situation, path_image, prb_gradient, ptracer_image
from reslrb_cli.measure.scenes.small import camera, diffuse, load, rgb, room, transform
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.needs import blend_warning, uneven_blends

pytestmark = pytest.mark.usefixtures("llvm")

W, SPP = 0.3, 64
#: BSDFs with singular lobes, with smooth lobes, and with both.
HALVES: dict[str, dict[str, Any]] = {
    "mirror": {"type": "conductor", "specular_reflectance": {"type": "rgb", "value": [0.9, 0.8, 0.7]}},
    "glass": {"type": "dielectric"},
    "pane": {"type": "thindielectric", "specular_transmittance": {"type": "rgb", "value": [0.6, 0.7, 0.8]}},
    "null": {"type": "null"},
    "black": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0, 0, 0]}},
    "matte": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.3, 0.2]}},
    "metal": {"type": "roughconductor", "alpha": 0.2},
    "frosted": {"type": "roughdielectric", "alpha": 0.3},
}
PATHS = ("camera", "light", "both")
#: All pairs of halves, in both orders. The kinds of paths take turns.
CASES = [f"{a}-{b}-{PATHS[turn % 3]}" for turn, (a, b) in enumerate(permutations(HALVES, 2))]
#: The case of the default suite. In the direction of the mirror, the metal is bright, so that every fault shows.
FEW = ["metal-mirror-camera"]


def sheet(bsdf: dict[str, Any]) -> dict[str, Any]:
    """Return the room under a sky, with a sheet in view that is lit from both sides."""
    place = transform(translate=[0.1, 0.0, 0.4], rotate=([1, 0, 0], -60), scale=0.6)
    return room(
        sheet={"type": "rectangle", "to_world": place, "bsdf": bsdf},
        camera=camera("gaussian"), sky={"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)},
    )  # fmt: skip


def tracer(paths: str) -> Any:
    return integrator("reslrb", 3, estimator="stack", paths=paths)


@functools.cache
def alone(name: str, paths: str) -> np.ndarray:
    """Return images of the sheet with one half alone, (N, H, W, C)."""
    case = Case(sheet(HALVES[name]), ())
    return np.array([np.array(case.image(tracer(paths), seed, 4 * SPP)) for seed in seeds(8, 1)])


@pytest.mark.parametrize("name", a_few(CASES, FEW))
def test_blends_are_linear(name: str):
    *pair, paths = name.split("-")
    first, second = (HALVES[half] for half in pair)
    case = Case(
        sheet({"type": "blendbsdf", "weight": W, "first": first, "second": second}), ("sheet.bsdf.weight.value",)
    )
    A, B = (alone(half, paths) for half in pair)
    ours = np.array([np.array(case.image(tracer(paths), seed, SPP)) for seed in seeds(8)])
    result = compare(ours, (1 - W) * A + W * B)
    print(name, result)
    assert result
    weights = np.array(case.weights)
    expected = ((B - A) * weights).sum((1, 2, 3))[:, None]
    found = case.gradients(tracer(paths), seeds(8), SPP)
    result = compare(found, expected, block=None)
    print(name, result)
    assert result


def test_stock_integrators_are_no_references_for_blends():
    mixed = {"type": "blendbsdf", "weight": W, "first": diffuse(0, 0, 0), "second": {"type": "conductor"}}
    even = {"type": "blendbsdf", "weight": W, "first": diffuse(0, 0, 0), "second": {"type": "roughconductor"}}
    for floor, refused in ((mixed, True), (even, False), ({"type": "twosided", "bsdf": mixed}, True)):
        case = Case(room(floor=floor), ())
        [key] = [key for key in case.params.keys() if key.endswith("weight.value")]  # noqa: SIM118
        at = Situation.of(case.scene, case.scene.sensors()[0], case.params, 4, False)
        for reason in (path_image(at), ptracer_image(at), prb_gradient(at, key)):
            assert (reason is not None and "blends of singular and smooth lobes" in reason) == refused


def masked(bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "mask", "opacity": 0.5, "nested": bsdf}


@pytest.mark.parametrize(
    ("half", "named"),
    [
        ({"type": "plastic"}, "plastic"),
        (masked({"type": "roughdielectric"}), "a mask over a BSDF that transmits light"),
        (masked({"type": "principledthin", "diff_trans": 1.0}), "a mask over a BSDF that transmits light"),
        (masked(diffuse(0.5, 0.5, 0.5)), None),
        ({"type": "roughplastic"}, None),
        ({"type": "conductor"}, None),
    ],
)
def test_blends_that_stay_wrong_are_named(half: dict[str, Any], named: str | None):
    bsdf = {"type": "blendbsdf", "weight": W, "first": diffuse(0, 0, 0), "second": half}
    graph = SceneGraph.of(load(sheet(bsdf)))
    warning = blend_warning(graph, uneven_blends(graph))
    assert (warning is None) if named is None else f" blends {named} with other lobes" in warning
