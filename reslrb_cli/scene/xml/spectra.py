"""Conversion of spectra by wavelength to elements that Mitsuba reads as colours.

The plugins `regular`, `irregular` and `blackbody` need wavelengths, which RGB variants lack. `convert_spectra` replaces
these plugins by elements such as `<spectrum value="400:0.1, 700:0.9"/>`. Mitsuba converts a `<spectrum>` element to a
colour with the CIE matching functions. For emitters, the result is the colour of light. Otherwise, the result is the
colour of a surface under D65.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from reslrb_cli.scene.xml.read import Element, floats, quoted

#: Plugins of spectra by wavelength.
_SPECTRA = ("regular", "irregular", "blackbody")
#: Mitsuba's visible range in nm; for black bodies, the step in nm and the maximum number of steps.
_VISIBLE, _STEP, _MOST = (360.0, 830.0), 5.0, 2**14
#: Planck's law: 2 h c^2 (W m^2) and h c / k_B (m K), with Mitsuba's constants.
_FIRST, _SECOND = 2 * 6.62607004e-34 * 2.99792458e8**2, 6.62607004e-34 * 2.99792458e8 / 1.38064852e-23


def convert_spectra(root: Element) -> list[Element]:
    """Replace the spectrum plugins below `root` by <spectrum> parameters in place. Return one replaced plugin per use.

    Raises ConfigError if a plugin is not a valid spectrum, or if it is not the parameter of an object.
    """
    named = {id: item for id, item in root.by_id().items() if item.type in _SPECTRA}
    used = []
    for owner in root.objects():
        kept = []
        for child in owner.children:
            meant = named.get(child.id)
            if meant is None:
                kept.append(child)
            elif owner is not root:
                name = child.name or meant.name
                if not name:
                    raise child.fail("", f"<{meant.tag}> `{meant.type}` needs a name, that of a parameter")
                kept.append(child.new("spectrum", name=name, **_by_wavelength(meant, owner)))
                used.append(meant)
        owner.children[:] = kept
    return used


def _by_wavelength(spectrum: Element, owner: Element) -> dict[str, str]:
    """Return the attributes of a <spectrum> element, a parameter of `owner`. The element is equivalent to `spectrum`, a
    plugin of `_SPECTRA`.

    Raises ConfigError if the plugin is not a valid spectrum, or is a black body outside of an emitter.
    """
    inner = spectrum.find("value")
    if spectrum.type == "blackbody":
        if owner.tag != "emitter":
            raise spectrum.fail("", f"only emitters can have a blackbody; a {owner.tag} can have <rgb>")
        wavelengths, values = _black_body(spectrum)
    elif inner is not None and inner.tag == "spectrum":
        return {key: value for key, value in inner.attributes.items() if key in ("value", "filename")}
    elif spectrum.type == "regular":
        values = _numbers(spectrum, "values")
        wavelengths = np.linspace(*_range(spectrum, ()), len(values))
    else:
        wavelengths, values = _numbers(spectrum, "wavelengths"), _numbers(spectrum, "values")
        if len(wavelengths) != len(values):
            raise spectrum.fail("", f"irregular has {len(wavelengths)} wavelengths and {len(values)} values")
    if len(wavelengths) < 2 or (np.diff(wavelengths) <= 0).any():
        raise spectrum.fail("", f"{spectrum.type} needs two wavelengths or more, in ascending order")
    pairs = zip(wavelengths, values, strict=True)
    return {"value": ", ".join(f"{wavelength:.9g}:{value:.9g}" for wavelength, value in pairs)}


def _black_body(spectrum: Element) -> tuple[np.ndarray, np.ndarray]:
    """Return wavelengths in nm, and the radiance of a black body in W/(m^2 sr nm)."""
    temperature = _numbers(spectrum, "temperature")
    if len(temperature) > 1 or temperature[0] <= 0:
        raise spectrum.fail("temperature", "must be a positive number of kelvin")
    first, last = _range(spectrum, _VISIBLE)
    nm = np.linspace(first, last, min(math.ceil((last - first) / _STEP), _MOST) + 1)
    exponent = _SECOND / (1e-9 * nm * temperature[0])
    # Above 700 the radiance is 0 in single precision, and expm1 overflows.
    return nm, 1e-9 * _FIRST / ((1e-9 * nm) ** 5 * np.expm1(np.minimum(exponent, 700)))


def _range(spectrum: Element, default: Sequence[float]) -> tuple[float, float]:
    """Return the range of wavelengths in nm. A missing `wavelength_min` or `wavelength_max` comes from `default`,
    unless `default` is empty.
    """
    names = ("wavelength_min", "wavelength_max")
    low, high = (
        default[place] if default and spectrum.find(name) is None else _numbers(spectrum, name)[0]
        for place, name in enumerate(names)
    )
    if not 0 < low < high:
        raise spectrum.fail("", f"{spectrum.type}: wavelength_max must be above wavelength_min, and both above 0")
    return low, high


def _numbers(spectrum: Element, name: str) -> np.ndarray:
    """Return the numbers of a parameter. Raises ConfigError if the parameter has no numbers, or if any number is
    negative or not finite.
    """
    if (parameter := spectrum.find(name)) is None:
        raise spectrum.fail("", f"{spectrum.type} needs a parameter `{name}`")
    numbers = np.array(floats(parameter.value))
    if not numbers.size or not (np.isfinite(numbers) & (numbers >= 0)).all():
        raise spectrum.fail(name, f"must be numbers of at least 0, not {quoted(parameter.value)}")
    return numbers
