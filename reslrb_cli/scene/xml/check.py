"""Checks of a scene's description before Mitsuba parses it.

The checks refuse plugins that are not Mitsuba's own, files that never end, and sizes that exceed the memory.
"""

from __future__ import annotations

import os
import re
import stat
from dataclasses import dataclass

import mitsuba as mi

from reslrb_cli.backend.installation import is_known, nearest_plugin, plugin_type
from reslrb_cli.config.files import PIXELS
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.xml.read import Description, Element, quoted

#: Plugins of Mitsuba 0.6 that Mitsuba 3 does not have, with substitutes.
LOST_PLUGINS = {
    **dict.fromkeys((("bsdf", "coating"), ("bsdf", "roughcoating")), "use `principled` with a clearcoat"),
    ("bsdf", "mixturebsdf"): "use nested `blendbsdf`",
    ("bsdf", "phong"): "use `roughplastic`",
    ("bsdf", "ward"): "use `roughconductor` or `roughplastic`",
    ("bsdf", "roughdiffuse"): "use `diffuse`",
    ("bsdf", "difftrans"): "use `principledthin`",
    ("bsdf", "hk"): "use a medium",
    ("bsdf", "irawan"): "use a texture",
    **dict.fromkeys((("emitter", "sky"), ("emitter", "sun")), "use `sunsky`, with z instead of y as its up axis"),
    ("emitter", "collimated"): "use `directionalarea`",
    ("shape", "heightfield"): "write it as a mesh",
    ("texture", "scale"): "multiply the texture itself",
    ("texture", "gridtexture"): "use `bitmap` or `checkerboard`",
    ("texture", "wireframe"): "use `bitmap`",
    ("texture", "curvature"): "use `mesh_attribute`",
    ("texture", "vertexcolors"): "use `mesh_attribute`",
}

#: Plugins that Mitsuba 3 has, or whose name it has, but that scene files cannot use here.
REFUSED_PLUGINS = {
    ("shape", "hair"): "is a plugin of Mitsuba 0.6 that Mitsuba 3 does not have; `bsplinecurve` draws strands",
    ("shape", "blender"): "reads the memory of a running Blender; export the mesh as `ply` or `obj`",
    ("sensor", "flat_sensor"): "belongs to Mitsuba's own RayDataLoader; use a `perspective` one",
}

#: Parameters without which a plugin reads memory out of bounds.
_NEEDED = {"bitmap": "filename", "normalmap": "normalmap"}
_VECTORS = ("point", "vector", "translate", "scale", "rotate")
_NUMBERS = ("float", "rgb", "spectrum", "matrix", "lookat", *_VECTORS)
#: Words that Mitsuba reads as non-finite numbers.
_NOT_FINITE = re.compile(r"(?i)(?<![\w.])[-+]?(nan|inf|infinity)(?!\w)")
#: Maximum number of lines that one message names.
_SHOWN = 5


def check(description: Description) -> None:
    """Raise ConfigError with file and line if the description is not safe for Mitsuba's parser."""
    for element in description.root.walk():
        if element.is_object:
            _check_plugin(description.root, element)
        elif element.tag in _NUMBERS:
            _check_numbers(element)
        if element.tag == "film" and (size := _size_of(element)).width * size.height > PIXELS:
            why = f"it must have at most {PIXELS}, since each image of a step takes at least 12 bytes per pixel"
            raise element.fail("", f"a film of {size.width}x{size.height} pixels; {why}")
    check_files(description)


def _check_plugin(root: Element, element: Element) -> None:
    """Refuse plugins that are not Mitsuba's own. Also refuse objects that lack a required part, because Mitsuba would
    then read memory out of bounds.
    """
    tag, type = element.tag, element.type
    if (refused := REFUSED_PLUGINS.get((tag, type))) is not None:
        raise element.fail("", f"{tag} `{type}` {refused}")
    if not is_known(type):
        raise _unknown_plugin(root, element)
    if plugin_type(type) not in (mi.ObjectType.Unknown, _object_type(tag)):
        raise element.fail("", f"{quoted(type)} is no {tag}")
    needed = _NEEDED.get(type)
    if needed is not None and element.find(needed) is None:
        raise element.fail("", f"{type} needs a parameter `{needed}`")
    if type == "blendbsdf" and sum(child.tag in ("bsdf", "ref") for child in element.children) < 2:
        raise element.fail("", "blendbsdf needs two BSDFs")


