"""Tints of textures: factors per channel that multiply all texels.

A scene may know the pattern of a texture, but not its colour. A tint then has one number for each channel, where the
texture has thousands. A step adds its gradient to the texels, and `collect` propagates it to the tint (`Leaf` in
`deformation.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.config.parameters import tint_of
from reslrb_cli.scene.deformation import Leaf, collect, push
from reslrb_cli.scene.upsampling import Upsampling


def tint_obstacle(params: mi.SceneParameters, key: str) -> str | None:
    """Return the reason why the parameter `key` has no tint, or None."""
    value, node = params[key], params.properties[key][2]
    is_bitmap = node.class_name().startswith("BitmapTexture") and key.endswith(".data") and dr.is_tensor_v(value)
    if not is_bitmap or len(value.shape) != 3:
        return "is no bitmap texture; only bitmap textures have a tint"
    if value.shape[2] not in (1, 3):
        return f"has {value.shape[2]} channels; a texture with a tint has 1 or 3"
    return None


@dataclass
class _Tinted(Leaf):
    """Texture with its texels for a tint of 1 (`base`), and its `value`, the tint."""

    key: str = ""
    base: Any = None
    value: Any = None


@dataclass
class Tints:
    """All recovered tints of a scene. A mapping from names to tints. `colours` has the textures whose spectra are in
    the scene, in a spectral variant.
    """

    params: mi.SceneParameters
    colours: Upsampling
    _found: dict[str, _Tinted] = field(default_factory=dict)

    def __contains__(self, name: str) -> bool:
        return name in self._found

    def __getitem__(self, name: str) -> Any:
        return self._found[name].value

    def __setitem__(self, name: str, value: Any) -> None:
        self._found[name].value = value

    def add(self, key: str) -> str:
        """Recover a tint of the texture `key`, and return its name. The texture must have no obstacle."""
        self.colours.add(key)
        base = self._holder(key)[key]
        base = type(base)(dr.detach(base)) + dr.opaque(mi.Float, 0)
        value = dr.opaque(mi.Color3f if base.shape[2] == 3 else mi.Float, 1)
        dr.make_opaque(base, value)
        self._found[tint_of(key)] = _Tinted(key=key, base=base, value=value)
        return tint_of(key)

    @property
    def names(self) -> list[str]:
        """Names of the recovered tints."""
        return list(self._found)

    @property
    def keys(self) -> list[str]:
        """Scene parameters that have the tinted texels."""
        return [found.key for found in self._found.values()]

    def place(self) -> list[Any]:
        """Set the scene's textures from the tints, as `Deformation.place`. Call `colours.place` afterwards."""
        for found in self._found.values():
            base, texel = found.base, dr.arange(mi.UInt32, found.base.shape[0] * found.base.shape[1])
            texels = dr.gather(type(found.value), base.array, texel) * found.value
            self._holder(found.key)[found.key] = found.place(type(base)(dr.ravel(texels), base.shape))
        return [found.leaf for found in self._found.values()]

    def collect(self) -> None:
        """Propagate the gradients at the texels to the tints. Call `colours.collect` before."""
        collect(self._found.values())

    def push(self) -> None:
        """Propagate tangents of the tints to the texels. Call `colours.push` afterwards."""
        push(self._found.values())

    def _holder(self, key: str) -> Any:
        return self.colours if key in self.colours else self.params
