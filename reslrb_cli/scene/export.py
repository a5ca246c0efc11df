"""Export of a scene with the current values of its parameters into a new folder.

The values go into the description that the scene was built from. Meshes and images go into files beside the
description. Other files are copied. Finally, Mitsuba must read the same values back.
"""

from __future__ import annotations

import functools
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePosixPath

import mitsuba as mi
import numpy as np

from reslrb_cli.backend.installation import looking_in, package_folder
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import unfinished_folder
from reslrb_cli.records.images import file_stem, write_file
from reslrb_cli.scene.catalog import as_numbers, parameter_kind
from reslrb_cli.scene.upsampling import colour_in_scene, is_upsampled
from reslrb_cli.scene.values import ParameterValue
from reslrb_cli.scene.xml.build import Owners, restore_films
from reslrb_cli.scene.xml.read import Description, Element, tag_lines

Array = np.ndarray[tuple[int, ...], np.dtype[np.float32]]


def replace(owner: Element, new: Element, *instead_of: str) -> None:
    """Put `new` among the children of `owner`. Replace children that have the name of `new` or a name in
    `instead_of`.
    """
    owner.drop(new.name, *instead_of)
    owner.children.insert(0, new)


def numbers(values: Array) -> str:
    """Return numbers as text that is read as the same 32-bit floats."""
    return " ".join(f"{float(value):.9g}" for value in values.ravel())


def number(owner: Element, name: str, value: float) -> Element:
    """Return an element for a number, or for a spectrum that is the same at all wavelengths."""
    return owner.new("float", name=name, value=numbers(np.array(value, dtype=np.float32)))


def colour(owner: Element, name: str, value: Array, bounded: bool) -> Element:
    """Return an element for a colour (3,) or a grey. If `bounded`, Mitsuba's <rgb> accepts only values from 0 to 1."""
    if value.size == 1:
        return number(owner, name, float(value.ravel()[0]))
    if not bounded or bool(((value >= 0) & (value <= 1)).all()):
        return owner.new("rgb", name=name, value=numbers(value))
    rgb = owner.new("rgb", name="color", value=numbers(value))
    return owner.new("texture", rgb, owner.new("boolean", name="unbounded", value="true"), type="srgb", name=name)


def triple(owner: Element, tag: str, name: str, value: Array) -> Element:
    """Return an element for three numbers. `tag` selects a <point> or a <vector>."""
    x, y, z = numbers(value).split()
    return owner.new(tag, name=name, x=x, y=y, z=z)


#: The exported scene, in its folder.
SCENE = "scene.xml"
#: Folders beside it: recovered values, and files from outside the scene's folder.
RECOVERED, ELSEWHERE = "recovered", "assets"
#: Parameters of a mesh that a PLY file does not hold.
_KEPT = ("face_normals", "flip_normals")
#: Other parameters of a position than `to_world`, by tag.
_OTHER_PLACES = {"shape": ("center", "radius", "p0", "p1"), "emitter": ("direction", "position")}

#: BSDFs whose `eta` is the index inside divided by that outside.
_RELATIVE_INDEX = ("dielectric", "roughdielectric", "thindielectric", "plastic", "roughplastic")

_CONDUCTORS = ("conductor", "roughconductor")
#: Spectra that Mitsuba reads as values by wavelength.
_SPECTRA = ("regular", "irregular", "d65", "illuminant")


