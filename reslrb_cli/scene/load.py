"""Loading of Mitsuba scene files, with errors that say where."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import ConfigError
from .cameras import read_cameras, replace_sensors
from .description import (
    Description,
    build,
    check,
    check_sizes,
    mend,
    name_objects,
    notes,
    place_textures,
    read_description,
    resize_films,
)
from .description.element import quoted
from .extent import coincident, lost_light
from .thin_glass import thin_glass

logger = logging.getLogger(__name__)


def load_scene(
    file: Path,
    options: Mapping[str, Any] | None = None,
    strict: bool = False,
    size: tuple[int, int] | None = None,
    cameras: Path | None = None,
    look: Callable[[Description], object] | None = None,
) -> mi.Scene:
    """Load a Mitsuba scene (XML, versions 0.4 to 3); a variant must be set.

    `options` are the values of the file's `$name` variables. Shapes are not merged, so that all parameters keep their
    names, and an object without an id is named by its kind and its number among all of that kind in the file, such as
    `Sphere_3`. What Mitsuba's parser would refuse because another version or an exporter wrote it is mended or left
    out, with a warning in the log; `strict` has it refused. Those of `cameras`, a file, stand in place of the scene's
    sensors. The scene's integrator is not loaded: an experiment has its own. Plugins are loaded from Mitsuba's own
    folder alone. `size` is the (width, height) of all films in pixels, in place of what the files say. `look` sees what
    is to be built before anything of it is, and may raise.

    Raises ConfigError, located in the scene file, where it is missing or wrong, has nothing in it, or no light. Warns,
    too, of a scene that is too far from the origin, or too small, of glass that is too thin, and of
    faces at the same place.
    """
    return load_described(file, options, strict, size, cameras, look)[0]


def load_described(
    file: Path,
    options: Mapping[str, Any] | None = None,
    strict: bool = False,
    size: tuple[int, int] | None = None,
    cameras: Path | None = None,
    look: Callable[[Description], object] | None = None,
) -> tuple[mi.Scene, Description]:
    """The same, and the description that the scene was built from, of which Mitsuba has a use for every element."""
    file = Path(file)
    description = read_description(file, {name: _as_text(value) for name, value in (options or {}).items()})
    root = description.root
    if cameras is not None:
        replace_sensors(description, read_cameras(cameras))
    found = notes.in_order([*name_objects(root), *mend(description)], root)
    if strict:
        notes.refuse(found)
    check(description)
    place_textures(root)
    if size is not None:
        resize_films(root, size)
    check_sizes(description)
    if look is not None:
        look(description)
    scene, unused = build(description)
    if strict:
        notes.refuse(unused)
    if not isinstance(scene, mi.Scene):
        raise ConfigError(file, "", "its root is a single object, not a <scene>")
    if len(scene.shapes()) == 0:
        raise ConfigError(file, "", "the scene is empty: it has no shapes")
    if len(scene.emitters()) == 0:
        raise ConfigError(file, "", "the scene has no emitters: no light path can start")
    if len(scene.sensors()) == 0:
        raise ConfigError(file, "", "the scene has no sensor")
    _check_meshes(file, scene)
    lost = {note.element for note in unused}  # what else was done to them says nothing
    found = [note for note in found if note.element not in lost]
    for line in notes.warnings(notes.in_order([*found, *unused], root)):
        warn_once(line)
    for loss in (lost_light(scene), thin_glass(scene), coincident(scene)):
        if loss is not None:
            warn_once(f"{file}: {loss}")
    for note in unused:
        if note.owner is not None:
            note.owner.children.remove(note.element)
    return scene, description


def _check_meshes(file: Path, scene: mi.Scene) -> None:
    """Raise ConfigError for a mesh whose faces name vertices that it lacks: Mitsuba reads past its end for them."""
    for shape in scene.shapes():
        if shape.is_mesh() and shape.face_count() and shape.vertex_count():
            last = int(np.array(shape.faces_buffer()).max())
            if last >= shape.vertex_count():
                has = f"has a face with vertex {last}, and {shape.vertex_count()} vertices"
                raise ConfigError(file, "", f"the mesh {quoted(shape.id())} {has}; write it again")


@functools.cache
def warn_once(line: str) -> None:
    """Say it in the log, once: one experiment may load its scene several times."""
    logger.warning("%s", line)


def _as_text(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
