"""Images and EXR files of named layers: complete or absent, with the given contents."""

from __future__ import annotations

import gc
import json
import sys

import numpy as np
import pytest

from reslrb_cli.records import images
from reslrb_cli.records.images import (
    FORMATS,
    as_bytes,
    finite_range,
    load_image,
    luminance,
    read_layers,
    read_mask,
    read_parameters,
    write_file,
    write_image,
    write_layers,
    write_mask,
    write_parameters,
)

# Images are whole or absent in every format, and contain the given values.


def make_image(channels=3):
    return np.random.default_rng(3).uniform(0, 1, (40, 30, channels)).astype(np.float32)


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("suffix", [".exr", ".hdr", ".pfm", ".png", ".jpg"])
def test_every_format_can_be_read_back(tmp_path, suffix):
    import mitsuba as mi

    assert suffix in FORMATS
    image, linear = make_image(), suffix in (".exr", ".hdr", ".pfm")
    write_file(tmp_path / f"a.key{suffix}", image, linear)
    read = mi.Bitmap(str(tmp_path / f"a.key{suffix}"))
    if not linear:
        read = read.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=False)
    off = np.abs(np.array(read)[:, :, :3] - image).mean()
    assert off < {".exr": 1e-6, ".pfm": 1e-6, ".hdr": 0.01, ".png": 0.01}.get(suffix, 0.2)
    assert [path.name for path in tmp_path.iterdir()] == [f"a.key{suffix}"]


