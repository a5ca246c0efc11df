"""Conversion of scene files from other Mitsuba versions and exporters to Mitsuba 3. Assignment of stable ids.

Mitsuba names an object without an id by its address in memory, which differs at each load. `mend` gives an object
without an id a new id: the name of its file, or its kind and its number among all objects of this kind. Conversions
keep the meaning. `mend` returns notes on the parts that are left out, on spectra that become colours, and on all
conversions of files for Mitsuba 0.x.

The plugins `regular`, `irregular` and `blackbody` need wavelengths, which only spectral variants have. In other
variants, `convert_spectra` replaces these plugins by elements such as `<spectrum value="400:0.1, 700:0.9"/>`. Mitsuba
converts a `<spectrum>` element to a colour with the CIE matching functions. For emitters, the result is the colour of
light. Otherwise, the result is the colour of a surface under D65.

In spectral variants, `convert_spectra` replaces only `blackbody`: Mitsuba cannot sample its wavelengths in light paths,
and ends with an error of Dr.Jit.
"""

from __future__ import annotations

import itertools
import logging
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import mitsuba as mi
import numpy as np

from reslrb_cli.backend.installation import is_known
from reslrb_cli.scene.images import read_stored
from reslrb_cli.scene.response import decode_srgb
from reslrb_cli.scene.xml.read import Description, Element, floats, is_true, quoted


@dataclass(frozen=True)
class Note:
    """A part of a scene's files that is left out or simplified. `wrong` is the reason, and `done` is the result.

    If a plugin does not use an element, `owner` is the parent of the element. For other notes, it is None. `level` is
    `logging.INFO` for conversions that keep the meaning.
    """

    element: Element
    wrong: str
    owner: Element | None = None
    done: str = "left out"
    level: int = logging.WARNING


def warnings(notes: Iterable[Note]) -> list[tuple[str, int]]:
    """Return one line per kind of note, and its level. Each line names the first occurrence of its kind."""
    kinds: dict[tuple[str, int, Path], list[Element]] = {}
    for note in notes:
        kinds.setdefault((f"{note.wrong}: {note.done}", note.level, note.element.file), []).append(note.element)
    return [
        (f"{elements[0].place}: {text}" + f" (also {len(elements) - 1} more)" * (len(elements) > 1), level)
        for (text, level, _), elements in kinds.items()
    ]


#: Elements with another name in Mitsuba 3.
ELEMENTS = {"lookAt": "lookat", "srgb": "rgb"}
_BEFORE_04 = "an element of Mitsuba before 0.4, which had other axes; save the scene with Mitsuba 0.6"
#: Elements of Mitsuba 0.x that Mitsuba 3 cannot express, with the reason and a remedy.
LOST_ELEMENTS = {
    **dict.fromkeys(("camera", "luminaire"), _BEFORE_04),
    "subsurface": "an element of Mitsuba 0.6 that Mitsuba 3 does not have; remove it, or use a medium",
    "blackbody": "an element of Mitsuba 0.6 that Mitsuba 3 does not have; give its colour as <rgb>",
    "animation": "an element of Mitsuba 0.6; nothing moves in Mitsuba 3: give one of its transforms",
}

#: Attributes of elements that are not objects.
ATTRIBUTES = {
    **dict.fromkeys(("float", "integer", "boolean", "string", "rgb"), ("name", "value")),
    **dict.fromkeys(("point", "vector"), ("name", "value", "x", "y", "z")),
    **dict.fromkeys(("translate", "scale"), ("value", "x", "y", "z")),
    "spectrum": ("name", "value", "filename"),
    "ref": ("id", "name"),
    "alias": ("id", "as"),
    "transform": ("name",),
    "rotate": ("angle", "value", "x", "y", "z"),
    "lookat": ("origin", "target", "up"),
    "matrix": ("value",),
}

OBJECT_ATTRIBUTES = ("type", "id", "name")

#: Plugins with another name in Mitsuba 3, by tag and old name.
PLUGINS = {
    ("bsdf", "bump"): "bumpmap",
    **{("film", name): "hdrfilm" for name in ("exrfilm", "pngfilm", "ldrfilm", "tiledhdrfilm", "mfilm")},
}

