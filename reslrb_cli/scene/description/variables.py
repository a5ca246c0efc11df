"""The `$name` variables of a scene file, put in as Mitsuba's parser does."""

from __future__ import annotations

import re
from collections.abc import Mapping

from ...errors import ConfigError
from .element import Element, quoted

#: Characters of one attribute, after its variables are put in: variables of variables can grow at each step.
MAX_LENGTH = 2**20
#: Characters of a variable's name; longer ones are never found.
_LONGEST_NAME = 256


class Variables:
    """Values by name: those that the user gives, and the file's defaults as they are met."""

    def __init__(self, options: Mapping[str, str]) -> None:
        self._values = dict(options)
        self._unused = set(options)

    def add_default(self, name: str, value: str) -> None:
        """Set the value of `name` where it has none yet."""
        self._values.setdefault(name, value)

    def values(self) -> dict[str, str]:
        """All values so far, those of the user first."""
        return dict(self._values)

    def put_into(self, element: Element) -> None:
        """Replace the variables in the attributes of `element`. Raises ConfigError for one without a value."""
        for key, text in element.attributes.items():
            if "$" in text:
                element.attributes[key] = self._replace(text, element)

    def _replace(self, text: str, element: Element) -> str:
        # The longest name first, since a name may be the beginning of another; and each once.
        done: set[str] = set()
        longest = _LONGEST_NAME
        while names := [name for name in self._named(text, longest) if name not in done]:
            name = max(names, key=len)
            done.add(name)
            longest = len(name)
            value, parts = self._values[name], re.split(r"(?<!\\)" + re.escape(f"${name}"), text)
            if len(parts) > 1:
                self._unused.discard(name)
            if len(text) + len(parts) * len(value) > MAX_LENGTH:
                raise element.fail(f"${name}", f"makes a text of more than {MAX_LENGTH} characters")
            text = value.join(parts)
        missing = re.search(r"(?<!\\)\$(\w*)", text, re.ASCII)
        if missing:
            name = quoted(missing[1], "")
            how = f"set scene.options.{name} (--set scene.options.{name}=VALUE)"
            message = f"has no value and no default; {how}" if name else "is no variable; write \\$"
            raise element.fail(f"${name}", message)
        return text.replace("\\$", "$")

    def _named(self, text: str, longest: int) -> set[str]:
        """The names of at most so many characters that stand behind a `$` in `text`."""
        longest = min(longest, max(map(len, self._values), default=0))
        behind = (text[place.end() : place.end() + longest] for place in re.finditer(r"\$", text))
        return {run[:n] for run in behind for n in range(1, len(run) + 1) if run[:n] in self._values}

    def check_used(self, source: object) -> None:
        """Raise ConfigError, located in `source`, where a value that the user gives was never put in."""
        if self._unused:
            names = ", ".join(f"${name}" for name in self._values if name in self._unused)
            raise ConfigError(source, quoted(names, ""), "is set in scene.options, but the scene file does not use it")
