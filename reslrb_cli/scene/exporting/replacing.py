"""Puts the values that a scene's parameters have into the description that the scene was built from."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from ...errors import ConfigError
from ...records.file_names import file_stem
from ...records.images import write_file
from ..catalog import parameter_kind
from ..description.element import Element
from ..description.naming import Owners
from ..values import Slot
from .elements import child, colour, number, remove, replace, transform, triple
from .meshes import put_mesh
from .parts import Parts

#: What gives a place in another way than `to_world`, by tag.
_OTHER_PLACES = {
    "shape": ("center", "radius", "p0", "p1"),
    "emitter": ("direction", "position"),
}
#: BSDFs whose `eta` is that of the inside over that of the outside.
_RELATIVE_INDEX = ("dielectric", "roughdielectric", "thindielectric", "plastic", "roughplastic")
#: What Mitsuba leaves out of a `principled` BSDF for good where it begins at 0.
LOBES = (
    *("anisotropic", "clearcoat", "diff_trans", "flatness", "metallic"),
    *("sheen", "sheen_tint", "spec_tint", "spec_trans"),
)
_CONDUCTORS = ("conductor", "roughconductor")


class Replacing:
    """The description of a scene, whose `params` have the values that it is to get; `parts` are the files beside it."""

    def __init__(self, root: Element, params: mi.SceneParameters, parts: Parts, source: object) -> None:
        self.params, self.parts, self.source = params, parts, source
        self._owners = Owners(root)

    def put(self, key: str) -> None:
        """Put the value of the scene parameter `key` in. Raises ConfigError where the description cannot say it."""
        node = self.params.properties[key][2]
        place = self._owners.place(self.params, key)
        if place is None:
            raise self._fail(key, "what it belongs to does not stand in the scene's files")
        owner, (*below, name) = place
        if below:
            self._put_nested(owner, below, name, key)
        elif isinstance(node, mi.Mesh) and name != "to_world":
            put_mesh(owner, node, self.parts, key)
        elif name == "to_world":
            replace(owner, transform(owner, name, self.params[key]), *_OTHER_PLACES.get(owner.tag, ()))
        elif name == "position":
            replace(owner, triple(owner, "point", name, self._array(key)), "to_world")
        elif name == "data":
            self._put_image(owner, key)
        elif name == "value" and owner.type == "srgb":
            replace(owner, colour(owner, "color", self._array(key), bounded=False))
        elif name == "value" and owner.type == "rawconstant" and self._array(key).size == 3:
            replace(owner, triple(owner, "vector", name, self._array(key)))
        else:
            self._put_number(owner, name, self._array(key), key)

    def _put_nested(self, owner: Element, below: list[str], name: str, key: str) -> None:
        """A value of something below `owner` that is no object in the scene's files."""
        if name == "value" and len(below) == 1:
            self._put_spectrum(owner, below[0], key)
        elif name == "value" and below[0] == "bsdf" and len(below) == 2 and owner.tag == "shape":
            bsdf = child(owner, "bsdf", type_="diffuse")  # Mitsuba's own, where a shape has none
            bsdf.children.append(colour(bsdf, below[1], self._array(key), bounded=True))
            owner.children.append(bsdf)
        else:
            raise self._fail(key, "what it belongs to does not stand in the scene's files")

    def _put_number(self, owner: Element, name: str, value: Any, key: str) -> None:
        if value.size != 1:
            raise self._fail(key, f"{owner.type} has no way to be given {value.size} numbers as its {name}")
        if name == "eta" and owner.type in _RELATIVE_INDEX:
            replace(owner, number(owner, "ext_ior", 1.0))
            replace(owner, number(owner, "int_ior", float(value)))
        elif owner.type == "principled" and name in ("eta", "specular"):
            replace(owner, number(owner, name, float(value)), "eta", "specular")
        else:
            replace(owner, number(owner, name, float(value)))

    def _put_spectrum(self, owner: Element, name: str, key: str) -> None:
        if owner.type == "spot" and name == "texture":
            raise self._fail(key, "a spot's texture is an image for Mitsuba; recover its intensity in place of it")
        if owner.type in _CONDUCTORS and name in ("eta", "k"):
            # A material's name gives both, and either stands in its place with the other alone.
            stem = key.rpartition(f".{name}.value")[0]
            for each in ("eta", "k"):
                replace(owner, colour(owner, each, self._array(f"{stem}.{each}.value"), bounded=False), "material")
            return
        if owner.type in ("principled", "principledthin") and name in LOBES and self._array(key).any():
            given = next((item for item in owner.children if item.name == name), None)
            if given is None or (given.tag == "float" and float(given.attributes["value"]) == 0):
                why = f"a {owner.type} has no such lobe where its file has no {name}, or 0, and so it had no effect"
                raise self._fail(key, why)
        bounded = parameter_kind(self.params, key) == "bsdf"
        replace(owner, colour(owner, name, self._array(key), bounded))

    def _put_image(self, owner: Element, key: str) -> None:
        image = self._array(key)
        self.parts.add(owner, file_stem(key), ".exr", lambda path: write_file(path, image, linear=True))
        if owner.tag == "texture":
            # Its values are linear as they stand, in a file of floats, and not to be rounded to fewer bits.
            replace(owner, child(owner, "string", name="format", value="variant"))
            remove(owner, {"color_space", "gamma"})

    def _array(self, key: str) -> Any:
        return Slot(self.params, key).get()

    def _fail(self, key: str, why: str) -> ConfigError:
        return ConfigError(self.source, key, f"cannot be exported: {why}")


def same_values(a: Any, b: Any) -> bool:
    """Whether two values of a parameter agree but for rounding; a grey agrees with the same number in each channel."""
    x, y = _numbers(a), _numbers(b)
    if x is None or y is None:
        return x is y
    if x.shape != y.shape and 1 not in (x.size, y.size):
        return False
    scale = max(float(np.abs(x).max(initial=0)), 1e-30)
    return bool(np.allclose(x, y, rtol=1e-5, atol=1e-6 * scale))


def _numbers(value: Any) -> Any:
    """A parameter's value as an array; None of what is no number."""
    try:
        array = np.array(value.matrix if "AffineTransform" in type(value).__name__ else value)
    except (RuntimeError, TypeError):
        return None
    return array.astype(np.float64) if array.dtype.kind in "buif" else None
