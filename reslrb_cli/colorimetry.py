"""Measured spectra of colour-science by name, and chromatic adaptation: the colours of a scene under other light.

Colours are linear sRGB for the CIE 1931 observer, which is also the observer of Mitsuba's RGB films. Wavelengths are in
nm.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from reslrb_cli.errors import known_name

Array = np.ndarray[Any, Any]

#: The illuminant whose light is white in linear sRGB.
WHITE = "D65"


def import_colour() -> Any:
    """Import the package `colour` late, because the import takes a second. Hide its warnings about optional
    packages.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour


def find_illuminant(name: str) -> str:
    """Return the name of an illuminant as colour-science spells it. Raises ValueError for an unknown name."""
    return known_name("illuminant", name, import_colour().SDS_ILLUMINANTS)


def illuminant(name: str, wavelengths: Array) -> Array:
    """Return the values of an illuminant. Their luminance equals that of a uniform spectrum of 1. The wavelengths are
    evenly spaced and visible. Raises ValueError for an unknown name.
    """
    spectrum, observer = import_colour().SDS_ILLUMINANTS[find_illuminant(name)], _observer(wavelengths)[1]
    values = np.interp(wavelengths, spectrum.wavelengths, spectrum.values, left=0, right=0)
    return np.asarray(values * (observer.sum() / (observer @ values)))


def colour_of(values: Array, wavelengths: Array) -> Array:
    """Return the colour (3,) of emission with these values at evenly spaced wavelengths. A uniform spectrum of 1 has a
    luminance of 1.
    """
    observer = _observer(wavelengths)
    xyz = observer @ values / observer[1].sum()
    return np.asarray(import_colour().RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB @ xyz)


def _observer(wavelengths: Array) -> Array:
    observer = import_colour().MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    return np.stack([np.interp(wavelengths, observer.wavelengths, observer.values[:, i]) for i in range(3)])


def sensitivity(camera: str, channel: str) -> tuple[Array, Array]:
    """Return wavelengths and values of the sensitivity of a camera's channel. The most sensitive channel has an
    integral of 1. Raises ValueError for an unknown camera or channel.
    """
    cameras = {name.partition(" (")[0]: curves for name, curves in import_colour().MSDS_CAMERA_SENSITIVITIES.items()}
    curves = cameras[known_name("camera", camera, cameras)]
    number = curves.labels.index(known_name("channel", channel, curves.labels))
    step = float(curves.wavelengths[1] - curves.wavelengths[0])
    return curves.wavelengths, curves.values[:, number] / (step * curves.values.sum(0).max())


def adaptation(before: str, after: str) -> Array:
    """Return the matrix (3, 3) by which colours under the illuminant `before` become colours under `after`.

    The matrix is Bradford's. Factors for the channels of sRGB are less accurate. On a colour chart under A, their mean
    CIEDE2000 is 3.1 instead of 1.9.
    """
    colour, wavelengths = import_colour(), np.arange(360.0, 831.0, 1.0)
    observer, to_xyz = _observer(wavelengths), colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ
    whites = [observer @ illuminant(name, wavelengths) / observer[1].sum() for name in (before, after)]
    matrix = colour.adaptation.matrix_chromatic_adaptation_VonKries(*whites, transform="Bradford")
    return np.asarray(np.linalg.inv(to_xyz) @ matrix @ to_xyz)
