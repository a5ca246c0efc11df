"""Images: formats, colour spaces, photographs, and incomplete or damaged files."""

from __future__ import annotations

import io
import itertools
import os
import struct
import zlib
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from kit import profile_of

from reslrb_cli.errors import ConfigError
from reslrb_cli.scene import images
from reslrb_cli.scene.images import orientation_of, photo_lines, read_image, read_photo, read_stored
from reslrb_cli.scene.proposal import write_smaller
from reslrb_cli.scene.response import LINEAR, decode_srgb

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
    is_known = share > {".pfm": 0, ".ppm": 0, ".jpg": 0.1}.get(image.suffix, 1)
    assert refused(image).startswith("is truncated" if is_known else "is not a readable image")
    if image.suffix == ".jpg" and share > 0.1:  # zeros in place of the missing part, as of an interrupted download
        image.write_bytes(data[: int(share * len(data))].ljust(len(data), b"\0"))
        assert refused(image) == "is truncated: the image has no end"
    assert capfd.readouterr() == ("", "")  # libjpeg's messages do not reach the terminal


def chunk(kind, content):
    """Return a chunk of a PNG file."""
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width, height, depth=8, kind=2, data=b"", more=b""):
    """Return a PNG file with this header. `data` are its rows, and `more` are chunks before them."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)) + more
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")


def exr(right, bottom, left=0, top=0):
    """Return the head of an EXR file whose data window ends at pixel (`right`, `bottom`)."""

    def attribute(name, kind, content):
        return name + b"\0" + kind + b"\0" + struct.pack("<i", len(content)) + content

    window = struct.pack("<4i", left, top, right, bottom)
    return b"\x76\x2f\x31\x01\x02\0\0\0" + attribute(b"dataWindow", b"box2i", window) + b"\0"


@pytest.mark.parametrize(("left", "top"), [(0, 0), (3, 5), (-3, -5)])
def test_the_window_of_an_exr_can_begin_anywhere(left, top, tmp_path):
    assert images._exr(tmp_path / "a.exr", io.BytesIO(exr(left + 6, top + 9, left, top))).size == (7, 10)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"GIF89a" + bytes(100),
        png(0, 7),
        b"\x89PNG\r\n\x1a\n" + bytes(100),
        b"\x76\x2f\x31\x01" + b"\x01" * 100,
        b"#?RADIANCE\n\n",
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
    raw, seen = read_stored(path), read_stored(path, upright=True)
    expected = np.array(ImageOps.exif_transpose(Image.open(path))).reshape(*seen.size[::-1], channels)
    assert orientation_of(path) == orientation
    assert np.array_equal(seen.pixels, expected)
    assert raw.size == (7, 5)
    assert seen.names == raw.names
    size = (5, 7) if orientation >= 5 else (7, 5)
    assert read_stored(path, size, upright=True).size == size
    if orientation >= 5:
        with pytest.raises(ConfigError, match=r"is 5x7 pixels, turned by 90 degrees .* it must be 7x5"):
            read_stored(path, (7, 5), upright=True)


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
    assert read_stored(tmp_path / name, upright=True).size == ((5, 7) if expected == 6 else (7, 5))
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
        (np.ones((4, 6, 7), np.float32), "has the channels ch0, ch1, .*; use an image with R, G and B"),
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


# Every kind of file, written by other programs or by the specification: depth, maximum, byte order, colour type.

HEIGHT, WIDTH = 3, 5


def fractions(channels, seed=0):
    """Return random values in [0, 1], (H, W, C), with the ends 0 and 1."""
    values = np.random.default_rng(seed).uniform(0, 1, (HEIGHT, WIDTH, channels))
    values[0, 0], values[0, 1] = 0, 1
    return values


def whole(channels, limit):
    return np.round(fractions(channels) * limit).astype(int)


def netpbm(kind, limit):
    """Return a PGM or PPM file, binary or plain, and its values."""
    values = whole(1 if kind in "25" else 3, limit)
    text = " ".join(map(str, values.ravel())).encode()
    body = text if kind in "23" else values.astype(">u2" if limit > 255 else "u1").tobytes()
    return f"P{kind}\n# a comment\n{WIDTH} {HEIGHT}\n{limit}\n".encode() + body, values / limit


def pfm(kind, order):
    values = fractions(3 if kind == "F" else 1).astype(np.float32)
    head = f"P{kind}\n{WIDTH} {HEIGHT}\n{'-1.0' if order == '<' else '1.0'}\n".encode()
    return head + values[::-1].astype(f"{order}f4").tobytes(), values


def png_of(depth, kind):
    """Return a PNG file. `kind` is its colour type: 0 grey, 2 RGB, 3 palette, 4 and 6 with alpha."""
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[kind]
    values = whole(channels, 2**depth - 1)
    bits = (values.reshape(HEIGHT, -1, 1) >> np.arange(depth)[::-1]) & 1
    rows = np.packbits(bits.reshape(HEIGHT, -1).astype(np.uint8), axis=1)
    colours = np.random.default_rng(5).integers(0, 256, (2**depth, 3), dtype=np.uint8) if kind == 3 else None
    data = b"".join(b"\0" + row.tobytes() for row in rows)
    header = (WIDTH, HEIGHT, depth, kind)
    if colours is not None:
        return png(*header, data, chunk(b"PLTE", colours.tobytes())), colours[values[:, :, 0]] / 255
    seen = values[:, :, : channels - (kind in (4, 6))] / (2**depth - 1)
    return png(*header, data), seen


def bmp(mode):
    from PIL import Image

    values = whole(4 if mode == "RGBA" else 3, 255).astype(np.uint8)
    if mode == "RGBA":
        image = Image.fromarray(values)
    else:
        image = Image.fromarray(values).quantize(7) if mode == "P" else Image.fromarray(values).convert(mode)
    stream = io.BytesIO()
    image.save(stream, "BMP")
    seen = np.array(image.convert("RGB"))
    return stream.getvalue(), seen / 255


def exr_of(names, type_, primaries=None):
    """Return an EXR file with channels of these names by OpenEXR. Red is .25, green .5 and blue .75."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= {} if primaries is None else {"chromaticities": primaries}
    values = {"R": 0.25, "G": 0.5, "B": 0.75, "Y": 0.25}
    planes = {name: np.full((HEIGHT, WIDTH), values.get(name[-1].upper(), 9), type_) for name in names}
    stream = io.BytesIO()
    OpenEXR.File(header, planes).write(stream)
    is_grey = not any(name.endswith(("B", "b")) for name in names)
    return stream.getvalue(), np.full((HEIGHT, WIDTH, 3), 0.25 if is_grey else [0.25, 0.5, 0.75])


