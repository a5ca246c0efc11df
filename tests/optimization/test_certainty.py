"""Certainty of a run's values. The tests cover verdicts on runs with known true values, views, and runs without a
measurement.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from kit import diffuse, scene, sensor, shape
from optimization import glass
from optimization.judged import (
    ALPHA,
    CONFIG,
    HIDDEN,
    LEFT,
    OTHER_TWIN,
    POSTER,
    RIGHT,
    TWIN,
    WALL,
    Outcome,
    Toy,
    lamp,
    run,
    write_scene,
)
from optimization.judged import SCENE as LIGHTS
from optimization.toy import make_problem

from reslrb_cli.config.loader import load
from reslrb_cli.optimization import targets
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.state import standing
from reslrb_cli.optimization.uncertainty import measuring
from reslrb_cli.optimization.uncertainty.curvature import LossCurvature, ParameterDirection, plan_changes
from reslrb_cli.optimization.uncertainty.measuring import LEAST_ITERATIONS, Certainty
from reslrb_cli.optimization.uncertainty.verdicts import weigh
from reslrb_cli.statistics import rms

# Verdicts about runs with known truth, of which half are made to fail. Verdicts are right, and none is too favourable.

SETTLED, MOVING, BOUND = "settled", "still moving", "at its bound"
NOISE, UNDETERMINED, NONE = "below the noise", "not determined", "no effect"
FAST = "initial: 1.0, bounds: [0, 1000], learning_rate: 0.15"
SLOW = "initial: 1.0, bounds: [0, 1000], learning_rate: 0.02"
COLOR, METAL = "initial: 0.5, bounds: [0, 1]", "initial: 0.5, bounds: [0.02, 1]"

WORK = [
    Toy("a lamp", {LEFT: FAST}, {LEFT: SETTLED}, ("run.spp=256", "run.iterations=150")),
    Toy("two lamps", {LEFT: FAST, RIGHT: FAST}, {LEFT: SETTLED, RIGHT: SETTLED},
        ("run.spp=512", "run.iterations=200", "optimizer.schedule=cosine")),
    Toy("a colour", {WALL: COLOR}, {WALL: SETTLED}, ("run.spp=256", "optimizer.schedule=cosine")),
    Toy("a texture", {POSTER: COLOR}, {POSTER: SETTLED}, ("run.spp=256", "run.iterations=150")),
    Toy("a roughness", {ALPHA: METAL}, {ALPHA: SETTLED}, ("run.spp=256", "optimizer.schedule=cosine")),
    Toy("no momentum, cosine", {WALL: COLOR}, {WALL: SETTLED},
        ("run.spp=64", "optimizer={beta_1: 0, beta_2: 0.99, learning_rate: 0.01, schedule: cosine}")),
    Toy("in its logarithm", {LEFT: "initial: 1.0, transform: log, bounds: [0.01, 1000], learning_rate: 0.05"},
        {LEFT: SETTLED}, ("run.spp=256", "run.iterations=150", "optimizer.schedule=cosine")),
    Toy("relative loss", {LEFT: FAST}, {LEFT: SETTLED}, ("run.spp=128", "loss={type: relative_l2}")),
    Toy("colour and roughness", {WALL: COLOR, ALPHA: METAL}, {WALL: SETTLED, ALPHA: SETTLED},
        ("run.spp=256", "optimizer.schedule=cosine")),
]  # fmt: skip
FAIL = [
    Toy("a lamp, too slow", {LEFT: SLOW}, {LEFT: MOVING}, ("run.iterations=40", "run.spp=64")),
    Toy("a roughness, too slow", {ALPHA: "initial: 0.6, bounds: [0.02, 1], learning_rate: 0.003"}, {ALPHA: MOVING},
        ("run.iterations=30", "run.spp=64")),
    Toy("a texture, too slow", {POSTER: "initial: 0.95, bounds: [0, 1], learning_rate: 0.001"}, {POSTER: MOVING},
        ("run.iterations=30", "run.spp=256")),
    Toy("a colour's bound", {WALL: "initial: 0.2, bounds: [0, 0.3]"}, {WALL: BOUND}, ("run.spp=64",)),
    Toy("a roughness's bound", {ALPHA: "initial: 0.6, bounds: [0.4, 1]"}, {ALPHA: BOUND}, ("run.spp=64",)),
    Toy("a lamp that lights nothing", {HIDDEN: FAST, LEFT: FAST}, {HIDDEN: NONE}, ("run.spp=64",)),
    Toy("alike", {TWIN: "initial: 2.0, bounds: [0, 1000], learning_rate: 0.05",
                  OTHER_TWIN: "initial: 5.0, bounds: [0, 1000], learning_rate: 0.05"},
        {TWIN: UNDETERMINED, OTHER_TWIN: UNDETERMINED}, ("run.spp=128", "run.iterations=50")),
    Toy("alike, too bright", {TWIN: "initial: 8.0, bounds: [0, 1000], learning_rate: 0.1",
                              OTHER_TWIN: "initial: 3.0, bounds: [0, 1000], learning_rate: 0.1"},
        {TWIN: UNDETERMINED, OTHER_TWIN: UNDETERMINED}, ("run.spp=256",)),
    Toy("a lamp's noise", {TWIN: FAST}, {TWIN: NOISE}, ("run.spp=1", "run.adjoint=independent")),
    Toy("a texture's noise", {POSTER: COLOR}, {POSTER: NOISE}, ("run.spp=4",)),
]  # fmt: skip
#: Runs among the long ones that every change is tested with.
SHORT = [FAIL[6]]


@pytest.fixture(scope="module")
def folder(llvm, tmp_path_factory):
    path = tmp_path_factory.mktemp("judged")
    write_scene(path)
    return path


def told(toy: Toy, found: Outcome) -> str:
    lines = [toy.name]
    for key, about in found.certainty.parameters.items():
        error = np.sqrt(np.mean(np.square(found.errors[key])))
        lines.append(f"    {key}: {about.verdict} {about.shares}, error {error:.3g}, spread {about.spread}")
    return "\n".join(lines)


def verdicts(toy: Toy, found: Outcome) -> dict[str, str]:
    return {key: found.certainty.parameters[key].verdict for key in toy.right}


@pytest.mark.parametrize("toy", SHORT, ids=lambda toy: toy.name)
def test_failures_are_reported_with_their_cause(folder, toy):
    found = run(folder, toy)
    assert verdicts(toy, found) == toy.right, told(toy, found)
    if toy is FAIL[6]:
        assert found.certainty.parameters[TWIN].partner == OTHER_TWIN
        assert found.certainty.parameters[OTHER_TWIN].partner == TWIN


def test_a_value_at_its_bound_without_a_gradient_is_at_its_bound(folder, monkeypatch):
    """A roughness reaches its bound, where the lobe is so narrow that no sample differs from 0."""
    monkeypatch.setattr(measuring, "sample_gradient", lambda *given: None)
    options = "initial: 0.6, bounds: [0.4, 1], learning_rate: 0.05"
    toy = Toy("without a gradient", {ALPHA: options, HIDDEN: COLOR}, {ALPHA: BOUND, HIDDEN: NONE},
              ("run.iterations=24", "run.spp=8", "target.render.spp=64"))  # fmt: skip
    found = run(folder, toy)
    assert verdicts(toy, found) == toy.right, told(toy, found)


@pytest.mark.long
def test_a_lamp_that_moves_through_a_wall_has_lost_its_effect(folder):
    """The target has the lamp nearer to the wall. The first step moves the lamp behind the wall."""
    motion = "motion: {of: left, free: [z]}, initial: -2.4, learning_rate: 2"
    toy = Toy("through the wall", {"left.z": motion}, {"left.z": "effect lost"},
              ("scene.file=smooth.xml", "run.iterations=20", "run.spp=8", "integrator.edges=off",
               "target.render={spp: 64, parameters: {left.z: -2.7}}"))  # fmt: skip
    (folder / "smooth.xml").write_text(LIGHTS.replace('rfilter type="box"', 'rfilter type="tent"'))
    found = run(folder, toy)
    assert verdicts(toy, found) == toy.right, told(toy, found)
    assert found.final["left.z"] < -3.5  # the wall is 3.5 away


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
def test_verdicts_of_twenty_runs(folder, seed):
    right, kind, ratios = [], [], []
    for toy in WORK + FAIL:
        found = run(folder, toy, seed)
        print(told(toy, found))
        right.append(verdicts(toy, found) == toy.right)
        if toy in FAIL:
            kind += [(toy.name, key) for key, verdict in verdicts(toy, found).items() if verdict == SETTLED]
            continue
        for key, about in found.certainty.parameters.items():
            if about.verdict == SETTLED:
                errors = found.errors[key].ravel()
                ratios += list(errors / np.resize(np.array(about.spread, dtype=float), errors.shape))
    wrong = [toy.name for toy, holds in zip(WORK + FAIL, right, strict=True) if not holds]
    print(f"{sum(right)} of {len(right)} right; wrong: {wrong}; errors over spreads, rms {np.std(ratios):.2f}")
    assert not kind
    assert sum(right) >= 18, wrong
    assert np.sqrt(np.mean(np.square(ratios))) < 1.5  # a spread that is too small would be worse than none


#: A texture that its regularizer keeps far from the result of the images alone.
EVEN = f"{COLOR}, regularizers: [{{type: total_variation, epsilon: 10, weight: 0.06}}]"
HELD = Toy("a texture that is held even", {POSTER: EVEN}, {POSTER: SETTLED}, ("run.spp=80", "run.iterations=60",
                               "target.render.spp=512",
                               "optimizer={type: adam, learning_rate: 0.02, schedule: cosine}"))  # fmt: skip


def test_regularizers_are_part_of_gradients_and_curvature(folder, monkeypatch):
    """The images alone would move the texture."""
    sampled, images, gradients = measuring.sample_gradient, [], []

    def of_images(problem, *rest):
        sampled(problem, *rest)
        images.append(np.array(problem.optimizer.gradient(POSTER), dtype=np.float64).ravel())

    weigh = measuring.weigh
    monkeypatch.setattr(measuring, "sample_gradient", of_images)
    monkeypatch.setattr(
        measuring,
        "weigh",
        lambda measured, *rest: (gradients.append(measured[POSTER].gradients), weigh(measured, *rest))[1],
    )
    held = run(folder, HELD)
    assert verdicts(HELD, held) == HELD.right
    assert np.abs(held.errors[POSTER]).max() > 0.1
    seen = np.mean(images, axis=0)
    added = gradients[0].mean(axis=0) - seen
    assert rms(added) > 0
    assert added @ seen < -0.7 * np.linalg.norm(added) * np.linalg.norm(seen)  # both gradients oppose each other


@pytest.mark.parametrize(("side", "spp"), [(2, 128), (3, 512)])
def test_each_entry_of_a_tiny_texture_has_its_own_direction(folder, side, spp, monkeypatch):
    """A texture of few texels has no groups of entries. It is settled if each of its texels is."""
    texture = np.random.default_rng(side).uniform(0.3, 0.8, (side, side, 3)).astype(np.float32)
    mi.Bitmap(texture).write(str(folder / f"tiny{side}.exr"))
    (folder / f"tiny{side}.xml").write_text(LIGHTS.replace("poster.exr", f"tiny{side}.exr"))
    toy = Toy("tiny", {POSTER: COLOR}, {POSTER: SETTLED},
              (f"scene.file=tiny{side}.xml", "run.iterations=40", f"run.spp={spp}",
               "optimizer={type: auto}"))  # fmt: skip
    given = []
    monkeypatch.setattr(measuring, "weigh", lambda *parts: (given.append(parts), weigh(*parts))[1])
    found = run(folder, toy)
    assert verdicts(toy, found) == toy.right, told(toy, found)
    ((measured, directions, *_),) = given
    assert [each.entry for each in directions] == list(range(3 * side**2))
    about = found.certainty.parameters[POSTER]
    error = rms(found.errors[POSTER])
    assert 0.3 * about.spread[0] < error < 1.3 * about.spread[0]
    assert measured[POSTER].is_small


def test_the_scale_of_a_heightmap_is_the_size_of_its_values(llvm, tmp_path):
    """Its bounds are far larger, and a step of a share of them would fold the caustic."""
    motions = "{motion: {of: slab, free: [x]}}, {motion: {of: lamp, free: [x]}}"
    heightmap = "parameters=[{heightmap: {mesh: slab, resolution: [3, 3]}, initial: %s}]"
    for initial, scale in ((0.01, 0.01), (0.0, 1.0)):
        certainty = Certainty(glass.assemble(tmp_path, heightmap % initial))
        assert certainty.scale("slab.heightmap") == pytest.approx(scale)
    problem = glass.assemble(tmp_path, f"parameters=[{motions}]")
    assert Certainty(problem).scale("slab.x") == pytest.approx(0.5 * problem.optimizer.extent("slab.x"))


def test_a_parameter_that_was_measured_in_part_has_no_directions(llvm):
    """Time may end between two entries. The other parameters stay."""
    places = [ParameterDirection("a", np.eye(3)[k], None, k) for k in range(3)]
    places += [ParameterDirection("t", np.ones(9), 0), ParameterDirection("b", np.eye(2)[0], None, 0)]
    sizes = {"a": 3, "t": 9, "b": 2}
    measured = {key: SimpleNamespace(value=np.zeros(size)) for key, size in sizes.items()}
    assert measuring._complete(places, measured) == [0, 1, 2, 3]
    assert measuring._complete([places[1], places[3]], measured) == [1]


@pytest.mark.long
def test_noisy_curvature_is_measured_again_with_more_samples(folder, monkeypatch):
    """If the first measurement finds no curvature of a colour, or noise takes most of it, one with more samples finds
    it.
    """
    asked, along, limits = [], measuring.LossCurvature.along, dict[str, int]()

    def hidden(self, changes, go_on):
        asked.append(self.spp)
        directions, H, B = along(self, changes, go_on)
        self.sure = self.sure * (self.spp > limits["noisy"])
        return directions, H * (self.spp > limits["blind"]), B

    monkeypatch.setattr(measuring.LossCurvature, "along", hidden)
    monkeypatch.setattr(measuring, "MOST_MULTIPLE", 4)
    toy = replace(WORK[2], settings=("run.spp=256", "run.iterations=60", "optimizer.schedule=cosine"))
    found = []
    for limits["blind"], limits["noisy"], wanted in (
        (0, 0, [64]), (64, 0, [64, 256]), (0, 64, [64, 256]), (256, 0, [64, 256, 1024]), (1024, 0, [64, 256, 1024])
    ):  # fmt: skip
        asked.clear()
        found.append(run(folder, toy).certainty.parameters[WALL].verdict)
        assert asked == wanted
    assert found == [SETTLED] * 4 + [NOISE]


#: Parameters, and the target's samples per pixel. Noise in the target causes most of the error of these parameters.
NOISY = {
    "a colour": ({WALL: COLOR}, 64), "a roughness": ({ALPHA: METAL}, 64), "a lamp": ({LEFT: FAST}, 64),
    "colour and roughness": ({WALL: COLOR, ALPHA: METAL}, 64), "a texture": ({POSTER: COLOR}, 64),
    "a colour, few samples": ({WALL: COLOR}, 16), "a texture, many samples": ({POSTER: COLOR}, 512),
}  # fmt: skip


def noisy(name: str, loss: str) -> Toy:
    parameters, spp = NOISY[name]
    settings = (f"target={{render: {{spp: {spp}}}}}", f"loss={{type: {loss}}}", "run.spp=64",
                "run.iterations=120", "optimizer.schedule=cosine")  # fmt: skip
    return Toy(name, parameters, {}, settings)


@pytest.mark.long
def test_noise_of_a_rendered_target_is_part_of_the_spread(folder):
    """With 16 times as many target samples, the target's part of the spread falls to about a quarter."""
    found = {}
    for spp in (16, 256):
        toy = noisy("a colour", "l2")
        settings = (*toy.settings, "run.iterations=60", f"target.render.spp={spp}")
        about = run(folder, Toy("", toy.parameters, {}, settings)).certainty
        assert (about.target_noise, about.target_spp) == ("measured", spp)
        found[spp] = about.parameters[WALL]
    of_target = {spp: np.mean(about.of_target) for spp, about in found.items()}
    assert 2 < of_target[16] / of_target[256] < 8
    assert np.all(np.array(found[16].spread) > 0.9 * np.array(found[16].of_target))
    assert found[16].verdict == NOISE
    assert of_target[16] > 0.03


