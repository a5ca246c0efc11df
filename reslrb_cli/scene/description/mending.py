"""Mends what other versions of Mitsuba and exporters for them wrote, where it can be said in Mitsuba 3's own way."""

from __future__ import annotations

import os
from pathlib import Path

from ...backend.plugins import is_known
from . import dialects
from .colours import SPECTRA, by_wavelength, hexadecimal, linear
from .coordinates import transform_coordinates
from .element import Element, quoted
from .including import Description
from .notes import Note

CURRENT_VERSION = "3.0.0"


def mend(description: Description) -> list[Note]:
    """Bring the elements of a scene to Mitsuba 3's spelling, in place; say what its parser would have refused.

    What Mitsuba itself upgrades, in files of before version 2, is brought over without a word. Materials, lights and
    shapes keep their meaning: those that Mitsuba 3 does not have stay as they are, to be refused. Parameters that no
    plugin asks for show only when the scene is built.
    """
    mender = _Mender(description.folders)
    root = description.root
    if root.source.version is None:
        given = root.attributes.get("version")
        wrong = "the version is missing" if given is None else f"version {quoted(given)} is not three numbers"
        mender.note(root, wrong, f"taken for {CURRENT_VERSION}")
    mender.mend_root(root)
    root.attributes["version"] = CURRENT_VERSION
    return mender.notes


