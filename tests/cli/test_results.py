"""The results that a run reports at its end: on the terminal, in the manifest and in its images."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli.test_optimize import KEY, SCENE, write_box
from cli.tiny import manifest as read_manifest
from cli.tiny import outcome, read_metrics, settings
from kit import scene, sensor, shape

from reslrb_cli.records.images import read_layers

LAMP, WALL = "lamp.emitter.radiance.value", "wall.reflectance.value"


@pytest.fixture(autouse=True)
def _experiment(llvm, tmp_path, monkeypatch):
    """Working directory with a scene and a configuration."""
    write_box(tmp_path)
    monkeypatch.chdir(tmp_path)


def optimize(*sets, options=()):
    """Run `reslrb optimize`, and return the last line, all of standard output, and the manifest's results."""
    shutil.rmtree("runs/box", ignore_errors=True)
    code, out, err = outcome("optimize", "box.yaml", *options, *settings(*sets))
    assert code == 0, err
    return out.splitlines()[-1], out, read_manifest("runs/box")["results"]


def read(path):
    import mitsuba as mi

    return np.array(mi.Bitmap(str(path)), dtype=np.float64)


def test_values_and_errors_precede_the_last_line():
    both = f"parameters=[{{key: {KEY}, initial: 0.5, bounds: [0, 1]}}, {{key: {WALL}, initial: [0.2, 0.3, 0.4]}}]"
    last, out, results = optimize(both, "run.iterations=3", "run.adjoint=independent")
    head, poster, wall, *rest = out.splitlines()
    assert rest == [last]
    assert head.split() == ["parameter", "start", "end", "true", "RMSE"]
    assert poster.startswith(KEY)
    assert wall.startswith(WALL)
    assert "0.2 0.3 0.4" in wall
    assert "0.5 0.4 0.3" in wall
    columns = [head.index(title) for title in ("start", "end", "true", "RMSE")]
    assert all(line[column - 1] == " " != line[column] for line in (poster, wall) for column in columns)
    errors = results["parameter_rmse"]
    for key, line in ((KEY, poster), (WALL, wall)):
        assert line.endswith(f"{errors[key]['initial']:.3g} to {errors[key]['final']:.3g}")
    assert f"parameter RMSE {results['rmse']['initial']:.3g} to {results['rmse']['final']:.3g};" in last
    about = results["parameters"][KEY]
    recovered = np.load("runs/box/parameters/parameters.npz")[KEY]
    assert about["final"]["mean"] == pytest.approx(recovered.mean(axis=(0, 1)).tolist(), rel=1e-5)
    assert (about["final"]["min"], about["final"]["max"]) == pytest.approx((recovered.min(), recovered.max()))
    assert results["parameters"][WALL]["true"] == {"value": pytest.approx([0.5, 0.4, 0.3])}
    assert optimize("run.iterations=1", options=["--quiet"])[1].count("\n") == 1


def test_different_units_give_relative_errors():
    both = f"parameters=[{{key: {WALL}, initial: 0.2}}, {{key: {LAMP}, initial: 2.0, learning_rate: 0.5}}]"
    last, out, results = optimize(both, "run.iterations=3")
    for record in read_metrics("runs/box"):
        assert record["parameter_rmse"] is None
        assert set(record["parameter_errors"]) == {WALL, LAMP}
    assert results["rmse"] == {"initial": None, "final": None}
    assert [results["parameters"][key]["quantity"] for key in (WALL, LAMP)] == ["", "radiance"]
    truth = {WALL: np.sqrt(np.mean(np.square([0.5, 0.4, 0.3]))), LAMP: 8.0}
    for key, pair in results["relative_error"].items():
        rmse = results["parameter_rmse"][key]
        assert pair == {at: pytest.approx(rmse[at] / truth[key], rel=1e-5) for at in ("initial", "final")}
    assert results["relative_error"][LAMP]["initial"] == pytest.approx(0.75)
    assert re.search(rf"relative error 0\.75 to \S+ at worst \({LAMP}\);", last), last
    assert "relative error" in out.splitlines()[0]


def test_a_truth_of_another_resolution_has_an_error():
    last, _, results = optimize("parameters[0].resolution=[8, 8]", "run.iterations=2")
    records = read_metrics("runs/box")
    assert all(record["parameter_rmse"] > 0 for record in records)
    assert results["parameter_rmse"][KEY]["initial"] == pytest.approx(records[0]["parameter_errors"][KEY])
    assert results["parameters"][KEY]["shape"] == [8, 8, 3]
    assert "parameter RMSE" in last
    assert read("runs/box/parameters/true/" + KEY + ".exr").shape == (8, 8, 3)


