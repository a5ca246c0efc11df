"""Building of Mitsuba's objects from elements with Mitsuba's own parser, and the map from parameters to elements.

Before Mitsuba parses a description, plugins that are not Mitsuba's own are refused, and files that never end.
"""

from __future__ import annotations

import bisect
import logging
import math
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from reslrb_cli.backend.installation import is_known, likely_parameters, looking_in, plugin_type, propose_plugin
from reslrb_cli.errors import ConfigError, did_you_mean, one_line
from reslrb_cli.scene.images import texture_problems
from reslrb_cli.scene.xml.mend import Note
from reslrb_cli.scene.xml.read import Description, Element, floats, is_true, quoted, tag_lines

#: Plugins that read an image file.
_IMAGES = ("bitmap", "envmap")
#: Mitsuba's class for each tag.
_KINDS = {"bsdf": "BSDF", "emitter": "Emitter", "shape": "Shape", "texture": "Texture"}


class Owners:
    """Elements of a description by the ids of their objects. `place` finds the element of a parameter."""

    def __init__(self, root: Element) -> None:
        self._elements = root.by_id()

    def place(self, params: mi.SceneParameters, key: str) -> tuple[Element, list[str]] | None:
        """Return the nearest element above the parameter `key`, and the key's names below this element.

        Returns None if no object above the parameter has an element. `params` are the parameters of a scene that was
        built from the description.
        """
        chain = [params.properties[key][2]]
        while chain[-1].id() not in self._elements:
            parent = params.hierarchy[chain[-1]][0]
            if parent is None:
                return None
            chain.append(parent)
        owner, names = self._elements[chain.pop().id()], key.split(".")
        names = names[-len(chain) - 1 :]
        while chain:
            if (nested := self._nested(owner, names[0], chain[-1])) is None:
                break
            owner, names = nested, names[1:]
            chain.pop()
        return owner, names

    def _nested(self, owner: Element, name: str, node: mi.Object) -> Element | None:
        """Return the child element of `owner` for the object `node`. Mitsuba calls this object `name` within `owner`.

        The search does not use ids. Some objects, for example bitmaps, lose their ids, and objects in a group have no
        ids.
        """
        tag = next((tag for tag, kind in _KINDS.items() if isinstance(node, getattr(mi, kind))), None)
        unnamed: list[Element] = []
        for item in owner.children:
            meant = self._elements.get(item.id, item) if item.tag == "ref" else item
            has_own_id = owner.type == "shapegroup" and meant.id  # `place` finds it by its id
            if meant.tag == tag and item.name in (name, "") and not has_own_id:
                if item.name:
                    return meant
                unnamed.append(meant)
        number = re.search(r"_(\d+)$", name)
        place = int(number[1]) if number and len(unnamed) > 1 else 0
        return unnamed[place] if place < len(unnamed) else None


_OLD = "is a plugin of Mitsuba 0.6 that Mitsuba 3 does not have"
#: Plugins that scene files cannot use here, with reasons and substitutes.
REFUSED_PLUGINS = {
    ("bsdf", "coating"): f"{_OLD}; use `principled` with a clearcoat",
    ("bsdf", "roughcoating"): f"{_OLD}; use `principled` with a clearcoat",
    ("bsdf", "mixturebsdf"): f"{_OLD}; use nested `blendbsdf`",
    ("bsdf", "phong"): f"{_OLD}; use `roughplastic`",
    ("bsdf", "ward"): f"{_OLD}; use `roughconductor` or `roughplastic`",
    ("bsdf", "roughdiffuse"): f"{_OLD}; use `diffuse`",
    ("bsdf", "difftrans"): f"{_OLD}; use `principledthin`",
    ("bsdf", "hk"): f"{_OLD}; use a medium",
    ("bsdf", "irawan"): f"{_OLD}; use a texture",
    ("emitter", "sky"): f"{_OLD}; use `sunsky`, with z instead of y as its up axis",
    ("emitter", "sun"): f"{_OLD}; use `sunsky`, with z instead of y as its up axis",
    ("emitter", "collimated"): f"{_OLD}; use `directionalarea`",
    ("shape", "heightfield"): f"{_OLD}; write it as a mesh",
    ("shape", "hair"): f"{_OLD}; `bsplinecurve` draws strands",
    ("texture", "scale"): f"{_OLD}; multiply the texture itself",
    ("texture", "gridtexture"): f"{_OLD}; use `bitmap` or `checkerboard`",
    ("texture", "wireframe"): f"{_OLD}; use `bitmap`",
    ("texture", "curvature"): f"{_OLD}; use `mesh_attribute`",
    ("texture", "vertexcolors"): f"{_OLD}; use `mesh_attribute`",
    ("shape", "blender"): "reads the memory of a running Blender; export the mesh as `ply` or `obj`",
    ("film", "specfilm"): "needs wavelengths: set `variant` to llvm_ad_spectral or cuda_ad_spectral, or use `hdrfilm`",
    ("sensor", "flat_sensor"): "belongs to Mitsuba's own RayDataLoader; use a `perspective` one",
}


