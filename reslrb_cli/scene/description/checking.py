"""What a scene's files must not say: plugins that are not Mitsuba's, endless files, chains without end."""

from __future__ import annotations

import os
import re
import stat
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import mitsuba as mi

from ...backend.plugins import is_known, nearest_plugin, plugin_type
from ...errors import ConfigError
from . import dialects
from .element import Element, quoted
from .including import Description
from .reading import MAX_DEPTH

#: Parameters without which a plugin reads memory that is not its own.
_NEEDED = {"bitmap": "filename", "normalmap": "normalmap"}
_VECTORS = ("point", "vector", "translate", "scale", "rotate")
_NUMBERS = ("float", "rgb", "spectrum", "matrix", "lookat", *_VECTORS)
#: Mitsuba reads these as numbers.
_NOT_FINITE = re.compile(r"(?i)(?<![\w.])[-+]?(nan|inf|infinity)(?!\w)")
#: Lines, or objects, that one message names.
_SHOWN = 5


def check(description: Description) -> None:
    """Raise ConfigError, located by file and line, for what must not reach Mitsuba's parser."""
    for element in description.root.walk():
        if element.is_object:
            refused = dialects.REFUSED_PLUGINS.get((element.tag, element.type))
            if refused is not None:
                raise element.fail("", f"{element.tag} `{element.type}` {refused}")
            if not is_known(element.type):
                raise _unknown_plugin(description.root, element)
            _check_kind(element)
            _check_needed(element)
        elif element.tag in _NUMBERS:
            _check_finite(element)
            if element.tag in _VECTORS:
                _check_vector(element)
        if element.tag == "string" and element.name == "filename":
            _check_regular(element, description.folders)
    _check_chains(description.root)


def _check_kind(element: Element) -> None:
    """Refuse a plugin that is not what its element says."""
    type = plugin_type(element.type)
    if type not in (mi.ObjectType.Unknown, _object_type(element.tag)):
        raise element.fail("", f"{quoted(element.type)} is no {element.tag}")


def _check_needed(element: Element) -> None:
    """Refuse an object without what Mitsuba takes to be there, and reads memory that is not its own."""
    name = _NEEDED.get(element.type)
    if name is not None and not any(child.name == name for child in element.children):
        raise element.fail("", f"{element.type} needs a parameter `{name}`")
    if element.type == "blendbsdf" and sum(child.tag in ("bsdf", "ref") for child in element.children) < 2:
        raise element.fail("", "blendbsdf needs two BSDFs")


def _check_finite(element: Element) -> None:
    """Refuse what is no number, and a colour or a place that is infinite: all that comes of it is not finite."""
    for name, text in element.attributes.items():
        bad = _NOT_FINITE.search(text) if name not in ("id", "name", "filename", "type") else None
        if bad is not None and (element.tag != "float" or bad[1].lower() == "nan"):
            raise element.fail(element.name or element.tag, f"{quoted(text)}: {bad[0]} is not finite")


def _check_vector(element: Element) -> None:
    """Refuse a vector that is given in two ways, or by a number of numbers; Mitsuba would not say where."""
    if "value" in element.attributes:
        if any(axis in element.attributes for axis in "xyz"):
            raise element.fail("", f"<{element.tag}> can have `value` or x, y and z, not both")
        if len(element.attributes["value"].replace(",", " ").split()) not in (1, 3):
            raise element.fail("", f"<{element.tag}> needs one or three numbers in `value`")


def _unknown_plugin(root: Element, element: Element) -> ConfigError:
    type, tag = element.type, element.tag
    if not type:
        return element.fail("", f"<{tag}> has no type")
    lines = [other.line for other in root.objects() if (other.tag, other.type) == (tag, type) and other is not element]
    more = (
        f" (also in line {', '.join(map(str, lines[:_SHOWN]))}{' and more' * (len(lines) > _SHOWN)})" if lines else ""
    )
    lost = dialects.LOST_PLUGINS.get((tag, type))
    if lost is not None:
        return element.fail("", f"{tag} `{type}` is a plugin of Mitsuba 0.6 that Mitsuba 3 does not have; {lost}{more}")
    near = nearest_plugin(type, _object_type(tag))
    hint = f"; did you mean `{near}`?" if near else "; only Mitsuba's own plugins are loaded"
    return element.fail("", f"there is no {tag} {quoted(type)} in Mitsuba 3{hint}{more}")


def _object_type(tag: str) -> mi.ObjectType:
    """Mitsuba's word for what an element is."""
    others = {
        "bsdf": "BSDF",
        "phase": "PhaseFunction",
        "rfilter": "ReconstructionFilter",
        "spectrum": "Texture",
    }
    return getattr(mi.ObjectType, others.get(tag, tag.capitalize()))


def _check_regular(element: Element, folders: list[Path]) -> None:
    """Refuse a file that is a pipe or a device: reading it might never end."""
    name = element.attributes.get("value", "")
    for path in [folder / name for folder in folders] + [Path(name)]:
        if os.path.exists(path):
            if not stat.S_ISREG(path.stat().st_mode):
                raise element.fail("filename", f"{path} is no regular file")
            return


def _check_chains(root: Element) -> None:
    """Refuse objects that use themselves, or others in chains so long that Mitsuba's stack would not hold them."""
    objects = root.objects()
    owners = {element.attributes["id"]: element for element in objects if "id" in element.attributes}
    for element in root.walk():
        if element.tag == "alias" and element.attributes.get("id") in owners:
            owners.setdefault(element.attributes.get("as", ""), owners[element.attributes["id"]])
    uses = {element: [child for child in element.children if child.is_object] for element in objects}
    for element in objects:
        references = [child.attributes.get("id") for child in element.children if child.tag == "ref"]
        uses[element] += [owners[name] for name in references if name in owners]
    try:
        order = list(TopologicalSorter(uses).static_order())
    except CycleError as error:
        circle: list[Element] = error.args[1]
        names = " uses ".join(element.attributes.get("id", element.tag) for element in reversed(circle[:_SHOWN]))
        raise circle[0].fail("", f"objects use one another in a circle: {names}") from None
    lengths: dict[Element, int] = {}
    for element in order:  # those that are used come first
        lengths[element] = 1 + max((lengths[other] for other in uses[element]), default=0)
        if lengths[element] > MAX_DEPTH:
            raise element.fail("", f"objects use one another in a chain of more than {MAX_DEPTH}")
