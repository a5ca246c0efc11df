"""Conversion between values in a configuration and values in the scene."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.parameters import RunValue, Settings
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.run_folder import read_value
from reslrb_cli.scene.catalog import halo
from reslrb_cli.scene.graph import look_up
from reslrb_cli.scene.images import read_image

Array = np.ndarray[Any, Any]


class Place:
    """Place of a value in the configuration. `fail` names the place in errors.

    `at` maps an option's name to its name in the configuration, or to "" if the value has no options there.
    """

    def __init__(self, source: object, key: str, at: Callable[[str], str] = str) -> None:
        self.source, self.key, self.at = source, key, at

    def fail(self, option: str, message: str) -> ConfigError:
        """Return the ConfigError for one `option` of the configuration value at this place."""
        option = self.at(option)
        return ConfigError(self.source, f"{self.key}.{option}" if option else self.key, message)


#: Textures of colours. Scenes mark them as `raw`, too, if their own files are linear.
COLOURS = re.compile(r"(reflectance|transmittance|base_color|color\d|radiance|irradiance|intensity)\.data$")


class ParameterValue:
    """One value of `holder` as a NumPy array: a texture (H, W, C), a colour (C,), a buffer (N,), or a number ().

    `holder` is a scene's `mi.traverse`, or a mapping of values outside of the scene. The array of an environment map
    lacks the halo columns that Mitsuba adds.
    """

    def __init__(self, holder: Any, key: str) -> None:
        self.holder, self.key = holder, key
        value = holder[key]
        node = holder.properties[key][2] if hasattr(holder, "properties") else None
        self.type = type(value)
        self.is_tensor = bool(dr.is_tensor_v(value))
        self.is_texture = self.is_tensor and len(value.shape) == 3
        self.halo = 0 if node is None else halo(node, value)
        #: True for offsets and heights. Colours are never negative.
        self.is_signed = node is None
        self._node = node
        #: Length of a list that fills the parameter.
        self.channels = _channels(node, key, value, self.is_tensor)

    @property
    def is_data(self) -> bool:
        """True for heights, and for `raw` textures that are no colours. Files of 8 bits are then linear."""
        if self._node is None:
            return True
        return not COLOURS.search(self.key) and re.search(r"^  raw = 1,$", str(self._node), re.MULTILINE) is not None

    def get(self) -> Array:
        """Return the current value."""
        return self.shown(self.holder[self.key])

    def shown(self, value: Any) -> Array:
        """Convert `value`, a Dr.Jit value of this parameter, to an array with the shape that `get` returns."""
        array = np.array(dr.detach(value), dtype=np.float32)
        if not self.is_tensor and array.ndim and array.shape[-1] == 1:
            array = array[..., 0]
        return array[:, self.halo : array.shape[1] - self.halo] if self.halo else array

    def set(self, array: Array) -> None:
        """Set the value. For a scene, call `params.update()` afterwards."""
        if self.halo:
            array = np.concatenate([array[:, -self.halo :], array, array[:, : self.halo]], axis=1)
        array = np.ascontiguousarray(array, dtype=np.float32)
        value = self.type(array) if self.is_tensor or array.ndim else self.type(float(array))
        # A sum, because an array in NumPy's memory would be used directly. Kernels depend on its alignment, which is
        # random, so a later step with Dr.Jit's own arrays would recompile them.
        value = self.type(value + dr.opaque(mi.Float, 0))
        dr.make_opaque(value)
        self.holder[self.key] = value


def initial_array(
    slot: ParameterValue, initial: Any, resolution: tuple[int, int] | None, place: Place, any_size: bool = False
) -> Array:
    """Return the initial value of the parameter in `slot` from "scene", a number, a list, an image file, a run, or an
    array of the parameter's shape.

    `resolution` is the (width, height) to which a texture is resampled, or None. With `any_size`, the value keeps the
    resolution of the file. Raises ConfigError at `place`.
    """
    current, resizable = slot.get(), any_size or resolution is not None
    if resolution is not None:
        if not slot.is_texture:
            raise place.fail("resolution", f"`{slot.key}` is not a texture and cannot be resampled")
        least = [2, 3] if slot.halo else [2, 2]
        if resolution[0] < least[0] or resolution[1] < least[1]:
            raise place.fail("resolution", f"must be at least {least}; Mitsuba has no smaller textures")
    if isinstance(initial, str):
        array = current
    elif isinstance(initial, (int, float)):
        array = np.full_like(current, initial)
    elif isinstance(initial, np.ndarray):
        array = _fitted(slot, current, initial, place)
    elif isinstance(initial, (list, tuple)):
        array = _fill(slot, current, list(initial), place)
    elif isinstance(initial, RunValue):
        array = _from_run(slot, current, initial.run, resizable, place)
    else:
        array = _from_file(slot, current, initial, resizable, place)
    if resolution is not None and array.shape[:2] != resolution[::-1]:
        array = resample(array, resolution)
    if (bad := first_entry(array, ~np.isfinite(array))) is not None:
        raise place.fail("initial", f"`{slot.key}` has {bad}; all values must be finite")
    return array


def check_bounds(slot: ParameterValue, array: Array, bounds: tuple[float, float], place: Place) -> None:
    """Raise ConfigError at `place` if an entry of `array` lies outside of `bounds`."""
    low, high = np.float32(bounds[0]), np.float32(bounds[1])
    if (outside := first_entry(array, (array < low) | (array > high))) is not None:
        raise place.fail("bounds", f"exclude the initial value of `{slot.key}`, {outside}")


def check_transform(slot: ParameterValue, array: Array, spec: Settings, place: Place) -> None:
    """Raise ConfigError at `place` if an entry of `array` is outside of the range of the transform."""
    if spec.transform == "none":
        return
    bounded = spec.transform == "sigmoid"
    low, high = (spec.bounds or (-np.inf, np.inf)) if bounded else (0.0, np.inf)
    outside = (array <= np.float32(low)) | (array >= np.float32(high))
    if isinstance(spec.initial, RunValue) and bounded:
        # Between close bounds, rounding may have moved a run's value onto one; the optimiser starts at the nearest
        # value that the transform can represent.
        outside = (array < np.float32(low)) | (array > np.float32(high))
    if (value := first_entry(array, outside)) is not None:
        yields = f"values between its bounds, {low:g} and {high:g}" if bounded else "positive values"
        problem = f"`{slot.key}` starts at {value}; transform: {spec.transform} yields only {yields}"
        raise place.fail("initial", problem)


def resample(array: Array, resolution: tuple[int, int]) -> Array:
    """Resample an (H, W, C) image to `resolution` (width, height) by means over areas. An image that grows is
    interpolated linearly.
    """
    from reslrb_cli.lens.transport import resized  # late, because SciPy takes a while to load

    return np.asarray(resized(array, resolution[::-1], between=True), dtype=np.float32)


def _channels(node: Any, key: str, value: Any, is_tensor: bool) -> int:
    if is_tensor:
        return int(value.shape[-1])
    shape, kind = dr.shape(value), key.rpartition(".")[2].partition("_")[0]
    if len(shape) == 1 and kind in ("vertex", "face") and hasattr(node, "vertex_count"):
        return int(shape[0]) // int(node.vertex_count() if kind == "vertex" else node.face_count())
    return int(shape[0])


def _fill(slot: ParameterValue, current: Array, numbers: list[float], place: Place) -> Array:
    if len(numbers) != slot.channels:
        has = "1 number" if slot.channels == 1 else f"{slot.channels} numbers"
        raise place.fail("initial", f"has {len(numbers)} numbers; `{slot.key}` takes {has}")
    return np.tile(np.array(numbers, dtype=np.float32), current.size // len(numbers)).reshape(current.shape)


def _fitted(slot: ParameterValue, current: Array, array: Array, place: Place) -> Array:
    """Return an array in the parameter's shape. One number, or one for each channel, fills the parameter."""
    if array.shape == (slot.channels,):
        return _fill(slot, current, array.tolist(), place)
    try:
        return np.broadcast_to(array, current.shape).copy()
    except ValueError:
        message = f"is of shape {array.shape}; it must have the parameter's shape {current.shape}"
        raise place.fail("", message) from None


