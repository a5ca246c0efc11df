"""What a scene's files say of their sizes: refused where no machine has room for it, before Mitsuba allocates any."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from ...backend.memory import free_bytes
from ...config.files import in_words
from ...config.limits import PIXELS
from ...errors import ConfigError
from ..image_file import DamagedImage, image_size
from .element import Element, quoted
from .including import Description

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
