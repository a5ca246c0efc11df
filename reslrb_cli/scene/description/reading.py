"""Reads one XML file into elements, and refuses what would take the parser down or never end."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from xml.parsers import expat

from ...config.files import read_file
from ...errors import ConfigError
from .element import Element, Source

#: XML of all files of a scene together, each counted as often as it is included.
MAX_BYTES = 64 * 2**20
#: Elements within one another. Mitsuba's parser calls itself for each level, until the stack is full.
MAX_DEPTH = 100

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
#: An ampersand that begins none of XML's own references: Mitsuba's parser takes it for itself.
_BARE_AMPERSAND = re.compile(r"&(?!(?:amp|lt|gt|quot|apos|#\d+|#x[0-9a-fA-F]+);)")
_DECLARED_ENCODING = re.compile(rb"""^\s*<\?xml[^>]*\bencoding\s*=\s*["']([\w.-]+)["']""")


def read_document(file: Path, max_bytes: int) -> tuple[Element, int]:
    """The root element of an XML file, and the file's size in bytes.

    Raises ConfigError, located in the file, where it cannot be read, is no regular file or larger than `max_bytes`, is
    not XML, is nested more than MAX_DEPTH levels deep, or declares entities.
    """
    data = read_file(file, MAX_BYTES)
    if len(data) > max_bytes:
        raise ConfigError(
            file, "", f"is too large: a scene may have {MAX_BYTES >> 20} MiB of XML, with all that it includes"
        )
    text = _COMMENT.sub(lambda comment: "\n" * comment[0].count("\n"), _decode(data))
    return _parse(file, _BARE_AMPERSAND.sub("&amp;", text)), len(data)


def _decode(data: bytes) -> str:
    """The text of a file; Mitsuba's parser takes bytes that are not of their encoding as they come."""
    declared = _DECLARED_ENCODING.match(data)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        encodings = ["utf-16"]
    else:
        encodings = ["utf-8-sig", *([declared[1].decode("ascii")] if declared else []), "latin-1"]
    for encoding in encodings:
        try:
            return data.decode(encoding)
        except (LookupError, UnicodeError):
            continue
    return data.decode("latin-1")


def _parse(file: Path, text: str) -> Element:
    parser = expat.ParserCreate("utf-8")
    stack: list[Element] = []
    roots: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        line = parser.CurrentLineNumber
        source = stack[0].source if stack else Source(file, _version(attributes.get("version")))
        element = Element(tag, attributes, source, line)
        if len(stack) == MAX_DEPTH:
            raise element.fail("", f"elements are nested more than {MAX_DEPTH} levels deep")
        (stack[-1].children if stack else roots).append(element)
        stack.append(element)

    def end(tag: str) -> None:
        stack.pop()

    def declare_entity(*_: Any) -> None:
        place = f"{file}:{parser.CurrentLineNumber}"
        raise ConfigError(
            place, "", "declares an XML entity, which no Mitsuba scene needs; write out what it stands for"
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.EntityDeclHandler = declare_entity
    try:
        parser.Parse(text.encode("utf-8"), True)
    except expat.ExpatError as error:
        raise ConfigError(f"{file}:{error.lineno}", "", f"not valid XML: {expat.ErrorString(error.code)}") from None
    return roots[0]


def _version(text: str | None) -> tuple[int, ...] | None:
    """A version as numbers; None where there is none, or it is not three numbers, which Mitsuba asks for."""
    return tuple(map(int, text.split("."))) if text is not None and re.fullmatch(r"\d+\.\d+\.\d+", text) else None
