"""Errors as people see them, against values that can be computed by hand or stand in publications."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from report.measured import FLOOR, LAMP, make_run, texture

from reslrb_cli.records.images import load_image
from reslrb_cli.report import perceptual
from reslrb_cli.report.perceptual import (
    WHITE,
    ciede2000,
    ciede2000_of_lab,
    color_errors,
    image_errors,
    is_color,
    itp,
    psnr,
    seen_errors,
    ssim,
    to_lab,
    told,
)

#: From Sharma, Wu, Dalal 2005, Table 1: two colours in L*a*b* and their difference.
SHARMA = [
    ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
    ((50.0, -1.1848, -84.8006), (50.0, 0.0, -82.7485), 1.0000),
    ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
    ((50.0, 2.5, 0.0), (50.0, 0.0, -2.5), 4.3065),
    ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
    ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
]


@pytest.mark.parametrize(("first", "second", "difference"), SHARMA)
def test_ciede2000_has_the_published_values(first, second, difference):
    assert ciede2000_of_lab(np.array(first), np.array(second)) == pytest.approx(difference, abs=5e-5)


def test_colours_are_linear_srgb():
    """White and the red of sRGB in L*a*b*; black and white are 100 apart; what is beyond white is white."""
    np.testing.assert_allclose(to_lab(np.ones(3)), [100, 0, 0], atol=0.02)
    np.testing.assert_allclose(to_lab(np.array([1.0, 0, 0])), [53.24, 80.09, 67.20], atol=0.03)
    assert ciede2000(np.zeros(3), np.ones(3)) == pytest.approx(100, abs=0.01)
    assert ciede2000(np.full(3, 5.0), np.ones(3)) == pytest.approx(0, abs=1e-9)


def perceptual_quantizer(luminance):
    """SMPTE ST 2084, from cd/m² to a signal."""
    power = (luminance / 1e4) ** (2610 / 16384)
    return ((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power)) ** (2523 / 32)


def test_the_difference_of_greys_in_high_dynamic_range():
    """Of greys it is 720 times that of their signals (BT.2124), also beyond what a screen shows as white."""
    for first, second in ((0.5, 0.6), (4.0, 8.0), (0.001, 0.002)):
        expected = 720 * abs(perceptual_quantizer(WHITE * first) - perceptual_quantizer(WHITE * second))
        assert itp(np.full((2, 3), first), np.full((2, 3), second)) == pytest.approx(expected, rel=2e-3)


def test_percentiles():
    found = told(np.arange(101.0))
    assert found == {"mean": 50, "p50": 50, "p95": 95, "p99": 99, "max": 100}


def test_images_that_are_the_same():
    image = texture(20, 24)
    found = image_errors(image, image, 1.0)
    assert (found["psnr_db"], found["ssim"]) == (None, pytest.approx(1, abs=1e-12))
    assert found["ciede2000"]["max"] == found["itp"]["max"] == found["absolute"]["max"] == 0
    assert "not_finite" not in found


def test_the_ratio_of_signal_to_noise():
    """An offset of 0.1 everywhere is 20 dB."""
    assert psnr(np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.6)) == pytest.approx(20)


def test_images_are_compared_as_a_screen_shows_them():
    """In sRGB, where a linear 0.5 is 0.735357 and 0.214041 is 0.5, and where nothing is brighter than 1."""
    half, dark = np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.214041)
    assert image_errors(half, dark, 1.0)["psnr_db"] == pytest.approx(-20 * np.log10(0.735357 - 0.5), rel=1e-4)
    assert image_errors(dark, 2 * dark, 20.0)["psnr_db"] is None
    assert image_errors(dark, 2 * dark, 20.0)["itp"]["mean"] > 10


def test_structural_similarity():
    """Of two even images it is (2 a b + C) / (a² + b² + C), with C = 0.01²; small images have none."""
    first, second = np.full((16, 16, 1), 0.5), np.full((16, 16, 1), 0.7)
    assert ssim(first, second) == pytest.approx((2 * 0.35 + 1e-4) / (0.25 + 0.49 + 1e-4), rel=1e-6)
    assert ssim(first[:10], second[:10]) is None
    noise = np.random.default_rng(1).normal(0, 0.2, (32, 32, 3))
    assert ssim(texture(32, 32) * 1.0, texture(32, 32) + noise) < 0.9


def test_exposure_counts_for_what_is_seen_and_not_for_the_difference_itself():
    image, target = texture(16, 16) * np.float32(1e-4), texture(16, 16, seed=1) * np.float32(1e-4)
    dark, bright = image_errors(image, target, 1.0), image_errors(image, target, 1e4)
    assert dark["psnr_db"] > 40 > 15 > bright["psnr_db"]
    assert dark["ciede2000"]["mean"] < 0.2 < 10 < bright["ciede2000"]["mean"]
    assert dark["absolute"] == bright["absolute"]


def test_what_is_not_finite_is_counted_and_black():
    image, target = texture(16, 16), texture(16, 16)
    image[0, :2], image[1, 1, 0], target[0, :2], target[1, 1] = np.nan, np.inf, 0, (0, *target[1, 1, 1:])
    found = image_errors(image, target, 1.0)
    assert found["not_finite"] == 3
    assert found["psnr_db"] is None


def test_grey_images_and_alpha():
    """One channel counts as a grey colour; alpha is no colour."""
    grey, other = texture(16, 16)[:, :, :1], texture(16, 16, seed=2)[:, :, :1]
    found = image_errors(grey, other, 1.0)
    tripled = image_errors(np.repeat(grey, 3, axis=2), np.repeat(other, 3, axis=2), 1.0)
    assert found["ciede2000"] == pytest.approx(tripled["ciede2000"])
    assert found["psnr_db"] == pytest.approx(tripled["psnr_db"])
    with_alpha = np.concatenate([texture(16, 16), np.zeros((16, 16, 1), np.float32)], axis=2)
    assert image_errors(with_alpha, texture(16, 16), 1.0)["psnr_db"] is None


def test_recovered_colours():
    """Of a texture the texels in the mask count; surfaces are told in CIEDE2000, lamps in ΔE_ITP."""
    true, final = np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.5)
    final[0] = 0.9
    mask = np.ones((4, 4), bool)
    found = color_errors({"final": final}, true, mask, "")
    assert (found["measure"], found["exposure"]) == ("ciede2000", 1.0)
    assert found["final"]["mean"] == pytest.approx(ciede2000(final[0, 0], true[0, 0]) / 4)
    mask[0] = False
    assert color_errors({"final": final}, true, mask, "")["final"]["max"] == 0
    lamp = color_errors({"initial": np.full(3, 2e6), "final": np.full(3, 1e6)}, np.full(3, 1e6), None, "radiance")
    assert (lamp["measure"], lamp["final"]["max"]) == ("itp", 0)
    assert lamp["initial"]["max"] > 10
    assert color_errors({"final": np.ones(1)}, np.ones(1), None, "") == {}
    finer = color_errors({"final": np.full((2, 2, 3), 0.5)}, true, np.ones((2, 2), bool), "")
    assert finer["final"]["max"] == pytest.approx(0, abs=1e-6)
    assert not is_color("plate.eta.value", "")
    assert not is_color("lens.translation", "length")


needs_flip = pytest.mark.skipif(not perceptual.is_installed(), reason="flip-evaluator is not installed")


@needs_flip
def test_flip_has_the_exposures_and_the_error_that_its_package_has():
    import flip_evaluator

    target = (texture(48, 40) ** 3) * np.float32(50)
    image = target * np.float32(1.2)
    _, mean, chosen = flip_evaluator.evaluate(target.copy(), image.copy(), "HDR", applyMagma=False)
    low, high = perceptual.find_exposures(target)
    assert (low, high) == (
        pytest.approx(chosen["startExposure"], abs=0.01),
        pytest.approx(chosen["stopExposure"], abs=0.01),
    )
    ours = perceptual.flip_map(image, target)
    assert ours.shape == (48, 40)
    assert ours.mean() == pytest.approx(mean, rel=0.02)
    assert perceptual.flip_map(target, target).max() == 0


@needs_flip
@pytest.mark.parametrize("kind", ["black", "mostly black", "even", "enormous", "not finite", "negative", "tiny"])
def test_flip_never_ends_the_process(kind):
    """Its package does, for what it does not like."""
    target = np.zeros((16, 16, 3), np.float32)
    target[:4] = {"black": 0, "enormous": 1e38, "not finite": np.nan}.get(kind, 3)
    target = np.full_like(target, 2) if kind == "even" else target[:2, :3] if kind == "tiny" else target
    image = -target if kind == "negative" else target + np.float32(0.5)
    error = perceptual.flip_map(image, target)
    if kind in ("black", "not finite"):
        assert error is None
    else:
        assert np.isfinite(error).all()
        assert error.shape == target.shape[:2]
        assert error.max() <= 1


def test_without_its_package_flip_is_named_and_everything_else_is_there(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    found = seen_errors(make_run(tmp_path / "lamp"), {})
    assert found["note"] == perceptual.MISSING
    assert "pip install reslrb[flip]" in found["note"]
    assert found["images"][""]["final"]["ssim"] > found["images"][""]["initial"]["ssim"]
    assert "flip" not in found["images"][""]["final"]


def test_what_is_found_in_a_run_folder(tmp_path):
    folder = make_run(tmp_path / "lamp", sensors=2)
    about = {FLOOR: {"quantity": ""}, LAMP: {"quantity": "intensity"}, "gone": {}}
    found = seen_errors(folder, {"parameters": about})
    assert list(found["images"]) == ["-0", "-1"]
    target, final = (load_image(folder / "images" / f"{name}-1.exr") for name in ("target", "final"))
    again = image_errors(final, target, 1.0)
    assert {key: found["images"]["-1"]["final"][key] for key in again} == again
    assert {key: colors["measure"] for key, colors in found["colors"].items()} == {FLOOR: "ciede2000", LAMP: "itp"}
    assert found["colors"][FLOOR]["initial"]["mean"] > found["colors"][FLOOR]["final"]["mean"] > 0
    for path in folder.glob("images/final*.exr"):
        path.write_bytes(path.read_bytes()[:200])
    (folder / "images" / "target-0.exr").unlink()
    assert list(seen_errors(folder, {})["images"]) == ["-1"]
    assert "final" not in seen_errors(folder, {})["images"]["-1"]
    assert seen_errors(tmp_path, {}) == {}
