"""Puts textures that stand by themselves where they are used, so that their parameters belong to what uses them."""

from __future__ import annotations

from .element import Element


def place_textures(root: Element) -> None:
    """Move each texture right below `root` into the place of the first reference to it; other references stay.

    Mitsuba lists the parameters of what stands right below the scene as the scene's own, by the id of a texture, which
    some lose: nothing would say that they are properties of a material or a light.
    """
    textures = {child.attributes.get("id", ""): child for child in root.children if child.tag == "texture"}
    textures.pop("", None)
    aliased = {element.attributes.get("id") for element in root.walk() if element.tag == "alias"}
    for element in list(root.walk()):
        for index, child in enumerate(element.children):
            texture = textures.get(child.attributes.get("id", "")) if child.tag == "ref" else None
            if texture is None or element is root or element is texture or texture.attributes["id"] in aliased:
                continue
            del textures[texture.attributes["id"]]
            root.children.remove(texture)
            texture.attributes.pop("name", None)
            if child.name:
                texture.attributes["name"] = child.name
            element.children[index] = texture
