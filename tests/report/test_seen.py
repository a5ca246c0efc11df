"""Errors as people see them, compared with values computed by hand or published."""

from __future__ import annotations

import colour
import numpy as np
import pytest
from report.measured import make_run, texture

from reslrb_cli.records.images import load_image, write_image
from reslrb_cli.report.perceptual import (
    ciede2000,
    image_errors,
    psnr,
    seen_errors,
    ssim,
    to_lab,
)


def test_colours_are_linear_srgb():
    """White and the red of sRGB have known L*a*b* values. Black and white are 100 apart. Colours beyond white count as
    white.
    """
    np.testing.assert_allclose(to_lab(np.ones(3)), [100, 0, 0], atol=0.02)
    np.testing.assert_allclose(to_lab(np.array([1.0, 0, 0])), [53.24, 80.09, 67.20], atol=0.03)
    red, green, blue = np.eye(3)
    assert [ciede2000(red, green), ciede2000(red, blue)] == pytest.approx(
        [86.61, 52.88], abs=0.02
    )  # CIE 1976 gives 171 and 176
    assert ciede2000(np.zeros(3), np.ones(3)) == pytest.approx(100, abs=0.01)
    assert ciede2000(np.full(3, 5.0), np.ones(3)) == pytest.approx(0, abs=1e-9)


def test_images_are_compared_as_displayed():
    """Errors are computed in sRGB, where a linear 0.5 is 0.735357 and a linear 0.214041 is 0.5. No value is brighter
    than 1.
    """
    assert psnr(np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.6)) == pytest.approx(20)
    half, dark = np.full((4, 4, 3), 0.5), np.full((4, 4, 3), 0.214041)
    assert image_errors(half, dark, 1.0)["psnr_db"] == pytest.approx(-20 * np.log10(0.735357 - 0.5), rel=1e-4)
    assert image_errors(dark, 2 * dark, 20.0)["psnr_db"] is None


def test_structural_similarity():
    """The similarity of two even images is (2 a b + C) / (a² + b² + C), with C = 0.01². Small images have no
    similarity.
    """
    first, second = np.full((16, 16, 1), 0.5), np.full((16, 16, 1), 0.7)
    assert ssim(first, second) == pytest.approx((2 * 0.35 + 1e-4) / (0.25 + 0.49 + 1e-4), rel=1e-6)
    assert ssim(first[:10], second[:10]) is None
    same = image_errors(texture(20, 24), texture(20, 24), 1.0)
    assert (same["psnr_db"], same["ssim"], same["ciede2000"]) == (None, pytest.approx(1), {"mean": 0, "max": 0})
    noise = np.random.default_rng(1).normal(0, 0.2, (32, 32, 3))
    assert ssim(texture(32, 32) * 1.0, texture(32, 32) + noise) < 0.9


def test_errors_depend_on_the_exposure():
    image, target = texture(16, 16) * np.float32(1e-4), texture(16, 16, seed=1) * np.float32(1e-4)
    dark, bright = image_errors(image, target, 1.0), image_errors(image, target, 1e4)
    assert dark["psnr_db"] > 40 > 15 > bright["psnr_db"]
    assert dark["ciede2000"]["mean"] < 0.2 < 10 < bright["ciede2000"]["mean"]


def test_non_finite_pixels_are_counted_and_black():
    image, target = texture(16, 16), texture(16, 16)
    image[0, :2], image[1, 1, 0], target[0, :2], target[1, 1] = np.nan, np.inf, 0, (0, *target[1, 1, 1:])
    found = image_errors(image, target, 1.0)
    assert found["not_finite"] == 3
    assert found["psnr_db"] is None


