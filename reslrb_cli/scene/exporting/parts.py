"""The files beside an exported scene: those that it refers to, copied, and those that hold recovered values."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from ..description import Description
from ..description.element import Element
from .elements import child, replace

#: The exported scene, in its folder.
SCENE = "scene.xml"
#: Folders beside it: of recovered values, and of files from elsewhere than the scene's own folder.
RECOVERED, ELSEWHERE = "recovered", "assets"


@dataclass
class Parts:
    """Files by their path in the exported folder, with `/`, and who writes each into a path that is new."""

    writers: dict[str, Callable[[Path], object]] = field(default_factory=dict)
    _copies: dict[Path, str] = field(default_factory=dict)
    _made: set[Element] = field(default_factory=set)

    def add(self, owner: Element, stem: str, suffix: str, write: Callable[[Path], object]) -> None:
        """Have `owner` name a file of recovered values in place of the one that it names."""
        name = f"{RECOVERED}/{stem}{suffix}"
        self.writers[name] = write
        element = child(owner, "string", name="filename", value=name)
        self._made.add(element)
        replace(owner, element)

    def copy_assets(self, description: Description) -> None:
        """Have every file that elements name copied, and named by where its copy is.

        A file in the folder of the scene keeps its path relative to that, any other goes to a folder of its own.
        """
        own = {name.casefold() for name in (SCENE, *self.writers)}
        home = description.root.source.file.absolute().parent
        for element in description.root.walk():
            attribute = _file_attribute(element)
            if attribute is None or element in self._made:
                continue
            source = _found(element.attributes[attribute], description.folders)
            if source is not None:
                if source not in self._copies:
                    self._copies[source] = _free(_wanted(source, home), own)
                    own.add(self._copies[source].casefold())
                element.attributes[attribute] = self._copies[source]
        for source, name in self._copies.items():
            self.writers[name] = _copier(source)

    def write(self, folder: Path) -> None:
        """Write all files into `folder`, which has none of them. Raises OSError."""
        for name, write in self.writers.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path)


def _copier(source: Path) -> Callable[[Path], object]:
    return lambda path: shutil.copyfile(source, path)


def _file_attribute(element: Element) -> str | None:
    """The attribute of an element that names a file; None of one that names none."""
    if element.tag == "spectrum" and "filename" in element.attributes:
        return "filename"
    return (
        "value" if element.tag == "string" and element.name == "filename" and element.attributes.get("value") else None
    )


def _found(name: str, folders: list[Path]) -> Path | None:
    """The file that Mitsuba opens by this name; None where there is none."""
    candidates = [folder / name for folder in folders] + [Path(name).absolute()]
    return next((path.resolve() for path in candidates if path.is_file()), None)


def _wanted(source: Path, home: Path) -> str:
    if source.is_relative_to(home.resolve()):
        return str(PurePosixPath(*source.relative_to(home.resolve()).parts))
    return f"{ELSEWHERE}/{source.name}"


def _free(wanted: str, taken: set[str]) -> str:
    """`wanted`, or with a number before its suffix where that is taken, by whatever case it is written in."""
    path, name, number = PurePosixPath(wanted), wanted, 1
    while name.casefold() in taken:
        number += 1
        name = str(path.with_name(f"{path.stem}-{number}{path.suffix}"))
    return name