def _check_numbers(element: Element) -> None:
    """Refuse NaN, and infinite colours and positions. Also refuse vectors with a wrong number of components or with two
    definitions.

    Mitsuba would not report their location.
    """
    for name, text in element.attributes.items():
        bad = _NOT_FINITE.search(text) if name not in ("id", "name", "filename", "type") else None
        if bad is not None and (element.tag != "float" or bad[1].lower() == "nan"):
            raise element.fail(element.name or element.tag, f"{quoted(text)}: {bad[0]} is not finite")
    if element.tag in _VECTORS and "value" in element.attributes:
        if any(axis in element.attributes for axis in "xyz"):
            raise element.fail("", f"<{element.tag}> can have `value` or x, y and z, not both")
        if len(element.value.replace(",", " ").split()) not in (1, 3):
            raise element.fail("", f"<{element.tag}> needs one or three numbers in `value`")


def _unknown_plugin(root: Element, element: Element) -> ConfigError:
    type, tag = element.type, element.tag
    if not type:
        return element.fail("", f"<{tag}> has no type")
    lines = [str(other.line) for other in root.walk(tag) if other.type == type and other is not element]
    more = f" (also in line {', '.join(lines[:_SHOWN])}{' and more' * (len(lines) > _SHOWN)})" if lines else ""
    if (lost := LOST_PLUGINS.get((tag, type))) is not None:
        return element.fail("", f"{tag} `{type}` is a plugin of Mitsuba 0.6 that Mitsuba 3 does not have; {lost}{more}")
    near = nearest_plugin(type, _object_type(tag))
    hint = f"; did you mean `{near}`?" if near else "; only Mitsuba's own plugins are loaded"
    return element.fail("", f"there is no {tag} {quoted(type)} in Mitsuba 3{hint}{more}")


def _object_type(tag: str) -> mi.ObjectType:
    """Return Mitsuba's object type of a tag."""
    others = {"bsdf": "BSDF", "phase": "PhaseFunction", "rfilter": "ReconstructionFilter", "spectrum": "Texture"}
    return getattr(mi.ObjectType, others.get(tag, tag.capitalize()))


@dataclass(frozen=True)
class FilmSize:
    """Width and height of a film in pixels, pixels in its crop window, and channels per pixel.

    Sizes are 0 if the file does not give them.
    """

    width: int
    height: int
    cropped: int
    channels: int


def film_sizes(description: Description) -> list[FilmSize]:
    """Return the sizes of the scene's films."""
    return [_size_of(film) for film in description.root.walk("film")]


def _size_of(film: Element) -> FilmSize:
    """Return the size of a film. Ignores values that are not numbers, because Mitsuba refuses such values."""
    values = {child.name: child.value.strip() for child in film.children}
    numbers = {name: int(value[:20]) for name, value in values.items() if value.isdecimal()}
    width, height = numbers.get("width", 0), numbers.get("height", 0)
    cropped = numbers.get("crop_width", width) * numbers.get("crop_height", height)
    channels = 1 if values.get("pixel_format", "rgb").lower().startswith("luminance") else 3
    return FilmSize(width, height, cropped, channels)


def check_files(description: Description) -> None:
    """Raise ConfigError with file and line if a file is missing, damaged or too large."""
    for element, name in description.named_files():
        if (wrong := _wrong_file(name, description)) is not None:
            raise element.fail("material" if element.name == "material" else "filename", wrong)


def _wrong_file(name: str, description: Description) -> str | None:
    """Return what is wrong with a file, or None.

    The check finds missing files, pipes and devices (which might never end), and images that are damaged or too large.
    """
    path = description.find_file(name)
    if path is None:
        looked = "" if os.path.isabs(name) else f"; searched in {', '.join(map(str, description.folders))}"
        return f"{quoted(name)}: no such file{looked}"
    if not stat.S_ISREG(path.stat().st_mode):
        return f"{path} is not a regular file"
    return None


#: Parameters of a film that set its size.
_SIZES = ("width", "height", "crop_offset_x", "crop_offset_y", "crop_width", "crop_height")


def resize_films(root: Element, size: tuple[int, int]) -> None:
    """Set the films of all sensors below `root` to `size` (width, height) in pixels, and remove crop windows."""
    for sensor in root.walk("sensor"):
        films = [child for child in sensor.children if child.tag == "film"]
        if not films:
            films = [sensor.new("film", type="hdrfilm")]
            sensor.children += films
        for film in films:
            film.drop(*_SIZES)
            for name, value in zip(("width", "height"), size, strict=True):
                film.children.append(film.new("integer", name=name, value=str(value)))