@pytest.mark.parametrize("bands", [2, 3, 4, 5])
def test_all_bands_of_a_film_count(bands, tmp_path):
    """The channels of a camera are not colours. Each of them counts, also if the others are black."""
    run = make_run(tmp_path / "a")
    view = {"sensor": 0, "shown": 1.0, "channels": [f"band{number}" for number in range(bands)]}
    for lit in range(bands):
        target = np.zeros((16, 16, bands), np.float32)
        target[:, :, lit] = texture(16, 16)[:, :, 0]
        for name, part in (("target", 1.0), ("initial", 1.0), ("final", 0.5)):
            write_image(run / "images" / name, target * np.float32(part))
        found = seen_errors(run, [view])[""]
        assert found["initial"]["psnr_db"] is None
        expected = image_errors(target[:, :, [lit]] / 2, target[:, :, [lit]], 1.0)["psnr_db"] + 10 * np.log10(bands)
        assert found["final"]["psnr_db"] == pytest.approx(expected)
        assert "ciede2000" not in found["final"]


def test_grey_images_and_alpha():
    """One channel counts as a grey colour. Alpha does not count as a colour."""
    grey, other = texture(16, 16)[:, :, :1], texture(16, 16, seed=2)[:, :, :1]
    found = image_errors(grey, other, 1.0)
    tripled = image_errors(np.repeat(grey, 3, axis=2), np.repeat(other, 3, axis=2), 1.0)
    assert found["ciede2000"] == pytest.approx(tripled["ciede2000"])
    assert found["psnr_db"] == pytest.approx(tripled["psnr_db"])
    with_alpha = np.concatenate([texture(16, 16), np.zeros((16, 16, 1), np.float32)], axis=2)
    assert image_errors(with_alpha, texture(16, 16), 1.0)["psnr_db"] is None


def test_colours_under_another_illuminant_are_adapted(tmp_path):
    """Under the illuminant A, differences are those that colour-science finds after Bradford's adaptation to D65. A
    film with the channels of a camera has no colours.
    """
    folder = make_run(tmp_path / "lamp")
    images = [load_image(folder / "images" / f"{name}.exr") for name in ("final", "target")]
    space, white = colour.RGB_COLOURSPACES["sRGB"], colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]
    xyz = [image.astype(np.float64) @ space.matrix_RGB_to_XYZ.T for image in images]
    whites = [colour.xy_to_XYZ(white[name]) for name in ("A", "D65")]
    matrix = colour.adaptation.matrix_chromatic_adaptation_VonKries(*whites, transform="Bradford")
    labs = [
        colour.XYZ_to_Lab(
            np.clip(each @ matrix.T @ np.linalg.inv(space.matrix_RGB_to_XYZ).T, 0, 1) @ space.matrix_RGB_to_XYZ.T,
            white["D65"],
        )
        for each in xyz
    ]
    wanted = colour.delta_E(*labs, method="CIE 2000")
    view = {"sensor": 0, "shown": 1.0}
    found = seen_errors(folder, [view | {"white": "A"}])[""]["final"]["ciede2000"]
    assert found == pytest.approx({"mean": wanted.mean(), "max": wanted.max()}, rel=0.005)
    plain = seen_errors(folder, [view])[""]["final"]
    assert abs(plain["ciede2000"]["mean"] / found["mean"] - 1) > 0.02
    assert seen_errors(folder, [view | {"channels": ["R", "G", "B"]}])[""]["final"].keys() == {"psnr_db", "ssim"}


def test_files_of_a_run_folder(tmp_path):
    folder = make_run(tmp_path / "lamp", sensors=2)
    views = [{"sensor": sensor, "shown": 1.0} for sensor in range(2)]
    found = seen_errors(folder, views)
    assert list(found) == ["-0", "-1"]
    target, final = (load_image(folder / "images" / f"{name}-1.exr") for name in ("target", "final"))
    again = image_errors(final, target, 1.0)
    assert {key: found["-1"]["final"][key] for key in again} == again
    for path in folder.glob("images/final*.exr"):
        path.write_bytes(path.read_bytes()[:200])
    (folder / "images" / "target-0.exr").unlink()
    assert list(seen_errors(folder, views)) == ["-1"]
    assert "final" not in seen_errors(folder, views)["-1"]
    assert seen_errors(tmp_path, views) == seen_errors(folder, None) == {}