class Replacing:
    """Scene description that gets the values of `params`.

    `writers` maps paths in the exported folder (with `/`) to functions. Each function writes its file to a new path.
    Errors name `source`.
    """

    def __init__(self, description: Description, params: mi.SceneParameters, source: object) -> None:
        self.description, self.params, self.source = description, params, source
        self.writers: dict[str, Callable[[Path], object]] = {}
        self._made: set[Element] = set()
        self._owners = Owners(description.root)

    def put(self, key: str) -> None:
        """Write the value of the scene parameter `key`. Raises ConfigError if the scene description cannot express the
        value.
        """
        node = self.params.properties[key][2]
        if (place := self._owners.place(self.params, key)) is None:
            raise self._fail(key, "the object that it belongs to is not in the scene's files")
        owner, (*below, name) = place
        if below:
            self._put_nested(owner, below, name, key)
        elif isinstance(node, mi.Mesh) and name != "to_world":
            # The file has vertices in world coordinates, faces and attributes.
            owner.children[:] = [item for item in owner.children if not item.is_value or item.name in _KEPT]
            owner.attributes["type"] = "ply"
            self._add_file(owner, file_stem(key.rpartition(".")[0]), ".ply", lambda path: node.write_ply(str(path)))
        elif name == "to_world":
            matrix = owner.new("matrix", value=numbers(np.array(self.params[key].matrix, dtype=np.float32)))
            replace(owner, owner.new("transform", matrix, name=name), *_OTHER_PLACES.get(owner.tag, ()))
        elif name == "position":
            replace(owner, triple(owner, "point", name, self._array(key)), "to_world")
        elif name == "data":
            self._put_image(owner, key)
        elif name == "values" and owner.type in _SPECTRA:
            owner.attributes["type"], owner.children[:] = self._by_wavelength(owner, key)
        elif name == "value" and owner.type == "srgb":
            replace(owner, colour(owner, "color", self._array(key), bounded=False))
        elif name == "value" and owner.type == "d65":
            value = self._array(key)
            scale = max(float(value.max()), 1.0)  # colours are at most 1
            owner.children[:] = [colour(owner, "color", value / scale, bounded=True), number(owner, "scale", scale)]
        elif name == "value" and owner.type == "rawconstant" and self._array(key).size == 3:
            replace(owner, triple(owner, "vector", name, self._array(key)))
        else:
            self._put_number(owner, name, self._array(key), key)

    def _put_nested(self, owner: Element, below: list[str], name: str, key: str) -> None:
        """Write a value below `owner` that does not belong to an object in the scene's files."""
        if owner.type in _CONDUCTORS and below in (["eta"], ["k"]):
            self._put_metal(owner, key)
        elif name == "value" and len(below) == 1:
            self._put_spectrum(owner, below[0], key)
        elif name == "values" and len(below) == 1:
            self._put_values(owner, below[0], key)
        elif name == "value" and below[0] == "bsdf" and len(below) == 2 and owner.tag == "shape":
            # Mitsuba's default, if a shape has none.
            reflectance = colour(owner, below[1], self._array(key), bounded=True)
            owner.children.append(owner.new("bsdf", reflectance, type="diffuse"))
        else:
            raise self._fail(key, "the object that it belongs to is not in the scene's files")

    def _put_metal(self, owner: Element, key: str) -> None:
        """Write eta and k. A material's name sets both, so either must be written with the other."""
        stem = key.rsplit(".", 2)[0]
        owner.drop("material")
        for each in ("eta", "k"):
            if f"{stem}.{each}.values" in self.params.properties:
                self._put_values(owner, each, f"{stem}.{each}.values")
            else:
                replace(owner, colour(owner, each, self._array(f"{stem}.{each}.value"), bounded=False))

    def _put_values(self, owner: Element, name: str, key: str) -> None:
        """Write the values of a spectrum with its wavelengths."""
        kind, parts = self._by_wavelength(owner, key)
        replace(owner, owner.new("spectrum", *parts, type=kind, name=name))

    def _by_wavelength(self, owner: Element, key: str) -> tuple[str, list[Element]]:
        """Return the type and the parameters of the spectrum whose values are the scene parameter `key`."""
        stem, values = key.rpartition(".")[0], owner.new("string", name="values", value=numbers(self._array(key)))
        if f"{stem}.wavelengths" in self.params.properties:
            wavelengths = numbers(self._array(f"{stem}.wavelengths"))
            parts, kind = [owner.new("string", name="wavelengths", value=wavelengths)], "irregular"
        else:
            ends, kind = np.ravel(self.params[f"{stem}.range"]), "regular"
            names = ("wavelength_min", "wavelength_max")
            parts = [number(owner, each, float(end)) for each, end in zip(names, ends, strict=True)]
        return kind, [values, *parts]

    def _put_number(self, owner: Element, name: str, value: Array, key: str) -> None:
        if value.size != 1:
            raise self._fail(key, f"{owner.type} cannot have {value.size} numbers as its {name}")
        if name == "eta" and owner.type in _RELATIVE_INDEX:
            replace(owner, number(owner, "ext_ior", 1.0))
            name = "int_ior"
        is_either = owner.type == "principled" and name in ("eta", "specular")
        replace(owner, number(owner, name, float(value)), *(("eta", "specular") if is_either else ()))

    def _put_spectrum(self, owner: Element, name: str, key: str) -> None:
        value, kind = self._array(key), parameter_kind(self.params, key)
        if kind == "emitter" and value.size == 1 and mi.is_spectral:  # a <float> would be multiplied by D65
            replace(owner, owner.new("spectrum", name=name, value=numbers(value)))
            return
        replace(owner, colour(owner, name, value, bounded=kind == "bsdf"))

    def _put_image(self, owner: Element, key: str) -> None:
        image = self._array(key)
        self._add_file(owner, file_stem(key), ".exr", lambda path: write_file(path, image, linear=True))
        if owner.tag == "texture":
            # The file holds linear floats, which must not be rounded to fewer bits.
            replace(owner, owner.new("string", name="format", value="variant"), "color_space", "gamma")

    def _array(self, key: str) -> Array:
        if is_upsampled(self.params, key):
            return colour_in_scene(self.params, key)
        return ParameterValue(self.params, key).get()

    def _fail(self, key: str, why: str) -> ConfigError:
        return ConfigError(self.source, key, f"cannot be exported: {why}")

    def _add_file(self, owner: Element, stem: str, suffix: str, write: Callable[[Path], object]) -> None:
        """Make `owner` name a file of recovered values instead of its original file."""
        name = f"{RECOVERED}/{stem}{suffix}"
        self.writers[name] = write
        element = owner.new("string", name="filename", value=name)
        self._made.add(element)
        replace(owner, element)

    def copy_assets(self) -> None:
        """Copy every file that the scene's elements name. Change the elements so that they name the copies.

        A file in the folder of the scene keeps its relative path. Other files go to a separate folder. The tables of a
        metal's `material` keep their names, by which Mitsuba finds them.
        """
        own = {name.casefold() for name in (SCENE, *self.writers)}
        home = self.description.root.file.absolute().parent.resolve()
        copies: dict[Path, str] = {}
        for element, name in list(self.description.named_files()):
            path = self.description.find_file(name)
            if element in self._made or path is None or not path.is_file():
                continue
            source = path.resolve()
            if not element.file_attribute:
                if not (package_folder() / name).exists():  # otherwise the run has read Mitsuba's own table
                    self.writers[name] = functools.partial(shutil.copyfile, source)
                continue
            if source not in copies:
                copies[source] = _free(source, home, own)
                own.add(copies[source].casefold())
            element.attributes[element.file_attribute] = copies[source]
        for source, name in copies.items():
            self.writers[name] = functools.partial(shutil.copyfile, source)