def _check(description: Description) -> list[Note]:
    """Raise ConfigError with file and line for a plugin that is not Mitsuba's own, for a number that is NaN, and for a
    file that is missing, never ends, or shows other pixels in Mitsuba. Return notes on colour profiles.
    """
    notes: list[Note] = []
    objects = {child: item.type for item in description.root.walk() if item.is_object for child in item.children}
    images = {child: item for item in description.root.walk() if item.type in _IMAGES for child in item.children}
    _check_parts(description.root)
    for element in description.root.walk():
        if element.is_object:
            _check_plugin(element)
        for name, text in element.attributes.items() if element.tag != "string" else ():
            if name not in ("id", "name", "type", "as") and any(map(math.isnan, floats(text))):
                raise element.fail(element.name, f"{name} {quoted(text)} is not a number")
    for element, name in description.named_files():
        path = description.find_file(name)
        if path is None:
            looked = "" if os.path.isabs(name) else f"; searched in {', '.join(map(str, description.folders))}"
            raise element.fail("filename", f"{quoted(name)}: no such file{looked}")
        if not path.is_file():
            raise element.fail("filename", f"{path} is not a regular file")
        if objects.get(element) == "obj" and len(materials := _materials(path)) > 1:
            wrong = f"{quoted(name)} has the materials {', '.join(map(quoted, materials[:3]))}"
            wrong += f" and {len(materials) - 3} more" if len(materials) > 3 else ""
            done = "read as one surface without them; save one file for each material"
            notes.append(Note(element, f"{wrong}, and Mitsuba ignores `usemtl` and .mtl files", done=done))
        if element in images:
            wrong, profile = texture_problems(path)
            if wrong:
                raise element.fail("filename", f"{quoted(name)} {wrong}")
            if profile and not is_true(images[element].find("raw")):
                ignored = f"{quoted(name)} has the colour profile {quoted(profile)}, which Mitsuba's textures ignore"
                notes.append(Note(element, ignored, done="read as sRGB; convert the file to sRGB"))
    return notes


def _materials(obj: Path) -> list[str]:
    """Return the names of the materials that an OBJ file uses, in their order."""
    found = re.findall(rb"^usemtl[ \t]+(.*?)\s*$", obj.read_bytes(), re.MULTILINE)
    return [name.decode(errors="replace") for name in dict.fromkeys(found)]


#: Maximum number of parts of a BSDF. A part that is used twice counts twice, because Mitsuba visits it twice.
_MOST_PARTS = 1000


def _check_parts(root: Element) -> None:
    """Refuse a BSDF with too many parts: Mitsuba would never finish. 90 nested `twosided` BSDFs have 2**90 parts."""
    by_id, parts, begun = root.by_id(), dict[Element, int](), set[Element]()
    for element in root.walk("bsdf"):
        pending = [element]
        while pending:  # no recursion, because chains of references can be long
            top = pending[-1]
            used = [by_id.get(child.id, child) if child.tag == "ref" else child for child in top.children]
            nested = [child for child in used if child.tag in ("bsdf", "texture")]
            lacking = [child for child in nested if child not in parts]
            if lacking and top not in begun:  # in a circle, which Mitsuba refuses, each part is begun once
                begun.add(top)
                pending += lacking
                continue
            pending.pop()
            uses = 2 if top.type == "twosided" and len(used) == 1 else 1
            parts[top] = 1 + uses * sum(parts.get(child, 1) for child in nested)
        if parts[element] > _MOST_PARTS:
            what = f"has more than {_MOST_PARTS} nested BSDFs and textures, counting each use"
            raise element.fail("", f"{what}; a `twosided` uses its BSDF twice, and needs no other `twosided`")


def _check_plugin(element: Element) -> None:
    """Refuse an object whose plugin is not Mitsuba's own, or belongs to another tag. Mitsuba would load the plugin from
    the scene's folder, or read memory out of bounds.
    """
    tag, type = element.tag, element.type
    if not type:
        raise element.fail("", f"<{tag}> has no type")
    if tag == "sensor" and element.find("srf") is not None:
        raise element.fail("srf", "only films have response functions here; use a `specfilm`")
    if (refused := REFUSED_PLUGINS.get((tag, type))) is not None and not (type == "specfilm" and mi.is_spectral):
        raise element.fail("", f"{tag} `{type}` {refused}")
    others = {"bsdf": "BSDF", "phase": "PhaseFunction", "rfilter": "ReconstructionFilter", "spectrum": "Texture"}
    wanted = getattr(mi.ObjectType, others.get(tag, tag.capitalize()))
    if not is_known(type):
        raise element.fail("", f"there is no {tag} {quoted(type)} in Mitsuba 3; {propose_plugin(type, wanted)}")
    if plugin_type(type) not in (mi.ObjectType.Unknown, wanted):
        raise element.fail("", f"{quoted(type)} is no {tag}")
    if type == "bitmap" and element.find("filename") is None:
        raise element.fail("", "bitmap needs a parameter `filename`")


