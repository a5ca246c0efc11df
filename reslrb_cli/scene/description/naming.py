"""Lasting names for objects without an id: their kind, and their number among all of that kind.

Mitsuba names an object without an id by its address in memory, which differs each time that the scene is loaded.
"""

from __future__ import annotations

from collections import Counter

from .element import Element
from .notes import Note

#: Plugins that name what they hold by its place among the others, in every load alike.
_GROUPS = ("shapegroup", "batch")


def name_objects(root: Element) -> list[Note]:
    """Give every object below `root` an id that is there in every load of the same files; say whose ids were changed.

    The third `sphere` of the files becomes `Sphere_3`, whether or not the first two have ids. An id that Mitsuba could
    not use in a key is replaced: one that is empty, or starts with `_unnamed_` (as Mitsuba itself writes), or holds
    what cannot be printed, or stands at an earlier object already. References follow. Raises ConfigError where a
    reference is to an id of two objects that differ.
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
        numbers[element.type] += 1
        own = element.attributes.get("id", "")
        if own in owners:
            doubled.setdefault(own, []).append(element)
        elif _is_usable(own):
            owners[own] = element
            continue
        elif element in grouped and not own:
            continue
        name = _free(f"{element.type[:1].upper()}{element.type[1:]}_{numbers[element.type]}", taken)
        taken.add(name)
        element.attributes["id"] = name
        if own in owners:
            notes.append(Note(element, f"id {own!r} is that of line {owners[own].line}, too", f"named {name}"))
        elif own.strip() and own not in renamed:
            renamed[own] = name
            if not own.isprintable():
                notes.append(Note(element, f"id {own!r} cannot be printed", f"named {name}"))
    for element in root.walk():
        if element.tag in ("ref", "alias") and "id" in element.attributes:
            _follow(element, owners, doubled, renamed)
    return notes


def _is_usable(own: str) -> bool:
    return own.strip() != "" and own.isprintable() and not own.startswith("_unnamed_")


def _free(name: str, taken: set[str]) -> str:
    """`name`, or the first of name_2, name_3 ... that no object has for its id."""
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free


def _follow(
    reference: Element, owners: dict[str, Element], doubled: dict[str, list[Element]], renamed: dict[str, str]
) -> None:
    own = reference.attributes["id"]
    for other in doubled.get(own, []):
        if not _same(owners[own], other):
            places = f"{owners[own].place} and {other.place}"
            raise reference.fail("", f"refers to {own!r}, the id of two objects ({places}); rename one of them")
    reference.attributes["id"] = renamed.get(own, own)


def _same(a: Element, b: Element) -> bool:
    """Whether two elements, their ids aside, say the same."""
    own = [{key: value for key, value in element.attributes.items() if key != "id"} for element in (a, b)]
    return (
        (a.tag, own[0], len(a.children)) == (b.tag, own[1], len(b.children))
        and all(_same(x, y) for x, y in zip(a.children, b.children, strict=True))
    )  # fmt: skip
