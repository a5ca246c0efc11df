"""Images and EXR files of named layers: complete or absent, with the given contents."""

from __future__ import annotations

import gc
import sys

import numpy as np
import pytest

from reslrb_cli.records.images import (
    FORMATS,
    load_image,
    read_layers,
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