#: Renamed values of text parameters, by plugin and parameter.
VALUES = {
    ("bitmap", "filter_type"): {"trilinear": "bilinear", "ewa": "bilinear"},
    ("hdrfilm", "pixel_format"): {
        "spectrum": "rgb",
        "spectrumAlpha": "rgba",
        "luminanceAlpha": "luminance_alpha",
        "xyzAlpha": "xyza",
    },
}


def snake_case(name: str) -> str:
    """Convert a parameter's name to the spelling since Mitsuba 2: `toWorld` to `to_world`, `intIOR` to `int_ior`."""
    return re.sub(r"(?<=[a-z])[A-Z]+", lambda capitals: "_" + capitals[0].lower(), name)


def hexadecimal(element: Element) -> str:
    """Return the three numbers of `#rrggbb`, each divided by 255. Raises ConfigError if the format differs."""
    text = element.value.strip()
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text) is None:
        raise element.fail(element.name, f"must be a colour such as #80ff00, not {quoted(text)}")
    return " ".join(f"{int(text[i : i + 2], 16) / 255:.9g}" for i in (1, 3, 5))


def linear(element: Element) -> str:
    """Convert an <srgb> element (one or three numbers, or `#rrggbb`) to linear Rec. 709. Raises ConfigError."""
    text = element.value
    encoded = floats(hexadecimal(element) if text.strip().startswith("#") else text)
    if len(encoded) not in (1, 3):
        raise element.fail(element.name, f"must be one or three numbers or #rrggbb, not {quoted(text)}")
    return " ".join(f"{value:.9g}" for value in decode_srgb(np.array(encoded)))


def transform_coordinates(texture: Element) -> bool:
    """Replace a texture's `uoffset`, `voffset`, `uscale` and `vscale` by a `to_uv` transform. Return whether there are
    any.
    """
    names = ("uoffset", "voffset", "uscale", "vscale")
    given = {child.name: child for child in texture.children if child.tag == "float" and child.name in names}
    if not given:
        return False
    steps = []
    for tag, word in (("translate", "offset"), ("scale", "scale")):  # the order of the steps matters
        axes = {axis: given[u + word].value for axis, u in (("x", "u"), ("y", "v")) if u + word in given}
        steps += [texture.new(tag, **axes)] if axes else []
    texture.drop(*given)
    texture.children.append(texture.new("transform", *steps, name="to_uv"))
    return True


#: Plugins that name their children by position, which is the same at every load.
_GROUPS = ("shapegroup", "batch")
#: Prefix of the ids that Mitsuba writes for objects without an id. It ignores them when it reads a scene.
_UNNAMED = "_unnamed_"
#: Ids that Mitsuba's `dict_to_xml`, and so the exporter of Blender, writes for objects without an id.
_NUMBERED = re.compile(r"elm__\d+")


