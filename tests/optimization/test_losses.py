"""Losses, exposures and masks, with tests of values, gradients and the weights of pixels."""

from __future__ import annotations

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from agreement import compare
from cli.tiny import KEY, SCENE, write_experiment
from optimization.toy import make_problem
from scipy.ndimage import gaussian_filter
from skimage.metrics import structural_similarity
from turns import taking_turns

from reslrb_cli.config.loader import dump, load, loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.identifiability import check_exposures, find_ambiguous
from reslrb_cli.optimization.loop import optimize, set_blur, step
from reslrb_cli.optimization.losses import LOSSES, blur, weighted
from reslrb_cli.optimization.sensitivity import sample_gradient, see_images, take_gradient
from reslrb_cli.optimization.shards import make_tasks
from reslrb_cli.optimization.state import standing
from reslrb_cli.optimization.views import View, make_loss, make_views, slope, view_records

# Losses: values and gradients, compared with NumPy.

EPSILON = 0.02
REFERENCES = {
    "l1": (lambda i, t: np.abs(i - t), lambda i, t: np.sign(i - t)),
    "l2": (lambda i, t: (i - t) ** 2, lambda i, t: 2 * (i - t)),
    "relative_l2": (lambda i, t: (i - t) ** 2 / (t**2 + EPSILON), lambda i, t: 2 * (i - t) / (t**2 + EPSILON)),
}
#: Losses that treat each pixel by itself.
POINTWISE = tuple(REFERENCES)


def images(shape=(5, 7, 3)):
    rng = np.random.default_rng(1)
    return rng.uniform(0, 2, shape), rng.uniform(0, 2, shape)


def options(name):
    return {"epsilon": EPSILON} if name == "relative_l2" else {}


def test_every_loss_has_a_reference():
    assert set(LOSSES) == {*REFERENCES, "ssim"}