def _free(source: Path, home: Path, taken: set[str]) -> str:
    """Return the path of a copy of `source` in the exported folder.

    A file below `home` keeps its relative path. Any other file gets a path in the folder for other files. If the path
    is already taken, the copy's name gets a number before the suffix. The comparison ignores case.
    """
    inside = source.is_relative_to(home)
    path = PurePosixPath(*source.relative_to(home).parts) if inside else PurePosixPath(ELSEWHERE, source.name)
    name, number = str(path), 1
    while name.casefold() in taken:
        number += 1
        name = str(path.with_name(f"{path.stem}-{number}{path.suffix}"))
    return name


def same_values(a: object, b: object) -> bool:
    """Whether two values of a parameter agree up to rounding. A grey value agrees with a colour if all channels of the
    colour equal the grey value.
    """
    x, y = as_numbers(a), as_numbers(b)
    if x is None or y is None:
        return x is y
    if x.shape != y.shape and 1 not in (x.size, y.size):
        return False
    scale = max(float(np.abs(x).max(initial=0)), 1e-30)
    return bool(np.allclose(x, y, rtol=1e-5, atol=1e-6 * scale))


def _keep_variables(description: Description) -> set[Element]:
    """Write the variables of the scene's films, such as `$resx`, with their values as defaults. Return the elements
    that name variables.
    """
    found, root = set[Element](), description.root
    for film in root.walk("film"):
        for size in film.children:
            if (known := re.fullmatch(r"\$(\w+)", size.variable)) and known[1] in description.variables:
                found.add(size)
                size.attributes["value"] = size.variable
    for name in sorted({size.variable[1:] for size in found}, reverse=True):
        root.children.insert(0, root.new("default", name=name, value=description.variables[name]))
    return found