def _from_file(slot: ParameterValue, current: Array, image_file: Any, any_size: bool, place: Place) -> Array:
    if not slot.is_texture:
        raise place.fail("initial", f"`{slot.key}` is not a texture; give a number or a list of numbers")
    path: Path = image_file.file
    is_linear = slot.is_data and image_file.color_space == "auto"
    try:
        image = read_image(path, "linear" if is_linear else image_file.color_space, signed=slot.is_signed)
    except ConfigError as error:
        raise place.fail("initial.file", f"{path}: {error.message}") from None
    if not any_size and image.shape[:2] != current.shape[:2]:
        message = f"{path} is {_size(image)}, the texture {_size(current)}; {_resample_hint(place)}"
        raise place.fail("initial.file", message)
    if slot.channels == 1:
        if (image != image[..., :1]).any():
            raise place.fail("initial.file", f"{path} is coloured, but `{slot.key}` has one channel; use a grey image")
        return image[..., :1]
    if slot.channels != 3:
        raise place.fail("initial.file", f"{path} has 3 channels, but `{slot.key}` has {slot.channels}")
    return image


def _from_run(slot: ParameterValue, current: Array, run: Path, any_size: bool, place: Place) -> Array:
    try:
        array = read_value(run, slot.key)
    except ConfigError as error:
        raise place.fail("initial.run", str(error)) from None
    is_like = slot.is_texture and array.ndim == 3 and array.shape[2] == current.shape[2]
    if array.shape == current.shape or (is_like and any_size):
        return np.asarray(array, dtype=np.float32)
    if is_like:
        has = f"with {_size(array)} texels, the texture has {_size(current)}; {_resample_hint(place)}"
    else:
        shapes = ["x".join(map(str, value.shape)) or "one number" for value in (array, current)]
        has = f"of shape {shapes[0]}, but in the scene of shape {shapes[1]}"
    raise place.fail("initial.run", f"{run} has `{slot.key}` {has}")