LAYERS = ["ViewLayer.Combined.R", "ViewLayer.Combined.G", "ViewLayer.Combined.B", "ViewLayer.Combined.A"]
KINDS = {
    **{f"P{kind}-{limit}": (netpbm, kind, limit)
       for kind, limit in itertools.product("2356", (1, 100, 255, 1023, 65535))},
    **{f"P{kind}{order}": (pfm, kind, order) for kind, order in itertools.product("Ff", "<>")},
    **{f"png-{depth}-{kind}": (png_of, depth, kind)
       for depth, kind in itertools.product((1, 2, 4, 8, 16), (0, 2, 3, 4, 6))
       if depth in {0: (1, 2, 4, 8, 16), 3: (1, 2, 4, 8)}.get(kind, (8, 16))},
    **{f"bmp-{mode}": (bmp, mode) for mode in ("1", "L", "P", "RGB", "RGBA")},
    **{f"exr-{' '.join(names)}-{type_.__name__}": (exr_of, names, type_)
       for names in ("RGB", "RGBA", "rgb", "RGBZ", "Y", "YA", ["V"], LAYERS, [*LAYERS, "ViewLayer.Depth.Z"],
                     [*LAYERS, "ViewLayer.Albedo.R", "ViewLayer.Albedo.G", "ViewLayer.Albedo.B"])
       for type_ in (np.float16, np.float32) if names != ["V"]},
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_file_has_its_values(kind, tmp_path, capfd):
    make, *options = KINDS[kind]
    data, expected = make(*options)
    path = tmp_path / "image"
    path.write_bytes(data)
    found = read_image(path, "linear", size=(WIDTH, HEIGHT))
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), atol=1e-6)
    assert capfd.readouterr() == ("", "")


def test_channels_of_an_exr_have_their_own_types(tmp_path):
    import OpenEXR

    planes = {"Albedo.R": np.zeros((2, 2), np.float16)}
    planes |= {name: np.full((2, 2), 1e6 + place, np.float32) for place, name in enumerate("RGB")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, planes).write(str(tmp_path / "a.exr"))
    assert read_image(tmp_path / "a.exr")[0, 0].tolist() == [1e6, 1e6 + 1, 1e6 + 2]


