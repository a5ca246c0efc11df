"""What was mended, or left out, so that a scene could be loaded."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ...errors import ConfigError
from .element import Element

#: Lines that one warning names, and warnings of one scene.
_LINES, _WARNINGS = 5, 30


@dataclass(frozen=True)
class Note:
    """One thing in a scene's files that Mitsuba would refuse: `wrong` says what, `done` what was made of it.

    `owner` is the object that has the element among its children and no use for it, where that is what is wrong.
    """

    element: Element
    wrong: str
    done: str
    owner: Element | None = None


def in_order(notes: Iterable[Note], root: Element) -> list[Note]:
    """The notes in the order of lines, those on the file of `root` first."""
    return sorted(notes, key=lambda note: (note.element.source != root.source, *_place(note)))


def _place(note: Note) -> tuple[str, int]:
    return str(note.element.source.file), note.element.line


def warnings(notes: Sequence[Note]) -> list[str]:
    """A line for each kind of thing, located where it is first met."""
    kinds: dict[tuple[str, str, object], list[Element]] = {}
    for note in notes:
        kinds.setdefault((note.wrong, note.done, note.element.source.file), []).append(note.element)
    lines = []
    for (wrong, done, _), elements in kinds.items():
        others = list(dict.fromkeys(element.line for element in elements[1:]))
        more = ", ".join(map(str, others[:_LINES])) + (f" and {len(others) - _LINES} more" * (len(others) > _LINES))
        lines.append(f"{elements[0].place}: {wrong}: {done}" + (f" (also in line {more})" if others else ""))
    if len(lines) > _WARNINGS:
        rest = len(lines) - _WARNINGS
        lines = [
            *lines[:_WARNINGS],
            f"{notes[0].element.source.file}: {rest} more kinds of things were mended or left out",
        ]
    return lines


def refuse(notes: Sequence[Note]) -> None:
    """Raise ConfigError for the first of `notes`, if there is any."""
    if notes:
        first = notes[0]
        more = f" (and {len(notes) - 1} more)" if len(notes) > 1 else ""
        raise ConfigError(
            first.element.place, "", f"{first.wrong}; with scene.strict: false it would be {first.done}{more}"
        )
