"""`paths: camera` and `both`. Images are compared with `path` in every pixel, and gradients with naive AD and in
expectation.

Mirrors and glass are in view, lamps are hidden, and the film's border counts. Light paths alone lack these effects.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare, is_same
from conformance.gradient_cases import CASES
from conformance.scenes import (
    RED,
    agreement,
    ball,
    bitmap,
    camera,
    images,
    lamp,
    plugin,
    rectangle,
    rgb,
    stage,
    transform,
)
from conformance.test_gradients import forward
from turns import a_few, taking_turns

from reslrb_cli.errors import UnsupportedScene
from reslrb_cli.guiding.pixels import MOST, NOTED_SPP, density_of
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.step import interface_of, render_image
from reslrb_cli.measure.gradients import Case, integrator, relative, seeds
from reslrb_cli.measure.scenes.case import SceneCase
from reslrb_cli.measure.scenes.catalogue import PRB
from reslrb_cli.records.clock import peak_mib, reset_peak
from reslrb_cli.transport.camera import one_of_group
from reslrb_cli.transport.pixel_shares import EVEN, MOST_SLOTS, PixelShares

pytestmark = pytest.mark.usefixtures("samples")


# --- images -----------------------------------------------------------------------------------------------------------

SMALL = {"width": 20, "height": 16}


def seen(**bsdf: Any) -> dict[str, Any]:
    """Return a ball of this material in the camera's view."""
    return {"ball": ball(bsdf)}


def lamps(**lights: Any) -> dict[str, Any]:
    return dict(lights)


def looks(**changes: Any) -> Any:
    return camera(**{**SMALL, **changes})


def sheet() -> Any:
    """Return a perforated sheet between camera and stage."""
    to_world = transform().look_at(origin=[0.2, 1.3, 2.0], target=[0.4, 1.5, 4], up=[0, 1, 0]) @ transform().scale(0.5)
    bsdf = {"type": "mask", "opacity": bitmap(6, 6, channels=1, low=0), "bsdf": {"type": "twosided", "bsdf": RED}}
    return rectangle(bsdf, to_world)


#: Emitters, objects, the sensor, and the options of both integrators.
SCENES: dict[str, Callable[[], tuple[dict[str, Any] | None, Any, dict[str, Any], dict[str, Any]]]] = {
    "mirror": lambda: (None, looks(), seen(type="conductor"), {}),
    "glass": lambda: (None, looks(), seen(type="dielectric"), {}),
    "plastic": lambda: (None, looks(), seen(type="plastic"), {}),
    "rough glass": lambda: (None, looks(), seen(type="roughdielectric", alpha=0.3), {}),
    "mask": lambda: (None, looks(), {"sheet": sheet()}, {}),
    "gaussian": lambda: (None, looks(rfilter="gaussian"), {}, {}),
    "mitchell": lambda: (None, looks(rfilter="mitchell"), {}, {}),
    "hidden lamp": lambda: (
        lamps(lamp=lamp(position=(0, 1.6, -0.8), target=(0, 0.3, 2))), looks(), {}, {"hide_emitters": True}),
    "lamp in view": lambda: (lamps(lamp=lamp(position=(0, 1.6, -0.8), target=(0, 0.3, 2))), looks(), {}, {}),
    "crop": lambda: (None, looks(film={"crop_width": 9, "crop_height": 7, "crop_offset_x": 5, "crop_offset_y": 4}),
                     {}, {}),
    "point": lambda: (lamps(lamp={"type": "point", "position": [0.5, 1.9, 0.6], "intensity": rgb(3, 4, 5)}), looks(),
                      {}, {}),
    "constant": lambda: (lamps(sky={"type": "constant", "radiance": rgb(0.5, 0.6, 0.7)}), looks(), {}, {}),
    "sphere": lambda: (lamps(lamp={"type": "sphere", "center": [0.5, 1.9, 0.6], "radius": 0.2, "emitter": {
        "type": "area", "radiance": rgb(5, 4, 3)}}), looks(), {}, {}),
    "roulette": lambda: (None, looks(), seen(type="roughconductor", alpha=0.2), {"rr_depth": 2, "max_depth": 8}),
}  # fmt: skip
WAYS = [{"paths": "camera"}, *({"paths": "both", "light_share": share} for share in (0.5, 0.1, 0.9))]
FEW = ("mirror", "mask", "gaussian", "hidden lamp", "crop", "sphere")