@pytest.mark.long
@pytest.mark.parametrize("loss", ["l2", "relative_l2"])
@pytest.mark.parametrize("name", NOISY)
def test_the_truth_is_within_spreads_with_the_noise_of_the_target(folder, name, loss, monkeypatch):
    """Over many noisy targets, errors are about as large as the spreads. Most of the error comes from the target's
    noise.
    """
    z, without, settled = [], [], 0
    for seed in range(12):
        monkeypatch.setattr(targets, "TARGET_SEED", seed)
        found = run(folder, noisy(name, loss), seed)
        for key, about in found.certainty.parameters.items():
            if about.spread is None:
                continue
            errors = np.ravel(found.errors[key])
            spread, of_target = (np.resize(np.array(part, dtype=float), errors.shape)
                                 for part in (about.spread, about.of_target))  # fmt: skip
            z += list(errors / spread)
            without += list(errors / np.sqrt(np.maximum(spread**2 - of_target**2, 1e-4 * spread**2)))
            settled += about.verdict == SETTLED and bool(np.sqrt(np.mean(np.square(errors / spread))) > 3)
    size, bare = (np.sqrt(np.nanmean(np.square(each))) for each in (z, without))
    print(f"{name}, {loss}: {len(z)} errors over spreads, rms {size:.2f}; without the target's noise {bare:.2f}")
    # A relative loss gives more weight to pixels that noise has darkened. The loss pulls parameters further than their
    # spread says.
    assert 0.3 < size < (1.5 if loss == "l2" else 2.5)
    assert bare > 1.5
    assert not settled