def name_objects(root: Element, used: Iterable[str] = ()) -> list[Note]:
    """Give every object below `root` an id that is the same at every load. Return notes on unprintable ids.

    A shape without an id gets the name of its file: `Lamp` for `meshes/Lamp.ply`. Among other objects, the third
    `sphere` of the files becomes `Sphere_3`, whether or not the first two have ids. Ids that are empty or unprintable,
    start with `_unnamed_`, or are numbers of an exporter are replaced, and references to them are updated.

    `used` are keys or globs, perhaps of earlier versions, which numbered all shapes: an object that they name by its
    number, as in `Ply_3` or `elm__12`, keeps this name. Raises ConfigError if two objects have one id, which Mitsuba
    refuses as well.
    """
    used = {word.partition(".")[0] for word in used}
    root.attributes.pop("id", None)
    objects = root.objects()[1:]
    grouped = {child for element in objects if element.type in _GROUPS for child in element.children}
    taken = {element.attributes[key] for element in root.walk() for key in ("id", "as") if key in element.attributes}
    owners: dict[str, Element] = {}
    renamed: dict[str, str] = {}
    notes: list[Note] = []
    numbers: Counter[str] = Counter()
    for element in objects:
        kind = element.type[:1].upper() + element.type[1:]
        numbers[kind] += 1
        own = element.id
        if own in owners:
            raise element.fail("", f"id {quoted(own)} is also that of {owners[own].place}; rename one of them")
        file = _file_stem(element)
        if own.strip() and own.isprintable() and not own.startswith(_UNNAMED):
            owners[own] = element
            if not (file and _NUMBERED.fullmatch(own)) or _names(used, own, file):
                continue
        if element in grouped and not own:
            continue
        first = f"{kind}_{numbers[kind]}"
        name = _untaken(first, taken)
        if file and (_NUMBERED.fullmatch(own) or not _names(used, name, file)):
            name = _untaken(file, taken)
        taken.add(name)
        element.attributes["id"] = name
        if own.strip() and own not in renamed:
            renamed[own] = name
            if not own.startswith(_UNNAMED) and not _NUMBERED.fullmatch(own):
                notes.append(Note(element, f"id {quoted(own)} cannot be part of a key", done=f"named {name}"))
    for element in root.walk("ref", "alias"):
        if element.id in renamed:
            element.attributes["id"] = renamed[element.id]
    return notes


def _file_stem(shape: Element) -> str:
    """Return the name of a shape's file as part of a key, without its suffix, or ""."""
    file = shape.find("filename") if shape.tag == "shape" else None
    stem = "" if file is None else re.split(r"[/\\]", file.value)[-1].rpartition(".")[0]
    return re.sub(r"[^\w-]+", "_", stem).strip("_")


def _untaken(first: str, taken: set[str]) -> str:
    names = itertools.chain([first], (f"{first}_{number}" for number in itertools.count(2)))
    return next(name for name in names if name not in taken)


def _names(used: Iterable[str], name: str, other: str) -> bool:
    """Whether a glob of `used` matches `name`, and not also the `other` name."""
    return any(fnmatchcase(name, word) and not fnmatchcase(other, word) for word in used)


def mend(description: Description, used: Iterable[str] = ()) -> list[Note]:
    """Convert the elements of a scene to Mitsuba 3 in place. Return notes on the parts that are left out, on spectra
    that become colours, and on all conversions of files for Mitsuba 0.x. `used` is that of `name_objects`.

    Materials, lights and shapes keep their meaning. Materials, lights and shapes that Mitsuba 3 lacks stay unchanged,
    and a later check refuses them. Unused parameters are found only when the scene is built.
    """
    mender, root = _Mender(description), description.root
    mender.notes += name_objects(root, used)
    root.attributes.pop("version", None)
    if root.is_object:
        mender.mend_element(root)
    mender.mend_below(root)
    if mi.is_spectral:
        upsample_bitmaps(description)
    replaced = convert_spectra(root)
    for spectrum in () if mi.is_spectral else replaced:
        wrong = f"RGB variants have no spectrum `{spectrum.type}`"
        mender.notes.append(Note(spectrum, wrong, done="read as its colour"))
    root.attributes["version"] = "3.0.0"
    return [*mender.notes, *mender.renamed()]


