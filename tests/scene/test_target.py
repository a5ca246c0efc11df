"""Images: formats, colour spaces, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.images import read_image

pytestmark = pytest.mark.usefixtures("llvm")


def write(path, array):
    import mitsuba as mi

    mi.Bitmap(np.ascontiguousarray(array)).write(str(path))
    return path


def srgb(value: float) -> float:
    """Linear value of an sRGB-encoded one (IEC 61966-2-1)."""
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


@pytest.mark.parametrize("type_", [np.float16, np.float32])
def test_exr_is_linear(tmp_path, type_):
    values = np.linspace(0, 5, 3 * 4 * 3).astype(type_).reshape(3, 4, 3)
    image = read_image(write(tmp_path / "a.exr", values), size=(4, 3))
    assert image.dtype == np.float32
    assert np.array_equal(image, values.astype(np.float32))


def test_png_is_srgb_by_default(tmp_path):
    values = np.tile(np.arange(0, 256, 17, dtype=np.uint8)[None, :, None], (2, 1, 3))
    path = write(tmp_path / "a.png", values)
    expected = [srgb(v / 255) for v in range(0, 256, 17)]
    assert np.allclose(read_image(path)[0, :, 0], expected, atol=1e-6)
    assert np.allclose(read_image(path, "srgb")[0, :, 0], expected, atol=1e-6)
    assert np.allclose(read_image(path, "linear")[0, :, 0], np.arange(0, 256, 17) / 255, atol=1e-6)


def test_float_files_can_be_srgb(tmp_path):
    path = write(tmp_path / "a.exr", np.full((2, 2, 3), 0.5, np.float32))
    assert np.allclose(read_image(path, "srgb"), srgb(0.5))


def test_jpg_and_hdr(tmp_path):
    jpg = read_image(write(tmp_path / "a.jpg", np.full((8, 8, 3), 128, np.uint8)))
    assert np.allclose(jpg, srgb(128 / 255), atol=0.01)
    hdr = read_image(write(tmp_path / "a.hdr", np.full((8, 8, 3), 3.0, np.float32)))
    assert np.allclose(hdr, 3, rtol=0.01)


def test_alpha_is_dropped_and_grey_becomes_rgb(tmp_path):
    rgba = np.full((2, 2, 4), 0.25, np.float32)
    assert read_image(write(tmp_path / "a.exr", rgba)).shape == (2, 2, 3)
    grey = read_image(write(tmp_path / "g.exr", np.full((2, 2, 1), 0.25, np.float32)))
    assert grey.shape == (2, 2, 3)
    assert np.array_equal(grey, np.full((2, 2, 3), 0.25, np.float32))


def image_with(value):
    array = np.ones((4, 6, 3), np.float32)
    array[2, 5, 1] = value
    return array


@pytest.mark.parametrize(
    ("array", "what"),
    [
        (np.ones((4, 5, 3), np.float32), "is 5x4 pixels; it must be 6x4"),
        (image_with(np.nan), r"pixel \(5, 2\), channel G, is nan: not finite \(1 pixels in all\)"),
        (image_with(np.inf), "is inf: not finite"),
        (image_with(-0.5), "is -0.5: negative"),
        (np.ones((4, 6, 7), np.float32), "has 7 channels"),
    ],
)
def test_refused(tmp_path, array, what):
    path = write(tmp_path / "a.exr", array)
    with pytest.raises(ConfigError, match=what) as error:
        read_image(path, size=(6, 4))
    assert str(error.value).startswith(f"{path}: ")


def test_missing_and_unreadable(tmp_path):
    with pytest.raises(ConfigError, match="no such file"):
        read_image(tmp_path / "none.png")
    with pytest.raises(ConfigError, match="is a folder"):
        read_image(tmp_path)
    for name in ("a.exr", "a.png", "a.txt"):
        (tmp_path / name).write_text("no image")
        with pytest.raises(ConfigError, match="is not an image"):
            read_image(tmp_path / name)
