"""One tracer is used on scenes and parameters in any order. Its results equal the results of a new tracer, bit by bit
on one thread.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import is_same
from conformance.gradient_cases import _IN_VIEW, _pane, _textured
from conformance.moving import camera as above
from conformance.moving import enclosed, flat, sheet, under_glass
from runs.going_on import one_thread
from turns import a_few

from reslrb_cli.integrators.step import gradient_step, render_image
from reslrb_cli.measure.gradients import Case, integrator
from reslrb_cli.measure.scenes.small import camera, diffuse, lamp, load, rgb, room, veiled
from reslrb_cli.scene.rays import no_wavelengths
from reslrb_cli.transport.film import AdjointImage, Film

pytestmark = pytest.mark.usefixtures("llvm")
SPP = 4
MIRROR = {"type": "twosided", "bsdf": {"type": "conductor", "specular_reflectance": rgb(0.9, 0.7, 0.5)}}
FLOOR, WALL = "floor.brdf_0.reflectance.data", "wall.brdf_0.reflectance.value"
LAMP, SLAB, SHEET = "lamp.emitter.radiance.value", "slab.vertex_positions", "sheet.vertex_positions"


def small(make: Callable[..., dict[str, Any]], **changes: Any) -> dict[str, Any]:
    """Return a scene with something that moves, on a tiny film. The scene's lamp shines in all directions.

    With a `directionalarea` instead, next event estimation in another scene would ask the lamp for properties that it
    lacks.
    """
    light = flat(diffuse(0, 0, 0), 3.0, -0.8, emitter={"type": "area", "radiance": rgb(3.2, 3.0, 2.6)})
    return make(camera=above(size=12), lamp=light, **changes)


def rippling() -> mi.Mesh:
    """Return a rippled sheet that may move, for a room."""
    return sheet("sheet", diffuse(0.5, 0.4, 0.3), -0.6, 4, 1.0, 0.3)


#: Each scene with its sets of parameters. A flat sheet with interpolated normals may bend.
SCENES: dict[str, tuple[Callable[[], dict[str, Any]], list[tuple[str, ...]]]] = {
    "mirror": (lambda: _textured(pane=_pane(MIRROR, **_IN_VIEW), sheet=rippling(), camera=camera("gaussian")),
               [(FLOOR,), (WALL, LAMP), (SHEET,)]),
    "zero": (lambda: room(wall={"type": "twosided", "bsdf": diffuse(0.0, 0.5, 0.2)}),
             [("side.brdf_0.reflectance.value",), (WALL,)]),
    "caustic": (lambda: small(under_glass), [("receiver.bsdf.reflectance.value",), (SLAB,), (LAMP,)]),
    "moving": (lambda: small(enclosed), [(SLAB, LAMP), ("shell.bsdf.reflectance.value",), (LAMP,)]),
    "flat": (lambda: small(enclosed, slab=sheet("slab", diffuse(0.5, 0.4, 0.3), 0.1, 4, 0.0, 0.3)),
             [(SLAB,), ("shell.bsdf.reflectance.value",)]),
    "mask": (lambda: veiled(0.4), [("veil.bsdf.opacity.value",), (WALL,)]),
    "sky": (lambda: room(lamp=None, light={"type": "constant", "radiance": rgb(1, 0.5, 0.8)},
                         sheet=rippling(), camera=camera("gaussian")), [(SHEET,), ("light.radiance.value", WALL)]),
    "lamps": (lambda: room(other=lamp(radiance=rgb(3, 4, 5)) | {"to_world": mi.ScalarTransform4f().translate(
        [-0.5, 0.8, 0.1]).rotate([1, 0, 0], 120).scale(0.3)}), [(LAMP,), (WALL, LAMP)]),
}  # fmt: skip
WAYS: dict[str, dict[str, Any]] = {
    "both": {"estimator": "stack", "paths": "both"},
    "measured": {"estimator": "stack", "paths": "both", "pixels": "measured"},
    "guided": {"estimator": "stack", "guiding": "on"},
    "reservoir": {"estimator": "reservoir", "sequence": "low_discrepancy"},
    "guided both": {"estimator": "gather", "paths": "both", "guiding": "on"},
}
#: A request to a tracer: a scene, and the number of a set of parameters. None as the number requests an image.
Visit = tuple[str, int | None]


@functools.cache
def case_of(name: str, number: int) -> Case:
    """Return a case with one set of parameters. All cases of a scene share the scene."""
    scene, sets = SCENES[name]
    return Case(scene() if number == 0 else case_of(name, 0).scene, sets[number])


def visit(tracer: Any, name: str, number: int | None) -> list[np.ndarray]:
    """Return the image that a tracer renders. With parameters, return image and gradient of a step. The number of the
    parameter set selects the kind of step.
    """
    case = case_of(name, number or 0)
    if number is None:
        return [np.array(render_image(tracer, case.scene, 0, 3, SPP))]
    images = []

    def step(*given: Any, **options: Any) -> Any:
        images.append(np.array((result := gradient_step(*given, **options)).image))
        return result

    adjoint = ("independent", "correlated", "batched")[number]
    gradient = case.gradient(tracer, 5, SPP, step=step, adjoint=adjoint)
    return [*images, gradient]


def visits_of(way: str, names: tuple[str, ...]) -> list[Visit]:
    """Return all visits that these scenes allow with this configuration."""
    found = [(name, number) for name in names for number in (None, *range(len(SCENES[name][1])))]
    able = ("stack", "reservoir")
    return [
        (name, number) for name, number in found
        if number is None or WAYS[way]["estimator"] in able or not any(
            key.endswith("vertex_positions") for key in SCENES[name][1][number]
        )
    ]  # fmt: skip


def differing(way: str, names: tuple[str, ...], orders: Iterator[np.random.Generator], length: int) -> list[str]:
    """Return visits in random orders whose results differ from the results of a new tracer.

    If tables learn, the new tracer first makes the visits to the same scene that immediately preceded.
    """
    make = functools.partial(integrator, "reslrb", 4, **WAYS[way])
    expected: dict[tuple[Visit, ...], list[np.ndarray]] = {}
    found, possible = [], visits_of(way, names)
    for random in orders:
        tracer, history = make(), list[Visit]()
        for index in random.integers(len(possible), size=length):
            name, number = possible[index]
            history = [*(history if history and history[-1][0] == name else []), (name, number)]
            before = tuple(history if "guiding" in WAYS[way] else history[-1:])
            if before not in expected:
                other = make()
                expected[before] = [visit(other, *each) for each in before][-1]
            pairs = zip(visit(tracer, name, number), expected[before], strict=True)
            if not all(is_same(*pair) for pair in pairs):
                found.append(f"{way}: {before}")
    return found


@pytest.mark.long
@pytest.mark.parametrize("way", WAYS)
def test_results_do_not_depend_on_200_orders_of_earlier_work(way: str) -> None:
    with one_thread():
        orders = map(np.random.default_rng, range(200 // len(WAYS)))
        assert differing(way, tuple(SCENES), orders, 6) == []


def test_weights_of_emitters_may_change() -> None:
    """Light paths and camera paths are weighted by the current probabilities of the emitters."""
    scene, image = load(SCENES["lamps"][0]()), functools.partial(render_image, sensor=0, seed=3, spp=SPP)
    params, tracer = mi.traverse(scene), integrator("reslrb", 4, **WAYS["both"])
    before = np.array(image(tracer, scene))
    params["lamp.emitter.sampling_weight"] = 0.02
    params.update()
    images = [np.array(image(each, scene)) for each in (tracer, integrator("reslrb", 4, **WAYS["both"]))]
    assert np.abs(images[1] - before).max() > 1e-3
    np.testing.assert_allclose(*images, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", a_few(["reslrb", "ptracer"], ["reslrb"]))
def test_a_scene_at_a_reused_address_is_another_one(name: str) -> None:
    """The directional light uses the bounding sphere of the current scene."""

    def mean(tracer: Any, size: float) -> tuple[float, int]:
        scene = load(room(lamp=None, far={"type": "sphere", "center": [0, size, 0], "radius": 0.1},
                          light={"type": "directional", "direction": [0, -1, -0.3], "irradiance": 1.0}))  # fmt: skip
        return float(np.mean(render_image(tracer, scene, 0, 3, SPP))), scene.ptr

    one, addresses = integrator(name, 4), set()
    for size in (2.0, 200.0, 5.0, 100.0) * 2:
        found, address = mean(one, size)
        assert found == pytest.approx(mean(integrator(name, 4), size)[0], rel=1e-5)
        addresses.add(address)
    print(len(addresses), "addresses")


@pytest.mark.parametrize("whole", [True, False])
def test_the_derivative_of_film_positions_is_the_same_in_both_modes(whole: bool) -> None:
    """Naive AD of splats, of their taps, and a lookup of dL/dI give the same derivatives. With `whole`, the film does
    not divide filter weights by their sum.
    """
    film = Film(load(room(camera=camera("gaussian"))).sensors()[0], whole)
    shape = film.block().tensor().shape
    colours = film.colours(mi.Spectrum([450, 530, 580, 620]) if mi.is_spectral else no_wavelengths())
    weights = mi.Float(np.random.default_rng(1).random(int(np.prod(shape)), np.float32))

    def splat(u: mi.Point2f) -> Any:
        block = film.block()
        film.put(block, u, mi.Spectrum(1), mi.Bool(True), colours, normalization=True)
        return dr.sum(block.tensor().array * weights)

    image = AdjointImage(film, weights, shape[2])

    def taps(u: mi.Point2f) -> Any:
        weighed, total = film.taps(u, True)
        inside = [(pixel, k, (pixel.x < shape[1]) & (pixel.y < shape[0])) for pixel, k in weighed]
        return sum(k / total * dr.sum(colours.adjoint(image._pixel(pixel, here))) for pixel, k, here in inside)

    found = []
    for objective in (splat, taps, lambda u: dr.sum(image.lookup(u, mi.Bool(True), colours))):
        u = mi.Point2f([2.3, 7.8, 0.2], [5.1, 3.4, 9.9])
        dr.enable_grad(u)
        dr.backward(objective(u))
        found.append(np.array(dr.grad(u)))
    least = 1e-4 if mi.is_spectral else 1e-3  # the film's response to a wavelength is about 0.01
    assert np.abs(found[2]).min() > least
    np.testing.assert_allclose(found[0], found[2], rtol=1e-3, atol=least / 100)
    np.testing.assert_allclose(found[1], found[2], rtol=1e-3, atol=least / 100)