class _Mender:
    def __init__(self, description: Description) -> None:
        self.notes: list[Note] = []
        #: Files for Mitsuba 0.x, and the elements whose parameters have other names in Mitsuba 3.
        self.old = [file for file, version in description.files.items() if version.startswith("0.")]
        self._renamed: list[Element] = []

    def renamed(self) -> Iterator[Note]:
        """Yield a note on the renamed parameters of each file for Mitsuba 0.x."""
        for file in self.old:
            found = {element.written: element for element in self._renamed if element.file == file}
            if not found:
                continue
            old, element = next(iter(found.items()))
            more = f", and {len(found) - 1} other names likewise" if len(found) > 1 else ""
            done = f"read as {quoted(element.name)}{more}"
            yield Note(element, f"{quoted(old)} is a name of Mitsuba 0.6", done=done, level=logging.INFO)

    def tell(self, element: Element, wrong: str, done: str, level: int = logging.INFO) -> None:
        """Note a conversion if the element is in a file for Mitsuba 0.x."""
        if element.file in self.old:
            self.notes.append(Note(element, wrong, done=done, level=level))

    def mend_below(self, element: Element) -> None:
        """Mend all elements below `element`. `element` itself must be mended already."""
        names = {child.name for child in element.children}
        # The experiment's integrator replaces that of the scene.
        kept = [child for child in element.children if child.tag != "integrator" and self.mend_element(child)]
        if element.is_object:
            kept = [child for child in kept if self._parameter(child, element, names)]
        element.children[:] = kept
        if element.is_object:
            self._repetitions(element)
        if element.tag == "texture" and transform_coordinates(element):
            self.tell(element, "scale and offset of a texture", "read as `to_uv`")
        for child in element.children:
            self.mend_below(child)

    def mend_element(self, element: Element) -> bool:
        """Mend the tag, the attributes and the plugin. Return False if the element must be left out."""
        tag = element.tag
        if tag == "srgb":
            element.attributes["value"] = linear(element)
        element.tag = ELEMENTS.get(tag, tag)
        if element.tag != tag:
            self.tell(element, f"<{tag}> is an element of Mitsuba 0.6", f"read as <{element.tag}>")
        known = OBJECT_ATTRIBUTES if element.is_object else ATTRIBUTES.get(element.tag)
        if known is None:
            if tag in LOST_ELEMENTS:
                raise element.fail("", f"<{tag}> is {LOST_ELEMENTS[tag]}")
            self.notes.append(Note(element, f"{quoted(f'<{tag}>')} is unknown to Mitsuba 3"))
            return False
        for attribute in [name for name in element.attributes if name not in known]:
            self.notes.append(Note(element, f"<{tag}> has no attribute {quoted(attribute)} in Mitsuba 3"))
            del element.attributes[attribute]
        type = element.type
        if tag == "sampler" and type != "independent":
            # Other samplers round the sample count, which the experiment sets, and fail if it is split differently.
            self.tell(element, f"sampler {quoted(type)}", "read as `independent`")
            element.attributes["type"] = "independent"
            element.children[:] = [child for child in element.children if child.name == "sample_count"]
        elif element.is_object and not is_known(type):
            other = PLUGINS.get((tag, type), type.lower())
            element.attributes["type"] = other if is_known(other) else type
            if element.type != type:
                self.tell(element, f"{tag} {quoted(type)} is a plugin of Mitsuba 0.6", f"read as `{element.type}`")
        if element.file in self.old:
            self._change_meaning(element)
        return True

    def _change_meaning(self, element: Element) -> None:
        """Keep the meaning of a plugin of Mitsuba 0.x whose defaults or axes are others in Mitsuba 3."""
        if element.type == "sunsky":
            reason = "had y as its up axis, and other parameters, in Mitsuba 0.6"
            raise element.fail(
                "", f"`sunsky` {reason}; write it for Mitsuba 3, with z as its up axis, in a file of 3.0.0"
            )
        names = {child.name for child in element.children}
        if element.type in ("conductor", "roughconductor") and not names & {"material", "eta", "k"}:
            element.children.append(element.new("string", name="material", value="Cu"))
            wrong = f"{element.type} without a material is copper in Mitsuba 0.6, and a perfect mirror in Mitsuba 3"
            self.tell(element, wrong, "read as copper", logging.WARNING)

    def _parameter(self, element: Element, owner: Element, names: set[str]) -> bool:
        """Mend the name and the value of a parameter of `owner`. `names` are the names of all parameters of `owner`.

        Returns False if the parameter must be left out.
        """
        if owner.tag == "scene" and element.is_object:
            # Names have no meaning here, but Mitsuba drops the first of two objects with the same name.
            element.attributes.pop("name", None)
            return True
        self._name(element, owner, names)
        name, value = element.name, element.value
        count = len(floats(value)) if element.tag == "spectrum" and "type" not in element.attributes else 0
        if count == 3:
            self.tell(element, "a <spectrum> of three numbers", "read as <rgb>")
            element.tag = "rgb"
        elif count == 1 and owner.tag == "emitter" and element.file in self.old and not mi.is_spectral:
            # Mitsuba 3 emits the same power at all wavelengths, whose colour is not that of D65.
            wrong = "one number as the <spectrum> of an emitter is grey in Mitsuba 0.6"
            self.tell(element, wrong, "read as grey <rgb>", logging.WARNING)
            element.tag, element.attributes["value"] = "rgb", " ".join(3 * [value.strip(" ,")])
        elif element.tag == "rgb" and value.startswith("#"):
            element.attributes["value"] = hexadecimal(element)
        if element.tag != "string":
            return True
        if owner.type == "hdrfilm" and name == "pixel_format":
            value = value.partition(",")[0].strip()  # a list has one format per image; keep the first
        new = VALUES.get((owner.type, name), {}).get(value, value)
        if new != value:
            self.tell(element, f"{quoted(name)} {quoted(value)}", f"read as `{new}`")
        element.attributes["value"] = new
        # Films write no files here, and Mitsuba 3 does not have all formats of earlier versions.
        return owner.type != "hdrfilm" or name not in ("file_format", "component_format")

    def _name(self, element: Element, owner: Element, names: set[str]) -> None:
        old, name = element.name, snake_case(element.name)
        if owner.type == "diffuse" and name == "diffuse_reflectance":
            name = "reflectance"
        # Users choose the names of mesh attributes and of a film's channels.
        is_attribute = owner.tag == "shape" and old.startswith(("vertex_", "face_"))
        is_attribute = is_attribute or (owner.type == "specfilm" and element.tag in ("spectrum", "texture", "ref"))
        if name != old and not is_attribute and name not in names:
            element.attributes["name"], element.written = name, old
            self._renamed.append(element)

    def _repetitions(self, owner: Element) -> None:
        """If a parameter is given more than once, keep only the last one, as in Mitsuba 0.6."""
        last: dict[str, Element] = {}
        dropped: set[Element] = set()
        for child in owner.children:
            earlier = last.get(child.name) if child.name else None
            if earlier is not None and (earlier.is_value or child.is_value):
                self.notes.append(Note(earlier, f"{quoted(child.name)} is given again in line {child.line}"))
                dropped.add(earlier)
            last[child.name] = child
        owner.children[:] = [child for child in owner.children if child not in dropped]


