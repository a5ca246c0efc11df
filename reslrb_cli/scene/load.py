"""Loading of Mitsuba scene files, with errors that say where."""

from __future__ import annotations

import functools
import logging
import os
import tempfile
from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.backend.variant import check_variant
from reslrb_cli.errors import ConfigError
from reslrb_cli.lens.experiment import face_ply
from reslrb_cli.lens.surface import Setting
from reslrb_cli.scene.cameras import read_cameras, replace_sensors
from reslrb_cli.scene.catalog import coarse_bits
from reslrb_cli.scene.extent import doubts
from reslrb_cli.scene.values import Place
from reslrb_cli.scene.xml.build import Owners, build
from reslrb_cli.scene.xml.check import check, check_files, resize_films
from reslrb_cli.scene.xml.mend import mend, refuse, warnings
from reslrb_cli.scene.xml.read import Description, Element, quoted, read_description

logger = logging.getLogger(__name__)


def load_scene(
    file: Path,
    options: Mapping[str, Any] | None = None,
    strict: bool = False,
    size: tuple[int, int] | None = None,
    cameras: Path | None = None,
    look: Callable[[Description], object] | None = None,
    keys: Iterable[str] = (),
    warn: bool = True,
) -> mi.Scene:
    """Load a Mitsuba scene (XML, versions 0.4 to 3); a variant must be set.

    `options` are the values of the file's `$name` variables. Shapes are not merged, so that all parameters keep their
    names, and an object without an id is named by its kind and its number among all of that kind in the file, such as
    `Sphere_3`. What Mitsuba's parser would refuse because another version or an exporter wrote it is mended or left
    out, with a warning in the log; `strict` has it refused. Those of `cameras`, a file, stand in place of the scene's
    sensors. The scene's integrator is not loaded: an experiment has its own. Plugins are loaded from Mitsuba's own
    folder alone. `size` is the (width, height) of all films in pixels, in place of what the files say. `look` sees the
    description that the scene is built from before anything of it is, and may raise; in the end Mitsuba has a use for
    every element of that. `keys`, which may be globs, are of parameters that are to have derivatives: bitmaps among
    them that Mitsuba would keep with 8 or 16 bits are read as floating point.

    Raises ConfigError, located in the scene file, where it is missing or wrong, has nothing in it, or no light. Warns,
    too, of a scene that is too far from the origin, or too small, of glass that is too thin, and of faces at the same
    place; without `warn`, as for a scene that was looked at before, none of this is looked for.
    """
    file = Path(file)
    texts = {
        name: str(value).lower() if isinstance(value, bool) else str(value) for name, value in (options or {}).items()
    }
    description = read_description(file, texts)
    root = description.root
    if cameras is not None:
        replace_sensors(description, read_cameras(cameras))
    found = mend(description)
    if strict:
        refuse(found, root)
    if size is not None:
        resize_films(root, size)
    check(description)
    if look is not None:
        look(description)
    scene, unused = build(description)
    if strict:
        refuse(unused, root)
    if not isinstance(scene, mi.Scene):
        raise ConfigError(file, "", "its root is a single object, not a <scene>")
    for objects, wrong in (
        (scene.shapes(), "the scene is empty: it has no shapes"),
        (scene.emitters(), "the scene has no emitters: no light path can start"),
        (scene.sensors(), "the scene has no sensor"),
    ):
        if len(objects) == 0:
            raise ConfigError(file, "", wrong)
    _check_meshes(file, scene)
    lost = {note.element for note in unused}  # what else was done to them says nothing
    for line in warnings([*(note for note in found if note.element not in lost), *unused], root):
        warn_once(line)
    for doubt in doubts(scene) if warn else ():
        warn_once(f"{file}: {doubt}")
    for note in unused:
        if note.owner is not None:
            note.owner.children.remove(note.element)
    if _mark_floats(scene, description, keys):
        scene = None  # before the other takes its memory
        scene = build(description)[0]
    return scene


def make_grid(description: Description, id: str, size: tuple[int, int], place: Place) -> None:
    """Make a mesh with `size` vertices along its edges of the rectangle `id` of a description, before it is built.

    That is a `rectangle`, or a mesh of four vertices that are a parallelogram's; its place and its material stay.
    Raises ConfigError at `place` for any other shape.
    """
    element = description.root.by_id().get(id)
    if element is None or element.tag != "shape":
        return  # to select it says why
    kept = [item for item in element.children if not item.is_value or item.name in _KEPT_OF_GRID]
    if element.type != "rectangle":
        corners = _corners_of(element, description)
        if corners is None:
            raise place.fail("heightmap.grid", f"`{id}` is no rectangle, nor a mesh of four vertices that is one; "
                             "remove `grid`, or give it a mesh as fine as the map")  # fmt: skip
        p, q, d = corners
        normal = np.cross(q - p, d - p)
        matrix = np.eye(4)
        matrix[:3] = np.stack([(q - p) / 2, (d - p) / 2, normal / np.linalg.norm(normal), (q + d) / 2], axis=1)
        first = element.new("matrix", value=" ".join(f"{value:.9g}" for value in matrix.ravel()))
        transform = next((item for item in kept if item.tag == "transform"), None)
        if transform is None:
            transform = element.new("transform", name="to_world")
            kept.append(transform)
        transform.children.insert(0, first)
    element.attributes["type"] = "ply"
    element.children[:] = [element.new("string", name="filename", value=str(_grid_file(*size))), *kept]