class _Mender:
    def __init__(self, folders: list[Path]) -> None:
        self.folders = folders
        self.notes: list[Note] = []
        self.gone: set[str] = set()

    def note(self, element: Element, wrong: str, done: str) -> None:
        self.notes.append(Note(element, wrong, done))

    def mend_root(self, root: Element) -> None:
        """Mend the whole scene."""
        root.attributes.pop("version", None)
        if root.is_object:
            self._element(root)
        self.mend(root)
        self._spectra(root)
        # What refers to something that was left out goes with it.
        for element in root.walk() if self.gone else ():
            element.children[:] = [
                child for child in element.children if child.tag != "ref" or child.attributes.get("id") not in self.gone
            ]

    def mend(self, element: Element) -> None:
        """Mend all below `element`, which is mended itself."""
        kept = []
        names = {child.name for child in element.children}
        for child in element.children:
            if self._is_kept(child):
                if element.is_object:
                    self._parameter(child, element, names)
                if not self._is_needless_format(child, element):
                    kept.append(child)
            else:
                self.gone.update(other.attributes.get("id", "") for other in child.walk() if other.is_object)
        element.children[:] = kept
        if element.is_object:
            self._repetitions(element)
            self._texture_coordinates(element)
        for child in element.children:
            self.mend(child)

    def _is_kept(self, element: Element) -> bool:
        """Mend an element and its plugin; False where it is to be left out."""
        if element.tag == "integrator":  # the experiment's own takes its place
            return False
        return self._element(element) and (not element.is_object or self._plugin(element))

    # --- elements and plugins -----------------------------------------------------------------------------------------

    def _element(self, element: Element) -> bool:
        """Mend tag and attributes; False where the element is to be left out."""
        tag = element.tag
        if tag == "srgb":
            element.attributes["value"] = linear(element)
        if tag in dialects.ELEMENTS:
            element.tag = dialects.ELEMENTS[tag]
            self.note(element, f"{quoted(f'<{tag}>')} is unknown to Mitsuba 3", f"read as <{element.tag}>")
        known = dialects.ATTRIBUTES.get(element.tag)
        if element.is_object:
            known = dialects.OBJECT_ATTRIBUTES
        if known is None:
            if tag in dialects.LOST_ELEMENTS:
                raise element.fail("", f"<{tag}> is {dialects.LOST_ELEMENTS[tag]}")
            self.note(element, f"{quoted(f'<{tag}>')} is unknown to Mitsuba 3", "left out")
            return False
        for attribute in [name for name in element.attributes if name not in known]:
            self.note(element, f"<{tag}> has no attribute {quoted(attribute)} in Mitsuba 3", "left out")
            del element.attributes[attribute]
        return True

    def _plugin(self, element: Element) -> bool:
        """Mend the name of an object's plugin; False where the object is to be left out."""
        type = element.type
        if is_known(type):
            if element.tag == "sampler" and type != "independent":
                # Others round the number of samples, which is the experiment's, and fail where it is split otherwise.
                element.attributes["type"] = "independent"
                element.children[:] = [child for child in element.children if child.name == "sample_count"]
            return True
        other = dialects.PLUGINS.get((element.tag, type), type.lower())
        if is_known(other):
            self.note(element, f"there is no {element.tag} {quoted(type)} in Mitsuba 3", f"read as `{other}`")
            element.attributes["type"] = other
            return True
        replacement = dialects.REPLACEABLE.get(element.tag)
        if replacement is None:
            return True
        self.note(element, f"there is no {element.tag} {quoted(type)} in Mitsuba 3", f"left out ({replacement})")
        return False

    # --- parameters ---------------------------------------------------------------------------------------------------

    def _parameter(self, element: Element, owner: Element, names: set[str]) -> None:
        """Mend the name and the value of a parameter of `owner`, whose parameters have these `names`."""
        if owner.tag == "scene" and element.is_object:
            # A name says nothing here, but of two objects with the same one Mitsuba drops the first.
            element.attributes.pop("name", None)
            return
        self._name(element, owner, names)
        value = element.attributes.get("value", "")
        if element.tag == "spectrum" and "type" not in element.attributes and _is_colour(value):
            self.note(element, "a <spectrum> of three numbers is unknown to Mitsuba 3", "read as <rgb>")
            element.tag = "rgb"
        elif element.tag == "rgb" and value.startswith("#"):
            element.attributes["value"] = hexadecimal(element)
            self.note(element, f"a colour cannot be written as {quoted(value)} in Mitsuba 3", "read as three numbers")
        elif element.tag == "string":
            self._text(element, owner, value)

    def _name(self, element: Element, owner: Element, names: set[str]) -> None:
        old, name = element.name, dialects.snake_case(element.name)
        if owner.type == "diffuse" and name == "diffuse_reflectance":
            name = "reflectance"
        # An attribute of a mesh has a name of the user's own.
        is_attribute = owner.tag == "shape" and old.startswith(("vertex_", "face_"))
        if name == old or is_attribute or name in names:
            return
        element.attributes["name"], element.written = name, old
        if not element.source.is_old:
            self.note(element, f"{quoted(old)} is spelled as before Mitsuba 2", f"read as {quoted(name)}")

    def _text(self, element: Element, owner: Element, value: str) -> None:
        other = dialects.VALUES.get((owner.type, element.name), {}).get(value)
        if (owner.type, element.name) == ("hdrfilm", "pixel_format") and "," in value:
            other = value.partition(",")[0].strip()  # one for each of several images
        wrong = f"{owner.type} has no {element.name} {quoted(value)} in Mitsuba 3"
        slashed = value.replace("\\", "/")
        if element.name == "filename" and slashed != value and not self._exists(value) and self._exists(slashed):
            other, wrong = slashed, f"there is no file {quoted(value)}"
        if other is not None:
            element.attributes["value"] = other
            self.note(element, wrong, f"read as {quoted(other)}")

    def _exists(self, file: str) -> bool:
        return any(os.path.exists(folder / file) for folder in self.folders)

    def _is_needless_format(self, element: Element, owner: Element) -> bool:
        """Whether `element` asks `hdrfilm` for a format that it does not know: images are written without it."""
        known = dialects.FORMATS.get(element.name)
        value = element.attributes.get("value", "")
        if owner.type != "hdrfilm" or known is None or element.tag != "string" or value.lower() in known:
            return False
        self.note(element, f"hdrfilm has no {element.name} {quoted(value)} in Mitsuba 3", "left out")
        return True

    def _repetitions(self, owner: Element) -> None:
        """Of parameters that are given more than once keep the last, as Mitsuba 0.6 did."""
        last: dict[str, Element] = {}
        dropped: set[Element] = set()
        for child in owner.children:
            earlier = last.get(child.name) if child.name else None
            if earlier is not None and (earlier.is_value or child.is_value):
                self.note(earlier, f"{quoted(child.name)} is given again in line {child.line}", "left out")
                dropped.add(earlier)
            last[child.name] = child
        owner.children[:] = [child for child in owner.children if child not in dropped]

    def _spectra(self, root: Element) -> None:
        """Write spectra by wavelength as parameters of what has them, since RGB variants have no such plugins."""
        named = {
            element.attributes["id"]: element
            for element in root.walk()
            if element.tag in ("spectrum", "texture") and element.type in SPECTRA and "id" in element.attributes
        }
        for alias in [element for element in root.walk() if element.tag == "alias"]:
            if alias.attributes.get("id") in named:
                named[alias.attributes.get("as", "")] = named[alias.attributes["id"]]
        for owner in [element for element in root.walk() if element.is_object and element.type != "specfilm"]:
            kept = []
            for child in owner.children:
                meant = named.get(child.attributes.get("id", ""))
                if meant is None:
                    kept.append(child)
                elif owner is not root:
                    name = child.name or meant.name
                    if not name:
                        raise child.fail("", f"<{meant.tag}> `{meant.type}` needs a name: that of what it is for")
                    attributes = {"name": name, **by_wavelength(meant, owner)}
                    kept.append(Element("spectrum", attributes, child.source, child.line))
                    self.note(meant, f"RGB variants have no spectrum `{meant.type}`", "read as the colour of it")
            owner.children[:] = kept

    def _texture_coordinates(self, owner: Element) -> None:
        replaced = transform_coordinates(owner) if owner.tag == "texture" else None
        if replaced is not None and not owner.source.is_old:
            self.note(replaced, f"`{replaced.name}` is unknown to Mitsuba 3", "read as `to_uv`")


def _is_colour(value: str) -> bool:
    return ":" not in value and len(value.replace(",", " ").split()) == 3
