"""The refusals of what a scene's files must not say, before Mitsuba sees any of it.

`check` refuses plugins that are not Mitsuba's, endless files, and chains without end; `check_sizes`, before Mitsuba
allocates any, sizes for which no machine has room. `resize_films` gives films another size than their files say.
"""

from __future__ import annotations

import os
import re
import stat
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import mitsuba as mi

from reslrb_cli.backend.installation import is_known, nearest_plugin, plugin_type
from reslrb_cli.backend.memory import free_bytes
from reslrb_cli.config.files import PIXELS, in_words
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.images import DamagedImage, image_size
from reslrb_cli.scene.xml import mend
from reslrb_cli.scene.xml.read import MAX_DEPTH, Description, Element, quoted

#: Parameters without which a plugin reads memory that is not its own.
_NEEDED = {"bitmap": "filename", "normalmap": "normalmap"}
_VECTORS = ("point", "vector", "translate", "scale", "rotate")
_NUMBERS = ("float", "rgb", "spectrum", "matrix", "lookat", *_VECTORS)
#: Mitsuba reads these as numbers.
_NOT_FINITE = re.compile(r"(?i)(?<![\w.])[-+]?(nan|inf|infinity)(?!\w)")
#: Lines, or objects, that one message names.
_SHOWN = 5


def check(description: Description) -> None:
    """Raise ConfigError, located by file and line, for what must not reach Mitsuba's parser."""
    for element in description.root.walk():
        if element.is_object:
            refused = mend.REFUSED_PLUGINS.get((element.tag, element.type))
            if refused is not None:
                raise element.fail("", f"{element.tag} `{element.type}` {refused}")
            if not is_known(element.type):
                raise _unknown_plugin(description.root, element)
            _check_kind(element)
            _check_needed(element)
        elif element.tag in _NUMBERS:
            _check_finite(element)
            if element.tag in _VECTORS:
                _check_vector(element)
        if element.tag == "string" and element.name == "filename":
            _check_regular(element, description.folders)
    _check_chains(description.root)


def _check_kind(element: Element) -> None:
    """Refuse a plugin that is not what its element says."""
    type = plugin_type(element.type)
    if type not in (mi.ObjectType.Unknown, _object_type(element.tag)):
        raise element.fail("", f"{quoted(element.type)} is no {element.tag}")


def _check_needed(element: Element) -> None:
    """Refuse an object without what Mitsuba takes to be there, and reads memory that is not its own."""
    name = _NEEDED.get(element.type)
    if name is not None and not any(child.name == name for child in element.children):
        raise element.fail("", f"{element.type} needs a parameter `{name}`")
    if element.type == "blendbsdf" and sum(child.tag in ("bsdf", "ref") for child in element.children) < 2:
        raise element.fail("", "blendbsdf needs two BSDFs")


def _check_finite(element: Element) -> None:
    """Refuse what is no number, and a colour or a place that is infinite: all that comes of it is not finite."""
    for name, text in element.attributes.items():
        bad = _NOT_FINITE.search(text) if name not in ("id", "name", "filename", "type") else None
        if bad is not None and (element.tag != "float" or bad[1].lower() == "nan"):
            raise element.fail(element.name or element.tag, f"{quoted(text)}: {bad[0]} is not finite")


def _check_vector(element: Element) -> None:
    """Refuse a vector that is given in two ways, or by a number of numbers; Mitsuba would not say where."""
    if "value" in element.attributes:
        if any(axis in element.attributes for axis in "xyz"):
            raise element.fail("", f"<{element.tag}> can have `value` or x, y and z, not both")
        if len(element.attributes["value"].replace(",", " ").split()) not in (1, 3):
            raise element.fail("", f"<{element.tag}> needs one or three numbers in `value`")


