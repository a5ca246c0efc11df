"""Colours as parameters of a scene in a spectral variant: recovered values are linear RGB, and the scene has spectra.

Mitsuba replaces a colour by a smooth spectrum with three coefficients c (Jakob and Hanika 2019).

    S(l) = 1/2 + v / (2 sqrt(1 + v^2)),    v = c_0 l^2 + c_1 l + c_2

A table in Mitsuba's package maps colours to coefficients. Here, the coefficients are the solution of the equations
colour(c) = rgb, so they have a derivative with respect to the colour. Emission with the colour E is the spectrum of D65
times 2 max(E) times the spectrum S of E / (2 max(E)).

A step adds its gradient to the coefficients, and `collect` propagates it to the colours (`Leaf` in `deformation.py`).
"""

from __future__ import annotations

import functools
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.installation import package_folder
from reslrb_cli.backend.memory import flat, own_memory
from reslrb_cli.scene.deformation import Leaf, collect, push
from reslrb_cli.scene.rays import visible

Array = np.ndarray[Any, Any]

#: Distance of colours from 0 and 1. Nearer, the spectrum's derivative has no precision left.
DARKEST = 1e-4
#: Least emission, because a lamp without light has no spectrum.
DIMMEST = 1e-30
#: Values below the step of single precision at 0.5. Mitsuba's spectra are 0 there, such as those of black.
UNRESOLVED = 2.0**-25
#: Centre and half of the range of wavelengths, in nm.
CENTRE, WIDTH = 595.0, 235.0
NEWTON_STEPS = 3


def is_upsampled(params: mi.SceneParameters, key: str) -> bool:
    """True if the scene parameter `key` has coefficients of a colour's spectrum."""
    if not mi.is_spectral:
        return False
    node, name = params.properties[key][2], key.rpartition(".")[2]
    if node.class_name() in ("SRGBReflectanceSpectrum", "D65Spectrum"):
        return name == "value"
    if not node.class_name().startswith("BitmapTexture") or name != "data":
        return False
    return params[key].shape[2] == 3 and not re.search(r"^ *raw = 1,$", str(node), re.MULTILINE)


def emitted(key: str) -> str:
    """Return the key of the spectrum of D65 that belongs to the colour `key` of an emitter."""
    return f"{key.removesuffix('.value')}.d65.values"


@functools.lru_cache(maxsize=2)
def _table(variant: str) -> tuple[mi.Float, mi.Float, int]:
    """Return the coefficients, the places along the axis of the largest channel, and the number of places."""
    path = package_folder() / "data" / "srgb.coeff"
    content = path.read_bytes()
    size = int(np.frombuffer(content, np.uint32, 1, 4)[0])
    scale = np.frombuffer(content, np.float32, size, 8)
    data = np.frombuffer(content, np.float32, 9 * size**3, 8 + 4 * size)
    return own_memory(mi.Float, data.copy()), own_memory(mi.Float, scale.copy()), size


def coefficients(rgb: mi.Color3f) -> mi.Color3f:
    """Return the coefficients of the spectrum with a linear colour under D65, with their derivative. Channels outside
    of [0, 1] are clipped, and have the derivative at the limit. Colours that are not finite have no finite
    coefficients.

    Mitsuba interpolates a table, whose colours are off by up to 0.001, and whose derivative by some percent. Newton's
    method starts from it.
    """
    is_finite = dr.all(dr.isfinite(rgb))
    with dr.suspend_grad():
        goal = dr.select(is_finite, dr.clip(dr.detach(rgb), DARKEST, 1 - DARKEST), 0.5)
        # -c is the spectrum 1 - S. The table is precise at dark colours, but not near white.
        is_bright = dr.min(goal) + dr.max(goal) > 1
        start = _from_table(dr.select(is_bright, 1 - goal, goal))
        found = _centred(dr.select(is_bright, -start, start))
        colour, columns = _colour(found)
        for _ in range(NEWTON_STEPS):
            tried = found + _solved(columns, mi.Vector3d(goal) - colour)
            new_colour, new_columns = _colour(tried)
            before, after = (dr.squared_norm(mi.Vector3d(goal) - value) for value in (colour, new_colour))
            found, colour, *columns = (
                dr.select(after < before, new, old)
                for new, old in zip((tried, new_colour, *new_columns), (found, colour, *columns), strict=True)
            )
    moved = mi.Vector3d(rgb) - dr.detach(mi.Vector3d(rgb))  # 0, with a derivative
    found = found + dr.select(is_finite, _solved(columns, moved), dr.nan)
    a, b, c = found
    m, s = CENTRE, 1 / WIDTH
    return mi.Color3f(a * s**2, b * s - 2 * a * m * s**2, a * (m * s) ** 2 - b * m * s + c)