# Noise of the images biases gradients of losses that are not quadratic in the image.


def write_target(folder, spp: int = 16384) -> None:
    """Write the image of the scene with few errors as `target.exr`."""
    problem = assemble(load(folder / "toy.yaml", [f"target.render.spp={spp}"]))
    mi.Bitmap(np.array(problem.views[0].target)).write(str(folder / "target.exr"))


def with_a_file(loss: str, spp: int, iterations: int = 150) -> Toy:
    settings = ("target={file: target.exr}", f"loss={{type: {loss}}}", f"run.spp={spp}",
                f"run.iterations={iterations}",
                "optimizer={type: adam, learning_rate: 0.05, schedule: cosine}")  # fmt: skip
    return Toy(f"{loss}, {spp} spp", {WALL: COLOR}, {}, settings)


def test_images_along_all_directions_share_a_recording(folder):
    """A recording depends on which parameters of the scene have derivatives."""
    keys = (WALL, LEFT, RIGHT)
    parameters = ", ".join(f"{{key: {key}, initial: [0.4, 0.5, 0.6], bounds: [0, 20]}}" for key in keys)
    problem = assemble(load(folder / "toy.yaml", [f"parameters=[{parameters}]", "run.spp=4"]))
    problem.apply()
    changes = plan_changes(problem, dict.fromkeys(keys, 0.5), 0.05)
    directions, *_ = LossCurvature(problem, 4).along(changes, lambda: True)
    assert len(directions) == 9
    assert problem.integrator.preparation.recordings.counts()["image"] <= 2


