"""Reading of scene files as elements, with includes and variables resolved. Writing of XML for Mitsuba's parser.

Each element knows its file and line.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError

#: Tags of objects, which plugins create. A <spectrum> with a type is also an object.
OBJECTS = frozenset(
    (
        *("scene", "sensor", "film", "sampler", "rfilter", "integrator", "emitter"),
        *("shape", "bsdf", "texture", "medium", "phase", "volume"),
    )
)

#: Tags of parameter values. A <spectrum> without a type is also a value.
VALUES = frozenset(("float", "integer", "boolean", "string", "point", "vector", "rgb", "transform"))
#: Maximum length of a quotation.
_QUOTED = 60


def quoted(text: str, mark: str = "`") -> str:
    """Quote text from a file for a message. Shorten the text, and escape terminal control characters."""
    text = text if len(text) <= _QUOTED else text[: _QUOTED - 3] + "..."
    return f"{mark}{text if text.isprintable() else repr(text)[1:-1]}{mark}"


def floats(text: str) -> list[float]:
    """Parse a list of numbers. Returns an empty list if any word of the text is not a number."""
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return []


def is_true(parameter: Element | None) -> bool:
    """Whether a boolean parameter is given and true. Mitsuba accepts any case."""
    return parameter is not None and parameter.value.strip().lower() == "true"


@dataclass(slots=True, eq=False)
class Element:
    """An XML element with its attributes and children in their order.

    `written` is the original name in the file if mending has changed the element's name. `variable` is the original
    text of the attribute `value` if it has variables.
    """

    tag: str
    attributes: dict[str, str]
    file: Path
    line: int
    children: list[Element] = field(default_factory=list)
    written: str = ""
    variable: str = ""

    @property
    def place(self) -> str:
        """File and line, for errors."""
        return f"{self.file}:{self.line}"

    @property
    def is_object(self) -> bool:
        """Whether the element is an object, which a plugin creates."""
        return self.tag in OBJECTS or (self.tag == "spectrum" and "type" in self.attributes)

    @property
    def is_value(self) -> bool:
        """Whether the element is the value of a parameter."""
        return self.tag in VALUES or (self.tag == "spectrum" and "type" not in self.attributes)

    @property
    def name(self) -> str:
        """The name of the parameter, or ""."""
        return self.attributes.get("name", "")

    @property
    def value(self) -> str:
        """The attribute `value`, or ""."""
        return self.attributes.get("value", "")

    @property
    def file_attribute(self) -> str:
        """The attribute that names a file, or "". Mitsuba's plugins read files only from `filename`."""
        if self.tag == "spectrum":
            return "filename" if self.attributes.get("filename") else ""
        return "value" if self.tag == "string" and self.name == "filename" else ""

    @property
    def id(self) -> str:
        """The element's own id, or the id to which the element refers, or "" if there is no id."""
        return self.attributes.get("id", "")

    @property
    def type(self) -> str:
        """The name of the plugin, or ""."""
        return self.attributes.get("type", "scene" if self.tag == "scene" else "")

    def fail(self, key: str, message: str) -> ConfigError:
        """Return a ConfigError located at this element."""
        return ConfigError(self.place, key, message)

    def walk(self, *tags: str) -> Iterator[Element]:
        """Yield this element and all elements below it in the order of the file. With `tags`, yield only elements with
        one of these tags.
        """
        waiting = [self]
        while waiting:
            element = waiting.pop()
            if not tags or element.tag in tags:
                yield element
            waiting += reversed(element.children)

    def objects(self) -> list[Element]:
        """Return all objects that `walk` yields. These objects are the nodes of Mitsuba's parser, in the parser's
        order.
        """
        return [element for element in self.walk() if element.is_object]

    def by_id(self) -> dict[str, Element]:
        """Return all objects that `walk` yields, by their ids and aliases."""
        found = {element.id: element for element in self.objects() if element.id}
        for alias in self.walk("alias"):
            if alias.id in found:
                found.setdefault(alias.attributes.get("as", ""), found[alias.id])
        return found

    def find(self, name: str) -> Element | None:
        """Return the first parameter with this name, or None."""
        return next((child for child in self.children if child.name == name), None)

    def drop(self, *names: str) -> None:
        """Remove the parameters with these names."""
        self.children[:] = [child for child in self.children if child.name not in names]

    def new(self, tag: str, /, *children: Element, **attributes: str) -> Element:
        """Return a new element with the location of this one. It is not added to the children."""
        return Element(tag, attributes, self.file, self.line, list(children))


_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)


