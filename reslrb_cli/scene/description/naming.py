"""Lasting names for objects without an id: their kind, and their number among all of that kind; and the way back.

Mitsuba names an object without an id by its address in memory, which differs each time that the scene is loaded.
"""

from __future__ import annotations

import re
from collections import Counter

import mitsuba as mi

from .element import Element, quoted
from .notes import Note

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
    doubled: dict[str, list[Element]] = {}
    notes: list[Note] = []
    numbers: Counter[str] = Counter()
    for element in objects:
        kind = element.type[:1].upper() + element.type[1:]
        numbers[kind] += 1
        own = element.attributes.get("id", "")
        if own in owners:
            doubled.setdefault(own, []).append(element)
        elif _is_usable(own):
            owners[own] = element
            continue
        elif element in grouped and not own:
            continue
        name = _free(f"{kind}_{numbers[kind]}", taken)
        taken.add(name)
        element.attributes["id"] = name
        if own in owners:
            notes.append(Note(element, f"id {quoted(own)} is that of {owners[own].place}, too", f"named {name}"))
        elif own.strip() and own not in renamed:
            renamed[own] = name
            if not own.startswith(_UNNAMED):
                notes.append(Note(element, f"id {quoted(own)} cannot stand in a key", f"named {name}"))
    differing = {own: other for own, others in doubled.items() for other in others if not _same(owners[own], other)}
    for element in root.walk():
        own = element.attributes.get("id", "")
        if element.tag in ("ref", "alias"):
            if own in differing:
                places = f"{owners[own].place} and {differing[own].place}"
                raise element.fail("", f"refers to {quoted(own)}, the id of two objects ({places}); rename one of them")
            if own in renamed:
                element.attributes["id"] = renamed[own]
    return notes


def _is_usable(own: str) -> bool:
    return own.strip() != "" and own.isprintable() and len(own) <= _LONGEST and not own.startswith(_UNNAMED)


def _free(name: str, taken: set[str]) -> str:
    """`name`, or the first of name_2, name_3 ... that no object has for its id."""
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free


def _same(a: Element, b: Element) -> bool:
    """Whether two elements, their ids aside, say the same."""
    own = [{key: value for key, value in element.attributes.items() if key != "id"} for element in (a, b)]
    return (
        (a.tag, own[0], len(a.children)) == (b.tag, own[1], len(b.children))
        and all(_same(x, y) for x, y in zip(a.children, b.children, strict=True))
    )  # fmt: skip


class Owners:
    """The elements of a description by the ids of their objects, for the way back from a parameter to its element."""

    def __init__(self, root: Element) -> None:
        self._elements = {
            item.attributes["id"]: item for item in root.walk() if item.is_object and "id" in item.attributes
        }

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
            nested = self._nested(owner, names[0], chain[-1])
            if nested is None:
                break
            owner, names = nested, names[1:]
            chain.pop()
        return owner, names

    def _nested(self, owner: Element, name: str, node: mi.Object) -> Element | None:
        """The element, among those in `owner`, of the object `node` that Mitsuba calls `name` there.

        Some objects lose their ids, as bitmaps do; those in a group have none.
        """
        tag = next((tag for tag, kind in _KINDS.items() if isinstance(node, getattr(mi, kind))), None)
        named: list[Element] = []
        unnamed: list[Element] = []
        for item in owner.children:
            meant = self._elements.get(item.attributes["id"], item) if item.tag == "ref" else item
            has_own_id = owner.type == "shapegroup" and "id" in meant.attributes  # by which it is found
            if meant.tag == tag and item.name in (name, "") and not has_own_id:
                (named if item.name else unnamed).append(meant)
        if named or not unnamed:
            return named[0] if named else None
        number = re.fullmatch(r".*?(?:_(\d+))?", name)
        place = int(number[1] or 0) if number else 0
        return unnamed[0] if len(unnamed) == 1 else unnamed[place] if place < len(unnamed) else None