@taking_turns("name", [*FEW, *(name for name in SCENES if name not in FEW)], "way", [0, 1, 2, 3], FEW)
def test_images_equal_path_in_every_pixel(name: str, way: int):
    lights, sensor, things, options = SCENES[name]()
    scene = stage(lights, sensor, **things)
    result = agreement(scene, spp=128, seeds=12, reslrb={"estimator": "stack", **WAYS[way]}, **options)
    print(name, WAYS[way], result)
    assert result


def unevenly(tracer: Any, scene: Any) -> Any:
    """Return the same tracer with camera paths that are randomly distributed over the pixels."""
    size = scene.sensors()[0].film().crop_size()
    return tracer.shared_out({"0": np.random.default_rng(5).exponential(size=(size[1], size[0])).astype(np.float32)})


@pytest.mark.parametrize("paths", [7, 20, 33, 100, 1003])
def test_distributed_paths_have_the_requested_number_per_pixel(paths: int):
    density = np.random.default_rng(paths).exponential(size=20)
    density[:3] = 0
    shares = PixelShares.of(density, paths)
    if paths <= density.size:
        assert shares is None
        return
    pixel, number = (np.array(x) for x in shares.draw(dr.arange(mi.UInt32, paths)))
    counts = np.array(shares.count(dr.arange(mi.UInt32, density.size)))
    assert np.array_equal(np.bincount(pixel, minlength=density.size), counts)
    assert counts.sum() == paths
    assert float(shares.mean()[0]) == pytest.approx(paths / density.size)
    for one in range(density.size):
        assert sorted(number[pixel == one]) == list(range(int(counts[one])))
    if paths > 1000:  # the requested numbers, apart from the even share
        even = int(shares.even[0])
        assert EVEN <= even / paths < EVEN + MOST_SLOTS * density.size / paths
        expected = even / density.size + (paths - even) * density / density.sum()
        np.testing.assert_allclose(counts, expected, atol=int(shares.rounds[0]) + 1)


@pytest.mark.parametrize(("count", "n"), [(3, 7), (2**24 - 3, 2**25), (2**25 + 1, 2**25 + 4)])
def test_fewer_paths_than_pixels_reach_every_pixel(count: int, n: int):
    """Each path belongs to its own group of pixels, also beyond 2^24, where floats are even numbers only."""
    lanes = np.unique(np.concatenate([np.arange(min(count, 50)), np.arange(max(count - 200, 0), count)]))
    low, high = lanes * n // count, -(-(lanes + 1) * n // count)
    drawn = np.stack([
        np.array(one_of_group(mi.UInt32(lanes.astype(np.uint32)), mi.UInt32(count), n, mi.Float(sample)))
        for sample in np.linspace(0, 1, 16, endpoint=False)
    ]).astype(int)  # fmt: skip
    assert (drawn >= low).all()
    assert (drawn < high).all()
    last = drawn[:, -100:]
    assert set(range(max(n - 50, 0), n)) <= set(last.ravel())


UNEVEN = ["mirror", "gaussian", "crop", "sphere"]


