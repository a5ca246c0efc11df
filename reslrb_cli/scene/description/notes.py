"""What was mended, or left out, so that a scene could be loaded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ...errors import ConfigError
from .element import Element

#: Lines that one warning names.
_LINES = 5


@dataclass(frozen=True)
class Note:
    """One thing in a scene's files that Mitsuba would refuse: `wrong` says what, `done` what was made of it."""

    element: Element
    wrong: str
    done: str


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
    return lines


def refuse(notes: Sequence[Note]) -> None:
    """Raise ConfigError for the first of `notes`, if there is any."""
    if notes:
        first = notes[0]
        more = f" (and {len(notes) - 1} more)" if len(notes) > 1 else ""
        raise ConfigError(
            first.element.place, "", f"{first.wrong}; with scene.strict: false it would be {first.done}{more}"
        )