def _resample_hint(place: Place) -> str:
    has_options = place.at("resolution") != ""
    return "give `resolution: [width, height]` to resample" if has_options else "use an image of this size"


def _size(image: Array) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def first_entry(array: Array, mask: Array) -> str | None:
    """Return, in words, the first entry of `array` in `mask` with its index, or None if there is none."""
    if not mask.any():
        return None
    value, index = f"{float(array[mask].flat[0]):g}", [int(n) for n in np.argwhere(mask)[0]]
    if array.ndim == 3:
        return f"{value} at texel ({index[1]}, {index[0]}), channel {index[2]}"
    return value if array.ndim == 0 else f"{value} at entry {index[0] if len(index) == 1 else index}"


def settle(params: mi.SceneParameters, keys: Iterable[str]) -> list[Any]:
    """Compute data that depend on newly set parameters at once. Returns the arrays to evaluate.

    A texture pads its storage at its first lookup, and removes the padding when the texture is read. The normals of a
    mesh depend on its vertices. If a step computed data derived from textures or meshes, Dr.Jit would split the step's
    kernels. The split would differ between the first and the second step.
    """
    normals = []
    for key in keys:
        node = params.properties[key][2]
        if isinstance(node, mi.Texture):
            look_up(node)
        elif isinstance(node, mi.Mesh) and node.has_vertex_normals():
            normals.append(node.vertex_normals_buffer())
    return normals