@taking_turns("name", UNEVEN, "way", [0, 1, 2, 3], UNEVEN)
def test_images_equal_path_for_any_distribution_of_paths(name: str, way: int):
    lights, sensor, things, _ = SCENES[name]()
    scene = stage(lights, sensor, **things)
    ours = unevenly(make_integrator("reslrb", max_depth=5, rr_depth=100, estimator="stack", **WAYS[way]), scene)
    theirs = images(scene, "path", range(50, 62), 128, max_depth=5, rr_depth=100)
    renders = np.stack([np.array(render_image(ours, scene, 0, seed, 128)) for seed in range(12)])
    shares = ours.passes(Job(scene, scene.sensors()[0], mi.UInt32(0), 128))[0].sides()[-1].shares
    assert shares is not None
    assert compare(renders, theirs)


@pytest.mark.parametrize("paths", a_few(["camera", "both"], ()))
def test_gradients_are_independent_of_the_distribution_of_paths(paths: str):
    case = next(case for case in CASES if case.name == "texture")
    scene = Case(case.scene(), case.keys)
    even = integrator("reslrb", **options_of(case, paths))
    ours = unevenly(integrator("reslrb", **options_of(case, paths), freeze=True), scene.scene)
    for step in ({}, {"step": scene.known_step}):
        expected = scene.gradients(even, seeds(16), case.spp, **step)
        assert compare(scene.gradients(ours, seeds(16, 1), case.spp, **step), expected, block=None)


def test_the_pilot_finds_pixels_that_only_a_mirror_shows():
    """A camera sees a red wall behind it only in a mirror. The mirror's pixels alone depend on the wall's colour, and
    the other pixels get few paths. They show a dark wall: in spectral variants, a path's wavelengths give a bright wall
    noise, which attracts paths. A second recording gives the same result.
    """
    size = {"width": 48, "height": 48, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    at = transform().look_at(origin=[0, 0, 0], target=[0, 0, -1], up=[0, 1, 0])
    back = transform().translate([0, 0, -3]).scale(3)
    scene = mi.load_dict({
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 60.0, "to_world": at, "film": {"type": "hdrfilm", **size}},
        "wall": rectangle({"type": "diffuse", "reflectance": rgb(0.2, 0.2, 0.2)}, back),
        "glass": rectangle({"type": "conductor"}, transform().translate([0.6, 0, -2.9]).scale(0.5)),
        "red": rectangle(RED, transform().translate([0, 0, 2]).rotate([0, 1, 0], 180).scale(3)),
        "lamp": rectangle(RED, transform().translate([0, 2.5, -1]).rotate([1, 0, 0], 90).scale(0.3))
        | {"emitter": {"type": "area", "radiance": rgb(9, 9, 9)}},
    }, optimize=False)  # fmt: skip
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.startswith("red.") and key.endswith("reflectance.value"))  # noqa: SIM118
    dr.enable_grad(params[key])
    params.update()
    job = Job(scene, scene.sensors()[0], mi.UInt32(3), 32, params)
    tracer = make_integrator("reslrb", estimator="stack", paths="both", max_depth=4, pixels="measured")
    density = tracer.note_pixels(job)
    assert is_same(density, tracer.note_pixels(job))
    show = density > 2
    ray = scene.sensors()[0].sample_ray(0, 0, grid(48), mi.Point2f(0.5))[0]
    mirror = np.array(mi.has_flag(scene.ray_intersect(ray).bsdf().flags(), mi.BSDFFlags.Delta)).reshape(48, 48)
    assert density.mean() == pytest.approx(1)
    assert density.max() <= MOST * (1 + 1e-5)
    assert density[mirror].mean() > 10 * density[~mirror].mean()
    assert show[mirror].mean() > 0.5
    # The first gradient records the pixel shares. Images before this gradient have even shares.
    assert tracer.passes(Job(scene, scene.sensors()[0], mi.UInt32(0), 32))[0].shares is None
    assert tracer.passes(job)[0].shares is not None


