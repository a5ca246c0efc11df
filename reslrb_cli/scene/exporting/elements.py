"""Values as elements of a scene description."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..description.element import Element

Array = np.ndarray[tuple[int, ...], np.dtype[np.float32]]


def child(owner: Element, tag: str, **attributes: str) -> Element:
    """A new element with these attributes, `type_` for `type`, which is not among the children of `owner` yet."""
    return Element(tag, {key.rstrip("_"): value for key, value in attributes.items()}, owner.source, owner.line)


def replace(owner: Element, new: Element, *instead_of: str) -> None:
    """Put `new` among the children of `owner`, in place of those of its name and of the names in `instead_of`."""
    gone = {new.name, *instead_of}
    owner.children[:] = [other for other in owner.children if other.name not in gone]
    owner.children.insert(0, new)


def remove(owner: Element, names: set[str]) -> None:
    """Remove the parameters of these names."""
    owner.children[:] = [other for other in owner.children if other.name not in names]


def numbers(values: Array) -> str:
    """Numbers as text from which the same 32-bit floats are read."""
    return " ".join(f"{float(value):.9g}" for value in values.ravel())


def number(owner: Element, name: str, value: float) -> Element:
    """A number, or a spectrum that is the same at all wavelengths."""
    return child(owner, "float", name=name, value=numbers(np.array(value, dtype=np.float32)))


def colour(owner: Element, name: str, value: Array, bounded: bool) -> Element:
    """A colour (3,), or a grey of one number; where it is `bounded`, Mitsuba's <rgb> has values from 0 to 1 only."""
    if value.size == 1:
        return number(owner, name, float(value.ravel()[0]))
    rgb = child(owner, "rgb", name=name, value=numbers(value))
    if not bounded or bool(((value >= 0) & (value <= 1)).all()):
        return rgb
    rgb.attributes["name"] = "color"
    whole = child(owner, "texture", type_="srgb", name=name)
    whole.children += [rgb, child(owner, "boolean", name="unbounded", value="true")]
    return whole


def transform(owner: Element, name: str, value: mi.AffineTransform4f) -> Element:
    """A transform by its 4x4 matrix."""
    whole = child(owner, "transform", name=name)
    matrix = np.array(value.matrix, dtype=np.float32).reshape(4, 4)
    whole.children.append(child(owner, "matrix", value=numbers(matrix)))
    return whole


def triple(owner: Element, tag: str, name: str, value: Array) -> Element:
    """Three numbers: a <point> or a <vector>, by `tag`."""
    x, y, z = (numbers(value.reshape(3)[k : k + 1]) for k in range(3))
    return child(owner, tag, name=name, x=x, y=y, z=z)
