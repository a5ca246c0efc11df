"""Writes a scene, with the values that its parameters have, into a new folder."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import mitsuba as mi

from ...backend.plugins import looking_in
from ...errors import ConfigError
from ...records.atomic import unfinished_folder
from ..description import Description, tag_lines
from .elements import child
from .parts import SCENE, Parts
from .replacing import Replacing, same_values

#: What of a scene is no part of what it looks like.
_ASIDE = ("silhouette_sampling_weight", "sampling_weight")
#: How Mitsuba names what has lost its id, as bitmaps do that nothing uses: by where it lies in memory.
_ADDRESS = re.compile(r"object_\d+\.")


def export_scene(
    description: Description,
    params: mi.SceneParameters,
    keys: Iterable[str],
    integrator: Mapping[str, object],
    folder: Path,
    source: object,
) -> None:
    """Write what `description` says, with the values that `params` have of `keys`, and an integrator, to `folder`.

    `params` are of a scene that was built from the description, which is changed. `integrator` has its type and
    options. The folder appears once it is whole, and Mitsuba has read the same values back from it. Raises ConfigError,
    located in `source` and the key, where a value cannot be said, and OSError.
    """
    parts = Parts()
    replacing = Replacing(description.root, params, parts, source)
    for key in keys:
        replacing.put(key)
    parts.copy_assets(description)
    _put_integrator(description, integrator)
    lines = ["<!-- Written by `reslrb export`. -->", *(line for line, _ in tag_lines(description.root)), ""]
    parts.writers[SCENE] = lambda path: path.write_text("\n".join(lines), encoding="utf-8")
    folder = folder.absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with unfinished_folder(folder.parent) as part:
        inner = part / "scene"  # since the folder of an unfinished one is the user's alone
        inner.mkdir()
        parts.write(inner)
        _check(inner, params, source)
        os.replace(inner, folder)


def _put_integrator(description: Description, integrator: Mapping[str, object]) -> None:
    root = description.root
    element = child(root, "integrator", type_=str(integrator["type"]))
    for name, value in integrator.items():
        if name != "type":
            tag = {bool: "boolean", int: "integer"}.get(type(value), "float")
            element.children.append(child(root, tag, name=name, value=str(value).lower()))
    root.children.insert(0, element)


def _check(folder: Path, params: mi.SceneParameters, source: object) -> None:
    """Raise ConfigError where Mitsuba does not read from `folder` what `params` are."""
    with looking_in([folder]):  # for plugins, which it would take from the working folder as well
        try:
            found = mi.traverse(mi.load_file(str(folder / SCENE), optimize=False))
        except Exception as error:
            raise ConfigError(source, "", f"cannot be exported: Mitsuba does not read it back ({error})") from None
    for key in params.properties:
        if key.rpartition(".")[2] in _ASIDE or key.startswith("integrator."):
            continue
        if params.properties[key][0] is None:  # what the files do not give, and Mitsuba does not hand out
            continue
        if key not in found.properties and not _ADDRESS.match(key):
            raise ConfigError(source, key, "cannot be exported: Mitsuba does not find it in what was written")
        if key in found.properties and not same_values(params[key], found[key]):
            raise ConfigError(source, key, "cannot be exported: Mitsuba reads another value from what was written")