@pytest.mark.parametrize("image", ["lamp", "texture"])
def test_edges_do_not_count_as_noise(image: str):
    """Beside a bright lamp without noise, the gradient's variance is at most 1.02 times the variance with even shares.
    For a flat noisy half beside a clean textured half, the factor is at most 0.8.
    """
    means, deviations, signal = np.ones((48, 48)), np.full((48, 48), 0.5), np.ones((48, 48))
    if image == "lamp":
        means[20:26, 20:26], deviations[20:26, 20:26], signal[20:26, 20:26] = 50, 0, 0
    else:
        deviations[:, :24], means[:, :24] = 0.05, np.indices((48, 24)).sum(0) % 2 * 2.0
    rng = np.random.default_rng(1)
    samples = means + deviations * rng.standard_normal((NOTED_SPP, 48, 48))
    density = density_of(np.stack([signal, samples.mean(0), np.square(samples).mean(0)]), [3])
    variance = np.square(deviations * signal)
    assert np.sum(variance / density) < (1.02 if image == "lamp" else 0.8) * np.sum(variance)


@pytest.mark.parametrize("left_out", [False, True])
def test_noise_outside_the_loss_gets_no_paths(left_out: bool):
    """A bright, noisy area around a lamp has a small curvature under relative_l2, or is left out of the loss. The
    gradient has less variance with the loss's curvature than without.
    """
    means, signal = np.ones((48, 48)), np.ones((48, 48))
    means[10:30, 10:30] = 30
    curvature = 1 / np.square(means)
    curvature[means > 1] *= not left_out
    rng = np.random.default_rng(1)
    samples = means * (1 + 0.5 * rng.standard_normal((NOTED_SPP, 48, 48)))
    rows = np.stack([signal, samples.mean(0), np.square(samples).mean(0)])
    variance = np.square(curvature * 0.5 * means * signal)
    best = np.square(np.sqrt(variance).mean()) * variance.size
    weighed, plain = density_of(rows, [3], curvature), density_of(rows, [3])
    assert np.sum(variance[weighed > 0] / weighed[weighed > 0]) < 1.1 * best
    assert np.sum(variance / plain) > 3 * best
    assert np.array_equal(weighed > 0, curvature > 0)