#: "[parser.cpp:482] " and "[PluginManager] ": where in Mitsuba's sources a message comes from.
_ORIGIN = re.compile(r"\[[\w.]+(:\d+)?\]\s*")
#: "At string (line 3, col 7): " and the like, before the message proper.
_PREAMBLE = re.compile(r"^(At|Error while loading|While loading) .*?\(line \d+, col \d+\):? ?")
_PLACE = re.compile(r"\(line (\d+), col \d+\)")
#: Traceback of a plugin in Python, before its message.
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):.*\n\w+: ", re.DOTALL)
#: Mitsuba's message about a mesh without faces.
_NO_FACES = re.compile(r"Storing new normals in a Mesh that didn't have normals.*")
#: Mitsuba's message about a texture without a mean, and the reason.
_NO_MEAN = "Texture::mean(): not implemented!"
_MEANS = "its plugin needs the mean of each texture, which mesh_attribute and volume do not have; use a bitmap, or the \
bsdf `principled` with a base_color"


def _place_textures(root: Element) -> None:
    """Move each texture directly below `root` to the place of the first reference to it. Other references stay.

    Without this move, Mitsuba would list a texture's parameters as the scene's own, under the texture's id. Some
    textures lose their id. The listing would not show that the texture's parameters belong to a material or a light.
    """
    textures = {child.id: child for child in root.children if child.tag == "texture" and child.id}
    for alias in root.walk("alias"):
        textures.pop(alias.id, None)
    for element in list(root.walk()):
        for index, child in enumerate(element.children if element is not root else ()):
            texture = textures.get(child.id) if child.tag == "ref" else None
            if texture is None or texture is element:
                continue
            del textures[texture.id]
            root.children.remove(texture)
            texture.attributes.pop("name", None)
            if child.name:
                texture.attributes["name"] = child.name
            element.children[index] = texture


def build(description: Description) -> tuple[Any, list[Note]]:
    """Build the Mitsuba object of a description. Return the object, and notes on parameters that no plugin uses and on
    colour profiles.

    Nothing is merged, so all parameters keep their names. Raises ConfigError with a location if a plugin is not
    Mitsuba's own, a file is missing, or Mitsuba refuses the scene.
    """
    notes = _check(description)
    _place_textures(description.root)
    text = _Text(description.root)
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = False
    config.unused_properties = mi.LogLevel.Debug  # `_unused` reports them
    said: list[str] = []
    with looking_in(description.folders), _collecting_warnings(said):
        try:
            state = mi.parser.parse_string(config, text.xml)
            mi.parser.transform_all(config, state)
            built = mi.parser.instantiate(config, state)
        except Exception as error:
            raise text.located(str(error)) from None
    unused = [note for node in state.nodes for note in _unused(node.props, text.element_at(node.offset))]
    return built, [*notes, *unused, *_warnings_of_mitsuba(said, description.root)]


@contextmanager
def _collecting_warnings(lines: list[str]) -> Iterator[None]:
    """Append Mitsuba's warnings to `lines`. Otherwise Mitsuba would print them with colour codes, one for each object.

    Mitsuba writes them into a file: threads that load objects cannot call Python.
    """
    log = mi.logger()
    appenders = [log.appender(place) for place in range(log.appender_count())]
    with tempfile.TemporaryDirectory(prefix="reslrb-") as folder:
        file = os.path.join(folder, "log")
        log.clear_appenders()
        log.add_appender(mi.StreamAppender(file))
        try:
            yield
        finally:
            log.clear_appenders()
            for appender in appenders:
                log.add_appender(appender)
            with open(file, errors="replace") as written:
                lines += written.read().splitlines()


#: A line of Mitsuba's log, and the file that a message begins with.
_LOGGED = re.compile(r"\bWARN\b.*?\] (?:\"(?P<file>[^\"]*)\": )?(?P<text>.*)")


def _warnings_of_mitsuba(lines: list[str], root: Element) -> list[Note]:
    """Return one note on each kind of warning in Mitsuba's log."""
    kinds: dict[str, list[str]] = {}
    for found in filter(None, map(_LOGGED.search, lines)):
        kinds.setdefault(found["text"].rstrip("."), []).append(found["file"] or "")
    notes = []
    for text, files in kinds.items():
        level = logging.INFO if text.startswith("performance") else logging.WARNING
        more = f", and {len(files) - 1} more" if len(files) > 1 else ""
        notes.append(Note(root, f"Mitsuba warns: {one_line(text, 200)}", done=f"{files[0]}{more}", level=level))
    return notes