def test_a_worse_parameter_is_reported():
    """The parameter starts close to the truth, and the learning rate is far too large."""
    wall = f"parameters=[{{key: {WALL}, initial: 0.42, bounds: [0, 1]}}]"
    last, out, results = optimize(wall, "optimizer.learning_rate=30", "optimizer.beta_2=0.999", "run.iterations=30")
    pair = results["parameter_rmse"][WALL]
    assert pair["final"] > 2 * pair["initial"]
    assert f"; {WALL} got worse (RMSE {pair['initial']:.3g} to {pair['final']:.3g})" in last
    assert results["worse"] == [WALL]
    assert ", worse " in out.splitlines()[1]
    assert "  at its bound" in out.splitlines()[1]


def test_a_good_run_has_no_complaints():
    last, _, results = optimize("run.adjoint=independent", "run.spp=128", "run.certainty=false")
    assert results["loss_trend"]["change"] == "fell"
    assert results["warnings"] == []
    assert last.count(";") == 1
    assert "certainty" not in results
    last, _, results = optimize("run.spp=128", "run.iterations=5")
    assert (results["loss_trend"], results["warnings"]) == (None, [])


def test_a_short_worse_run_is_reported_with_the_reason():
    """Images of many samples and known errors show that the run got worse. The losses of a few iterations do not show
    it.
    """
    wall = f"parameters=[{{key: {WALL}, initial: 0.42, bounds: [0, 1]}}]"
    last, out, results = optimize(wall, "optimizer.learning_rate=30", "run.iterations=5")
    assert results["loss_trend"] is None
    images, error = results["image_loss"], results["parameter_rmse"][WALL]
    assert results["warnings"][:2] == [
        f"the images got farther from their targets (loss {images['initial']:.3g} to {images['final']:.3g})",
        f"{WALL} got worse (RMSE {error['initial']:.3g} to {error['final']:.3g})",
    ]
    assert f"; {results['warnings'][0]}; {results['warnings'][1]}; " in last
    assert "; 5 iterations are few: --set run.iterations=200; look at" in last
    assert ", worse" in out.splitlines()[1]
    few = optimize(wall, "optimizer.learning_rate=30", "run.iterations=5", "target.render.spp=2")
    assert "the target itself has 2 samples per pixel only: --set target.render.spp=" in few[0]


def test_an_unfinished_run_is_marked_everywhere():
    sets = ["run.adjoint=independent", "run.spp=128", "optimizer.learning_rate=0.002"]
    last, out, results = optimize(*sets)
    about = results["certainty"]["parameters"][KEY]
    assert about["verdict"] == "still moving"
    assert about["shares"]["still moving"] > 0.5
    remedy = "(a higher rate: --set optimizer.learning_rate="
    assert f"; not converged, still moving: {KEY} {remedy}" in last
    assert "spread" in out.splitlines()[0]
    assert re.search(r"\+- 0\.\d+ +still moving( \(\d\d.* %\))?: a higher rate$", out.splitlines()[1])
    assert [line.startswith(f"not converged, still moving: {KEY} {remedy}") for line in results["warnings"]] == [True]
    page = Path("runs/box/report.html").read_text()
    assert f"not converged, still moving: {KEY}" in page.partition("<section>")[0]
    assert '<th scope="col">verdict</th>' in page
    assert '<span class="worse">still moving' in page


@pytest.mark.long
def test_a_run_without_certainty_ends_with_the_same_values():
    sets = ["run.adjoint=independent", "run.spp=128", "optimizer.learning_rate=0.002"]
    optimize(*sets)
    values = np.load("runs/box/parameters/parameters.npz")[KEY]
    optimize(*sets, "run.certainty=false")
    np.testing.assert_allclose(np.load("runs/box/parameters/parameters.npz")[KEY], values, rtol=1e-5)
    assert '<th scope="col">verdict</th>' not in Path("runs/box/report.html").read_text()


def test_initial_and_final_images_have_their_own_samples(monkeypatch):
    """They have whole passes."""
    from reslrb_cli.optimization.problem import Problem

    samples, render = [], Problem.render

    def spy(problem, sensor, spp, iteration, purpose):
        samples.append(spp)
        return render(problem, sensor, spp, iteration, purpose)

    monkeypatch.setattr(Problem, "render", spy)
    passes = "integrator={type: reslrb, max_depth: 3, estimator: event, samples_per_pass: 24}"
    sets = [passes, "run.final_spp=40", "run.spp=24", "run.iterations=3"]
    optimize(*sets, "target.render.spp=480")
    assert samples == [48, 48]


