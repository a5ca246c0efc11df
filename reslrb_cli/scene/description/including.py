"""Brings a scene together from its files: includes are followed, variables put in, folders to look in collected."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ...errors import ConfigError
from . import reading
from .element import Element, quoted
from .reading import MAX_DEPTH, read_document
from .variables import Variables

MAX_INCLUDES = 1000
#: Includes within one another; that of Mitsuba's parser.
MAX_INCLUDE_DEPTH = 15


@dataclass
class Description:
    """A scene as its files describe it, with nothing left to include or to put in.

    `folders` are those in which the files that it names are looked for, first to last; `variables` are the values of
    its `$name` variables, those that it has itself among them. `hides_emitters`: whether the integrator that it names,
    of which nothing else is kept, leaves lights out of the picture.
    """

    root: Element
    folders: list[Path]
    variables: dict[str, str]
    hides_emitters: bool


def read_description(file: Path, options: Mapping[str, str]) -> Description:
    """Read the scene in `file` and all that it includes; `options` are the values of its `$name` variables.

    Raises ConfigError, located by file and line, for what cannot be read, for variables without a value, and for
    options without a variable.
    """
    reader = _Reader(Variables(options))
    folders = [file.absolute().parent]
    root = reader.read(file, folders, None)
    reader.variables.check_used(file)
    return Description(root, folders, reader.variables.values(), _hides_emitters(root))


def _hides_emitters(root: Element) -> bool:
    """Whether an integrator of the scene says so, in the spelling of any version."""
    found = [value for child in root.children if child.tag == "integrator" for value in child.walk()]
    return any(
        value.name in ("hide_emitters", "hideEmitters") and value.attributes.get("value", "").strip() == "true"
        for value in found
    )


@dataclass
class _Reader:
    """What the files of one scene share."""

    variables: Variables
    bytes_left: int = field(default_factory=lambda: reading.MAX_BYTES)
    includes: list[Path] = field(default_factory=list)
    including: list[Path] = field(default_factory=list)

    def read(self, file: Path, folders: list[Path], include: Element | None, depth: int = 0) -> Element:
        """The root of `file`, complete. `folders` grows by what its <path> elements name."""
        if include is not None:
            self.includes.append(file)
            if len(self.including) + 1 >= MAX_INCLUDE_DEPTH:
                raise include.fail("", f"files are included more than {MAX_INCLUDE_DEPTH} levels deep")
            if len(self.includes) > MAX_INCLUDES:
                raise include.fail("", f"more than {MAX_INCLUDES} files are included")
        try:
            root, size = read_document(file, self.bytes_left)
        except ConfigError as error:
            if include is None or error.source != str(file):
                raise
            raise include.fail("", f"includes {file}, which {error.message}") from None
        self.bytes_left -= size
        self.including.append(file)
        self._complete(root, root, folders, depth)
        self.including.pop()
        return root

    def _complete(self, element: Element, root: Element, folders: list[Path], depth: int) -> None:
        """Put variables into `element` and all below it, and what is included in the place of its includes."""
        if depth >= MAX_DEPTH:
            raise element.fail("", f"elements are nested more than {MAX_DEPTH} levels deep")
        self.variables.put_into(element)
        if element.tag == "spectrum" and "filename" in element.attributes:
            # Mitsuba opens it while it parses, from the folder of the file that is being parsed.
            element.attributes["filename"] = str(_find(element.attributes["filename"], folders))
        children: list[Element] = []
        for child in element.children:
            if child.tag == "default":
                self.variables.put_into(child)
                self.variables.add_default(_required(child, "name"), _required(child, "value"))
            elif child.tag == "path":
                self.variables.put_into(child)
                if element is not root:
                    raise child.fail("", "<path> can only stand directly below the root")
                folders.insert(0, _folder(child, folders))
            elif child.tag == "include":
                self.variables.put_into(child)
                children += self._include(child, element, folders, depth)
            else:
                self._complete(child, root, folders, depth + 1)
                children.append(child)
        element.children[:] = children

    def _include(self, include: Element, parent: Element, folders: list[Path], depth: int) -> list[Element]:
        """What stands in the place of `include`: the objects of a scene, or the one object that a file holds."""
        here = [include.source.file.absolute().parent, *folders]
        file = _find(_required(include, "filename"), here)
        if not os.path.exists(file):
            raise include.fail("", f"included file {quoted(include.attributes['filename'])} not found")
        root = self.read(file, here, include, depth)
        if root.type == "scene":
            # Parameters of the included <scene> itself, and references right below it, are nobody's: so with Mitsuba.
            return [child for child in root.children if not child.is_value and child.tag != "ref"]
        root.attributes.pop("version", None)
        root.attributes.pop("name", None)
        if include.name:
            root.attributes["name"] = include.name
        return [root]


def _required(element: Element, attribute: str) -> str:
    if not element.attributes.get(attribute):
        raise element.fail("", f"<{element.tag}> needs the attribute `{attribute}`")
    return element.attributes[attribute]


def _find(name: str, folders: list[Path]) -> Path:
    """The first file of that name in `folders`, or what the name says by itself."""
    return next((folder / name for folder in folders if os.path.exists(folder / name)), Path(name))


def _folder(element: Element, folders: list[Path]) -> Path:
    name = _required(element, "value")
    folder = _find(name, [element.source.file.absolute().parent, *folders])
    if not folder.is_dir():
        raise element.fail("", f"<path>: folder {quoted(name)} not found")
    return folder.absolute()
