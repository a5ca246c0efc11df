"""What a scene's XML consists of: elements that know the line that they come from."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from ...errors import ConfigError

#: Elements that are objects, made by plugins; a <spectrum> with a type is one, too.
OBJECTS = frozenset(
    (
        *("scene", "sensor", "film", "sampler", "rfilter", "integrator", "emitter"),
        *("shape", "bsdf", "texture", "medium", "phase", "volume"),
    )
)
#: Elements that are values of parameters; a <spectrum> without a type is one, too.
VALUES = frozenset(("float", "integer", "boolean", "string", "point", "vector", "rgb", "transform"))

#: Characters of a quotation.
_QUOTED = 60


def quoted(text: str, mark: str = "`") -> str:
    """What a file says, as it can stand in a message: not too long, and nothing in it that a terminal would obey."""
    text = text if len(text) <= _QUOTED else text[: _QUOTED - 3] + "..."
    return f"{mark}{text if text.isprintable() else repr(text)[1:-1]}{mark}"


@dataclass(frozen=True)
class Source:
    """One file of a scene; `version` is that of Mitsuba which it says that it was written for, None without one."""

    file: Path
    version: tuple[int, ...] | None

    @property
    def is_old(self) -> bool:
        """Whether it was written for Mitsuba before 2, which spelled parameters in another way."""
        return self.version is not None and self.version < (2,)


@dataclass(slots=True, eq=False)
class Element:
    """One element, with its attributes and children in their order.

    `written` is its name as the file has it, where that is another.
    """

    tag: str
    attributes: dict[str, str]
    source: Source
    line: int
    children: list[Element] = field(default_factory=list)
    written: str = ""

    @property
    def place(self) -> str:
        """File and line, as errors name them."""
        return f"{self.source.file}:{self.line}"

    @property
    def is_object(self) -> bool:
        """Whether a plugin is to be made of it."""
        return self.tag in OBJECTS or (self.tag == "spectrum" and "type" in self.attributes)

    @property
    def is_value(self) -> bool:
        """Whether it is the value of a parameter."""
        return self.tag in VALUES or (self.tag == "spectrum" and "type" not in self.attributes)

    @property
    def name(self) -> str:
        """The name of the parameter that it is, or empty."""
        return self.attributes.get("name", "")

    @property
    def type(self) -> str:
        """The name of its plugin; empty where it has none."""
        return self.attributes.get("type", "scene" if self.tag == "scene" else "")

    def fail(self, key: str, message: str) -> ConfigError:
        """The error for this element."""
        return ConfigError(self.place, key, message)

    def walk(self) -> Iterator[Element]:
        """This element and all below it, in the order of the file."""
        waiting = [self]
        while waiting:
            element = waiting.pop()
            yield element
            waiting += reversed(element.children)

    def objects(self) -> list[Element]:
        """The objects among them: the nodes that Mitsuba's parser makes, in its order."""
        return [element for element in self.walk() if element.is_object]
