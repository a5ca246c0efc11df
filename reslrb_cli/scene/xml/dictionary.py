"""Conversion of Mitsuba dictionaries to scene files.

The file has the ids that `mi.load_dict` gives: the key of each object directly in the scene, unless the object has an
`id`. Mitsuba's own `mi.parser.write_file` leaves out ids to which no object refers, so parameters lose their names.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.backend.installation import is_known, plugin_type, propose_plugin
from reslrb_cli.errors import ConfigError, MachineError, one_line
from reslrb_cli.records.atomic import unfinished_folder
from reslrb_cli.records.decisions import cache_folder
from reslrb_cli.records.images import write_file
from reslrb_cli.scene.xml.read import Element, quoted, tag_lines

#: Name of the written scene file.
SCENE_FILE = "scene.xml"
#: Writing a scene removes scenes from the cache: those that no dictionary has needed for `KEPT_SECONDS`, and the oldest
#: while all together exceed `KEPT_BYTES`. Scenes younger than `YOUNG_SECONDS` stay: a process may soon load them.
KEPT_SECONDS, KEPT_BYTES, YOUNG_SECONDS = 90 * 86400.0, 2 * 2**30, 86400.0
_INSTEAD = "or load the scene with `mi.load_dict(..., optimize=False)` and pass `scene=` that"
#: Tags of plugins' objects, where they are not the name of Mitsuba's type in lower case.
_TAGS = {"PhaseFunction": "phase", "ReconstructionFilter": "rfilter"}


def write_dictionary(scene: Mapping[str, Any], source: object, base: Path) -> Path:
    """Write a Mitsuba dictionary as a scene file, with its bitmaps beside it, and return the file.

    The file is `scenes/DIGEST/scene.xml` in the cache, so that equal dictionaries share a file. File names in the
    dictionary are relative to `base`, or to a folder of `mi.file_resolver()`. A variant must be set. Raises a
    ConfigError that names `source` and the place in the dictionary for a value that a scene file cannot express, and
    MachineError if the file cannot be written.
    """
    writer = _Writer(source, [base, *(Path(str(path)) for path in mi.file_resolver())])
    try:
        root = writer.object(scene, "", "scene", None)
        text = "".join(f"{line}\n" for line, _ in tag_lines(root)).encode()
    except RecursionError:
        raise ConfigError(source, "scene", "is nested too deeply") from None
    except UnicodeEncodeError:
        raise ConfigError(source, "scene", "has text that UTF-8 cannot encode") from None
    digest = hashlib.blake2b(text, digest_size=16)
    for image in writer.images.values():
        digest.update(f"{image.shape} {image.dtype}".encode())  # other images may have the same bytes
        digest.update(image.tobytes())
    place: object = "the cache"
    try:
        folder = cache_folder() / "scenes"
        place = folder / digest.hexdigest()
        if (place / SCENE_FILE).is_file():
            with contextlib.suppress(OSError):  # a cache of another user
                os.utime(place)
            return place / SCENE_FILE
        _prune(folder)
        folder.mkdir(parents=True, exist_ok=True)
        with unfinished_folder(folder) as unfinished:
            for name, image in writer.images.items():
                write_file(unfinished / name, image, linear=True)
            (unfinished / SCENE_FILE).write_bytes(text)
            if not (place / SCENE_FILE).is_file():  # another process may write the same
                unfinished.rename(place)
    except (OSError, RuntimeError) as error:  # RuntimeError: no home folder
        reason = getattr(error, "strerror", None) or error
        raise MachineError(f"{place}: cannot write the scene: {reason}; set RESLRB_CACHE to a folder") from None
    return place / SCENE_FILE


def _prune(folder: Path) -> None:
    """Remove old scenes from the cache `folder`. Entries that cannot be read or removed stay."""
    found = []
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            with contextlib.suppress(OSError):
                size = sum(each.stat().st_size for each in os.scandir(entry.path))
                found.append((time.time() - entry.stat().st_mtime, size, entry.path))
    total = sum(size for _, size, _ in found)
    for age, size, path in sorted(found, reverse=True):
        if age > KEPT_SECONDS or (total > KEPT_BYTES and age > YOUNG_SECONDS):
            shutil.rmtree(path, ignore_errors=True)
            total -= size


class _Writer:
    """Elements of one dictionary. `images` has the bitmaps in memory, (H, W, C) float32, by the names of their files.

    `folders` are searched for the files that the dictionary names.
    """

    def __init__(self, source: object, folders: Sequence[Path]) -> None:
        self.images: dict[str, np.ndarray[Any, Any]] = {}
        self._source, self._folders = source, folders

    def object(self, value: Mapping[str, Any], name: str, key: str, parent: Element | None) -> Element:
        """Return the element of an object. `key` is its place in the dictionary, and `name` is its name in `parent`."""
        type = value.get("type")
        if not isinstance(type, str):
            raise self._fail(key, "has no `type`; each object of a Mitsuba dictionary has one")
        if (type == "scene") != (parent is None):
            wrong = "is a scene within a scene" if parent else f'has type {quoted(type)}; it must be "scene"'
            raise self._fail(key, wrong)
        attributes = {"name": name} if parent is not None and parent.tag != "scene" else {}
        if type in ("rgb", "spectrum"):
            return self._colour(type, value, attributes, key)
        own = value.get("id", name if parent is not None and parent.tag == "scene" else "")
        if type == "ref":
            return Element("ref", {"id": str(own), **attributes}, Path(), 0)
        if parent is not None:
            attributes = {"type": type, **attributes} | ({"id": str(own)} if own else {})
        element = Element("scene" if parent is None else self._tag(type, key), attributes, Path(), 0)
        if parent is None:
            element.attributes["version"] = mi.__version__
        for child, item in value.items():
            if not isinstance(child, str):
                raise self._fail(key, f"has the key {one_line(repr(child), 40)}; keys are text")
            if child not in ("type", "id"):
                element.children.append(self._child(element, value, child, item, f"{key}.{child}"))
        return element

    def _child(self, element: Element, owner: Mapping[str, Any], name: str, item: Any, key: str) -> Element:
        if isinstance(item, Mapping):
            return self.object(item, name, key, element)
        if element.tag == "texture" and name == "data":
            return self._image(name, _array(item, np.float32), key)
        if isinstance(item, mi.Bitmap):
            encoded = owner.get("raw", False) and item.srgb_gamma()  # raw values are not decoded
            plain = item.convert(component_format=mi.Struct.Type.Float32, srgb_gamma=bool(encoded))
            return self._image(name, np.array(plain), key)
        tag, attributes = self._value(name, item, key)
        if tag != "transform":
            return Element(tag, {"name": name, **attributes}, Path(), 0)
        return Element(tag, {"name": name}, Path(), 0, [Element("matrix", attributes, Path(), 0)])

    def _value(self, name: str, item: Any, key: str) -> tuple[str, dict[str, str]]:
        """Return the tag and the attributes of the parameter `name` that is no object."""
        if name == "filename" or isinstance(item, Path):
            return "string", {"value": self._file(item, key)}
        if isinstance(item, str):
            return "string", {"value": item}
        kind = type(item).__name__
        if "Transform" in kind and hasattr(item, "matrix"):
            return "transform", {"value": _numbers(_matrix(np.array(item.matrix, dtype=np.float64)))}
        if item is None:
            raise self._fail(key, "is None; leave it out")
        if isinstance(item, mi.Object):
            raise self._fail(key, f"is an object of Mitsuba ({kind}); give its dictionary, {_INSTEAD}")
        array = _array(item)
        if array.dtype == bool and array.size == 1:
            return "boolean", {"value": str(bool(array.item())).lower()}
        if array.dtype.kind in "iuf" and array.size == 1 and array.ndim < 2:
            return ("float" if array.dtype.kind == "f" else "integer"), {"value": repr(array.item())}
        if array.dtype.kind in "iuf" and array.size == 3:
            if "Color" in kind:
                return "rgb", {"value": _numbers(array)}
            return "vector", dict(zip("xyz", _numbers(array).split(), strict=True))
        raise self._fail(key, f"is {one_line(repr(item), 60)}, which a scene file cannot express; {_INSTEAD[3:]}")

    def _colour(self, type: str, value: Mapping[str, Any], attributes: dict[str, str], key: str) -> Element:
        if more := sorted(set(map(str, value)) - {"type", "value", "filename", "id"}):
            raise self._fail(f"{key}.{more[0]}", f"{type} has only `value` or `filename`")
        if "filename" in value:
            return Element(type, {**attributes, "filename": self._file(value["filename"], key)}, Path(), 0)
        given = value.get("value")
        array = _array(given, np.float64)
        if type == "spectrum" and array.ndim == 2 and array.shape[1] == 2:
            text = ", ".join(f"{wavelength!r}:{number!r}" for wavelength, number in array.tolist())
        elif isinstance(given, str):
            text = given
        elif array.size in (1, 3):
            text = _numbers(array)
        else:
            wrong = f"{key}.value", f"is {one_line(repr(given), 60)}; {type} needs one number or three"
            raise self._fail(*wrong)
        return Element(type, {**attributes, "value": text}, Path(), 0)

    def _image(self, name: str, image: np.ndarray[Any, Any], key: str) -> Element:
        """Add the pixels of a bitmap in memory, and return the parameter that names their file."""
        image = image[:, :, None] if image.ndim == 2 else image
        if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
            raise self._fail(key, f"has shape {image.shape}; it must be (height, width, channels)")
        file = f"{len(self.images)}_{name}.exr"
        self.images[file] = image
        return Element("string", {"name": "filename", "value": file}, Path(), 0)

    def _file(self, name: Any, key: str) -> str:
        for folder in self._folders:
            if (path := folder / str(name)).is_file():
                return os.path.abspath(path)
        looked = ", ".join(dict.fromkeys(os.path.abspath(folder) for folder in self._folders))
        raise self._fail(key, f"{quoted(str(name))}: no such file; searched in {looked}")

    def _tag(self, type: str, key: str) -> str:
        kind = plugin_type(type)
        if kind != mi.ObjectType.Unknown:
            return _TAGS.get(kind.name, kind.name.lower())
        if is_known(type):
            raise self._fail(
                key, f"{quoted(type)} is a plugin of your own, which a scene file cannot name; {_INSTEAD[3:]}"
            )
        kinds = (mi.ObjectType.Shape, mi.ObjectType.BSDF, mi.ObjectType.Emitter, mi.ObjectType.Texture)
        raise self._fail(key, f"there is no plugin {quoted(type)} in Mitsuba 3; {propose_plugin(type, *kinds)}")

    def _fail(self, key: str, message: str) -> ConfigError:
        return ConfigError(self._source, key, message)


def _array(item: Any, dtype: Any = None) -> np.ndarray[Any, Any]:
    """Return a value as an array. It is empty if the value is no array."""
    try:
        return np.array(item, dtype=dtype)
    except (TypeError, ValueError):
        return np.zeros(0)


def _numbers(array: np.ndarray[Any, Any]) -> str:
    return " ".join(repr(number) for number in array.ravel().tolist())


def _matrix(matrix: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return a 4x4 matrix. A 3x3 matrix acts on homogeneous coordinates in the plane, as in `to_uv`."""
    matrix = matrix.squeeze()
    if matrix.shape == (4, 4):
        return matrix
    full = np.eye(4)
    full[np.ix_((0, 1, 3), (0, 1, 3))] = matrix
    return full
