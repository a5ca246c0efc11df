"""A scene's elements as the XML that Mitsuba's own parser reads."""

from __future__ import annotations

from collections.abc import Iterator
from xml.sax.saxutils import quoteattr

from .element import Element


def tag_lines(element: Element, depth: int = 0) -> Iterator[tuple[str, Element]]:
    """The XML of `element` and all below it, a tag a line, each with the element that it belongs to."""
    # `$` begins a variable for Mitsuba's parser; here all are put in already.
    attributes = "".join(f" {key}={quoteattr(value)}" for key, value in element.attributes.items())
    indent, end = "    " * depth, "" if element.children else "/"
    yield f"{indent}<{element.tag}{attributes.replace('$', chr(92) + '$')}{end}>", element
    for child in element.children:
        yield from tag_lines(child, depth + 1)
    if element.children:
        yield f"{indent}</{element.tag}>", element