# --- colours as spectra ---

#: Parameters that are colours, by the ends of their names.
_COLOURS = re.compile(r"(reflectance|transmittance|base_color|color\d|radiance|irradiance|intensity|^texture)$")
#: Files of linear floating-point numbers.
_LINEAR = (".exr", ".hdr", ".pfm", ".rgbe")


def upsample_bitmaps(description: Description) -> None:
    """Remove `raw` from the scene's bitmaps that are colours. In a spectral variant, Mitsuba would not convert raw
    colours to spectra. Raises ConfigError if the file of a colour is not linear. Bitmaps with one channel stay.

    Bump maps are no colours. Their bitmap may have the same name as the texture of a spot.
    """
    root = description.root
    named = root.by_id()
    for owner in (item for item in root.objects() if item.type != "bumpmap"):
        for child in owner.children:
            bitmap = named.get(child.id, child) if child.tag == "ref" else child
            raw = bitmap.find("raw") if bitmap.type == "bitmap" else None
            if raw is None or not is_true(raw) or not _COLOURS.search(child.name or bitmap.name):
                continue
            file = bitmap.find("filename")
            path = None if file is None else description.find_file(file.value)
            if file is not None and path is not None and not file.value.lower().endswith(_LINEAR):
                if read_stored(path).pixels.shape[2] <= 2:
                    continue
                why = "is not a file of linear colours; remove `raw`, or use an EXR file"
                raise bitmap.fail("raw", f"{quoted(file.value)} {why}")
            bitmap.children.remove(raw)


# --- spectra by wavelength --------------------------------------------------------------------------------------------

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
    types = ("blackbody",) if mi.is_spectral else _SPECTRA
    named = {id: item for id, item in root.by_id().items() if item.type in types}
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