def test_the_error_map_belongs_to_the_final_image():
    _, _, results = optimize("views=[{sensor: 0}, {sensor: 1}]", "run.iterations=1", "run.final_spp=16")
    images = Path("runs/box/images")
    for suffix in ("-0", "-1"):
        final, target = (read(images / f"{name}{suffix}.exr") for name in ("final", "target"))
        layers = read_layers(images / f"comparison{suffix}.exr")
        assert set(layers) == {"image", "target", "difference", "gradient"}
        np.testing.assert_array_equal(layers["image"], final[:, :, :3])
        np.testing.assert_array_equal(layers["target"], target)
        np.testing.assert_allclose(layers["difference"], final - target, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(layers["gradient"], 2 * (final - target) / final.size, rtol=1e-3, atol=1e-9)  # l2
        error = np.abs(layers["difference"])
        about = results["error_maps"][f"error{suffix}"]
        assert about["mean"] == pytest.approx(error.mean(), rel=1e-5)
        beyond = np.sum(error.mean(axis=2) > about["end"])
        assert beyond <= np.ceil(0.01 * error[:, :, 0].size)
        assert (images / f"error{suffix}.png").exists()


SKY = scene(
    sensor(size=(12, 8), fov=39.3077, id="camera", pixels="rgba"),
    shape("sphere", "ball", '<bsdf type="roughconductor"/>'),
    '<emitter type="envmap" id="sky"><string name="filename" value="poster.exr"/></emitter>',
)


def test_an_environment_map_has_an_error_and_a_picture():
    """The tensor of the environment map has columns that its image lacks. The film has an alpha channel that the target
    lacks.
    """
    Path("scene.xml").write_text(SKY)
    _, out, results = optimize(
        "parameters=[{key: sky.data, initial: 3.0}]", "integrator={type: prb}", "run.iterations=2"
    )
    assert results["parameters"]["sky.data"]["quantity"] == "radiance"
    assert results["parameters"]["sky.data"]["shape"] == [4, 4, 3]
    assert results["parameter_rmse"]["sky.data"]["initial"] > 2
    assert out.splitlines()[1].startswith("sky.data")
    assert read("runs/box/images/final.exr").shape == (8, 12, 4)
    layers = read_layers(Path("runs/box/images/comparison.exr"))
    assert {array.shape for array in layers.values()} == {(8, 12, 3)}
    assert 'alt="true: sky.data"' in Path("runs/box/report.html").read_text()


def test_images_are_tone_mapped_without_lamps():
    bulb = '<shape type="sphere" id="bulb"><float name="radius" value="0.3"/><point name="center" value="0, 0, 1"/>' \
        '<emitter type="area"><rgb name="radiance" value="9000, 9000, 9000"/></emitter></shape>'  # fmt: skip
    Path("scene.xml").write_text(SCENE.replace("</scene>", f"{bulb}</scene>"))
    optimize("run.iterations=2")
    [view] = read_manifest("runs/box")["views"]
    target = read("runs/box/images/target.exr")
    lamp = target.max(axis=2) > 4000
    assert 0 < lamp.mean() < 0.5
    assert 0 < view["shown"] < 1
    wall = target.max(axis=2) < 600  # brighter pixels show part of the bulb
    assert 0.5 < np.quantile(target[wall], 0.99) * view["shown"] < 1.5  # 1 is white, and the bulb is far brighter
    assert target[lamp].min() * view["shown"] > 3
    for name in ("initial", "final", "target"):
        linear = np.clip(read(f"runs/box/images/{name}.exr") * view["shown"], 0, 1)
        srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        assert np.abs(read(f"runs/box/images/{name}.png") - 255 * srgb).max() < 1
    page = Path("runs/box/report.html").read_text()
    assert re.search(r"shown \d\S* times darker; \d\S* % of the target is brighter than white, and clipped", page)


def test_a_png_is_tone_mapped_on_request():
    dim = re.sub(r'(name="radiance" value=")[^"]*', r"\g<1>0.01, 0.01, 0.01", SCENE)
    assert dim != SCENE
    Path("scene.xml").write_text(dim)
    printed = {}
    for name, options in (("a.exr", ()), ("as_is.png", ()), ("auto.png", ("auto",)), ("ten.png", ("10",))):
        more = ("--set", "run.spp=64", *(("--exposure", *options) if options else ()))
        code, printed[name], err = outcome("render", "box.yaml", "--scene", "-o", name, *more)
        assert code == 0, err
    assert "exposure" not in printed["a.exr"] + printed["auto.png"]
    factor = re.search(r"; --exposure auto: shown (\S+) times brighter$", printed["as_is.png"].strip())
    assert f", shown {factor[1]} times brighter" in printed["auto.png"]
    as_is, ten, auto = (read(f"{name}.png").mean() for name in ("as_is", "ten", "auto"))
    assert as_is < ten < auto
    assert 100 < auto < 230
    for file, given, line in (
        ("a.png", "-1", "'-1' is neither auto nor a number above 0"),
        ("a.exr", "2", "--exposure is for PNG and JPG"),
    ):
        code, _, err = outcome("render", "box.yaml", "-o", file, "--exposure", given)
        assert (code, line in err) == (2, True)