def test_primaries_of_an_exr_are_converted_with_or_without_other_channels(tmp_path):
    acescg = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
    for name, channels in (("a.exr", "RGB"), ("b.exr", "RGBZ"), ("grey.exr", "YZ")):
        (tmp_path / name).write_bytes(exr_of(channels, np.float32, acescg)[0])
    assert (read_image(tmp_path / "grey.exr") == 0.25).all()
    alone = np.array(mi.Bitmap(str(tmp_path / "a.exr")))
    np.testing.assert_allclose(read_image(tmp_path / "a.exr"), alone, rtol=1e-6)
    np.testing.assert_allclose(read_image(tmp_path / "b.exr"), alone, rtol=1e-3)
    assert abs(alone[0, 0] - [0.25, 0.5, 0.75]).max() > 0.02


def test_alpha_is_that_of_the_layer_of_the_colours(tmp_path):
    import OpenEXR

    planes = {name: np.full((2, 2), 0.5, np.float32) for name in LAYERS}
    planes |= {"A": np.zeros((2, 2), np.float32), "ViewLayer.Combined.A": np.float32([[1, 1], [0, 0.25]])}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, planes).write(str(tmp_path / "a.exr"))
    photo = read_photo(tmp_path / "a.exr")
    assert photo.alpha.tolist() == [[1, 1], [0, 0.25]]
    assert np.argwhere(photo.transparent).tolist() == [[1, 0]]


def test_channels_without_a_layer_come_first(tmp_path):
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    planes = {f"{layer}{name}": np.full((2, 2), value, np.float32)
              for layer, value in (("", 0.25), ("Combined.", 0.5)) for name in "RGB"}  # fmt: skip
    OpenEXR.File(header, planes).write(str(tmp_path / "a.exr"))
    assert (read_image(tmp_path / "a.exr") == 0.25).all()


def test_the_first_of_several_parts_of_an_exr_is_read(tmp_path):
    import OpenEXR

    planes = {value: {letter: np.full((2, 2), value, np.float32) for letter in "RGB"} for value in (0.25, 0.5)}
    parts = [OpenEXR.Part({"type": OpenEXR.scanlineimage}, planes[value], f"part {value}") for value in planes]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    assert (read_image(tmp_path / "a.exr") == 0.25).all()


def test_several_layers_are_refused(tmp_path):
    (tmp_path / "a.exr").write_bytes(exr_of(["a.R", "a.G", "a.B", "b.R", "b.G", "b.B"], np.float32)[0])
    assert refused(tmp_path / "a.exr") == "has the layers a, b; save the one of the image alone"