@pytest.mark.usefixtures("llvm")
def test_an_incomplete_image_is_removed(tmp_path, file_size_limit):
    with file_size_limit(500), pytest.raises(OSError, match=r"final\.png"):
        write_file(tmp_path / "final.png", make_image(), linear=False)
    with file_size_limit(300), pytest.raises(OSError, match=r"a\.exr"):
        write_layers(tmp_path / "a.exr", layers())
    with file_size_limit(300), pytest.raises(OSError, match=r"wall\.data\.exr"):
        write_parameters(tmp_path, {"wall.data": make_image()})
    mask = np.random.default_rng(3).uniform(size=(64, 64)) > 0.5
    with file_size_limit(4300), pytest.raises(OSError, match="mask"):
        write_mask(tmp_path, "wall.data", np.tile(mask, (2, 2)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("llvm")
def test_a_heightmap_is_shown_from_lowest_to_highest(tmp_path):
    from matplotlib.image import imread

    heights = np.linspace(-1e-3, 2e-3, 12, dtype=np.float32).reshape(3, 4, 1)
    write_parameters(tmp_path, {"face.heightmap": heights, "wall.data": np.abs(heights)})
    assert np.array_equal(load_image(tmp_path / "face.heightmap.exr"), heights)
    seen = imread(tmp_path / "face.heightmap.png")
    assert (seen.min(), seen.max()) == (0, 1)
    assert np.all(np.diff(seen.ravel()[: heights.size]) >= 0)
    assert imread(tmp_path / "wall.data.png").max() < 0.1


@pytest.mark.usefixtures("llvm")
def test_small_values_are_listed_and_large_ones_are_only_in_the_archive(tmp_path):
    values = {"a.value": np.arange(64.0), "b.value": np.arange(65.0), "a.data": make_image(1)}
    write_parameters(tmp_path, values)
    listed = json.loads((tmp_path / "parameters.json").read_text())
    assert listed == {"a.value": {"shape": [64], "value": list(range(64))}, "b.value": {"shape": [65]},
                      "a.data": {"shape": [40, 30, 1], "file": "a.data.exr"}}  # fmt: skip
    with np.load(tmp_path / "parameters.npz") as archive:
        assert all(np.array_equal(archive[key], value) for key, value in values.items())


@pytest.mark.usefixtures("llvm")
def test_missing_and_damaged_images_are_none(tmp_path):
    (tmp_path / "damaged.exr").write_bytes(b"\x76\x2f\x31\x01 and no more")
    assert load_image(tmp_path / "damaged.exr") is load_image(tmp_path / "missing.exr") is None
    for content in (b"", b"\x93NUMPY and no more", b"no array"):
        (tmp_path / "key.mask.npy").write_bytes(content)
        (tmp_path / "parameters.npz").write_bytes(content)
        assert (read_mask(tmp_path, "key"), read_parameters(tmp_path)) == (None, {})
    np.save(tmp_path / "key.mask.npy", np.ones(3))  # no mask
    assert read_mask(tmp_path, "key") is None


def test_ranges_and_luminances_of_images():
    assert finite_range([np.array([np.nan, 3.0]), np.array([-1.0, np.inf])]) == (-1.0, 3.0)
    assert finite_range([np.full(2, np.nan), np.zeros(0)]) == (0.0, 0.0)
    image = make_image(4)
    np.testing.assert_allclose(luminance(image), image[:, :, :3] @ np.float32([0.212671, 0.71516, 0.072169]), rtol=1e-6)
    for channels in (1, 2):
        assert np.array_equal(luminance(image[:, :, :channels]), image[:, :, 0])


@pytest.mark.usefixtures("llvm")
def test_an_incomplete_checkpoint_keeps_the_previous_one(tmp_path, file_size_limit, monkeypatch):
    from reslrb_cli.records.checkpoint import save_checkpoint

    said = []  # errors of discarded archives
    monkeypatch.setattr(sys, "unraisablehook", said.append)
    save_checkpoint(tmp_path, 1, {"a": np.zeros(3)})
    for size in (100, 2000, 9000):  # in the headers, in the first array, in the last array
        with file_size_limit(size), pytest.raises(OSError, match=r"state\.npz"):
            save_checkpoint(tmp_path, 2, {"a": np.zeros(999), "b": np.zeros(999)})
    with np.load(tmp_path / "state.npz") as state:
        assert int(state["iteration"]) == 1
    gc.collect()
    assert said == []


# EXR files with named layers: whole or absent, readable by other programs, and reported when they are damaged.


def layers():
    generator = np.random.default_rng(4)
    shapes = {"image": (6, 5, 3), "z": (6, 5), "grey": (6, 5, 1), "alpha": (6, 5, 4), "spectrum": (6, 5, 12)}
    return {name: generator.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def test_layers_survive_a_round_trip(tmp_path, llvm):
    written = layers()
    write_layers(tmp_path / "a.exr", written)
    read = read_layers(tmp_path / "a.exr")
    assert set(read) == set(written)
    for name, array in written.items():
        np.testing.assert_array_equal(read[name], array[:, :, None] if array.ndim == 2 else array)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    write_image(tmp_path / "b", np.abs(written["image"]))
    np.testing.assert_array_equal(read_layers(tmp_path / "b.exr")[""], np.abs(written["image"]))


def test_other_programs_find_the_channels(tmp_path):
    """Mitsuba's reader finds the channels by the names that every reader knows."""
    import mitsuba as mi

    written = layers()
    write_layers(tmp_path / "a.exr", {name: written[name] for name in ("image", "z")})
    bitmap = mi.Bitmap(str(tmp_path / "a.exr"))
    fields = {field.name: place for place, field in enumerate(bitmap.struct_())}
    assert set(fields) == {"image.R", "image.G", "image.B", "z.Y"}
    np.testing.assert_array_equal(np.array(bitmap)[:, :, fields["image.G"]], written["image"][:, :, 1])


def test_damaged_files_are_reported(tmp_path):
    write_layers(tmp_path / "a.exr", layers())
    whole = (tmp_path / "a.exr").read_bytes()
    for damaged in (b"", b"no image", whole[:60], whole[: len(whole) // 2]):
        (tmp_path / "b.exr").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"b\.exr"):
            read_layers(tmp_path / "b.exr")
    with pytest.raises(OSError, match="gone"):
        read_layers(tmp_path / "gone.exr")


def test_channels_of_a_layer_have_an_order():
    assert sorted(["Z", "A", "2", "B", "10", "R", "G", "1"], key=images._place) == [*"RGBA", "Z", "1", "2", "10"]


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    ("pixel", "shown"),
    [
        ([0.0, 0.5, 1.0], [0, 188, 255]),
        ([-1.0, np.nan, 2.0], [0, 0, 255]),
        ([np.inf, -np.inf, 0.0], [255, 0, 0]),
        ([1.0, 1.0, 1.0, 0.0], [255, 255, 255]),  # without alpha
        ([0.5, 1.0], [188]),
        ([0.5], [188]),
    ],
)
def test_values_as_bytes(pixel: list[float], shown: list[int]) -> None:
    found = as_bytes(np.float32([[pixel, pixel]]))
    assert (found.shape, found.dtype) == ((1, 2, len(shown)), np.uint8)
    np.testing.assert_allclose(found[0].astype(int), [shown, shown], atol=1)  # Mitsuba dithers