def _unknown_plugin(root: Element, element: Element) -> ConfigError:
    type, tag = element.type, element.tag
    if not type:
        return element.fail("", f"<{tag}> has no type")
    lines = [other.line for other in root.objects() if (other.tag, other.type) == (tag, type) and other is not element]
    more = (
        f" (also in line {', '.join(map(str, lines[:_SHOWN]))}{' and more' * (len(lines) > _SHOWN)})" if lines else ""
    )
    lost = mend.LOST_PLUGINS.get((tag, type))
    if lost is not None:
        return element.fail("", f"{tag} `{type}` is a plugin of Mitsuba 0.6 that Mitsuba 3 does not have; {lost}{more}")
    near = nearest_plugin(type, _object_type(tag))
    hint = f"; did you mean `{near}`?" if near else "; only Mitsuba's own plugins are loaded"
    return element.fail("", f"there is no {tag} {quoted(type)} in Mitsuba 3{hint}{more}")


def _object_type(tag: str) -> mi.ObjectType:
    """Mitsuba's word for what an element is."""
    others = {
        "bsdf": "BSDF",
        "phase": "PhaseFunction",
        "rfilter": "ReconstructionFilter",
        "spectrum": "Texture",
    }
    return getattr(mi.ObjectType, others.get(tag, tag.capitalize()))


def _check_regular(element: Element, folders: list[Path]) -> None:
    """Refuse a file that is a pipe or a device: reading it might never end."""
    name = element.attributes.get("value", "")
    for path in [folder / name for folder in folders] + [Path(name)]:
        if os.path.exists(path):
            if not stat.S_ISREG(path.stat().st_mode):
                raise element.fail("filename", f"{path} is no regular file")
            return


def _check_chains(root: Element) -> None:
    """Refuse objects that use themselves, or others in chains so long that Mitsuba's stack would not hold them."""
    objects = root.objects()
    owners = {element.attributes["id"]: element for element in objects if "id" in element.attributes}
    for element in root.walk():
        if element.tag == "alias" and element.attributes.get("id") in owners:
            owners.setdefault(element.attributes.get("as", ""), owners[element.attributes["id"]])
    uses = {element: [child for child in element.children if child.is_object] for element in objects}
    for element in objects:
        references = [child.attributes.get("id") for child in element.children if child.tag == "ref"]
        uses[element] += [owners[name] for name in references if name in owners]
    try:
        order = list(TopologicalSorter(uses).static_order())
    except CycleError as error:
        circle: list[Element] = error.args[1]
        names = " uses ".join(element.attributes.get("id", element.tag) for element in reversed(circle[:_SHOWN]))
        raise circle[0].fail("", f"objects use one another in a circle: {names}") from None
    lengths: dict[Element, int] = {}
    for element in order:  # those that are used come first
        lengths[element] = 1 + max((lengths[other] for other in uses[element]), default=0)
        if lengths[element] > MAX_DEPTH:
            raise element.fail("", f"objects use one another in a chain of more than {MAX_DEPTH}")


#: Bytes of memory that a pixel of an image takes as a texture at the least: Mitsuba keeps three half floats of it, or
#: floats where the scene says so.
_TEXEL_BYTES, _FLOAT_BYTES = 6, 12
#: Bytes in which a mesh says what it consists of.
_HEAD = 2**16
#: What Git's extension for large files writes in place of one.
_LFS = b"version https://git-lfs.github.com/"


@dataclass(frozen=True)
class FilmSize:
    """Width and height of a film in pixels, how many of them its crop window has, and channels of a pixel; 0 pixels
    where the file does not say."""

    width: int
    height: int
    cropped: int
    channels: int


def check_sizes(description: Description) -> None:
    """Raise ConfigError, located by file and line, for films and files that are larger than can be held."""
    free: int | None = None
    for owner in description.root.walk():
        if owner.tag == "film":
            _check_film(owner)
        as_floats = any(
            child.name == "format" and child.attributes.get("value") == "variant" for child in owner.children
        )
        for element in owner.children:
            if element.tag == "string" and element.name == "filename":
                free = free_bytes(mi.variant()) if free is None else free
                _check_file(element, description.folders, free, _FLOAT_BYTES if as_floats else _TEXEL_BYTES)