@pytest.mark.parametrize(("loss", "is_biased"), [("l1", True), ("l2", False), ("relative_l2", False)])
def test_only_losses_that_noise_biases_have_a_bias(loss, is_biased, folder):
    """The bias enters B along directions and by entry."""
    write_target(folder, 1024)
    settings = [*with_a_file(loss, 64).settings, "parameters=[{key: wall.reflectance.value, bounds: [0, 1]}]"]
    problem = assemble(load(folder / "toy.yaml", settings))
    problem.apply()
    curvature = LossCurvature(problem, 64)
    _, H, B = curvature.along(plan_changes(problem, {WALL: 0.5}, 0.05), lambda: True)
    by_entry = curvature.by_entry(1, lambda: True)[WALL].of_target
    assert bool(curvature.biases) is is_biased
    if is_biased:
        offsets = np.sqrt(np.diag(B)) / np.diag(H)
        assert np.all((offsets > 0.01) & (offsets < 0.6)), offsets
        assert by_entry.shape == (3,)
        assert 0.05 * B.trace() < by_entry.sum() < 5 * B.trace()
    else:
        assert not B.any()
        assert by_entry is None
    assert not LossCurvature(problem, 64, of_target=False).biases


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("loss", "spp"), [("l1", 64), ("l1", 256), ("l1", 1024), ("ssim", 1024), ("l2", 64)])
def test_values_that_noise_biases_are_not_settled(loss, spp, seed, folder):
    """With `l1` and 64 samples, colours end 6 to 16 % off, and 12 gradients agree that they are right."""
    write_target(folder)
    problem = assemble(load(folder / "toy.yaml"))
    found = run(folder, with_a_file(loss, spp), seed, problem.truth)
    about, errors = found.certainty.parameters[WALL], np.abs(found.errors[WALL].ravel())
    print(loss, spp, about.verdict, errors, about.spread)
    assert found.certainty.is_biased is (loss != "l2")
    assert np.all(errors < 3 * np.array(about.spread))
    if loss == "l1" and spp == 64:
        assert about.verdict == NOISE
    if about.verdict == SETTLED:
        assert np.all(errors < 0.1 * found.final[WALL].ravel())


