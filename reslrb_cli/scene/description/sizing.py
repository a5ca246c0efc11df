"""Gives films another size than their files say."""

from __future__ import annotations

from .element import Element

#: What of a film says how many pixels it has.
_SIZES = ("width", "height", "crop_offset_x", "crop_offset_y", "crop_width", "crop_height")


def resize_films(root: Element, size: tuple[int, int]) -> None:
    """Give the film of every sensor below `root` this (width, height) in pixels, and no crop window."""
    for sensor in [element for element in root.walk() if element.tag == "sensor"]:
        films = [child for child in sensor.children if child.tag == "film"]
        if not films:
            films = [Element("film", {"type": "hdrfilm"}, sensor.source, sensor.line)]
            sensor.children += films
        for film in films:
            film.children[:] = [child for child in film.children if child.name not in _SIZES]
            for name, value in zip(("width", "height"), size, strict=True):
                attributes = {"name": name, "value": str(value)}
                film.children.append(Element("integer", attributes, film.source, film.line))
