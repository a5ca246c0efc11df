"""Images: formats, colour spaces, photographs, and incomplete or damaged files."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.images import decode_srgb, orientation_of, read_bitmap, read_image
from reslrb_cli.scene.proposal import open_photograph, write_smaller

pytestmark = pytest.mark.usefixtures("llvm")


# Files that are not whole images: truncated, damaged, or no files at all. Also whole images whose EXIF data gives their
# orientation.


def picture():
    """Return a (H, W, 3) float32 image with detail everywhere."""
    y, x = np.mgrid[0:96, 0:128].astype(np.float32)
    noise = np.random.default_rng(3).uniform(0, 0.3, (96, 128, 3)).astype(np.float32)
    return noise + np.stack([x / 200, y / 200, (x + y) / 400], axis=-1)


NAMES = ["a.jpg", "progressive.jpg", "restarts.jpg", "a.png", "a.exr", "a.hdr", "a.pfm", "a.ppm", "a.bmp"]


@pytest.fixture(params=NAMES)
def image(request, tmp_path):
    """A complete image file in each readable format."""
    from PIL import Image  # comes with matplotlib

    path = tmp_path / request.param
    array = picture() if path.suffix in (".exr", ".hdr", ".pfm") else (255 * picture()).astype(np.uint8)
    if request.param in ("progressive.jpg", "restarts.jpg", "a.bmp"):
        options = {"progressive.jpg": {"progressive": True}, "restarts.jpg": {"restart_marker_rows": 2}}
        Image.fromarray(array).save(path, **options.get(request.param, {}))
    else:
        mi.Bitmap(array).write(str(path))
    return path


def refused(path, **options):
    """Return the message for a refused file, without the file's path at its beginning."""
    with pytest.raises(ConfigError) as caught:
        read_image(path, **options)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


def test_a_complete_file_is_read(image, capfd):
    assert read_image(image, size=(128, 96)).shape == (96, 128, 3)
    image.write_bytes(image.read_bytes() + b"\0" * 500)  # cameras and copies append such bytes
    assert read_image(image).shape == (96, 128, 3)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("share", [0.0, 0.001, 0.25, 0.5, 0.75, 0.9, 0.999])
def test_a_truncated_file_is_refused(image, share, capfd):
    data = image.read_bytes()
    image.write_bytes(data[: int(share * len(data))])
    assert refused(image).startswith("is not a readable image")
    if image.suffix == ".jpg" and share > 0.1:  # zeros in place of the missing part, as of an interrupted download
        image.write_bytes(data[: int(share * len(data))].ljust(len(data), b"\0"))
        assert refused(image).startswith("is not a readable image")
    assert capfd.readouterr() == ("", "")  # libjpeg's messages do not reach the terminal


def png(width, height, data=b""):
    """Return a PNG file whose header gives the size `width` x `height`."""

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def exr(right, bottom):
    """Return the head of an EXR file whose data window ends at pixel (`right`, `bottom`)."""

    def attribute(name, kind, content):
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(content)) + content

    window = struct.pack("<4i", 0, 0, right, bottom)
    return b"\x76\x2f\x31\x01\x02\0\0\0" + attribute(b"dataWindow", b"box2i", window) + b"\0"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"GIF89a" + bytes(100),
        png(0, 7),
        b"\x89PNG\r\n\x1a\n" + bytes(100),
        exr(-1, 5),
        b"\x76\x2f\x31\x01" + b"\x01" * 100,
        b"#?RADIANCE\n\n",
        b"PF\n4 99999999999999999999\n",
        b"\xff\xd8\xff\xd9",
        b"BM",
    ],
)
def test_empty_headers(tmp_path, data):
    path = tmp_path / "a.png"
    path.write_bytes(data)
    assert refused(path).startswith("is not a readable image (EXR, PNG")


@pytest.mark.parametrize("kind", ["pipe", "device", "sparse"])
def test_only_regular_files_are_read(tmp_path, kind):
    path = tmp_path / "a.png"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.touch()
        os.truncate(path, 2**40)
    assert refused(path).startswith(
        "is not a readable image" if kind == "sparse" else "is a pipe, a socket or a device, not a regular"
    )


def with_orientation(path, orientation, channels=3):
    """Write a picture of 7x5 pixels whose EXIF has this orientation, in the form that Pillow writes."""
    from PIL import Image  # comes with matplotlib

    pixels = np.random.default_rng(1).integers(0, 255, (5, 7, channels), dtype=np.uint8)
    image = Image.fromarray(pixels if channels > 1 else pixels[:, :, 0])
    exif = image.getexif()
    exif[0x0112] = orientation
    image.save(path, exif=exif)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("name", "channels"), [("a.jpg", 3), ("a.jpg", 1), ("a.png", 4), ("a.png", 3)])