# Five lamps and four roughnesses at once: all wrong values are reported.

LAMPS = {
    "a": (-2.4, "9, 6, 4"),
    "b": (-1.2, "3, 5, 8"),
    "c": (0.1, "4, 4, 4"),
    "d": (1.2, "6, 2, 5"),
    "e": (2.6, "2, 7, 3"),
}
PLATES = {"p": (-0.9, -0.8, 0.1), "q": (0.9, -0.8, 0.2), "r": (-0.9, 0.8, 0.35), "s": (0.9, 0.8, 0.5)}
SCENE = scene(
    sensor("0, -0.5, 4", size=24, fov=42),
    shape("rectangle", "back", diffuse("0.6, 0.4, 0.25"), place='<scale value="3"/><translate z="-0.5"/>'),
    "BODY",
)
#: Largest error of a value with the verdict settled: in standard deviations of its spread, and as a share of the value.
SPREADS, SHARE = 3.0, 0.15


def plate(name: str, x: float, y: float, alpha: float) -> str:
    return f"""<shape type="rectangle" id="{name}">
        <transform name="to_world"><scale value="0.55"/><translate x="{x}" y="{y}"/></transform>
        <bsdf type="roughconductor"><float name="alpha" value="{alpha}"/></bsdf>
    </shape>"""