def _centred(c: mi.Color3f) -> mi.Vector3d:
    """Return the coefficients for wavelengths in units of WIDTH from CENTRE."""
    x, y, z = (mi.Float64(part) for part in c)
    return mi.Vector3d(x * WIDTH**2, (y + 2 * x * CENTRE) * WIDTH, (x * CENTRE + y) * CENTRE + z)


def _solved(columns: Sequence[mi.Vector3d], value: mi.Vector3d) -> mi.Vector3d:
    """Return the solution x of the equations x_0 columns_0 + x_1 columns_1 + x_2 columns_2 = value."""
    a, b, c = columns
    normals = dr.cross(b, c), dr.cross(c, a), dr.cross(a, b)
    return mi.Vector3d(*(dr.dot(normal, value) for normal in normals)) / dr.dot(a, normals[0])


def _colour(found: mi.Vector3d) -> tuple[mi.Vector3d, list[mi.Vector3d]]:
    """Return the colour of the spectrum with centred coefficients, and its derivatives by them."""
    a, b, c = found
    zero = mi.Vector3d(0)
    responses, wavelengths = mi.Float64(_responses(mi.variant())[1].ravel()), mi.Float64(visible())

    def add(
        number: mi.UInt32, colour: mi.Vector3d, by_a: mi.Vector3d, by_b: mi.Vector3d, by_c: mi.Vector3d
    ) -> tuple[mi.UInt32, mi.Vector3d, mi.Vector3d, mi.Vector3d, mi.Vector3d]:
        t = (dr.gather(mi.Float64, wavelengths, number) - CENTRE) / WIDTH
        response = dr.gather(mi.Vector3d, responses, number)
        v = (a * t + b) * t + c
        inverse = dr.rsqrt(dr.square(v) + 1)
        slope = response * (0.5 * inverse * dr.square(inverse))
        return (
            number + 1, colour + response * (0.5 + 0.5 * v * inverse), by_a + slope * dr.square(t), by_b + slope * t,
            by_c + slope,
        )  # fmt: skip

    state = mi.UInt32(0), mi.Vector3d(zero), mi.Vector3d(zero), mi.Vector3d(zero), mi.Vector3d(zero)
    _, colour, *columns = dr.while_loop(state, lambda number, *_: number < len(visible()), add, label="colour")
    return colour, columns


def _from_table(rgb: mi.Color3f) -> mi.Color3f:
    """Return the coefficients that Mitsuba's table has for a colour within (0, 1)."""
    data, scale, size = _table(mi.variant())
    green, blue = rgb.y >= rgb.x, rgb.z >= dr.maximum(rgb.x, rgb.y)
    first = dr.select(blue, mi.UInt32(2), dr.select(green, mi.UInt32(1), 0))
    z = dr.select(blue, rgb.z, dr.select(green, rgb.y, rgb.x))
    x = dr.select(blue, rgb.x, dr.select(green, rgb.z, rgb.y)) * ((size - 1) / z)
    y = dr.select(blue, rgb.y, dr.select(green, rgb.x, rgb.z)) * ((size - 1) / z)
    xi, yi = (dr.minimum(mi.UInt32(value), size - 2) for value in (x, y))
    zi = dr.binary_search(0, size - 1, lambda index: dr.gather(mi.Float, scale, index) <= z)
    zi = dr.clip(mi.UInt32(zi), 1, size - 1) - 1
    low, high = (dr.gather(mi.Float, scale, zi + step) for step in (0, 1))
    shares = [(1 - t, t) for t in (x - mi.Float(xi), y - mi.Float(yi), (z - low) / (high - low))]
    result = mi.Color3f(0)
    for corner in range(8):
        dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
        index = ((first * size + zi + dz) * size + yi + dy) * size + xi + dx
        result += dr.gather(mi.Color3f, data, index) * (shares[0][dx] * shares[1][dy] * shares[2][dz])
    return result


