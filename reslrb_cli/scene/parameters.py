"""The parameters that are recovered: selected by key or glob, checked, and set to where they start."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import mitsuba as mi
import numpy as np

from ..config import ParameterSpec
from ..errors import ConfigError
from .catalog import describe, list_parameters
from .values import Place, Slot, check_bounds, check_transform, initial_array


@dataclass(frozen=True)
class Selection:
    """The parameters that are recovered.

    `params` is all of the scene's `mi.traverse`; `specs` holds the configuration of each selected key, in the order of
    the configuration and, for a glob, of the scene.
    """

    params: Any
    specs: dict[str, ParameterSpec]

    @property
    def keys(self) -> list[str]:
        """The selected keys of `params`."""
        return list(self.specs)

    def spec(self, key: str) -> ParameterSpec:
        """What the configuration says about the selected `key`."""
        return self.specs[key]

    def array(self, key: str) -> np.ndarray[Any, Any]:
        """The current value of `key`: a texture (H, W, C), a colour (C,), a buffer (N,), a number ().

        An environment map comes without the halo columns that its tensor has.
        """
        return Slot(self.params, key).get()

    def set_arrays(self, values: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set parameters in the scene, from arrays as `array` returns them."""
        for key, value in values.items():
            Slot(self.params, key).set(value)
        self.params.update()


def select_parameters(scene: Any, specs: Sequence[ParameterSpec], source: object) -> Selection:
    """Select the parameters of `scene` that `specs` name, and set their initial values in the scene.

    A glob selects what it matches and can be recovered. `source` names the configuration in errors. Raises ConfigError
    where a key matches nothing, or nothing that can be recovered, or what another spec has already; where an initial
    value does not fit, is not finite, or lies outside of the bounds or of what the transform yields; and where a
    resolution is given for no texture.
    """
    params = mi.traverse(scene)
    chosen: dict[str, ParameterSpec] = {}
    origin: dict[str, int] = {}
    for index, spec in enumerate(specs):
        for key in _matching(params, spec.key, Place(source, f"parameters[{index}]")):
            if key in chosen:
                raise ConfigError(
                    source, f"parameters[{index}].key", f"`{key}` is matched by parameters[{origin[key]}] already"
                )
            chosen[key], origin[key] = spec, index
    for key, spec in chosen.items():
        place, slot = Place(source, f"parameters[{origin[key]}]"), Slot(params, key)
        value = initial_array(slot, spec.initial, spec.resolution, place)
        if spec.bounds is not None:
            check_bounds(slot, value, spec.bounds, place)
        check_transform(slot, value, spec, place)
        if spec.initial != "scene" or spec.resolution is not None:
            slot.set(value)
    params.update()
    return Selection(params, chosen)


def _matching(params: Any, pattern: str, place: Place) -> list[str]:
    """The keys that `pattern` names, all of which can be recovered."""
    if pattern in params.properties:
        info = describe(params, pattern)
        if info.obstacle is not None:
            raise place.fail("key", f"`{pattern}` {info.obstacle}")
        return [pattern]
    matches = [key for key in params.properties if fnmatchcase(key, pattern)]
    if not matches:
        near = difflib.get_close_matches(pattern, list(params.properties), n=3, cutoff=0.5)
        near = near or difflib.get_close_matches(pattern, _recoverable(params), n=3, cutoff=0)
        hint = " or ".join(f"`{key}`" for key in near)
        raise place.fail("key", f"`{pattern}` matches no parameter of the scene; did you mean {hint}?")
    infos = [describe(params, key) for key in matches]
    usable = [info.key for info in infos if info.obstacle is None]
    if not usable:
        more = f", nor can the other {len(infos) - 1}" if len(infos) > 1 else ""
        raise place.fail(
            "key",
            f"`{pattern}` matches nothing that can be recovered: `{infos[0].key}` {infos[0].obstacle}{more}",
        )
    return usable


def _recoverable(params: Any) -> list[str]:
    return [info.key for info in list_parameters(params) if info.obstacle is None]