@pytest.mark.long
@pytest.mark.parametrize("spp", [4, 64])
def test_wrong_values_are_reported(llvm, tmp_path, spp):
    shapes = [lamp(name, x, radiance, 0.4) for name, (x, radiance) in LAMPS.items()]
    shapes += [plate(name, *place) for name, place in PLATES.items()]
    (tmp_path / "scene.xml").write_text(SCENE.replace("BODY", "\n".join(shapes)))
    (tmp_path / "toy.yaml").write_text(CONFIG.replace("wall.reflectance.value", "p.bsdf.alpha.value"))
    radiance = {
        f"{name}.emitter.radiance.value": "initial: 1.0, bounds: [0, 1000], learning_rate: 0.1" for name in LAMPS
    }
    alphas = {f"{name}.bsdf.alpha.value": "initial: 0.6, bounds: [0.02, 1]" for name in PLATES}
    found = run(tmp_path, Toy("many", radiance | alphas, {}, (f"run.spp={spp}",)))
    kind, wrong = [], 0
    for key, about in found.certainty.parameters.items():
        relative = np.abs(found.errors[key]).max() / np.abs(found.true[key]).max()
        off = relative > SHARE
        wrong += off
        spread = "" if about.spread is None else np.array2string(np.array(about.spread, dtype=float), precision=3)
        print(f"{key}: {about.verdict}, off by {100 * relative:.0f} %, spread {spread}, {about.partner or ''}")
        if about.verdict == "settled" and off:
            far = np.abs(found.errors[key]).ravel() > SPREADS * np.array(about.spread, dtype=float)
            kind += [key] if far.any() else []
    print(
        f"{wrong} of {len(found.certainty.parameters)} wrong; measured in {found.certainty.share:.3f} of the run's time"
    )
    assert wrong >= 3  # else the test shows nothing
    assert not kind


# How certain values are with an exposure and under a mask. The loss of the masked information is detected and named.

EXPOSURE = "exposure"
COLOR_OF_BACK = {WALL: "initial: 0.5, bounds: [0, 1]"}
SETTINGS = ("run.spp=64", "target.exposure=auto")
#: Settings that separate exposure and colour by the small known part in view.
ENOUGH = ("run.spp=512", "run.iterations=200", "optimizer.schedule=cosine", "target.exposure=auto")
SUBPIXELS = 4


