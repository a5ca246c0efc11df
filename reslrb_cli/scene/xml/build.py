"""The way from a scene's elements to Mitsuba's objects, under names that last, and back.

Mitsuba names an object without an id by its address in memory, which differs each time that the scene is loaded. Its
lasting name is its kind, and its number among all of that kind; `Owners` leads from names back to elements. Objects are
made by way of Mitsuba's own parser.
"""

from __future__ import annotations

import bisect
import difflib
import itertools
import re
from collections import Counter
from typing import Any

import mitsuba as mi

from reslrb_cli.backend.installation import likely_parameters, looking_in
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.xml.mend import Note
from reslrb_cli.scene.xml.read import Description, Element, quoted, tag_lines

#: Plugins that name what they hold by its place among the others, in every load alike.
_GROUPS = ("shapegroup", "batch")
#: How the ids begin that Mitsuba gives to objects without one when it writes a scene; it takes them for none.
_UNNAMED = "_unnamed_"
#: Characters of an id that is kept: keys become names of files.
_LONGEST = 120
#: Elements, by what Mitsuba makes of them.
_KINDS = {"bsdf": "BSDF", "emitter": "Emitter", "shape": "Shape", "texture": "Texture"}


def name_objects(root: Element) -> list[Note]:
    """Give every object below `root` an id that is there in every load of the same files; say whose ids were changed.

    The third `sphere` of the files becomes `Sphere_3`, whether or not the first two have ids. An id that Mitsuba could
    not use in a key is replaced: one that is empty, starts with `_unnamed_`, is very long or holds what cannot be
    printed, or is that of an earlier object. References follow. Raises ConfigError where a reference is to an id of two
    objects that differ.
    """
    root.attributes.pop("id", None)
    objects = root.objects()[1:]
    grouped = {child for element in objects if element.type in _GROUPS for child in element.children}
    taken = {element.attributes[key] for element in root.walk() for key in ("id", "as") if key in element.attributes}
    owners: dict[str, Element] = {}
    renamed: dict[str, str] = {}
    differing: dict[str, Element] = {}
    notes: list[Note] = []
    numbers: Counter[str] = Counter()
    for element in objects:
        kind = element.type[:1].upper() + element.type[1:]
        numbers[kind] += 1
        own = element.id
        if own in owners:
            if not _same(owners[own], element):
                differing[own] = element
        elif own.strip() and own.isprintable() and len(own) <= _LONGEST and not own.startswith(_UNNAMED):
            owners[own] = element
            continue
        elif element in grouped and not own:
            continue
        name = first = f"{kind}_{numbers[kind]}"
        for number in itertools.count(2):
            if name not in taken:
                break
            name = f"{first}_{number}"
        taken.add(name)
        element.attributes["id"] = name
        if own in owners:
            notes.append(Note(element, f"id {quoted(own)} is that of {owners[own].place}, too", f"named {name}"))
        elif own.strip() and own not in renamed:
            renamed[own] = name
            if not own.startswith(_UNNAMED):
                notes.append(Note(element, f"id {quoted(own)} cannot stand in a key", f"named {name}"))
    for element in root.walk("ref", "alias"):
        own = element.id
        if own in differing:
            places = f"{owners[own].place} and {differing[own].place}"
            raise element.fail("", f"refers to {quoted(own)}, the id of two objects ({places}); rename one of them")
        if own in renamed:
            element.attributes["id"] = renamed[own]
    return notes


def _same(a: Element, b: Element) -> bool:
    """Whether two elements, their ids aside, say the same."""
    one, other = ({**element.attributes, "id": ""} for element in (a, b))
    return (
        (a.tag, one, len(a.children)) == (b.tag, other, len(b.children))
        and all(_same(x, y) for x, y in zip(a.children, b.children, strict=True))
    )  # fmt: skip


class Owners:
    """The elements of a description by the ids of their objects, for the way back from a parameter to its element."""

    def __init__(self, root: Element) -> None:
        self._elements = root.by_id()

    def place(self, params: mi.SceneParameters, key: str) -> tuple[Element, list[str]] | None:
        """The element of the nearest object above the parameter `key` that has one, and the names that lead on.

        None of a parameter that nothing in the files is above of. `params` are those of a scene that was built from
        the description.
        """
        chain = [params.properties[key][2]]
        while chain[-1].id() not in self._elements:
            parent = params.hierarchy[chain[-1]][0]
            if parent is None:
                return None
            chain.append(parent)
        owner, names = self._elements[chain.pop().id()], key.split(".")
        names = names[-len(chain) - 1 :]
        while chain:
            if (nested := self._nested(owner, names[0], chain[-1])) is None:
                break
            owner, names = nested, names[1:]
            chain.pop()
        return owner, names

    def _nested(self, owner: Element, name: str, node: mi.Object) -> Element | None:
        """The element, among those in `owner`, of the object `node` that Mitsuba calls `name` there.

        Some objects lose their ids, as bitmaps do; those in a group have none.
        """
        tag = next((tag for tag, kind in _KINDS.items() if isinstance(node, getattr(mi, kind))), None)
        unnamed: list[Element] = []
        for item in owner.children:
            meant = self._elements.get(item.id, item) if item.tag == "ref" else item
            has_own_id = owner.type == "shapegroup" and meant.id  # by which it is found
            if meant.tag == tag and item.name in (name, "") and not has_own_id:
                if item.name:
                    return meant
                unnamed.append(meant)
        number = re.search(r"_(\d+)$", name)
        place = int(number[1]) if number and len(unnamed) > 1 else 0
        return unnamed[place] if place < len(unnamed) else None


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
    notes: list[Note] = []
    unnamed = [child for child in element.children if not child.name and (child.is_object or child.tag == "ref")]
    for name in props.unqueried():
        number = re.match(r"_arg_(\d+)", name)
        if number and int(number[1]) < len(unnamed):
            child = unnamed[int(number[1])]
            wrong = f"{element.type} has no use for a <{child.tag}> in Mitsuba 3"
        else:
            likely = likely_parameters(element.type) if len(notes) < _HINTS else []
            near = difflib.get_close_matches(name, likely, n=1, cutoff=0.75)
            hint = f" (did you mean `{near[0]}`?)" if near else ""
            child = element.find(name) or element
            wrong = f"{element.type} has no parameter {quoted(child.written or name)} in Mitsuba 3{hint}"
        notes.append(Note(child, wrong, "left out", None if child is element else element))
    return notes
