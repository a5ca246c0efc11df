"""Responses of cameras: decoding, the basis of curves, and values that count as clipped."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from reslrb_cli.config.response import KNOTS, Response
from reslrb_cli.scene.images import read_photo
from reslrb_cli.scene.response import DARKEST_VALUE, LINEAR, MIDDLE, SRGB, basis, clipped_level, decode, shown, start

VALUES = np.linspace(0, 1, 101)
FILM = Response(curve=[0.8, 0.9, 1, 1.3, 2, 5])


def srgb(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def test_known_responses():
    np.testing.assert_allclose(srgb(decode(SRGB, VALUES)), VALUES, atol=1e-7)
    np.testing.assert_array_equal(decode(LINEAR, VALUES), VALUES)
    np.testing.assert_allclose(decode(Response(gamma=1.8), VALUES), VALUES**1.8)
    np.testing.assert_allclose(decode(Response(curve=[1] * KNOTS), VALUES), decode(SRGB, VALUES))


def test_the_contrasts_are_those_of_the_curve():
    """At the knots, and linear in the values between them. The curve equals sRGB at the middle."""
    step = 1e-3
    for value, expected in [(0.2, 0.9), (0.4, 1), (0.6, 1.3), (0.8, 2), (0.7, 1.65), (0.9, 3.5), (0.1, 0.85)]:
        light, other = (np.log(decode(each, value + step * np.array([-1.0, 1.0]))) for each in (FILM, SRGB))
        assert np.diff(light)[0] / np.diff(other)[0] == pytest.approx(expected, rel=5e-3)
    middle = np.atleast_1d(srgb(np.float64(MIDDLE)))
    np.testing.assert_allclose(decode(FILM, middle), MIDDLE, rtol=1e-5)


def test_curves_are_monotone_and_dark_values_are_proportional():
    assert np.all(np.diff(decode(FILM, np.linspace(0, 1.2, 1000))) > 0)
    ratio = decode(FILM, np.array([0.01, 0.02, DARKEST_VALUE])) / decode(SRGB, np.array([0.01, 0.02, DARKEST_VALUE]))
    np.testing.assert_allclose(ratio, ratio[0])


@pytest.mark.parametrize("kind", ["gamma", "curve"])
def test_a_recovered_response_is_decoded_like_the_given_one(kind):
    """The light by the basis is that of a response with the same numbers, and `shown` is the inverse."""
    numbers = [1.7] if kind == "gamma" else FILM.curve
    given = Response(gamma=1.7) if kind == "gamma" else FILM
    values = np.linspace(DARKEST_VALUE, 1, 50)
    decoded = decode(Response.model_validate({kind: "auto"}).fixed(), values)
    light = decoded * np.exp(np.tensordot(np.array(numbers) - start(kind), basis(kind, decoded), 1))
    if kind == "curve":
        np.testing.assert_allclose(light, decode(given, values), rtol=1e-6)
    else:  # below 0.04 of linear light, which the values of a gamma reach later, a gamma is a straight line
        np.testing.assert_allclose(light[4:], decode(given, values)[4:], rtol=1e-6)
    np.testing.assert_allclose(shown(kind, np.array(numbers), light), decoded, rtol=1e-4)
    np.testing.assert_allclose(shown(kind, np.array(numbers), np.array([0.0, 1e-9]))[0], 0)


@pytest.mark.parametrize(("response", "levels"), [(SRGB, (255, 65535, 3)), (Response(gamma=2.2), (255, 65535, 3)),
                                                  (Response(curve=[1, 1, 1, 1, 3, 16]), (212, 65535, 3))])  # fmt: skip
def test_values_count_as_clipped_if_a_step_is_large(response, levels):
    for white, level in zip((255, 65535, 3), levels, strict=True):
        assert clipped_level(response, white) == level


@pytest.mark.usefixtures("llvm")
def test_a_file_is_decoded_and_its_clipped_pixels_are_found(tmp_path):
    pixels = np.array([[[10, 128, 200], [245, 0, 0], [255, 1, 1], [0, 0, 0]]], np.uint8)
    mi.Bitmap(pixels).write(str(tmp_path / "a.png"))
    steep = Response(curve=[1, 1, 1, 1, 3, 16])
    for response, clipped in ((None, [0, 0, 1, 0]), (steep, [0, 1, 1, 0]), (LINEAR, [0, 0, 1, 0])):
        photo = read_photo(tmp_path / "a.png", response)
        assert photo.clipped.tolist() == [[bool(each) for each in clipped]]
        np.testing.assert_allclose(photo.image, decode(response or SRGB, pixels / 255.0), rtol=1e-5)
