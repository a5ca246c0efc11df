"""The picture of scenes/prism by a tracer of its own, in NumPy: Snell's and Fresnel's laws at two plane faces, for each
wavelength and each place in the slit. It shares no code with the package or Mitsuba.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import colour
import numpy as np

#: Sellmeier coefficients of the glass F2 (SCHOTT), and the lines d, F and C in nm.
B, C = (1.34533359, 0.209073176, 0.937357162), (0.00997743871, 0.0470450767, 111.886764)
LINES = np.array([587.5618, 486.1327, 656.2725])
#: Film (width, height), and the scene in dm and degrees, in the plane (x, z).
FILM, FOV = (96, 32), 14.0
SLIT, BEAM, HALF_WIDTH, HEIGHT = np.array([-0.85584, -0.25322]), 24.0, 0.005, 0.07
INRADIUS, SCREEN, SCREEN_TURN, EYE = 0.14433757, np.array([1.9332, -0.7825]), -64.7, np.array([1.0291, -0.3552])
ALBEDO, LIGHT = 0.8, 40.0
#: Wavelengths in nm, and places in the slit.
STEP, PLACES = 1.0, 41
WAVELENGTHS = np.arange(380.0, 780.0, STEP)


def sellmeier(nm: np.ndarray, B: tuple[float, ...] = B, C: tuple[float, ...] = C) -> np.ndarray:
    """Return the index of F2, or of a glass with other coefficients."""
    square = (nm / 1000) ** 2
    return np.sqrt(1 + sum(b * square / (square - c) for b, c in zip(B, C, strict=True)))


def index(nm: np.ndarray, nd: float | None = None, Vd: float | None = None) -> np.ndarray:
    """Return the index of a glass with the dispersion curve of F2, scaled to n_d and V_d."""
    d, F, C_ = sellmeier(LINES)
    nd, Vd = d if nd is None else nd, (d - 1) / (F - C_) if Vd is None else Vd
    return nd + (nd - 1) / Vd * (sellmeier(nm) - d) / (F - C_)


@functools.cache
def picture(nd: float | None = None, Vd: float | None = None) -> np.ndarray:
    """Return the sum of the picture over its rows, (width, 3), in linear sRGB."""
    return picture_of(lambda nm: index(nm, nd, Vd))


def picture_of(glass: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the same for the index that `glass` returns at wavelengths in nm."""
    along, across = axes(90 - BEAM)[0], axes(90 - BEAM)[1]
    places = (np.arange(PLACES) + 0.5) / PLACES * 2 - 1
    nm, offset = (grid.ravel() for grid in np.meshgrid(WAVELENGTHS, HALF_WIDTH * places, indexing="ij"))
    n = glass(nm)
    o = SLIT[:, None] + across[:, None] * offset
    d, flux = np.repeat(along[:, None], len(n), 1), np.ones(len(n))
    for turn, relative in ((-60.0, n), (60.0, 1 / n)):
        normal = axes(turn)[0][:, None]
        o = o + d * ((INRADIUS - (o * normal).sum(0)) / (d * normal).sum(0))
        d, passed = refract(d, normal if turn > 0 else -normal, relative)
        flux = flux * passed
    normal, right = (axis[:, None] for axis in axes(SCREEN_TURN))
    o = o + d * (((SCREEN[:, None] - o) * normal).sum(0) / (d * normal).sum(0))
    place = ((o - SCREEN[:, None]) * right).sum(0)

    # Film: the eye looks along -normal, and columns run along `right`.
    half = np.tan(np.radians(FOV) / 2) * float(np.linalg.norm(SCREEN - EYE))
    u = (1 + place / half) / 2 * FILM[0]
    pixel = (2 * half / FILM[0]) ** 2
    area = 2 * HALF_WIDTH * HEIGHT / PLACES
    spectra = colour_of(nm) * (flux * illuminant(nm) * STEP * area * ALBEDO / np.pi / pixel)[:, None]
    return splat(u, spectra, FILM[0])


def image(nd: float | None = None, Vd: float | None = None) -> np.ndarray:
    """Return the picture (height, width, 3) in linear sRGB. All rows show the same colours."""
    half = np.tan(np.radians(FOV) / 2) * float(np.linalg.norm(SCREEN - EYE))
    v = FILM[1] / 2 + np.linspace(-0.5, 0.5, 1001) * HEIGHT / (2 * half) * FILM[0]
    rows = splat(v, np.ones((len(v), 1)), FILM[1])[:, 0]
    return (rows / rows.sum())[:, None, None] * picture(nd, Vd)


def axes(turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes z and x of a frame that is turned about y by some degrees, in the plane (x, z)."""
    angle = np.radians(turn)
    return np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])


def refract(d: np.ndarray, normal: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return refracted directions (2, N) and the transmittance (N,). `normal` points along the light, and `n` is the
    index behind the boundary divided by that before it.
    """
    cos = (d * normal).sum(0)
    sine = (d - cos * normal) / n
    cos_t = np.sqrt(1 - (sine**2).sum(0))
    s = (cos - n * cos_t) / (cos + n * cos_t)
    p = (n * cos - cos_t) / (n * cos + cos_t)
    return sine + cos_t * normal, 1 - (s**2 + p**2) / 2


def colour_of(nm: np.ndarray) -> np.ndarray:
    """Return the linear sRGB (N, 3) of monochromatic light of 1 W, with a luminance of 1 for a uniform spectrum."""
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    xyz = np.stack([np.interp(nm, observer.wavelengths, observer.values[:, i]) for i in range(3)], -1)
    return xyz / 106.856895 @ colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T


def illuminant(nm: np.ndarray) -> np.ndarray:
    """Return D65 with the luminance of a uniform spectrum of `LIGHT`."""
    d65, observer = colour.SDS_ILLUMINANTS["D65"], colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    grid = np.arange(380.0, 780.0, 1.0)
    y = np.interp(grid, observer.wavelengths, observer.values[:, 1])
    whole = (y * np.interp(grid, d65.wavelengths, d65.values)).sum() / y.sum()
    return LIGHT * np.interp(nm, d65.wavelengths, d65.values) / whole


def splat(u: np.ndarray, values: np.ndarray, size: int) -> np.ndarray:
    """Return the values (N, C) at places u (N,) on a film through Mitsuba's Gaussian filter, summed per pixel."""
    result, first = np.zeros((size, values.shape[1])), np.floor(u).astype(int)
    columns = [first + i for i in range(-3, 4)]
    weights = [np.maximum(np.exp(-2 * (c + 0.5 - u) ** 2) - np.exp(-8.0), 0) * (abs(c + 0.5 - u) <= 2) for c in columns]
    whole = sum(weights)
    for column, weight in zip(columns, weights, strict=True):
        inside = (column >= 0) & (column < size)
        np.add.at(result, column[inside], values[inside] * (weight / whole)[inside, None])
    return result