def grid(n: int) -> mi.Point2f:
    """Return the centres of n x n pixels."""
    pixel = dr.arange(mi.UInt32, n * n)
    return mi.Point2f((pixel % n + 0.5) / n, (pixel // n + 0.5) / n)


@pytest.mark.long
def test_light_paths_alone_can_have_the_border_of_both():
    """If `paths: auto` turns `both` into light paths alone, the border of the image stays right."""
    film = {"film": {"rfilter": {"type": "gaussian", "stddev": 1.5}}}
    scene = stage(None, looks(**film))
    ours = make_integrator("reslrb", estimator="stack", max_depth=3, rr_depth=100)
    theirs = images(scene, "path", range(50, 62), 48, max_depth=3, rr_depth=100)
    for made, holds in ((ours, False), (ours.afresh(light_share=1.0), True)):
        renders = np.stack([np.array(render_image(made, scene, 0, seed, 48)) for seed in range(12)])
        assert bool(compare(renders, theirs, block=1)) == holds


def test_light_that_camera_paths_cannot_find_is_left_to_light_paths():
    """Parallel light passes through a ball of glass. Next event estimation is blocked, and no camera path meets the
    lamp.
    """
    scene = stage({"sun": {"type": "directional", "direction": [0, -1, -0.2], "irradiance": rgb(3, 3, 3)}}, looks(),
                  ball=ball({"type": "dielectric"}))  # fmt: skip
    sizes = {"max_depth": 5, "rr_depth": 100, "estimator": "stack"}
    ours, light, alone = (
        images(scene, "reslrb", range(at, at + 12), 128, paths=paths, **sizes)
        for at, paths in ((0, "both"), (100, "light"), (200, "camera"))
    )
    # The caustic's pixels see only the floor. All their light comes from light paths or from next event estimation.
    caustic = light.mean((0, 3)) > 2 * alone.mean((0, 3)) + 1e-3
    assert caustic.sum() >= 4
    assert compare(ours[:, caustic][:, None], light[:, caustic][:, None])


@pytest.mark.long
@pytest.mark.parametrize("paths", a_few(["camera", "both"], ["both"]))
def test_fewer_paths_than_pixels(paths: str):
    """Means do not change with one sample per pixel, even if only a few paths are light paths."""
    scene = stage(None, looks())
    options = {"max_depth": 3, "rr_depth": 100, "estimator": "stack", "paths": paths}
    usual = images(scene, "reslrb", range(8), 256, **options)
    few = images(scene, "reslrb", range(1000, 1100), 1, **options, light_share=0.01 if paths == "both" else 0.5)
    assert compare(few.mean((1, 2), keepdims=True), usual.mean((1, 2), keepdims=True), block=None)


@pytest.mark.parametrize("depth", [0, 1])
def test_short_paths(depth: int):
    scene = stage({"lamp": lamp(position=(0, 1.6, -0.8), target=(0, 0.3, 2))}, looks())
    for way in WAYS[:2]:
        ours = images(scene, "reslrb", range(4), 64, max_depth=depth, estimator="stack", **way)
        theirs = images(scene, "path", range(50, 54), 64, max_depth=depth)
        assert ours.mean() == pytest.approx(theirs.mean(), rel=0.1)


# --- gradients --------------------------------------------------------------------------------------------------------

#: Cases whose light both kinds of paths can find. Camera paths cannot find parallel lamps.
BOTH = [case for case in CASES if case.name not in ("texture_prb", "directionalarea")]


def options_of(case: SceneCase, paths: str, **more: Any) -> dict[str, Any]:
    return {**case.options, "estimator": "stack", "paths": paths, **more}


#: Ways of a step: dL/dI becomes known after the image, or before it, in one traversal; with a small stack (one vertex)
#: or from a recording.
STEPS: dict[str, tuple[dict[str, Any], bool]] = {
    "correlated": ({}, False), "recorded": ({"freeze": True}, True),
    "known": ({}, True), "beyond": ({"stack_size": 1}, False),
}  # fmt: skip


#: The default suite: each case with one kind of paths. Each kind of paths has every way.
SOME = {
    "texture": ("camera", tuple(STEPS)), "visible_lamp": ("both", tuple(STEPS)),
}  # fmt: skip


@pytest.mark.parametrize(
    ("case", "paths", "steps"),
    [
        *(pytest.param(case, *SOME[case.name], id=f"{case.name}-{SOME[case.name][0]}")
          for case in BOTH if case.name in SOME),
        *(pytest.param(case, paths, tuple(STEPS), id=f"{case.name}-{paths}-all", marks=pytest.mark.long)
          for case in BOTH for paths in ("camera", "both")),
    ],
)  # fmt: skip
def test_gradients_equal_naive_ad(case: SceneCase, paths: str, steps: tuple[str, ...]):
    scene = Case(case.scene(), case.keys)
    reference = scene.gradient(integrator("walk_ad", **case.options, paths=paths), 5, case.spp)
    for name in steps:
        more, known = STEPS[name]
        step = {"step": scene.known_step} if known else {}
        ours = scene.gradient(integrator("reslrb", **options_of(case, paths, **more)), 5, case.spp, **step)
        error = relative(ours, reference)
        print(case.name, paths, name, f"{error:.1e}")
        assert error < scene.rounding(), f"{name}: {error:.1e}"


@pytest.mark.parametrize("name", a_few([case.name for case in BOTH], ["texture", "area"]))
@pytest.mark.parametrize("paths", a_few(["camera", "both"], ["camera"]))  # the next test has both
def test_forward_mode_equals_naive_ad(name: str, paths: str):
    case = next(case for case in CASES if case.name == name)
    scene = Case(case.scene(), case.keys)
    tangent = forward(scene, plugin("reslrb", **options_of(case, paths)), 3, 16)
    naive = forward(scene, plugin("walk_ad", **case.options, paths=paths), 3, 16)
    assert np.abs(naive).max() > 0
    assert relative(tangent, naive) < 1e-5


def test_a_parallel_lamp_of_another_scene_does_not_matter():
    """Dr.Jit records calls for the emitters of all scenes. Mitsuba evaluates no `directionalarea`."""
    by_name = {case.name: case for case in CASES}
    case = by_name["area"]
    scene = Case(case.scene(), case.keys)
    alone = scene.gradient(plugin("reslrb", **options_of(case, "camera")), 3, 4)
    other = mi.load_dict(by_name["directionalarea"].scene(), optimize=False)
    assert np.array_equal(scene.gradient(plugin("reslrb", **options_of(case, "camera")), 3, 4), alone)
    assert other.emitters()


def test_forward_mode_sees_no_light_from_hidden_lamps():
    """Camera rays start behind a white lamp, in front of which a mask hangs. Light paths that end on the lamp do not
    count. Forward mode counted them.
    """
    by_name = {case.name: case for case in CASES}
    lit, masked = by_name["visible_lamp"].scene(), by_name["mask_texture_in_view"].scene()
    white = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(0.8, 0.8, 0.8)}}
    sign = rectangle(white, transform().translate([0.2, -0.1, 0.4]).rotate([0, 1, 0], 15).scale(0.6))
    sign["emitter"] = {"type": "area", "radiance": rgb(1, 2, 1)}
    scene = Case(lit | {"veil": masked["veil"], "sign": sign}, ["veil.bsdf.opacity.data"])
    options = {"hide_emitters": True, "paths": "both"}
    tangent = forward(scene, plugin("reslrb", estimator="stack", **options), 3, 16)
    assert relative(tangent, forward(scene, plugin("walk_ad", **options), 3, 16)) < 1e-5


