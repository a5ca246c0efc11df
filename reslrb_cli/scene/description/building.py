"""From the elements of a scene to Mitsuba's objects, by way of its own parser."""

from __future__ import annotations

import bisect
import difflib
import re
from typing import Any

import mitsuba as mi

from ...backend.plugins import likely_parameters, looking_in
from ...errors import ConfigError
from .element import Element, quoted
from .including import Description
from .notes import Note
from .writing import tag_lines

#: "[parser.cpp:482] " and "[PluginManager] ": where in Mitsuba's sources a message comes from.
_ORIGIN = re.compile(r"\[[\w.]+(:\d+)?\]\s*")
#: "At string (line 3, col 7): " and the like, before the message proper.
_PREAMBLE = re.compile(r"^(At|Error while loading|While loading) .*?\(line \d+, col \d+\):? ?")
_PLACE = re.compile(r"\(line (\d+), col \d+\)")

#: What Mitsuba says of a mesh without faces.
_NO_FACES = re.compile(r"Storing new normals in a Mesh that didn't have normals.*")

#: Parameters of one object for which names that are like theirs are looked for.
_HINTS = 30


def build(description: Description) -> tuple[Any, list[Note]]:
    """The Mitsuba object that a description stands for, and notes on parameters that no plugin asked for.

    Nothing is merged: all parameters keep their names. Raises ConfigError, located, for what Mitsuba refuses.
    """
    text = _Text(description.root)
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = False
    config.unused_properties = mi.LogLevel.Debug  # they are looked for below
    with looking_in(description.folders):
        try:
            state = mi.parser.parse_string(config, text.xml)
            mi.parser.transform_all(config, state)
            built = mi.parser.instantiate(config, state)
        except Exception as error:
            raise text.located(str(error)) from None
    return built, [note for node in state.nodes for note in _unused(node.props, text.element_at(node.offset))]


class _Text:
    """A description as XML, one tag a line, and which element each line comes from."""

    def __init__(self, root: Element) -> None:
        self._root = root
        lines, elements = zip(*tag_lines(root), strict=True)
        self._elements: tuple[Element, ...] = elements
        #: Kept for as long as the parser's state, which refers to it.
        self.xml = "\n".join(lines)
        self._starts = [0]
        for line in lines:
            self._starts.append(self._starts[-1] + len(line.encode("utf-8")) + 1)

    def element_at(self, offset: int) -> Element:
        """The element at that byte of `xml`."""
        return self._elements[bisect.bisect_right(self._starts, offset) - 1]

    def located(self, message: str) -> ConfigError:
        """Mitsuba's message as one located line, without the places in its own sources and in `xml`."""
        place = _PLACE.search(message)
        element = self._elements[int(place[1]) - 1] if place else None
        text = _ORIGIN.sub("", message).strip()
        while _PREAMBLE.match(text):
            text = _PREAMBLE.sub("", text).strip()
        text = _NO_FACES.sub("the mesh has no faces", text)
        text = _PLACE.sub(lambda other: f"({self._elements[int(other[1]) - 1].place})", text)
        return ConfigError(element.place if element else self._root.source.file, "", text)


def _unused(props: mi.Properties, element: Element) -> list[Note]:
    """Notes on what `element` gives its plugin, and the plugin did not ask for."""
    notes = []
    children = {child.name: child for child in element.children if child.name}
    unnamed = [child for child in element.children if not child.name and (child.is_object or child.tag == "ref")]
    for name in props.unqueried():
        number = re.match(r"_arg_(\d+)", name)
        if number and int(number[1]) < len(unnamed):
            child = unnamed[int(number[1])]
            wrong = f"{element.type} has no use for a <{child.tag}> in Mitsuba 3"
            notes.append(Note(child, wrong, "left out", element))
        else:
            likely = likely_parameters(element.type) if len(notes) < _HINTS else []
            near = difflib.get_close_matches(name, likely, n=1, cutoff=0.75)
            hint = f" (did you mean `{near[0]}`?)" if near else ""
            child = children.get(name, element)
            wrong = f"{element.type} has no parameter {quoted(child.written or name)} in Mitsuba 3{hint}"
            notes.append(Note(child, wrong, "left out", None if child is element else element))
    return notes
