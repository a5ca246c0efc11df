"""Photographs at the size of a film: means of light, and marks of what is clipped or transparent that stay."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.scene.images import decode_srgb, read_image
from reslrb_cli.scene.proposal import open_photograph, write_smaller

pytestmark = pytest.mark.usefixtures("llvm")


def smaller(path: Path, values: np.ndarray, size: tuple[int, int]) -> Path:
    """The file `values` as an image, and then with fewer pixels."""
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
    assert np.allclose(found, expected, atol=2e-5)  # of 16 bits


def test_pixels_take_their_share_of_those_between_them(tmp_path: Path) -> None:
    values = np.random.default_rng(0).uniform(0, 5, (5, 7, 3)).astype(np.float32)
    found = read_image(smaller(tmp_path, values, (3, 2)))
    fine = np.repeat(np.repeat(values, 2, axis=0), 3, axis=1)  # by which both sizes divide
    assert np.allclose(found, fine.reshape(2, 5, 3, 7, 3).mean(axis=(1, 3)), rtol=1e-5)


def test_what_is_clipped_in_part_stays_clipped(tmp_path: Path) -> None:
    values = np.full((8, 8, 3), 100, dtype=np.uint8)
    values[2, 6, 1] = 255
    pixels = np.array(mi.Bitmap(str(smaller(tmp_path, values, (2, 2)))))
    assert np.argwhere(pixels == 65535).tolist() == [[0, 1, 1]]


def test_what_is_transparent_in_part_stays_transparent(tmp_path: Path) -> None:
    values = np.full((8, 8, 4), 100, dtype=np.uint8)
    values[5, 1, 3] = 0
    pixels = np.array(mi.Bitmap(str(smaller(tmp_path, values, (2, 2)))))
    assert np.argwhere(pixels[:, :, 3] == 0).tolist() == [[1, 0]]
    assert (np.delete(pixels[:, :, 3].ravel(), 2) == 65535).all()


def test_what_is_not_finite_stays_so_and_reaches_no_other(tmp_path: Path) -> None:
    values = np.ones((6, 6, 3), dtype=np.float32)
    values[0, 5, 2] = np.inf
    pixels = np.array(mi.Bitmap(str(smaller(tmp_path, values, (3, 3)))))
    assert np.argwhere(~np.isfinite(pixels)).tolist() == [[0, 2, 2]]
    assert np.allclose(pixels[np.isfinite(pixels)], 1)
