"""Texture coordinates as Mitsuba 0.6 let them be scaled and shifted."""

from __future__ import annotations

from .element import Element

#: The steps of a transform, in their order, and the parameters that give them along u and v.
_STEPS = {"translate": ("uoffset", "voffset"), "scale": ("uscale", "vscale")}


def transform_coordinates(texture: Element) -> Element | None:
    """Write what a texture says of `uscale` and its like as the transform that they mean; return the first of them."""
    names = [name for pair in _STEPS.values() for name in pair]
    given = {child.name: child for child in texture.children if child.tag == "float" and child.name in names}
    if not given:
        return None
    first = next(iter(given.values()))
    steps = []
    for tag, pair in _STEPS.items():
        values = {
            axis: given[name].attributes.get("value", "")
            for axis, name in zip("xy", pair, strict=True)
            if name in given
        }
        if values:
            steps.append(Element(tag, values, first.source, first.line))
    texture.children[:] = [child for child in texture.children if child not in given.values()]
    texture.children.append(Element("transform", {"name": "to_uv"}, first.source, first.line, steps))
    return first