def test_orientation_matches_pillow(name, channels, orientation, tmp_path):
    from PIL import Image, ImageOps

    path = with_orientation(tmp_path / name, orientation, channels)
    raw, seen = read_bitmap(path), read_bitmap(path, upright=True)
    expected = np.array(ImageOps.exif_transpose(Image.open(path))).reshape(*seen.size()[::-1], channels)
    assert orientation_of(path) == orientation
    assert np.array_equal(np.array(seen).reshape(expected.shape), expected)
    assert list(raw.size()) == [7, 5]
    assert (seen.pixel_format(), seen.srgb_gamma()) == (raw.pixel_format(), raw.srgb_gamma())
    size = (5, 7) if orientation >= 5 else (7, 5)
    assert list(read_bitmap(path, size, upright=True).size()) == list(size)
    if orientation >= 5:
        with pytest.raises(ConfigError, match=r"is 5x7 pixels, turned by 90 degrees .* it must be 7x5"):
            read_bitmap(path, (7, 5), upright=True)


def orientation(value):
    """Return EXIF data with one entry, the orientation `value`."""
    return b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, value, 0, 0)


@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (orientation(6), 6),
        (orientation(0), 1),
        (orientation(9), 1),
        (orientation(6)[:-10], 1),  # cut off within the entry
        (b"MM\0*\xff\xff\xff\xff", 1),
        (b"XX\0*" + orientation(6)[4:], 1),
        (b"MM\0*", 1),
    ],
)
def test_damaged_exif_rotates_nothing(name, data, expected, tmp_path, recwarn):
    from PIL import Image

    Image.new("RGB", (7, 5)).save(tmp_path / name, exif=b"Exif\0\0" + data)
    assert orientation_of(tmp_path / name) == expected
    assert list(read_bitmap(tmp_path / name, upright=True).size()) == ([5, 7] if expected == 6 else [7, 5])
    assert not recwarn.list


def test_a_texture_is_read_unrotated_with_a_message(tmp_path, caplog):
    path = with_orientation(tmp_path / "a.png", 8)
    assert read_image(path).shape == (5, 7, 3)
    assert f"{path}: the stored orientation is used, not turned by 90 degrees counter" in caplog.text


# Images: formats, colour spaces, and refused files.


def write(path, array):
    mi.Bitmap(np.ascontiguousarray(array)).write(str(path))
    return path


def srgb(value: float) -> float:
    """Return the linear value of an sRGB-encoded value (IEC 61966-2-1)."""
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
        with pytest.raises(ConfigError, match="is not a readable image"):
            read_image(tmp_path / name)


# Photographs at the size of a film: pixels are means of light, and marks of clipped or transparent pixels stay.


def smaller(path: Path, values: np.ndarray, size: tuple[int, int]) -> Path:
    """Write `values` as an image, and return a version of this image with fewer pixels."""
    bitmap = mi.Bitmap(np.ascontiguousarray(values))
    bitmap.set_srgb_gamma(values.dtype.kind == "u")
    source = path / ("photo.png" if values.dtype.kind == "u" else "photo.exr")
    bitmap.write(str(source))
    photo = open_photograph(source)
    assert photo.is_integer is (values.dtype.kind == "u")
    written = path / f"small{source.suffix}"
    write_smaller(photo, size, written)
    return written


def test_pixels_are_means_of_light(tmp_path: Path) -> None:
    values = np.random.default_rng(0).integers(0, 250, (12, 20, 3), dtype=np.uint8)
    found = read_image(smaller(tmp_path, values, (5, 4)))
    expected = decode_srgb(values.astype(np.float32) / 255).reshape(4, 3, 5, 4, 3).mean(axis=(1, 3))
    assert np.allclose(found, expected, atol=2e-5)  # 16-bit precision


def test_partly_covered_pixels_are_weighted(tmp_path: Path) -> None:
    values = np.random.default_rng(0).uniform(0, 5, (5, 7, 3)).astype(np.float32)
    found = read_image(smaller(tmp_path, values, (3, 2)))
    fine = np.repeat(np.repeat(values, 2, axis=0), 3, axis=1)  # divisible by both sizes
    assert np.allclose(found, fine.reshape(2, 5, 3, 7, 3).mean(axis=(1, 3)), rtol=1e-5)


def test_partly_clipped_pixels_stay_clipped(tmp_path: Path) -> None:
    values = np.full((8, 8, 3), 100, dtype=np.uint8)
    values[2, 6, 1] = 255
    pixels = np.array(mi.Bitmap(str(smaller(tmp_path, values, (2, 2)))))
    assert np.argwhere(pixels == 65535).tolist() == [[0, 1, 1]]


def test_partly_transparent_pixels_stay_transparent(tmp_path: Path) -> None:
    values = np.full((8, 8, 4), 100, dtype=np.uint8)
    values[5, 1, 3] = 0
    pixels = np.array(mi.Bitmap(str(smaller(tmp_path, values, (2, 2)))))
    assert np.argwhere(pixels[:, :, 3] == 0).tolist() == [[1, 0]]
    assert (np.delete(pixels[:, :, 3].ravel(), 2) == 65535).all()


def test_non_finite_pixels_stay_isolated(tmp_path: Path) -> None:
    values = np.ones((6, 6, 3), dtype=np.float32)
    values[0, 5, 2] = np.inf
    pixels = np.array(mi.Bitmap(str(smaller(tmp_path, values, (3, 3)))))
    assert np.argwhere(~np.isfinite(pixels)).tolist() == [[0, 2, 2]]
    assert np.allclose(pixels[np.isfinite(pixels)], 1)