def values_of(params: mi.SceneParameters, key: str) -> Any:
    """Return the value of a parameter. In place of the coefficients of colours, return the values of their spectra at a
    few visible wavelengths, one after the other. Texels of environment maps have a fourth number, a scale.
    """
    value = params[key]
    scaled = (
        mi.is_spectral and params.properties[key][2].class_name() == "EnvironmentMapEmitter" and key.endswith("data")
    )
    if not (scaled or is_upsampled(params, key)):
        return value
    c, scale = dr.detach(value), mi.Float(1)
    dr.eval()  # scheduled variables, which would change this kernel in the first step
    if dr.is_tensor_v(value):
        texel = dr.arange(mi.UInt32, value.shape[0] * value.shape[1]) * value.shape[2]
        c = mi.Color3f(*(dr.gather(mi.Float, value.array, texel + channel) for channel in range(3)))
        scale = dr.gather(mi.Float, value.array, texel + 3) if scaled else scale
    else:
        c = mi.Color3f(c)
    found = []
    for wavelength in (420.0, 500.0, 580.0, 660.0):
        v = (c.x * wavelength + c.y) * wavelength + c.z
        found.append(scale * (0.5 + 0.5 * v * dr.rsqrt(dr.square(v) + 1)))
    return dr.ravel(mi.Vector4f(*found))


@functools.lru_cache(maxsize=2)
def _responses(variant: str) -> tuple[Array, Array]:
    """Return D65 (95,), and the responses (95, 3) of linear RGB to reflected D65, which sum to 1 in each channel."""
    wavelengths = mi.Float(visible().astype(np.float32))
    d65 = np.array(mi.cie_d65(wavelengths), np.float64)
    responses = np.array(mi.linear_rgb_rec(wavelengths), np.float64).reshape(3, -1).T * d65[:, None]
    return d65, responses / responses.sum(0)


def colours_of(found: Array) -> Array:
    """Return the linear colours (..., 3) under D65 of the spectra with the coefficients (..., 3)."""
    c = np.asarray(found, np.float64)
    responses, result = _responses(mi.variant())[1], np.zeros(c.shape)
    for wavelength, weight in zip(visible(), responses, strict=True):
        v = (c[..., 0] * wavelength + c[..., 1]) * wavelength + c[..., 2]
        with np.errstate(invalid="ignore"):
            S = np.where(np.isinf(c[..., 2]), c[..., 2] > 0, 0.5 + 0.5 * v / np.sqrt(1 + np.square(v)))
        S = np.where(S < UNRESOLVED, 0, S)
        result += S[..., None] * weight
    return result


def colour_in_scene(params: mi.SceneParameters, key: str) -> Array:
    """Return the linear colours of an upsampled parameter, float32: (3,), or (H, W, 3) for a texture."""
    value = np.array(dr.detach(params[key]), np.float64)
    colours: Array = np.clip(colours_of(value.reshape(-1, 3)), 0, None).reshape(value.shape).astype(np.float32)
    if value.ndim == 2:  # width 1
        colours = colours.ravel()
    if emitted(key) in params.properties:
        spectrum, d65 = np.array(dr.detach(params[emitted(key)]), np.float64), _responses(mi.variant())[0]
        colours = colours * np.float32(spectrum.sum() / d65.sum())
    return colours


@dataclass
class _Upsampled:
    """Colour `value` with its spectrum in the scene: keys of the coefficients, and leaves by key."""

    keys: list[str]
    value: Any
    leaves: dict[str, Leaf] = field(default_factory=dict)