@pytest.mark.parametrize("seed", range(10))
def test_a_photograph_with_a_video_behind_it_is_read(seed, tmp_path):
    """Phones append a second image, or a video of arbitrary bytes."""
    from PIL import Image

    path = tmp_path / "a.jpg"
    Image.fromarray((255 * picture()).astype(np.uint8)).save(path)
    data, video = path.read_bytes(), np.random.default_rng(seed).bytes(20000)
    path.write_bytes(data + video)
    assert read_image(path).shape == (96, 128, 3)
    path.write_bytes(data[: len(data) // 2])
    assert refused(path) == "is truncated: the image has no end"


def test_the_first_of_several_images_is_read(tmp_path):
    from PIL import Image

    first, second = (Image.new("RGB", (8, 4), colour) for colour in ("red", "blue"))
    first.save(tmp_path / "a.jpg", "MPO", save_all=True, append_images=[second])
    assert read_image(tmp_path / "a.jpg", size=(8, 4))[0, 0, 0] > 0.9


@pytest.mark.parametrize(
    ("name", "size"), [("png", None), ("png", (8, 8)), ("ppm", None), ("exr", None), ("hdr", None)]
)
def test_the_size_is_checked_before_pixels_are_decoded(name, size, tmp_path, monkeypatch):
    data = {
        "png": png(12000, 12000, 8, 2),
        "ppm": b"P6 12000 12000 255\n",
        "exr": exr(11999, 11999),
        "hdr": b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 12000 +X 12000\n",
    }
    path = tmp_path / "a"
    path.write_bytes(data[name])
    monkeypatch.setattr(mi, "Bitmap", None)
    wanted = "it must be 8x8" if size else "an image has at most 134217728 pixels"
    assert refused(path, size=size) == f"is 12000x12000 pixels; {wanted}"
    path.write_bytes(png(30000, 30000, 8, 2))
    assert "too many pixels; an image has at most 134217728 pixels" in refused(path, size=size)


# Colour profiles. The expected colours come from colour-science.


@pytest.mark.parametrize("space", ["Display P3", "Adobe RGB (1998)"])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_colour_profiles_are_converted(space, suffix, tmp_path):
    import colour
    from PIL import Image

    values = np.tile(np.array([[[90, 140, 100], [200, 180, 170], [60, 60, 60]]], np.uint8).repeat(16, 1), (16, 1, 1))
    path, options = tmp_path / f"a.{suffix}", {"quality": 100, "subsampling": 0} if suffix == "jpg" else {}
    Image.fromarray(values).save(path, icc_profile=profile_of(space, 2.2), **options)
    linear = colour.RGB_to_RGB((values / 255) ** 2.2, space, "sRGB", chromatic_adaptation_transform="Bradford")
    seen = read_image(path)
    np.testing.assert_allclose(seen, linear, atol=0.006)  # bytes
    assert abs(decode_srgb(values / 255.0) - linear).max() > 0.03
    assert photo_lines(path) == [f"{path}: colours are converted from its profile {space} to sRGB"]
    raw = read_image(path, "linear")
    np.testing.assert_allclose(raw, values / 255, atol=0.01)
    assert photo_lines(path, response=LINEAR) == [
        f"{path}: its colour profile {space} is ignored, as the response is linear"
    ]


def test_profiles_of_srgb_change_nothing_and_damaged_ones_neither(tmp_path):
    from PIL import Image, ImageCms

    values = whole(3, 255).astype(np.uint8)
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for profile in (own, b"no profile", profile_of("Display P3", 2.2)[:200]):
        Image.fromarray(values).save(tmp_path / "a.png", icc_profile=profile)
        assert np.array_equal(read_image(tmp_path / "a.png", "linear"), np.float32(values) / np.float32(255))
        np.testing.assert_allclose(read_image(tmp_path / "a.png"), decode_srgb(values / 255.0), atol=1e-6)
        assert photo_lines(tmp_path / "a.png") == photo_lines(tmp_path / "a.png", response=LINEAR) == []


def test_a_profile_of_16_bits_is_refused_unless_values_are_linear(tmp_path):
    profile = chunk(b"iCCP", b"P3\0\0" + zlib.compress(profile_of("Display P3", 2.2)))
    (tmp_path / "a.png").write_bytes(png(1, 1, 16, 2, b"\0" + struct.pack(">3H", 100, 200, 300), profile))
    assert refused(tmp_path / "a.png").startswith("has the colour profile Display P3 in 16 bits; convert it to sRGB")
    assert read_image(tmp_path / "a.png", "linear")[0, 0, 2] == np.float32(300 / 65535)


@pytest.mark.parametrize("space", ["Display P3", "SMPTE C"])  # a wider and a narrower gamut than sRGB
def test_clipped_and_transparent_pixels_of_a_profile_stay_marked(space, tmp_path):
    from PIL import Image

    values = np.full((2, 2, 4), 100, np.uint8)
    values[0, 0, 0], values[1, 1, 3] = 255, 0
    Image.fromarray(values).save(tmp_path / "a.png", icc_profile=profile_of(space, 2.2))
    photo = read_photo(tmp_path / "a.png")
    assert (np.argwhere(photo.clipped).tolist(), np.argwhere(photo.transparent).tolist()) == ([[0, 0]], [[1, 1]])


# Photographs at the size of a film: pixels are means of light, and marks of clipped or transparent pixels stay.


def smaller(path: Path, values: np.ndarray, size: tuple[int, int]) -> Path:
    """Write `values` as an image, and return a version of this image with fewer pixels."""
    bitmap = mi.Bitmap(np.ascontiguousarray(values))
    bitmap.set_srgb_gamma(values.dtype.kind == "u")
    source = path / ("photo.png" if values.dtype.kind == "u" else "photo.exr")
    bitmap.write(str(source))
    photo = read_stored(source, upright=True)
    assert (photo.white is not None) is (values.dtype.kind == "u")
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


@pytest.mark.parametrize("data", [b"P5 2 1 100\n\x64\0", b"P2 2 1 65535\n65535 0\n", b"P2 #\n2 1 1 1 0 and more"])
def test_values_are_at_most_the_maximum(data, tmp_path):
    (tmp_path / "a.pgm").write_bytes(data)
    assert read_image(tmp_path / "a.pgm", "linear")[0, :, 0].tolist() == [1, 0]


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"P5 2 1 0\n\0\0", "has 0 in its header in place of a maximum of 1 to 65535"),
        (b"P5 2 1 65536\n\0\0\0\0", "has 65536 in its header in place of a maximum of 1 to 65535"),
        (b"P2 2 1 25.5\n1 1", "has 25.5 in its header in place of a maximum of 1 to 65535"),
        (b"Pf 1 1 0\n\0\0\0\0", "has 0 in its header in place of a scale other than 0"),
        (b"PF 1 1 1e999\n" + bytes(12), "has 1e999 in its header in place of a scale other than 0"),
        (b"P5 2 1 100\n\x65\0", "has the value 101, but its maximum is 100"),
        (b"P2 2 1 100\n101 0\n", "has the value 101, but its maximum is 100"),
        (b"P2 2 1 100\n-1 0\n", "has -1 in place of a value"),
        (b"P3 1 1 100\n0 0 x\x1b\n", r"has x\\x1b in place of a value"),
        (b"P2 2 1 100\n1\n", "is truncated: it has 1 of 2 values"),
        (b"P5 2 1 100\n", "is truncated: it has 0 of 2 values"),
        (b"P6 1 1 256\n\0\1\0\1\0", "is truncated: it has 2 of 3 values"),
        (b"PF 1 1 -1\n\0\0\0\0\0", "is truncated: it has 1 of 3 values"),
        (b"P6 0 5 255\n", "is 0x5 pixels, so it is empty"),
        (exr(-1, 5), "is 0x6 pixels, so it is empty"),
        (b"PF\n4 99999999999999999999\n", "has a damaged header: PF must precede width, height and scale"),
        (b"P6 2 1\n", "has a damaged header: P6 must precede width, height and maximum"),
        (b"P5 2 -1 255\n\0\0", "has a damaged header: P5 must precede width, height and maximum"),
        (b"Pf 2 1 1e\n", "has a damaged header: Pf must precede width, height and scale"),
    ],
)
def test_reasons_of_damaged_headers_and_portable_maps(data, reason, tmp_path):
    (tmp_path / "a.pnm").write_bytes(data)
    with pytest.raises(ConfigError, match=rf"a\.pnm: {reason}$"):
        read_image(tmp_path / "a.pnm")