@pytest.mark.parametrize("case", a_few([case for case in BOTH if case.source == PRB], ()))
def test_gradients_equal_prb(case: SceneCase):
    scene = Case(case.scene(), case.keys)
    reference = scene.gradients(integrator("prb", **case.options), seeds(16, 1), case.spp)
    for paths in ("camera", "both"):
        ours = scene.gradients(integrator("reslrb", **options_of(case, paths)), seeds(16), case.spp)
        assert compare(ours, reference, block=None), paths


#: Cases without caustics, since only light paths find caustics in reasonable time.
NO_CAUSTICS = [case for case in BOTH if case.name not in ("glass", "mirror")]


@pytest.mark.parametrize("case", a_few(NO_CAUSTICS, ()))
def test_both_has_the_expectation_of_camera_paths(case: SceneCase):
    scene = Case(case.scene(), case.keys)
    ours, reference = (
        scene.gradients(integrator("reslrb", **options_of(case, paths)), seeds(16, at), case.spp)
        for at, paths in enumerate(("both", "camera"))
    )
    assert compare(ours, reference, block=None)


@pytest.mark.long
@pytest.mark.parametrize("estimator", a_few(["gather", "event", "reservoir"], ["gather", "reservoir"]))
def test_every_estimator_handles_weighted_connections(estimator: str):
    case = next(case for case in CASES if case.name == "texture")
    scene = Case(case.scene(), case.keys)
    exact = scene.gradients(integrator("reslrb", **options_of(case, "both")), seeds(16), case.spp)
    own = {**options_of(case, "both"), "estimator": estimator}
    assert compare(scene.gradients(integrator("reslrb", **own), seeds(16, 1), case.spp), exact, block=None)


# --- what a run asks for ----------------------------------------------------------------------------------------------