def read_document(file: Path) -> Element:
    """Return the root element of an XML file. Raises ConfigError with the line in the file if the file is not valid
    XML.
    """
    text = _COMMENT.sub(lambda comment: "\n" * comment[0].count("\n"), _decode(read_file(file)))
    return _parse(file, text)


def _decode(data: bytes) -> str:
    """Decode the text of a file. Never fails, since Mitsuba's parser also accepts bytes of a wrong encoding."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeError:
        return data.decode("latin-1")


def _parse(file: Path, text: str) -> Element:
    parser = expat.ParserCreate("utf-8")
    stack: list[Element] = []
    roots: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, file, parser.CurrentLineNumber)
        (stack[-1].children if stack else roots).append(element)
        stack.append(element)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: stack.pop()
    try:
        parser.Parse(text.encode("utf-8"), True)
    except expat.ExpatError as error:
        raise ConfigError(f"{file}:{error.lineno}", "", f"not valid XML: {expat.ErrorString(error.code)}") from None
    return roots[0]


#: An unescaped `$`, and the text after it that may be the name of a variable, at most 256 characters.
_VARIABLE = re.compile(r"(?<!\\)\$([^$]{0,256})")


@dataclass
class Description:
    """A scene as described by its files, with all includes and variables resolved.

    - `folders`: the search path for the files that the scene names.
    - `variables`: the values of the scene's `$name` variables, including the scene's own defaults.
    - `hides_emitters`: whether the scene's integrator hides emitters. All other settings of this integrator are
        ignored.
    - `files`: the XML files that were read, and the versions of Mitsuba for which they were written, or "".
    - `own_sizes`: the sizes of the films in the files, if other sizes replace them.
    """

    root: Element
    folders: list[Path]
    variables: dict[str, str]
    hides_emitters: bool
    files: dict[Path, str]
    own_sizes: dict[Element, list[Element]] = field(default_factory=dict)

    def find_file(self, name: str) -> Path | None:
        """Return the file or folder that Mitsuba opens for this name, or None. Searches `folders` first."""
        return _find(name, self.folders)

    def named_files(self) -> Iterator[tuple[Element, str]]:
        """Yield the element and the file name for each file that Mitsuba opens for the scene.

        The two tables of a metal's `material` are included if `folders` contain them.
        """
        for element in self.root.walk():
            if element.file_attribute:
                yield element, element.attributes[element.file_attribute]
            elif element.tag == "string" and element.name == "material":
                tables = (f"data/ior/{element.value}.{table}.spd" for table in ("eta", "k"))
                yield from ((element, name) for name in tables if self.find_file(name) is not None)


def read_description(file: Path, options: Mapping[str, Any]) -> Description:
    """Read the scene in `file` and all files that it includes. `options` are the values of the scene's `$name`
    variables.

    Raises ConfigError if a file cannot be read, a variable has no value, or an option has no variable.
    """
    texts = {name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in options.items()}
    reader = _Reader(texts, set(options))
    folders = [file.absolute().parent]
    try:
        root = reader.read(file, folders, None)
    except RecursionError:
        raise ConfigError(file, "", "elements or includes are nested too deeply") from None
    _check_depth(root)
    for element in root.walk():
        key = element.file_attribute
        if key and (slashed := _with_slashes(element.attributes[key], folders)) is not None:
            element.attributes[key] = slashed
    if reader.unused:
        names = quoted(", ".join(f"${name}" for name in options if name in reader.unused), "")
        raise ConfigError(file, names, "is set in scene.options, but the scene file does not use it")
    said = [value for child in root.children if child.tag == "integrator" for value in child.walk()]
    # Accept the spelling of any version.
    hides = any(each.name in ("hide_emitters", "hideEmitters") and is_true(each) for each in said)
    return Description(root, folders, reader.values, hides, reader.files)


@dataclass
class _Reader:
    """State shared by the files of one scene.

    `values` holds all variables by name. The user's variables come first, then defaults in the order of the files.
    `unused` are the user's variables that no file has used so far.
    """

    values: dict[str, str]
    unused: set[str]
    files: dict[Path, str] = field(default_factory=dict)

    def read(self, file: Path, folders: list[Path], include: Element | None) -> Element:
        """Return the root of `file` with includes and variables resolved. Adds folders of <path> to `folders`."""
        try:
            root = read_document(file)
        except ConfigError as error:
            if include is None or error.source != str(file):
                raise
            raise include.fail("", f"includes {file}, which {error.message}") from None
        self.files[file] = root.attributes.get("version", "")
        self._put_variables(root)
        self._complete(root, root, folders)
        return root

    def _complete(self, element: Element, root: Element, folders: list[Path]) -> None:
        """Resolve variables and includes in `element` and all elements below it."""
        if element.tag == "spectrum" and "filename" in element.attributes:
            # Mitsuba opens this file during parsing, relative to the folder of the parsed file.
            name = element.attributes["filename"]
            element.attributes["filename"] = str(_find(name, folders) or name)
        children: list[Element] = []
        for child in element.children:
            self._put_variables(child)
            if child.tag == "default":
                self.values.setdefault(_required(child, "name"), _required(child, "value"))
            elif child.tag == "path":
                if element is not root:
                    raise child.fail("", "<path> must be directly below the root")
                folders.insert(0, _folder(child, folders))
            elif child.tag == "include":
                children += self._include(child, folders)
            else:
                self._complete(child, root, folders)
                children.append(child)
        element.children[:] = children

    def _put_variables(self, element: Element) -> None:
        """Replace the variables in the attributes of `element`. Raises ConfigError if one has no value."""
        for key, text in element.attributes.items():
            if "$" in text:
                element.attributes[key] = self._replace(text, element)
                element.variable = text if key == "value" else element.variable

    def _replace(self, text: str, element: Element) -> str:
        def value_of(found: re.Match[str]) -> str:
            """Return the value of the longest matching name, since one name may be a prefix of another."""
            behind = found[1]
            name = next((behind[:n] for n in range(len(behind), 0, -1) if behind[:n] in self.values), None)
            if name is None:
                raise self._fail(behind, element)
            self.unused.discard(name)
            return self.values[name] + behind[len(name) :]

        return _VARIABLE.sub(value_of, text).replace("\\$", "$")

    def _fail(self, behind: str, element: Element) -> ConfigError:
        name = quoted(re.match(r"\w*", behind, re.ASCII)[0], "")  # type: ignore[index]  # an empty text matches
        how = f"set scene.options.{name} (--set scene.options.{name}=VALUE)"
        message = f"has no value and no default; {how}" if name else "is not a variable; write \\$"
        return element.fail(f"${name}", message)

    def _include(self, include: Element, folders: list[Path]) -> list[Element]:
        """Return the elements that replace `include`. A scene file gives its objects, and any other file gives its
        single object.
        """
        here = [include.file.absolute().parent, *folders]
        if (file := _find(_required(include, "filename"), here)) is None:
            raise include.fail("", f"included file {quoted(include.attributes['filename'])} not found")
        root = self.read(file, here, include)
        if root.type == "scene":
            # Drop parameters of the included <scene> itself and references directly below it, as Mitsuba does.
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


def _find(name: str, folders: Sequence[Path]) -> Path | None:
    name = _with_slashes(name, folders) or name
    places = [*(folder / name for folder in folders), Path(name)]
    return next((path for path in places if os.path.exists(path)), None)  # False for too long names, too


def _with_slashes(name: str, folders: Sequence[Path]) -> str | None:
    """Return the name of a file with slashes if only this spelling is found. Windows writes names with backslashes."""
    slashed = name.replace("\\", "/")
    if slashed == name or any(os.path.exists(folder / name) for folder in (*folders, Path())):
        return None
    return slashed if _find(slashed, folders) is not None else None


#: Maximum depth of elements. Scenes of exporters have fewer than 20 levels, and Mitsuba's parser recurses.
_DEEPEST = 100


def _check_depth(root: Element) -> None:
    waiting = [(root, 1)]
    while waiting:
        element, depth = waiting.pop()
        if depth > _DEEPEST:
            raise element.fail("", f"is nested too deeply, in more than {_DEEPEST} elements")
        waiting += ((child, depth + 1) for child in element.children)


def _folder(element: Element, folders: list[Path]) -> Path:
    name = _required(element, "value")
    folder = _find(name, [element.file.absolute().parent, *folders])
    if folder is None or not folder.is_dir():
        raise element.fail("", f"<path>: folder {quoted(name)} not found")
    return folder.absolute()


def tag_lines(element: Element, depth: int = 0) -> Iterator[tuple[str, Element]]:
    """Yield the XML of `element` and of all elements below it, one tag per line. Each line comes with its element."""
    # Escape `$`, which starts a variable in Mitsuba's parser. All variables are resolved already.
    attributes = "".join(f" {key}={quoteattr(value)}" for key, value in element.attributes.items())
    indent, end = "    " * depth, "" if element.children else "/"
    yield f"{indent}<{element.tag}{attributes.replace('$', chr(92) + '$')}{end}>", element
    for child in element.children:
        yield from tag_lines(child, depth + 1)
    if element.children:
        yield f"{indent}</{element.tag}>", element
