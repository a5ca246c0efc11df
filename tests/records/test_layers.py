"""EXR files of named layers: whole or absent, readable by others, and never a surprise when they are damaged."""

from __future__ import annotations

import numpy as np
import pytest

from reslrb_cli.records.images import read_layers, write_layers


def layers():
    generator = np.random.default_rng(4)
    shapes = {"image": (6, 5, 3), "z": (6, 5), "grey": (6, 5, 1), "alpha": (6, 5, 4), "spectrum": (6, 5, 12)}
    return {name: generator.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def test_layers_are_read_as_they_were_written(tmp_path):
    written = layers()
    write_layers(tmp_path / "a.exr", written)
    read = read_layers(tmp_path / "a.exr")
    assert set(read) == set(written)
    for name, array in written.items():
        np.testing.assert_array_equal(read[name], array[:, :, None] if array.ndim == 2 else array)
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_other_programs_find_the_channels(tmp_path):
    """Mitsuba's reader, by the names that every reader knows."""
    import mitsuba as mi

    written = layers()
    write_layers(tmp_path / "a.exr", {name: written[name] for name in ("image", "z")})
    bitmap = mi.Bitmap(str(tmp_path / "a.exr"))
    fields = {field.name: place for place, field in enumerate(bitmap.struct_())}
    assert set(fields) == {"image.R", "image.G", "image.B", "z.Y"}
    np.testing.assert_array_equal(np.array(bitmap)[:, :, fields["image.G"]], written["image"][:, :, 1])


def test_an_image_without_layers_is_one_without_a_name(tmp_path, llvm):
    from reslrb_cli.records.images import write_image

    image = np.abs(layers()["image"])
    write_image(tmp_path / "a", image)
    np.testing.assert_array_equal(read_layers(tmp_path / "a.exr")[""], image)


def test_one_that_does_not_fit_is_not_there(tmp_path, file_size_limit):
    with file_size_limit(300), pytest.raises(OSError, match=r"a\.exr"):
        write_layers(tmp_path / "a.exr", layers())
    assert list(tmp_path.iterdir()) == []


def test_damaged_files_are_said_to_be(tmp_path):
    write_layers(tmp_path / "a.exr", layers())
    whole = (tmp_path / "a.exr").read_bytes()
    for damaged in (b"", b"no image", whole[:60], whole[: len(whole) // 2]):
        (tmp_path / "b.exr").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"b\.exr"):
            read_layers(tmp_path / "b.exr")
    with pytest.raises(OSError, match="gone"):
        read_layers(tmp_path / "gone.exr")