@pytest.mark.parametrize("name", POINTWISE)
def test_values_and_gradients(name):
    image, target = images()
    value, derivative = (function(image, target) for function in REFERENCES[name])
    attached = mi.TensorXf(image.astype(np.float32))
    dr.enable_grad(attached)
    loss = make_loss(name, **options(name))(attached, mi.TensorXf(target.astype(np.float32)))
    assert np.array(loss).size == 1
    assert float(np.array(loss).item()) == pytest.approx(value.mean(), rel=1e-5)
    dr.backward(loss)
    np.testing.assert_allclose(np.array(attached.grad), derivative / image.size, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("noise", [0.05, 0.1])
def test_noise_of_the_target_darkens_the_minimum_of_relative_l2(noise):
    """The minimum is at t (1 - 2 v / (t² + epsilon)) for targets of mean t and variance v (docs/losses.md)."""
    t, deviation = 0.7, np.random.default_rng(4).standard_normal((64, 64, 3))
    target = t * (1 + noise * np.concatenate([deviation, -deviation]))
    slopes = []
    for level in (t, 0.9 * t):
        image = dr.full(mi.TensorXf, level, target.shape)
        dr.enable_grad(image)
        dr.backward(make_loss("relative_l2", epsilon=EPSILON)(image, mi.TensorXf(target.astype(np.float32))))
        slopes.append(np.array(image.grad, dtype=np.float64).sum())
    darker = 0.1 * slopes[0] / (slopes[0] - slopes[1])  # the slope is linear in the image
    assert darker == pytest.approx(2 * (t * noise) ** 2 / (t**2 + EPSILON), rel=0.1)


@pytest.mark.parametrize("name", POINTWISE)
def test_black_and_negative_pixels_stay_finite(name):
    image = mi.TensorXf(np.array([[[0.0], [-0.3], [2.0]]], dtype=np.float32))
    dr.enable_grad(image)
    loss = make_loss(name)(image, mi.TensorXf(np.zeros((1, 3, 1), dtype=np.float32)))
    dr.backward(loss)
    assert np.isfinite(np.array(loss)).all()
    assert np.isfinite(np.array(image.grad)).all()


@pytest.mark.parametrize("name", POINTWISE)
def test_a_nan_is_not_hidden(name):
    image = mi.TensorXf(np.array([[[np.nan], [1.0]]], dtype=np.float32))
    assert np.isnan(np.array(make_loss(name)(image, mi.TensorXf(np.ones((1, 2, 1), dtype=np.float32)))))


# Blurred images (`run.blur`).


def blurred(image, sigma):
    return gaussian_filter(image, (sigma, sigma, 0), mode="reflect", truncate=8)


@pytest.mark.parametrize("sigma", [1.0, 3.0])
def test_a_blur_is_a_reflected_gaussian(sigma):
    image = images((23, 18, 3))[0]
    found = np.array(blur(mi.TensorXf(image.astype(np.float32)), sigma))
    # A cosine series has no frequencies beyond the pixels' own, which are 1 % of a Gaussian of one pixel.
    np.testing.assert_allclose(found, blurred(image, sigma), atol=1e-2 if sigma == 1 else 1e-5)
    assert found.sum() == pytest.approx(image.sum(), rel=1e-5)


def blurred_view(image, target, weights=None):
    """Return the loss of an image that a blurred view sees, and its derivative. The view has seen another target."""
    view = View(0, make_loss("l2"), blur=3.0)
    view.see(0.5 * target)
    view.blurred_objective(mi.TensorXf(image.astype(np.float32)))
    view.see(target, weights)
    attached = mi.TensorXf(image.astype(np.float32))
    dr.enable_grad(attached)
    loss = view.compare(attached)
    dr.backward(loss)
    return float(loss[0]), np.array(attached.grad)


@pytest.mark.parametrize("masked", [False, True])
def test_a_blurred_view_has_the_plain_loss_and_the_derivative_of_blurred_images(masked):
    image, target = images((23, 18, 3))
    weights = np.ones((23, 18))
    weights[:4] = 1 - masked
    loss, derivative = blurred_view(image, target, weights.astype(np.float32))
    difference, factor = (image - target) * (weights > 0)[..., None], (weights / weights.mean())[..., None]
    assert loss == pytest.approx((factor * difference**2).mean(), rel=1e-5)
    expected = blurred(factor * blurred(difference, 3.0), 3.0) * (weights > 0)[..., None] * 2 / image.size
    np.testing.assert_allclose(derivative, expected, atol=1e-4 * abs(expected).max())


def test_a_blur_does_not_spread_a_nan():
    image, target = images((23, 18, 3))
    image[11, 9, 1] = np.nan
    loss, derivative = blurred_view(image, target)
    assert np.isnan(loss)
    assert np.isfinite(derivative).all()
    assert (derivative != 0).sum() == derivative.size - 1


def test_with_auto_images_are_blurred_for_few_iterations(tmp_path):
    problem = make_problem(tmp_path, sets=["run.iterations=1000", "run.blur=2", "optimizer={type: auto}"])
    for iteration, blur_now in ((0, 2), (10, 2 - 10 / 39 * 4), (20, 0)):
        set_blur(problem, iteration, 0.0)
        assert [view.blur for view in problem.trained] == pytest.approx([blur_now])


@pytest.mark.parametrize(
    ("settings", "first"),
    [
        (["run.blur=2"], 2),
        ([], 0),
        (["parameters=[{motion: {of: box, free: [translation]}}]"], 2 / 16),  # of a target of 2x2 pixels
    ],
)
def test_the_blur_falls_to_zero_at_half_of_a_run_and_reaches_shards(tmp_path, monkeypatch, settings, first):
    problem, seen = make_problem(tmp_path, sets=["run.iterations=9", *settings]), []
    monkeypatch.setattr(
        "reslrb_cli.optimization.loop.gradient",
        lambda problem, iteration: (
            seen.append([part.blur for task in make_tasks(problem, iteration) for part in task.parts]),
            (mi.Float(1), {"albedo": mi.Float(0)}, {"albedo": mi.UInt32(0)}, [], None),
        )[1],
    )
    state = standing(problem)
    for _ in range(9):
        state, _ = step(problem, state)
    assert np.ravel(seen) == pytest.approx(np.multiply(first, [1, 0.75, 0.5, 0.25, 0, 0, 0, 0, 0]))


# SSIM, and sums of losses.


def textured(shape=(17, 14, 3), seed=5):
    """Return an image with structure and a similar image, both float32."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    base = 0.6 + 0.3 * np.sin(rows / 2)[:, :, None] * np.cos(columns[:, :, None] / 3 + np.arange(shape[2]))
    return (0.8 * base + rng.uniform(0, 0.3, shape)).astype(np.float32), base.astype(np.float32)


@pytest.mark.parametrize(("ground", "rel"), [(0, 2e-4), (200, 1e-3)])
def test_ssim_equals_scikit_image(ground, rel):
    """On a bright ground, squares in single precision have no digits left of the structure."""
    image, target = (ground + each for each in textured())
    expected = structural_similarity(
        image.astype(np.float64), target.astype(np.float64), channel_axis=2, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=float(target.max()),
    )  # fmt: skip
    found = make_loss("ssim")(mi.TensorXf(image), mi.TensorXf(target))
    assert float(found[0]) == pytest.approx(1 - expected, rel=rel)


@pytest.mark.parametrize("level", [1.0, 1000.0])
def test_ssim_of_bright_images_keeps_its_digits(level):
    image, target = (level * each for each in textured())
    found = make_loss("ssim")(mi.TensorXf(image), mi.TensorXf(target))
    same = make_loss("ssim")(*(mi.TensorXf(each / level) for each in (image, target)))
    assert float(found[0]) == pytest.approx(float(same[0]), rel=1e-4)
    assert float(make_loss("ssim")(mi.TensorXf(target), mi.TensorXf(target))[0]) == pytest.approx(0, abs=1e-5)


def differences(loss, image, rng, step):
    """Return a derivative along a random direction, once by Dr.Jit and once by central differences."""
    direction = rng.uniform(-1, 1, image.shape).astype(np.float32)
    attached = mi.TensorXf(image)
    dr.enable_grad(attached)
    dr.backward(loss(attached))
    by_drjit = float(np.sum(np.array(attached.grad, dtype=np.float64) * direction))
    above, below = (float(loss(mi.TensorXf(image + sign * step * direction))[0]) for sign in (1, -1))
    return by_drjit, (above - below) / (2 * step)


LISTS = {
    "ssim": [{"type": "ssim"}],
    "list": [{"type": "l2", "weight": 2}, {"type": "ssim", "weight": 0.1}, {"type": "l1"}],
}


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", LISTS)
def test_gradients_of_new_losses_against_finite_differences(name, masked):
    rng = np.random.default_rng(3)
    image, target = textured((25, 23, 3))
    parts = [(each.get("weight", 1), make_loss(each["type"])) for each in LISTS[name]]
    view = View(0, functools.partial(weighted, parts))
    weights = np.ones(image.shape[:2])
    if masked:
        weights = rng.uniform(0.5, 2, image.shape[:2])
        weights[:4, :9] = weights[12, 12] = 0
    view.see(target, weights)
    image = np.where(
        weights[:, :, None] > 0, target + np.where(image > target, 1, -1) * (0.1 + np.abs(image - target)), 7
    )
    pairs = [differences(view.judge, image.astype(np.float32), rng, 2e-3) for _ in range(3)]
    found, expected = np.transpose(pairs)
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=5e-3 * np.abs(expected).max())


@pytest.mark.parametrize(("name", "biased"), [("l2", False), ("ssim", True)])
def test_gradients_that_image_noise_biases(name, biased):
    """Over noisy images, the mean dL/dI of `l2` is unbiased, and that of `ssim` is biased. `independent` and `batched`
    also take dL/dI from separate samples.
    """
    rng = np.random.default_rng(11)
    image, target = textured((16, 16, 1))
    view = View(0, make_loss(name))
    view.see(target)
    along = slope(view.judge, image)
    at_noise = [slope(view.judge, image + 0.2 * rng.normal(size=image.shape)) for _ in range(200)]
    shares = np.array([np.sum(each * along) for each in at_noise]) / np.sum(along * along)
    z = (shares.mean() - 1) / (shares.std(ddof=1) / np.sqrt(len(shares)))
    assert (abs(z) > 6) if biased else (abs(z) < 3), (z, shares.mean())


def test_pixels_excluded_from_ssim_equal_the_target():
    image, target = textured((24, 24, 1))
    spoilt = image.copy()
    spoilt[3:6, 3:6] = np.nan
    weights = np.ones((24, 24))
    weights[3:6, 3:6] = 0
    view = View(0, make_loss("ssim"))
    view.see(target, weights)
    filled = np.where(weights[:, :, None] > 0, image, target)
    _, full = structural_similarity(
        filled[:, :, 0].astype(np.float64), target[:, :, 0].astype(np.float64), gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=float(target[weights > 0].max()), full=True,
    )  # fmt: skip
    inside = np.zeros((24, 24), bool)
    inside[5:-5, 5:-5] = True
    expected = 1 - full[inside & (weights > 0)].mean()
    assert float(view.judge(mi.TensorXf(spoilt))[0]) == pytest.approx(expected, rel=2e-4)


def read(tmp_path, loss, **more):
    write_experiment(tmp_path)
    sets = [f"{key}={value}" for key, value in more.items()]
    return load(tmp_path / "tiny.yaml", [f"loss={loss}", *sets])


def test_a_list_of_one_equals_the_loss_and_weights_multiply(tmp_path):
    image, target = textured()
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": {
        "type": "hdrfilm", "width": 14, "height": 17}}})  # fmt: skip
    found = []
    for loss in (
        "{type: l1}",
        "[{type: l1}]",
        "[{type: l1, weight: 3}]",
        "[{type: l1}, {type: l2, weight: 0.5}]",
        "{}",
    ):
        [view] = make_views(read(tmp_path, loss), scene)
        view.see(target)
        found.append(float(view.judge(mi.TensorXf(image))[0]))
    assert found[0] == found[1]
    assert found[2] == pytest.approx(3 * found[0], rel=1e-6)
    assert found[3] == pytest.approx(found[0] + 0.5 * found[4], rel=1e-6)


def test_a_single_loss_is_written_unchanged_and_a_list_is_read_back(tmp_path):
    assert read(tmp_path, "{type: l1}").model_dump()["loss"] == {"type": "l1"}
    listed = read(tmp_path, "[{type: l2}, {type: ssim, weight: 0.1}]")
    assert listed.model_dump()["loss"] == [{"type": "l2"}, {"type": "ssim", "weight": 0.1}]
    assert loads(dump(listed), tmp_path / "tiny.yaml") == listed


@pytest.mark.parametrize(
    ("loss", "key", "words"),
    [
        ("{type: l2, weight: 2}", "loss.weight", "needs a list of losses"),
        ("[]", "loss", "at least one entry"),
        ("[{type: l2}, {type: l3}]", "loss[1].type", "l1"),
        ("[{type: l2, weight: 0}]", "loss[0].weight", "above 0"),
        ("[{type: l2, sigma: 1}]", "loss[0].sigma", "unknown key"),
        ("l2", "loss", "must be a mapping"),
    ],
)
def test_invalid_lists(tmp_path, loss, key, words):
    with pytest.raises(ConfigError) as error:
        read(tmp_path, loss)
    assert error.value.key == key
    assert words in error.value.message


def test_ssim_of_a_too_small_image(tmp_path):
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective", "film": {
        "type": "hdrfilm", "width": 21, "height": 10}}})  # fmt: skip
    with pytest.raises(ConfigError, match=r"loss\[1\].type: ssim needs 11x11 pixels, but the image has 21x10"):
        make_views(read(tmp_path, "[{type: l2}, {type: ssim}]"), scene)


# Recovery of exposures: their gradient, and cases where images cannot tell exposures from parameters.

#: Exposures at which gradients are taken.
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


@taking_turns("adjoint", ["batched", "independent", "correlated"], "kind", list(AT))
def test_the_gradient_equals_that_of_the_mean_image(folder, kind, adjoint):
    """dL/dE of `l2` is the sum of 2 (E I - T) I over all entries, divided by their number. I is the mean image.

    If I and dL/dI share samples, the noise of I adds its variance. `correlated` shows this bias.
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
    reference = np.stack([exact, exact])  # with negligible noise
    found = compare(np.array(rows, np.float64)[:, None, None], reference[:, None, None], 1)
    assert found.holds == (adjoint != "correlated"), found


@pytest.mark.parametrize("exposure", ["target.exposure=auto", "views=[{sensor: 0, exposure: auto}]"])
def test_indistinguishable_parameters_are_refused(folder, exposure):
    """Parameters of all light, or of everything that light reaches directly, scale the image as the exposure does."""
    wall = make(folder, exposure, "integrator.max_depth=2")
    with pytest.raises(ConfigError, match=f"cannot distinguish `exposure.*` from `{KEY}`") as error:
        check_exposures(wall)
    assert error.value.key == exposure.replace("=[{sensor: 0, exposure: auto}]", "[0].exposure").replace("=auto", "")
    lamp = make(folder, exposure, f"parameters=[{{key: {LAMP}, initial: 5}}]")
    found = find_ambiguous(lamp)
    assert found is not None
    assert found[1] == [LAMP]
    known = make(folder, "target.exposure=2", f"parameters=[{{key: {LAMP}, initial: 5}}]")
    check_exposures(known)


@pytest.mark.long
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


# Masks: which pixels they leave out, and that these pixels have no effect.

#: Pixels (y, x) of the target with unreliable values, one of each kind.
CLIPPED, CLEAR, BROKEN = (1, 2), (3, 4), (5, 6)
GLASS = """
    <shape type="sphere" id="ball">
        <float name="radius" value="0.4"/> <point name="center" x="0" y="0" z="1"/> <bsdf type="{}"/>
    </shape>
</scene>"""


@pytest.fixture
def masked_folder(tmp_path):
    """Folder with the tiny experiment, and with an 8-bit PNG and an EXR as photographs."""
    write_experiment(tmp_path)
    rng = np.random.default_rng(1)
    pixels = rng.integers(40, 200, (8, 8, 4), dtype=np.uint8)
    pixels[:, :, 3] = 255
    pixels[CLIPPED][1] = 255
    pixels[CLEAR][3] = 0
    mi.Bitmap(pixels).write(str(tmp_path / "photo.png"))
    floats = rng.uniform(0.1, 2, (8, 8, 3)).astype(np.float32)
    floats[BROKEN][2] = np.nan
    mi.Bitmap(floats).write(str(tmp_path / "photo.exr"))
    return tmp_path


def make_masked(folder, *sets):
    said = []
    problem = assemble(load(folder / "tiny.yaml", ["target.render=null", *sets]), said.append)
    return problem, [line for line in said if line.startswith("view ")]


def left_out(problem):
    """Return the pixels (y, x) without weight."""
    [view] = problem.views
    return [] if view.weights is None else [tuple(at) for at in np.argwhere(np.array(view.weights)[:, :, 0] == 0)]


@pytest.mark.parametrize("name", POINTWISE)
def test_a_masked_loss_equals_that_of_the_remaining_pixels(name):
    rng = np.random.default_rng(2)
    image, target = (rng.uniform(0.1, 2, (4, 5, 3)).astype(np.float32) for _ in range(2))
    weights = np.where(rng.uniform(size=(4, 5)) > 0.4, rng.uniform(0.5, 3, (4, 5)), 0)
    image[weights == 0], target[weights == 0] = np.inf, np.nan
    view = View(0, make_loss(name))
    view.see(target, weights)
    leaf = mi.TensorXf(image)
    dr.enable_grad(leaf)
    loss = view.compare(leaf)
    dr.backward(loss)

    kept, total = weights > 0, 0.0
    for y, x in np.argwhere(kept):
        pixel = (slice(y, y + 1), slice(x, x + 1))
        one = make_loss(name)(mi.TensorXf(image[pixel].copy()), mi.TensorXf(target[pixel].copy()))
        total += weights[y, x] * float(one[0])
    np.testing.assert_allclose(float(loss[0]), total / weights.sum(), rtol=1e-5)
    gradient = np.array(dr.grad(leaf))
    assert np.isfinite(gradient).all()
    assert not gradient[~kept].any()
    assert gradient[kept].all()


#: All kinds of pixels but those at the border.
NO_BORDER = "target.mask={kinds: [specular, clipped, alpha]}"


def test_kinds_of_a_file(masked_folder):
    problem, lines = make_masked(masked_folder, "target.file=photo.png")
    assert left_out(problem) == [CLIPPED, CLEAR]
    [record] = view_records(problem.views)
    assert (record["kinds"], record["left_out"]) == ({"clipped": 1, "alpha": 1}, 2)
    assert lines == ["view 0: 2 of 64 pixels (3.1%) are left out: 1 are clipped, 1 have alpha 0"]
    assert left_out(
        make_masked(masked_folder, "target.file=photo.png", "target.mask={kinds: [specular, border, alpha]}")[0]
    ) == [CLEAR]
    problem, lines = make_masked(masked_folder, "target.file=photo.png", "target.mask=none")
    assert (left_out(problem), lines) == ([], [])


def test_pixels_mixed_with_clipped_ones_are_excluded(masked_folder):
    scene = masked_folder / "scene.xml"
    scene.write_text(scene.read_text().replace('rfilter type="box"', 'rfilter type="gaussian"'))  # its radius is 2
    problem, lines = make_masked(masked_folder, "target.file=photo.png", NO_BORDER)
    y, x = CLIPPED
    near = {(v, u) for v in range(max(y - 2, 0), min(y + 3, 8)) for u in range(max(x - 2, 0), min(x + 3, 8))}
    assert set(left_out(problem)) == near | {CLEAR}
    assert f"1 are clipped, {len(near) - 1} are within the film's filter of clipped ones, 1 have" in lines[0]
    off = "target.mask={kinds: [specular, alpha]}"
    assert left_out(make_masked(masked_folder, "target.file=photo.png", off)[0]) == [CLEAR]


#: A square lamp in front of the plate. In an image of 16x16 pixels, its edges are inside pixels.
PANEL = """
    <shape type="rectangle" id="panel">
        <transform name="to_world"><scale value="0.45"/><translate z="1"/></transform>
        <emitter type="area"><rgb name="radiance" value="17"/></emitter>
    </shape>
</scene>"""


@pytest.mark.parametrize(
    ("level", "sets", "left"),
    [
        (250, (), True),
        (204, (), True),  # 0.604
        (203, (), False),  # 0.597
        (250, (NO_BORDER,), True),
        (250, ("target.mask={kinds: [specular, border, alpha]}",), False),
        (250, ("target.response={encoding: linear}",), False),
        (250, ("target.response={curve: auto}", "target.exposure=auto"), True),
        (250, ("target.response={curve: [1, 1, 1, 1, 2, 4]}",), False),
        (250, ("target.response={gamma: 2.2}",), True),
    ],
)
def test_a_lamp_that_a_film_curve_compressed_is_excluded(tmp_path, level, sets, left):
    """A lamp near white has any brightness. Its edges, which are darker in the file, are excluded too; bright pixels
    beside it are not.
    """
    write_experiment(tmp_path, SCENE.replace("</scene>", PANEL))
    pixels = np.full((8, 8, 3), 60, np.uint8)
    pixels[3:5, 3:5] = level
    pixels[0, 0] = 250
    mi.Bitmap(pixels).write(str(tmp_path / "photo.png"))
    problem, lines = make_masked(tmp_path, "target.file=photo.png", *sets)
    found = set(left_out(problem))
    inside = {(y, x) for y in (3, 4) for x in (3, 4)}
    assert found == set() if not left else inside <= found <= {(y, x) for y in range(2, 6) for x in range(2, 6)}
    assert [line.endswith(f"{len(found)} show lamps near white") for line in lines] == ([True] if left else [])


def test_a_file_can_show_the_values_of_the_scene(masked_folder):
    """A file can show the scene's own values, as pictures of other renderers do. The parameters' errors are then
    measured from the scene's own values.
    """
    assert not make_masked(masked_folder, "target.file=photo.png")[0].truth
    problem, _ = make_masked(masked_folder, "target.file=photo.png", "target.truth=true")
    rendered = assemble(load(masked_folder / "tiny.yaml", []))
    assert rendered.truth.keys() == problem.truth.keys() == set(problem.selection.keys)
    for key, value in rendered.truth.items():
        np.testing.assert_array_equal(problem.truth[key], value)
        assert not np.array_equal(value, problem.selection.array(key))  # the run starts elsewhere


def test_photograph_and_weights_are_rotated_by_their_own_exif(masked_folder):
    """The same picture upright, and upside down with a matching EXIF orientation, gives the same target and mask."""
    from PIL import Image  # comes with matplotlib

    pixels = np.random.default_rng(2).integers(40, 200, (8, 8, 3), dtype=np.uint8)
    pixels[1, 2] = 255
    weights = np.full((8, 8), 255, np.uint8)
    weights[5, 1] = 0
    for name, orientation in (("up", 1), ("down", 3)):
        for kind, array in (("photo", pixels), ("weights", weights)):
            image = Image.fromarray(array if orientation == 1 else array[::-1, ::-1])
            exif = image.getexif()
            exif[0x0112] = orientation
            image.save(masked_folder / f"{kind}-{name}.png", exif=exif)
    only = "target.mask={file: weights-%s.png, kinds: [specular, clipped, alpha]}"
    upright, _ = make_masked(masked_folder, "target.file=photo-up.png", only % "up")
    said = []
    sets = ["target.render=null", "target.file=photo-down.png", only % "down"]
    turned = assemble(load(masked_folder / "tiny.yaml", sets), said.append)
    assert left_out(turned) == left_out(upright) == [(1, 2), (5, 1)]
    np.testing.assert_array_equal(np.array(turned.views[0].target), np.array(upright.views[0].target))
    assert f"{masked_folder}/photo-down.png: turned by 180 degrees, as its EXIF orientation says" in said


def test_non_finite_values(masked_folder):
    problem, _ = make_masked(masked_folder, "target.file=photo.exr")
    assert left_out(problem) == [BROKEN]
    assert np.isfinite(np.array(problem.views[0].target)).all()
    problem, _ = make_masked(masked_folder, "target.file=photo.exr", "target.mask=none")
    assert left_out(problem) == [BROKEN]


def test_weights_of_a_file(masked_folder):
    weights = np.full((8, 8, 1), 128, np.uint8)
    weights[0, 0], weights[7, 7] = 0, 255
    mi.Bitmap(weights).write(str(masked_folder / "weights.png"))
    problem, _ = make_masked(masked_folder, "target.file=photo.png", "target.mask=weights.png")
    found = np.array(problem.views[0].weights)[:, :, 0]
    assert left_out(problem) == [(0, 0)]  # clipped pixels still count
    np.testing.assert_allclose(found[7, 7] / found[1, 2], 255 / 128, rtol=1e-5)
    np.testing.assert_allclose(found.mean(), 1, rtol=1e-5)
    problem, _ = make_masked(masked_folder, "target.file=photo.png", "target.mask={file: weights.png}")
    assert left_out(problem) == [(0, 0), CLIPPED, CLEAR]
    with pytest.raises(ConfigError) as error:
        make_masked(masked_folder, "target.file=photo.png", "target.mask=missing.png")
    assert error.value.key == "target.mask.file"


@pytest.mark.parametrize(("maker", "count"), [("prb", 48), ("reslrb, paths: light", 0)])
def test_the_border_is_excluded_unless_both_are_light_traced(masked_folder, maker, count):
    scene = masked_folder / "scene.xml"
    scene.write_text(scene.read_text().replace('rfilter type="box"', 'rfilter type="gaussian"'))
    render = f"target.render={{spp: 4, integrator: {{type: {maker}, max_depth: 3}}}}"
    assert len(left_out(assemble(load(masked_folder / "tiny.yaml", [render])))) == count
    assert not left_out(assemble(load(masked_folder / "tiny.yaml", [render, NO_BORDER])))
    if maker == "prb":  # camera paths lose no light at the border
        for same in ("type: prb", "paths: camera", "paths: both, light_share: 0.5"):
            sets = [f"integrator={{{same}, max_depth: 3}}", render]
            assert not left_out(assemble(load(masked_folder / "tiny.yaml", sets)))


@pytest.mark.parametrize(("bsdf", "kind"), [("conductor", "specular"), ("plastic", "mixed")])
def test_pixels_invisible_to_light_tracing(masked_folder, bsdf, kind):
    scene = masked_folder / "scene.xml"
    scene.write_text(scene.read_text().replace("</scene>", GLASS.format(bsdf)))
    problem, _ = make_masked(masked_folder, "target.file=photo.png")
    masked = problem.views[0].masked
    if kind == "specular":
        assert 0 < masked.counts()["specular"] < 40
        assert (3, 3) in left_out(problem)
        return
    assert masked.counts().keys() == {"clipped", "alpha"}


def test_an_empty_mask_is_refused(masked_folder):
    mi.Bitmap(np.zeros((8, 8, 3), np.float32)).write(str(masked_folder / "nothing.exr"))
    with pytest.raises(ConfigError, match=r"leaves no pixel to compare .*64 have weight 0 in the mask's file") as error:
        make_masked(masked_folder, "target.file=photo.png", "target.mask=nothing.exr")
    assert error.value.key == "target.mask"


def test_excluded_pixels_do_not_count(masked_folder):
    """Pixels with an alpha of 0 affect neither the gradients nor the images that measurements take."""
    found = []
    for value in (60, 200):
        pixels = np.array(mi.Bitmap(str(masked_folder / "photo.png")))
        pixels[CLEAR] = (value, value, value, 0)
        mi.Bitmap(pixels).write(str(masked_folder / "photo.png"))
        problem, _ = make_masked(masked_folder, "target.file=photo.png")
        sample_gradient(problem, problem.integrator, 0, "test", 4)
        [gradient] = take_gradient(problem).values()
        found.append((gradient, see_images(problem)))
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_array_equal(found[0][1], found[1][1])
    problem, _ = make_masked(masked_folder, "target.file=photo.png", "run.spp=256")
    [image] = see_images(problem)
    assert not image[CLEAR].any()
    assert image[4, 4].all()