def peak(depth: int, spp: int, paths: str) -> float:
    """Return the peak memory of a step in MiB, after its kernels are compiled."""
    case = next(case for case in CASES if case.name == "texture")
    options = options_of(case, paths) | {"max_depth": depth, "rr_depth": 1000}
    scene, work = Case(case.scene(), case.keys), integrator("reslrb", **options)
    for _ in range(2):
        reset_peak()
        scene.gradient(work, 3, spp, step=scene.known_step)
        dr.sync_thread()
    return peak_mib(dr.backend_v(mi.Float))


@pytest.mark.parametrize("paths", a_few(["camera", "both"], ["both"]))
def test_memory_is_flat_in_depth(paths: str):
    light = peak(4, 16, "light")
    film = 32 * 32 * 4 * 4 / 2**20
    for depth, spp in ((4, 16), (64, 16), (4, 64)):
        assert peak(depth, spp, paths) <= max(1.03 * light, light + film), (depth, spp)


def test_a_share_of_0_or_1_compiles_only_one_side():
    for share, paths in ((0.0, "camera"), (1.0, "light")):
        made = make_integrator("reslrb", estimator="stack", paths="both", light_share=share)
        assert made.paths == paths


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"paths": "camera", "estimator": "gather"}, "needs the connections of light paths"),
        ({"paths": "both", "light_share": 1.5}, "must lie in"),
        ({"paths": "sideways"}, "must be one of auto, light, camera, both"),
    ],
)
def test_impossible_options(options: dict[str, Any], words: str):
    with pytest.raises(ValueError, match=words):
        make_integrator("reslrb", **options)


def test_sensors_that_light_paths_cannot_connect_to():
    """`camera` renders with these sensors. `both` is refused, with the advice to use `camera`."""
    sensor = {"type": "orthographic", "to_world": transform().look_at([0, 1, 4], [0, 0.7, 0], [0, 1, 0]),
              "film": {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}}}  # fmt: skip
    scene = stage(None, mi.load_dict(sensor) if not isinstance(sensor, dict) else sensor)
    ours = images(scene, "reslrb", range(8), 64, max_depth=4, estimator="stack", paths="camera")
    theirs = images(scene, "path", range(50, 58), 64, max_depth=4)
    assert compare(ours[..., :3], theirs[..., :3])
    with pytest.raises(UnsupportedScene, match=r"use integrator.paths: camera"):
        images(scene, "reslrb", range(1), 4, max_depth=4, estimator="stack", paths="both")


def test_lamps_whose_rays_mitsuba_cannot_sample(combined: None):
    """`camera` renders their light. `both` is refused, with the advice to use `camera`."""
    checks = {"type": "checkerboard", "color0": rgb(1, 0.8, 0.6), "color1": rgb(0.3, 0.3, 0.3)}
    scene = stage({"lamp": lamp() | {"emitter": {"type": "area", "radiance": checks}}}, looks())
    ours = images(scene, "reslrb", range(8), 64, max_depth=3, estimator="stack", paths="camera")
    assert compare(ours, images(scene, "path", range(50, 58), 64, max_depth=3))
    with pytest.raises(UnsupportedScene, match=r"cannot sample the rays of emitter .*use integrator.paths: camera"):
        images(scene, "reslrb", range(1), 4, max_depth=3, estimator="stack", paths="both")


def test_moving_light_uses_light_paths_in_its_image_too():
    case = next(case for case in CASES if case.name == "gaussian")
    scene = Case(case.scene(), case.keys)
    work = interface_of(integrator("reslrb", estimator="stack", paths="both", attached=True, **case.options))
    job = Job(scene.scene, scene.scene.sensors()[0], mi.UInt32(3), 4, scene.params)
    leaves = scene.leaves()
    assert work.plan(scene.scene, job.sensor, scene.params).paths == "light"
    assert work.preparation.plan(scene.scene, job.sensor, scene.params, image=True).paths == "light"
    assert work.plan(scene.scene, job.sensor).paths == "both"  # an image has no moving parameters
    scene.release(leaves)
