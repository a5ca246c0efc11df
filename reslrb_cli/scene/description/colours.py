"""Colours as Mitsuba 0.6 let them be written, as the three numbers that Mitsuba 3 takes."""

from __future__ import annotations

import re

from .element import Element, quoted


def hexadecimal(element: Element) -> str:
    """The three numbers of `#rrggbb`, each a fraction of 255. Raises ConfigError where it is none."""
    text = element.attributes.get("value", "").strip()
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text) is None:
        raise element.fail(element.name, f"must be a colour such as #80ff00, not {quoted(text)}")
    return " ".join(f"{int(text[i : i + 2], 16) / 255:.9g}" for i in (1, 3, 5))


def linear(element: Element) -> str:
    """The value of an <srgb> element, one or three numbers or `#rrggbb`, as linear Rec. 709. Raises ConfigError."""
    text = element.attributes.get("value", "")
    words = (hexadecimal(element) if text.strip().startswith("#") else text).replace(",", " ").split()
    try:
        encoded = [float(word) for word in words]
    except ValueError:
        encoded = []
    if len(encoded) not in (1, 3):
        raise element.fail(element.name, f"must be one or three numbers or #rrggbb, not {quoted(text)}")
    # IEC 61966-2-1
    return " ".join(f"{c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4:.9g}" for c in encoded)