#: Parts of a scene that do not affect its appearance, and the size of the film, which the export restores.
_ASIDE = ("silhouette_sampling_weight", "sampling_weight")
_FILM = re.compile(r"\bfilm\.(size|crop_size|crop_offset)$")
#: Mitsuba's names for objects without an id, such as unused bitmaps: their memory address.
_ADDRESS = re.compile(r"object_\d+\.")


def export_scene(
    description: Description,
    params: mi.SceneParameters,
    keys: Iterable[str],
    integrator: Mapping[str, object],
    folder: Path,
    source: object,
    beside: Mapping[str, Callable[[Path], object]] | None = None,
    note: str = "",
) -> None:
    """Write `description` and an integrator to `folder`. The description gets the values of `params` for `keys`.

    `params` belong to a scene that was built from `description`. The function modifies `description`. `integrator` has
    its type and options. `beside` maps names of further files to their writers. `note` is a comment at the top of the
    scene. The folder appears once it is complete and Mitsuba has read the same values back. Raises a ConfigError that
    names `source` and the key if a value cannot be expressed. Raises OSError.
    """
    replacing, root = Replacing(description, params, source), description.root
    for key in keys:
        replacing.put(key)
    replacing.writers |= beside or {}  # before assets, which then get other names
    replacing.copy_assets()
    restore_films(description)
    variables = _keep_variables(description)
    options = [
        root.new({bool: "boolean", int: "integer"}.get(type(value), "float"), name=name, value=str(value).lower())
        for name, value in integrator.items()
        if name != "type"
    ]
    root.children.insert(0, root.new("integrator", *options, type=str(integrator["type"])))
    if outside := [name for name in replacing.writers if {"..", ""} & {*re.split(r"[/\\]", name)}]:
        raise ConfigError(source, "", f"cannot be exported: the scene names a file outside of the folder, {outside[0]}")
    head = f"<!-- {' '.join(filter(None, ['Written by `reslrb export`.', note]))} -->"
    lines = [head, *(line.replace("\\$", "$") if each in variables else line for line, each in tag_lines(root)), ""]
    replacing.writers[SCENE] = lambda path: path.write_text("\n".join(lines), encoding="utf-8")
    folder = folder.absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with unfinished_folder(folder.parent) as part:
        for name, write in replacing.writers.items():
            path = part / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path)
        _check(part, params, source)
        os.replace(part, folder)


def _check(folder: Path, params: mi.SceneParameters, source: object) -> None:
    """Raise ConfigError if Mitsuba does not read the values of `params` from `folder`."""
    with looking_in([folder]):  # otherwise Mitsuba also loads plugins from the working folder
        try:
            found = mi.traverse(mi.load_file(str(folder / SCENE), optimize=False))
        except Exception as error:
            raise ConfigError(source, "", f"cannot be exported: Mitsuba does not read it back ({error})") from None
    for key in params.properties:
        is_given = params.properties[key][0] is not None  # set by the files; Mitsuba does not expose other parameters
        if not is_given or key.rpartition(".")[2] in _ASIDE or key.startswith("integrator.") or _FILM.search(key):
            continue
        if key not in found.properties and not _ADDRESS.match(key):
            raise ConfigError(source, key, "cannot be exported: Mitsuba does not find it in the written scene")
        if key in found.properties and is_upsampled(params, key):
            # Mitsuba's table has almost the same spectrum.
            is_same = np.allclose(colour_in_scene(params, key), colour_in_scene(found, key), rtol=0.01, atol=0.01)
        elif key in found.properties:
            is_same = same_values(params[key], found[key])
        else:
            continue
        if not is_same:
            raise ConfigError(source, key, "cannot be exported: Mitsuba reads another value from the written scene")
