"""Colours as Mitsuba 0.6 let them be written, and spectra that RGB variants lack, in a form that has a colour there.

The plugins `regular`, `irregular` and `blackbody` can be evaluated by wavelength alone. Of the same spectrum written as
`<spectrum value="400:0.1, 700:0.9"/>` Mitsuba computes the colour, by the CIE's matching functions: that of light where
it is what an emitter emits, elsewhere that of a surface under D65.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence

from .element import Element, quoted

#: Spectra by wavelength, by plugin.
SPECTRA = ("regular", "irregular", "blackbody")
#: Wavelengths, in nm, of what Mitsuba takes for visible, and how far apart a black body's are taken.
_VISIBLE, _STEP = (360.0, 830.0), 5.0
#: Planck's constant times the speed of light squared, twice (W m^2), and times it over Boltzmann's (m K), as Mitsuba's.
_FIRST, _SECOND = 2 * 6.62607004e-34 * 2.99792458e8**2, 6.62607004e-34 * 2.99792458e8 / 1.38064852e-23


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


def by_wavelength(spectrum: Element, owner: Element) -> dict[str, str]:
    """The attributes of the <spectrum> that says what a plugin of `SPECTRA` says, as a parameter of `owner`.

    Raises ConfigError where it is no spectrum, or a black body that is not what an emitter emits.
    """
    inner = next((child for child in spectrum.children if child.tag == "spectrum" and child.name == "value"), None)
    if inner is not None and spectrum.type != "blackbody":
        return {key: value for key, value in inner.attributes.items() if key in ("value", "filename")}
    if spectrum.type == "blackbody":
        if owner.tag != "emitter":
            raise spectrum.fail("", f"a blackbody is what an emitter emits; a {owner.tag} can have <rgb>")
        pairs = _black_body(spectrum)
    elif spectrum.type == "regular":
        values, (first, last) = _numbers(spectrum, "values"), _range(spectrum, required=True)
        step = (last - first) / max(len(values) - 1, 1)
        pairs = [(first + step * place, value) for place, value in enumerate(values)]
    else:
        wavelengths, values = _numbers(spectrum, "wavelengths"), _numbers(spectrum, "values")
        if len(wavelengths) != len(values):
            raise spectrum.fail("", f"irregular has {len(wavelengths)} wavelengths and {len(values)} values")
        pairs = list(zip(wavelengths, values, strict=True))
    if len(pairs) < 2 or any(left >= right for (left, _), (right, _) in itertools.pairwise(pairs)):
        raise spectrum.fail("", f"{spectrum.type} needs two wavelengths or more, in ascending order")
    return {"value": ", ".join(f"{wavelength:.9g}:{value:.9g}" for wavelength, value in pairs)}


def _black_body(spectrum: Element) -> list[tuple[float, float]]:
    """Wavelengths in nm, and the radiance of a black body in W/(m^2 sr nm)."""
    [temperature, *more] = _numbers(spectrum, "temperature")
    if more or temperature <= 0:
        raise spectrum.fail("temperature", "must be a number of kelvin above 0")
    first, last = _range(spectrum, required=False)
    count = max(math.ceil((last - first) / _STEP), 1)
    pairs = []
    for place in range(count + 1):
        metres = 1e-9 * (first + (last - first) * place / count)
        exponent = min(_SECOND / (metres * temperature), 700.0)  # beyond it is 0 to a float, and the other overflows
        pairs.append((1e9 * metres, 1e-9 * _FIRST / (metres**5 * math.expm1(exponent))))
    return pairs


def _range(spectrum: Element, required: bool) -> tuple[float, float]:
    names = ("wavelength_min", "wavelength_max")
    given = {child.name for child in spectrum.children}
    ends = [
        _numbers(spectrum, name)[0] if required or name in given else default
        for name, default in zip(names, _VISIBLE, strict=True)
    ]
    if not 0 < ends[0] < ends[1]:
        raise spectrum.fail("", f"{spectrum.type}: wavelength_max must be above wavelength_min, and both above 0")
    return ends[0], ends[1]


def _numbers(spectrum: Element, name: str) -> Sequence[float]:
    """The numbers of a parameter, one or more, none of them negative or not finite."""
    text = next((child.attributes.get("value", "") for child in spectrum.children if child.name == name), None)
    if text is None:
        raise spectrum.fail("", f"{spectrum.type} needs a parameter `{name}`")
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if not numbers or not all(math.isfinite(number) and number >= 0 for number in numbers):
        raise spectrum.fail(name, f"must be numbers from 0 on, not {quoted(text)}")
    return numbers