@pytest.mark.parametrize(
    ("head", "is_read"),
    [
        (b"P6 1 1 255\n", True),
        (b"P6 1 1 254\n", False),
        (b"P5 1 1 255\n", False),
        (b"PF 1 1 -1\n", True),
        (b"Pf 1 1 1\n", True),
    ],
)
def test_portable_pixmaps_that_mitsuba_reads(head, is_read, tmp_path):
    (tmp_path / "a.pnm").write_bytes(head)
    with (tmp_path / "a.pnm").open("rb") as file:
        assert (images._netpbm(tmp_path / "a.pnm", file).wrong == "") is is_read


def test_a_wrong_pixel_is_located_and_pixels_are_counted_once(tmp_path):
    pixels = np.ones((2, 3, 3), np.float32)
    pixels[1, 2] = -1, -2, 3
    pixels[1, 0, 1] = -3
    write(tmp_path / "a.exr", pixels)
    with pytest.raises(ConfigError, match=r"pixel \(0, 1\), channel G, is -3: negative \(2 pixels in all\)"):
        read_image(tmp_path / "a.exr")


def test_a_pixel_is_clipped_if_one_channel_is(tmp_path):
    write(tmp_path / "a.png", np.uint8([[[255, 0, 0], [254, 254, 254], [255, 255, 255], [0, 0, 0]]]))
    assert read_photo(tmp_path / "a.png").clipped.tolist() == [[True, False, True, False]]


@pytest.mark.parametrize("restart", range(0xD0, 0xD8))
def test_every_restart_of_a_jpeg_is_skipped(restart):
    start = bytes([0xFF, 0xD8, 0xFF, 0xE0, 0, 4, 0xFF, 0xD9])  # the end inside of a segment does not count
    assert images._ends(start + bytes([0xFF, restart, 0xFF, 0, 0xFF, 0xD9]))
    assert not images._ends(start + bytes([0xFF, restart, 0xFF, 0]))


def test_alpha_is_a_share(tmp_path):
    pixels = np.full((2, 3, 4), 0.5, np.float32)
    pixels[0, :, 3] = 0, 0.25, 2
    write(tmp_path / "a.exr", pixels)
    write(tmp_path / "a.png", np.uint8(np.minimum(pixels, 1) * 255))
    for name in ("a.exr", "a.png"):
        photo = read_photo(tmp_path / name)
        np.testing.assert_allclose(photo.alpha[0], [0, 0.25, 1], atol=1 / 255)
        assert photo.transparent[0].tolist() == [True, False, False]
