"""`--set a.b=value`: a value, typed as YAML, at a place in the configuration."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from typing import Any

from ..errors import ConfigError, one_line
from .limits import DEPTH
from .text import UNFIT, Location, format_location, parse

#: Mappings whose keys are the user's own and may hold dots: what follows their name is one key.
FREE_MAPPINGS: tuple[Location, ...] = (("scene", "options"), ("target", "render", "parameters"))

_PART = re.compile(r"\[(\d+)\]|(?:^|\.)([^.\[\]]+)")


@dataclass(frozen=True)
class Override:
    """One `--set`: `label` as it is named in errors, the place, and the value."""

    label: str
    location: Location
    value: Any


def parse_override(text: str) -> Override:
    """An override from `a.b=value`. Raises ConfigError where `text` is none."""
    label = "--set " + one_line(text, 100)
    path, equals, value = text.partition("=")
    path = path.strip()
    if not equals or not path:
        raise ConfigError(label, "", "must be KEY=VALUE, such as run.spp=32")
    location = _parse_location(path, label)

    def in_shell(mended: str) -> str:
        return f"--set {shlex.quote(f'{path}={mended}')}"

    return Override(label, location, parse(value, label, name_line=False, example=in_shell))


def _parse_location(path: str, label: str) -> Location:
    if UNFIT.search(path):
        raise ConfigError(label, "", "a key must not hold control characters, or bytes that are not UTF-8")
    location: list[str | int] = []
    position = 0
    while position < len(path):
        match = _PART.match(path, position)
        if match is None:
            raise ConfigError(label, "", f"`{one_line(path, 100)}` is no key; write it as in parameters[0].bounds")
        index, name = match.groups()
        location.append(int(index[:9]) if index else name)
        position = match.end()
        if len(location) > DEPTH:
            raise ConfigError(label, "", f"leads deeper than {DEPTH} levels; no setting lies there")
        if tuple(location) in FREE_MAPPINGS and path[position : position + 1] == "." and path[position + 1 :]:
            return (*location, path[position + 1 :])
    return tuple(location)


def apply(data: dict[str, Any], override: Override) -> dict[str, Any]:
    """A copy of `data` with the override's value in its place; sections on the way are made.

    What is not on the way is shared with `data`. Raises ConfigError where the place cannot be: an index out of range, a
    key below a value that has none.
    """
    result = dict(data)
    at: Any = result
    for i, part in enumerate(override.location):
        here = override.location[:i]
        part = _check_part(at, part, here, override)
        if i == len(override.location) - 1:
            value = override.value
        else:
            value = at[part] if (part in at if isinstance(at, dict) else part < len(at)) else None
            if value is None:
                value = [] if isinstance(override.location[i + 1], int) else {}
            elif isinstance(value, (dict, list)):
                value = value.copy()
        if isinstance(at, list) and part == len(at):
            at.append(value)
        else:
            at[part] = value
        at = value
    return result


def _check_part(at: Any, part: str | int, here: Location, override: Override) -> Any:
    name = format_location(here)
    if isinstance(at, list):
        if isinstance(part, str) and part.isdecimal():
            part = int(part[:9])
        if not isinstance(part, int):
            raise ConfigError(override.label, name, f"is a list; name an entry, such as {name}[0]")
        if part > len(at):
            has = "1 entry" if len(at) == 1 else f"{len(at)} entries"
            raise ConfigError(override.label, name, f"has {has}; there is no [{part}]")
        return part
    if not isinstance(at, dict):
        raise ConfigError(override.label, name, "is a single value; replace it as a whole")
    if isinstance(part, int):
        raise ConfigError(override.label, name, "is no list; name a key of it, not an index")
    return part
