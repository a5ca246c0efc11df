"""The `$name` variables of a scene file, put in as Mitsuba's parser does."""

from __future__ import annotations

import re
from collections.abc import Mapping

from ...errors import ConfigError
from .element import Element

#: Characters of one attribute, after its variables are put in: variables of variables can double at each step.
MAX_LENGTH = 2**20


class Variables:
    """Values by name: those that the user gives, and the file's defaults as they are met."""

    def __init__(self, options: Mapping[str, str]) -> None:
        self._values = dict(options)
        self._unused = set(options)
        self._order: list[str] | None = None

    def add_default(self, name: str, value: str) -> None:
        """Set the value of `name` where it has none yet."""
        if name not in self._values:
            self._values[name] = value
            self._order = None

    def put_into(self, element: Element) -> None:
        """Replace the variables in the attributes of `element`. Raises ConfigError for one without a value."""
        for key, text in element.attributes.items():
            if "$" in text:
                element.attributes[key] = self._replace(text, element)

    def _replace(self, text: str, element: Element) -> str:
        if self._order is None:  # longest first: a name may be the beginning of another
            self._order = sorted(self._values, key=len, reverse=True)
        for name in self._order:
            variable, value = f"${name}", self._values[name]
            count = text.count(variable)
            if count == 0:
                continue
            if len(text) + count * len(value) > MAX_LENGTH:
                raise element.fail(variable, f"makes a text of more than {MAX_LENGTH} characters")
            parts = re.split(r"(?<!\\)" + re.escape(variable), text)
            if len(parts) > 1:
                self._unused.discard(name)
            text = value.join(parts)
        missing = re.search(r"(?<!\\)\$(\w*)", text, re.ASCII)
        if missing:
            name = missing[1]
            message = f"has no value and no default; set scene.options.{name}" if name else "is no variable; write \\$"
            raise element.fail(f"${name}", message)
        return text.replace("\\$", "$")

    def check_used(self, source: object) -> None:
        """Raise ConfigError, located in `source`, where a value that the user gives was never put in."""
        if self._unused:
            names = ", ".join(f"${name}" for name in self._values if name in self._unused)
            raise ConfigError(source, names, "is set in scene.options, but the scene file does not use it")