def write_mask(folder: Path) -> None:
    """Write a mask without the pixels that see anything but the wall."""
    scene = mi.load_file(str(folder / "scene.xml"), optimize=False)
    sensor, (width, height) = scene.sensors()[0], scene.sensors()[0].film().size()
    x, y = np.meshgrid(*(np.arange(SUBPIXELS * size) + 0.5 for size in (width, height)))
    position = mi.Point2f(x.ravel() / (SUBPIXELS * width), y.ravel() / (SUBPIXELS * height))
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    back = next(shape for shape in scene.shapes() if shape.id() == "back")
    hit = np.array(scene.ray_intersect(ray).shape == mi.ShapePtr(back)).reshape(height, SUBPIXELS, width, SUBPIXELS)
    weights = hit.all(axis=(1, 3)).astype(np.float32)
    assert 20 < weights.sum() < 0.9 * weights.size
    mi.Bitmap(weights[:, :, None]).write(str(folder / "mask.exr"))


@pytest.fixture(scope="module")
def folder_of_views(llvm: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("views")
    write_scene(path)
    write_mask(path)
    return path


@pytest.mark.long
def test_a_known_visible_poster_separates_exposure_from_colour(folder_of_views: Path) -> None:
    found = run(folder_of_views, Toy("seen", COLOR_OF_BACK, {}, ENOUGH))
    verdicts = {key: about.verdict for key, about in found.certainty.parameters.items()}
    assert verdicts == {WALL: "settled", EXPOSURE: "settled"}, found.certainty
    for key, about in found.certainty.parameters.items():
        spread = np.array(about.spread, dtype=float)
        assert np.all(np.abs(np.ravel(found.errors[key])) < 4 * spread), key


@pytest.mark.long
def test_with_a_mask_colour_and_exposure_compensate_for_each_other(folder_of_views: Path) -> None:
    found = run(folder_of_views, Toy("masked", COLOR_OF_BACK, {}, (*SETTINGS, "target.mask=mask.exr")))
    wall, exposure = (found.certainty.parameters[key] for key in (WALL, EXPOSURE))
    assert wall.verdict == exposure.verdict == "not determined", found.certainty
    assert (wall.partner, exposure.partner) == (EXPOSURE, WALL)


# Certainty is not measured in short runs and in runs that are told to stop.


def test_short_and_stopped_runs_have_no_verdicts(tmp_path, monkeypatch):
    problem, asked = make_problem(tmp_path), []

    def sample(problem, integrator, number, purpose, spp):
        asked.append(number)

    monkeypatch.setattr(measuring, "sample_gradient", sample)
    certainty, before = Certainty(problem), problem.values()["albedo"].copy()
    assert certainty.measure(LEAST_ITERATIONS - 1, 1.0, lambda: False) is None
    assert certainty.measure(100, 1.0, lambda: True) is None
    assert asked == []
    assert certainty.measure(100, 1.0, lambda: len(asked) == 2) is None  # Ctrl-C during the measurement
    assert asked == [0, 1]
    np.testing.assert_array_equal(problem.values()["albedo"], before)


def test_gradients_of_blurred_images_do_not_count(tmp_path):
    problem = make_problem(tmp_path)
    before = standing(problem)
    state, certainty = replace(before, gradients=before.values), Certainty(problem)
    for blur, count in ((1.0, 0), (0.0, 1)):
        for view in problem.trained:
            view.blur = blur
        certainty.see(before, state)
        assert [len(rows) for rows in certainty.last.values()] == [1] * count


def test_a_failure_leaves_no_gradient(tmp_path, monkeypatch):
    import drjit as dr

    problem = make_problem(tmp_path)

    def fail(problem, *others):
        dr.set_grad(problem.optimizer["albedo"], 1.0)
        raise RuntimeError("no more memory")

    monkeypatch.setattr(measuring, "sample_gradient", fail)
    with pytest.raises(RuntimeError, match="no more memory"):
        Certainty(problem).measure(100, 1.0, lambda: False)
    assert not np.any(np.array(problem.optimizer.gradient("albedo")))