#: What a rectangle hands on to a grid of it.
_KEPT_OF_GRID = ("to_world", "flip_normals", "face_normals")


def _corners_of(element: Element, description: Description) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """A corner of a parallelogram of four vertices, in a mesh's file, the next one and the one before, seen from
    outside; None of anything else. The first is that of the least texture coordinates, where it has some."""
    name = element.find("filename")
    path = None if name is None else description.find_file(name.value)
    if path is None or element.type not in ("ply", "obj"):
        return None
    mesh = mi.load_dict({"type": element.type, "filename": str(path)})
    if mesh.vertex_count() != 4 or mesh.face_count() != 2:
        return None
    points = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    one, other = (list(face) for face in np.array(mesh.faces_buffer()).reshape(2, 3))
    [alone], [apart] = [k for k in one if k not in other] or [-1], [k for k in other if k not in one] or [-1]
    if min(alone, apart) < 0:
        return None
    at = one.index(alone)
    loop = [one[at - 1], alone, one[(at + 1) % 3], apart]
    if not np.allclose(points[loop[0]] + points[loop[2]], points[loop[1]] + points[apart], atol=1e-5 * np.ptp(points)):
        return None
    if mesh.has_vertex_texcoords():
        least = np.array(mesh.vertex_texcoords_buffer()).reshape(-1, 2).sum(axis=1)
        start = int(np.argmin(least[loop]))
        loop = loop[start:] + loop[:start]
    return points[loop[0]], points[loop[1]], points[loop[3]]


@functools.cache
def _grid_file(width: int, height: int) -> Path:
    """A file with a grid over [-1, 1] x [-1, 1], which is there as long as this process."""
    path = Path(_grid_folder().name) / f"grid_{width}x{height}.ply"
    path.write_bytes(face_ply(Setting(size=(2.0, 2.0)), width, height))
    return path


@functools.cache
def _grid_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="reslrb-")


def load_for_script(file: str | os.PathLike[str], keys: Iterable[str] = (), /, **options: Any) -> mi.Scene:
    """Load a Mitsuba scene file as the command line does: its parameters have the names that `reslrb inspect` lists.

    In place of `mi.load_file(file, optimize=False, **options)`, which refuses what other versions of Mitsuba and
    exporters wrote, and names objects without an id otherwise. `options` are the values of the file's `$name`
    variables, which messages call `scene.options.NAME`, as configurations do. `keys` are parameters, or globs, that are
    to have gradients: their textures of 8 or 16 bits are read as floating point. A variant must be set; the scene's own
    integrator is not loaded.

    Raises `reslrb_cli.errors.ConfigError`, one line that says where, for a file that is missing or wrong, and
    BackendError under a variant that reslrb does not work with.
    """
    check_variant(mi.variant())
    return load_scene(Path(file), options, keys=[keys] if isinstance(keys, str) else keys)


def read_as_floats(scene: mi.Scene, description: Description, keys: Iterable[str]) -> mi.Scene:
    """The scene with bitmaps of 8 or 16 bits that `keys`, which may be globs, name read as floating point.

    That is `scene` itself where there are none, else one that is built anew from `description`, which is changed.
    """
    return build(description)[0] if _mark_floats(scene, description, keys) else scene


def _mark_floats(scene: mi.Scene, description: Description, keys: Iterable[str]) -> bool:
    """Have those bitmaps say in the description that they are floats; whether there are any.

    All others stay as they are: floats take four times the memory of bytes. The values are the same, decoded from sRGB
    when they are read and not when they are looked up.
    """
    keys = list(keys)
    if not keys or not any(element.type == "bitmap" for element in description.root.walk()):
        return False
    params, owners, changed = mi.traverse(scene), Owners(description.root), False
    for key in params.properties:
        if coarse_bits(params, key) is None or not any(key == each or fnmatchcase(key, each) for each in keys):
            continue
        owner, names = owners.place(params, key) or (description.root, [])
        if owner.type == "bitmap" and names == ["data"]:  # else nothing is done, and to select it says why
            warn_once(f"{owner.place}: `{key}` is read as floating point", logging.INFO)
            owner.drop("format")
            owner.children.append(owner.new("string", name="format", value="variant"))
            changed = True
    if changed:
        check_files(description)
    return changed


def _check_meshes(file: Path, scene: mi.Scene) -> None:
    """Raise ConfigError for a mesh whose faces name vertices that it lacks: Mitsuba reads past its end for them."""
    for shape in scene.shapes():
        if shape.is_mesh() and shape.face_count() and shape.vertex_count():
            last = int(np.array(shape.faces_buffer()).max())
            if last >= shape.vertex_count():
                has = f"has a face with vertex {last}, and {shape.vertex_count()} vertices"
                raise ConfigError(file, "", f"the mesh {quoted(shape.id())} {has}; write it again")


@functools.cache
def warn_once(line: str, level: int = logging.WARNING) -> None:
    """Say it in the log, once: one experiment may load its scene several times."""
    logger.log(level, "%s", line)