def _check_film(film: Element) -> None:
    """Refuse a film of more pixels than an image may have; what is no number, Mitsuba refuses."""
    size = _size_of(film)
    if size.width * size.height > PIXELS:
        raise film.fail(
            "",
            f"a film of {size.width}x{size.height} pixels; it must have at most {PIXELS}, since each image of a step "
            "takes 12 bytes or more of every one",
        )


def film_sizes(description: Description) -> list[FilmSize]:
    """What the scene's films say of their sizes."""
    return [_size_of(element) for element in description.root.walk() if element.tag == "film"]


def _size_of(film: Element) -> FilmSize:
    values = {child.name: child.attributes.get("value", "").strip() for child in film.children}
    numbers = {name: int(value[:20]) for name, value in values.items() if value.isdecimal()}
    width, height = numbers.get("width", 0), numbers.get("height", 0)
    cropped = numbers.get("crop_width", width) * numbers.get("crop_height", height)
    channels = 1 if values.get("pixel_format", "rgb").lower().startswith("luminance") else 3
    return FilmSize(width, height, cropped, channels)


def _check_head(element: Element, path: Path) -> None:
    """Refuse what Git LFS leaves where a file was not brought, and a PLY mesh whose elements have names that are no
    text, which Mitsuba prints as they come, or that says to have more of them than it has bytes, for which Mitsuba
    makes room."""
    with path.open("rb") as file:
        head = file.read(_HEAD)
    if head.startswith(_LFS):
        raise element.fail("filename", f"{path} is a pointer of Git LFS, not the file; `git lfs pull` brings it")
    if not head.startswith(b"ply"):
        return
    for line in head.partition(b"end_header")[0].splitlines():
        text = line.decode("ascii", errors="replace")
        if not line.startswith((b"comment", b"obj_info")) and not all(c == "\t" or " " <= c <= "~" for c in text):
            raise element.fail("filename", f"{path}: its head holds what is no text, {quoted(text)}; write it again")
        count = re.fullmatch(r"\s*element\s+(\S+)\s+(\d+)\s*", text)
        if count is not None and float(count[2]) > os.path.getsize(path):
            what = f"says that it has {quoted(count[2])} of the element {quoted(count[1])}"
            raise element.fail("filename", f"{path} {what}, and has {in_words(os.path.getsize(path))}; write it again")


def _check_file(element: Element, folders: list[Path], free: int, texel: int) -> None:
    """Refuse a file that takes more memory than is free, by its size or by what an image says of itself.

    `texel` are the bytes that a pixel of it takes.
    """
    name = element.attributes.get("value", "")
    places = [*(folder / name for folder in folders), Path(name)]
    path = next((path for path in places if os.path.isfile(path)), None)  # False of names that are too long, too
    if path is None:
        if not os.path.basename(name):
            return  # which Mitsuba says
        looked = "" if os.path.isabs(name) else f"; looked for in {', '.join(str(folder) for folder in folders)}"
        raise element.fail("filename", f"{quoted(name)}: no such file{looked}")
    if os.path.getsize(path) > free:
        raise element.fail(
            "filename", f"{path} has {in_words(os.path.getsize(path))}, and {in_words(free)} of memory are free"
        )
    _check_head(element, path)
    try:
        width, height = image_size(path)
    except DamagedImage as error:
        raise element.fail("filename", str(error)) from None
    except ConfigError:
        return  # no image, or none that we know
    if width * height > PIXELS:
        raise element.fail("filename", f"{path} is {width}x{height} pixels; more than {PIXELS} are not read")
    if width * height * texel > free:
        needed = in_words(width * height * texel)
        raise element.fail(
            "filename", f"{path} is {width}x{height} pixels, which take {needed}; {in_words(free)} are free"
        )


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