@dataclass
class Upsampling:
    """All recovered colours of a scene with these `params`. A mapping from keys to colours."""

    params: mi.SceneParameters
    _found: dict[str, _Upsampled] = field(default_factory=dict)

    @property
    def properties(self) -> Any:
        """Entries of the scene's parameters, by key."""
        return self.params.properties

    def __contains__(self, key: str) -> bool:
        return key in self._found

    def __getitem__(self, key: str) -> Any:
        return self._found[key].value

    def __setitem__(self, key: str, value: Any) -> None:
        self._found[key].value = value

    def add(self, key: str, others: Sequence[str] = ()) -> None:
        """Recover the colour of `key`, unless the parameter is no colour or is recovered already. The parameters
        `others` share it.
        """
        if key in self._found or key not in self.params.properties or not is_upsampled(self.params, key):
            return
        array, kind = colour_in_scene(self.params, key), type(self.params[key])
        value = kind(array) if dr.is_tensor_v(kind) else kind(*(mi.Float(float(channel)) for channel in array))
        dr.make_opaque(value)
        self._found[key] = _Upsampled([key, *others], value)

    @property
    def keys(self) -> list[str]:
        """Scene parameters that have the recovered colours. The scene's files have elements for these parameters, but
        not for the D65 factors of lamps.
        """
        return [key for found in self._found.values() for key in found.keys]

    def place(self) -> list[Any]:
        """Set the scene's parameters from the colours, as `Deformation.place`."""
        placed = []
        for found in self._found.values():
            for key in found.keys:
                for name, value in self._spectra(key, found.value).items():
                    leaf = found.leaves.setdefault(name, Leaf())
                    placed.append(leaf.place(value))
                    self.params[name] = leaf.leaf
        return placed

    def _spectra(self, key: str, value: Any) -> dict[str, Any]:
        """Return the values of the scene's parameters for a colour."""
        if dr.is_tensor_v(value):
            texel = dr.arange(mi.UInt32, value.shape[0] * value.shape[1])
            found = coefficients(dr.gather(mi.Color3f, value.array, texel))
            return {key: mi.TensorXf(dr.ravel(found), value.shape)}
        if emitted(key) not in self.params.properties:
            return {key: coefficients(value)}
        scale = 2 * dr.maximum(dr.max(value), DIMMEST)
        d65 = mi.Float(_responses(mi.variant())[0].astype(np.float32))
        # Double precision, because the derivative has the square of the scale.
        ratio = mi.Color3f(mi.Vector3d(value) / mi.Float64(scale))
        return {key: coefficients(ratio), emitted(key): d65 * scale}

    def collect(self) -> None:
        """Propagate the gradients at the scene's spectra to the colours."""
        collect(self._leaves())

    def cancellation(self) -> dict[str, float]:
        """Return the condition number of each colour's gradient: the norm of the sums of its terms' magnitudes, divided
        by the norm of the sums. A term belongs to one coefficient of one texel.

        The scene's spectra have gradients, and the colours have none yet. Without a gradient, the number is 1.
        """
        result = {}
        for colour_key, found in self._found.items():
            total, magnitude = np.zeros(1), np.zeros(1)
            for own, name in ((key, name) for key in found.keys for name in (key, emitted(key))):
                if name not in found.leaves:
                    continue
                gradient = flat(dr.grad(found.leaves[name].leaf))
                parts = 3 if name == own else 1  # coefficients, or the values of D65 times a scale
                for part in range(parts):
                    here = dr.select(dr.arange(mi.UInt32, dr.width(gradient)) % parts == part, gradient, 0)
                    colour = type(found.value)(dr.detach(found.value))
                    dr.enable_grad(colour)
                    product = flat(self._spectra(own, colour)[name]) * here
                    # A product with 0 does not depend on the colour.
                    dr.backward(product, dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
                    term = np.array(dr.grad(colour), np.float64)
                    total, magnitude = total + term, magnitude + np.abs(term)
            size = np.linalg.norm(total)
            result[colour_key] = float(np.linalg.norm(magnitude) / size) if size > 0 else 1.0
        return result

    def push(self) -> None:
        """Propagate tangents of the colours to the scene's spectra."""
        push(self._leaves())

    def _leaves(self) -> list[Leaf]:
        return [leaf for found in self._found.values() for leaf in found.leaves.values()]