class _Text:
    """A description as XML with one tag per line, and the element of each line."""

    def __init__(self, root: Element) -> None:
        self._root = root
        lines, elements = zip(*tag_lines(root), strict=True)
        self._elements: tuple[Element, ...] = elements
        #: Must live as long as the parser's state, which refers to it.
        self.xml = "\n".join(lines)
        self._starts = [0]
        for line in lines:
            self._starts.append(self._starts[-1] + len(line.encode("utf-8")) + 1)

    def element_at(self, offset: int) -> Element:
        """Return the element at a byte offset of `xml`."""
        return self._elements[bisect.bisect_right(self._starts, offset) - 1]

    def located(self, message: str) -> ConfigError:
        """Convert Mitsuba's message to one line that names places in the scene's files. The line names no places in
        Mitsuba's sources or in `xml`.
        """
        place = _PLACE.search(message)
        element = self._elements[int(place[1]) - 1] if place else None
        text = _TRACEBACK.sub("", _ORIGIN.sub("", message)).strip()
        while _PREAMBLE.match(text):
            text = _PREAMBLE.sub("", text).strip()
        text = text.replace(_NO_MEAN, _MEANS)
        text = _NO_FACES.sub("the mesh has no faces", text)
        text = _PLACE.sub(lambda other: f"({self._elements[int(other[1]) - 1].place})", text)
        return ConfigError(element.place if element else self._root.file, "", text)


def _unused(props: mi.Properties, element: Element) -> list[Note]:
    """Return notes on parameters of `element` that its plugin does not use."""
    notes: list[Note] = []
    unnamed = [child for child in element.children if not child.name and (child.is_object or child.tag == "ref")]
    for name in props.unqueried():
        number = re.match(r"_arg_(\d+)", name)
        if number and int(number[1]) < len(unnamed):
            child = unnamed[int(number[1])]
            wrong = f"{element.type} does not use a <{child.tag}> in Mitsuba 3"
        else:
            hint = did_you_mean(name, likely_parameters(element.type), cutoff=0.75)
            child = element.find(name) or element
            wrong = f"{element.type} has no parameter {quoted(child.written or name)} in Mitsuba 3"
            wrong += f" ({hint})" if hint else ""
        notes.append(Note(child, wrong, None if child is element else element))
    return notes


@dataclass(frozen=True)
class FilmSize:
    """Width and height of a film in pixels, pixels in its crop window, and channels per pixel.

    Sizes are 0 if the file does not give them.
    """

    width: int
    height: int
    cropped: int
    channels: int


def film_sizes(description: Description) -> list[FilmSize]:
    """Return the sizes of the scene's films."""
    return [_size_of(film) for film in description.root.walk("film")]


def _size_of(film: Element) -> FilmSize:
    """Return the size of a film. Ignores values that are not numbers, because Mitsuba refuses such values."""
    values = {child.name: child.value.strip() for child in film.children}
    numbers = {name: int(value[:20]) for name, value in values.items() if value.isdecimal()}
    width, height = numbers.get("width", 0), numbers.get("height", 0)
    cropped = numbers.get("crop_width", width) * numbers.get("crop_height", height)
    channels = 1 if values.get("pixel_format", "rgb").lower().startswith("luminance") else 3
    return FilmSize(width, height, cropped, channels)


def restore_films(description: Description) -> None:
    """Give films that `resize_films` resized their sizes in the files, if they show the same view: the same aspect
    ratio within 1 %, and no crop window.
    """
    for film, sizes in description.own_sizes.items():
        before, now = (
            {child.name: child.value for child in children if child.name in _SIZES}
            for children in (sizes, film.children)
        )
        if before.keys() != now.keys() or not all(value.strip().isdecimal() for value in before.values()):
            continue
        ratios = [float(size["width"]) / float(size["height"]) for size in (before, now)]
        if abs(ratios[0] / ratios[1] - 1) < 0.01:
            film.drop(*_SIZES)
            film.children += sizes


#: Parameters of a film that set its size.
_SIZES = ("width", "height", "crop_offset_x", "crop_offset_y", "crop_width", "crop_height")


def resize_films(description: Description, size: tuple[int, int]) -> None:
    """Set the films of all sensors to `size` (width, height) in pixels, and remove crop windows."""
    for sensor in description.root.walk("sensor"):
        films = [child for child in sensor.children if child.tag == "film"]
        if not films:
            films = [sensor.new("film", type="hdrfilm")]
            sensor.children += films
        for film in films:
            description.own_sizes[film] = [child for child in film.children if child.name in _SIZES]
            film.drop(*_SIZES)
            for name, value in zip(("width", "height"), size, strict=True):
                film.children.append(film.new("integer", name=name, value=str(value)))
