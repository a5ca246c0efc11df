"""Loading of Mitsuba scene files, and scenes of the caller (`SceneInMemory`). Errors name their location."""

from __future__ import annotations

import functools
import logging
import os
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.variant import check_variant
from reslrb_cli.config.files import NAMELESS, as_path
from reslrb_cli.config.parameters import is_named
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene import dispersion
from reslrb_cli.scene.cameras import read_cameras, replace_sensors
from reslrb_cli.scene.catalog import coarse_bits
from reslrb_cli.scene.graph import bounds
from reslrb_cli.scene.xml.build import Owners, build, resize_films
from reslrb_cli.scene.xml.dictionary import write_dictionary
from reslrb_cli.scene.xml.mend import Note, mend, warnings
from reslrb_cli.scene.xml.read import Description, quoted, read_description

logger = logging.getLogger(__name__)
#: Largest ray offset, as a fraction of the scene's size, without visible loss of light: that of a room of size 3 at
#: about 150 from the origin, or of a room a fiftieth in size.
_LARGEST_OFFSET = 5e-3


def load_scene(
    file: Path,
    options: Mapping[str, Any] | None = None,
    size: tuple[int, int] | None = None,
    cameras: Path | None = None,
    look: Callable[[Description], object] | None = None,
    keys: Iterable[str] = (),
    named: Iterable[str] = (),
) -> mi.Scene:
    """Load a Mitsuba scene (XML, versions 0.4 to 3). A variant must be set.

    - `options` are the values of the file's `$name` variables.
    - `size` is the (width, height) of all films in pixels, and replaces the sizes in the files.
    - `cameras` is a file of cameras that replace the scene's sensors.
    - `look` is called with the description before anything is built, and may raise exceptions.
    - `keys` are keys or globs of parameters that need derivatives. If a bitmap of these parameters has 8 or 16 bits,
        the bitmap is read as floating point.
    - `named` are keys, globs or ids that may use earlier names of objects. These objects keep their earlier names.

    Shapes are not merged, so all parameters keep their names. A shape without an id is named after its file. Another
    object without an id is named by its kind and a number, such as `Sphere_3`. The number counts the file's objects of
    this kind. Elements of other versions or
    exporters that Mitsuba's parser would refuse are converted, or left out with a warning. Mitsuba must use every
    remaining element. The function does not load the scene's integrator, because an experiment has its own
    integrator. Plugins are loaded only from Mitsuba's own folder.

    Raises a ConfigError that names the scene file if the file is missing or wrong. Raises ConfigError also for a scene
    without shapes or light. Warns of a scene that is too far from the origin or too small.
    """
    file = Path(file)
    dispersion.register()
    description = read_description(file, options or {})
    if cameras is not None:
        replace_sensors(description, read_cameras(cameras))
    keys = list(keys)
    found = mend(description, [*keys, *named])
    if size is not None:
        resize_films(description, size)
    if look is not None:
        look(description)
    scene, unused = build(description)
    if not isinstance(scene, mi.Scene):
        raise ConfigError(file, "", "its root is a single object instead of a <scene>")
    check_scene(file, scene, [*found, *unused])
    for note in unused:
        if note.owner is not None:
            note.owner.children.remove(note.element)
    if _mark_floats(scene, description, keys):
        scene = None  # frees memory before the other is loaded
        scene = build(description)[0]
    return scene


def check_scene(source: object, scene: mi.Scene, notes: Iterable[Note] = ()) -> None:
    """Raise ConfigError for a scene without shapes, light or sensor, or with a broken mesh. Log `notes`, and warn of a
    scene that is too far from the origin or too small.
    """
    for objects, wrong in (
        (scene.shapes(), "the scene is empty: it has no shapes"),
        (scene.emitters(), "the scene has no emitters: no light path can start"),
        (scene.sensors(), "the scene has no sensor"),
    ):
        if len(objects) == 0:
            raise ConfigError(source, "", wrong)
    _check_meshes(source, scene)
    for line, level in warnings(notes):
        warn_once(line, level)
    if (problem := _lost_light(scene)) is not None:
        warn_once(f"{source}: {problem}")


def load_for_script(
    file: str | os.PathLike[str] | Mapping[str, Any], keys: Iterable[str] = (), /, **options: Any
) -> mi.Scene:
    """Load a Mitsuba scene as the command line does. The parameters have the names that `reslrb inspect` lists.

    `file` is a scene file, or a dictionary as for `mi.load_dict`. `load_for_script` replaces `mi.load_file(file,
    optimize=False, **options)`. `mi.load_file` refuses files of other versions and exporters, and names objects without
    an id differently. `options` are the values of the file's `$name` variables. Messages call these variables
    `scene.options.NAME`. `keys` are parameters, or globs, that need gradients. Textures of 8 or 16 bits among `keys`
    are read as floating point. A variant must be set. The function does not load the scene's own integrator.

    Raises a one-line `reslrb_cli.errors.ConfigError` with a location if a file is missing or wrong. Raises BackendError
    under an unsupported variant.
    """
    check_variant(mi.variant())
    wanted = [keys] if isinstance(keys, str) else keys
    if isinstance(file, Mapping):
        return load_scene(write_dictionary(file, NAMELESS, Path.cwd()), options, keys=wanted)
    path = as_path(file, "file", "the path of a scene file, or a Mitsuba dictionary")
    return load_scene(path, options, keys=wanted)


def _mark_floats(scene: mi.Scene, description: Description, keys: Iterable[str]) -> bool:
    """Mark the 8-bit and 16-bit bitmaps that `keys` name as floats in the description. Returns whether there are any.

    Other bitmaps keep their format, because floats take four times the memory of bytes. The values stay the same. The
    bitmaps are decoded from sRGB when they are read, instead of at each lookup.
    """
    keys = list(keys)
    if not keys or not any(element.type == "bitmap" for element in description.root.walk()):
        return False
    params, owners, changed = mi.traverse(scene), Owners(description.root), False
    for key in params.properties:
        if coarse_bits(params, key) is None or not is_named(key, keys):
            continue
        owner, names = owners.place(params, key) or (description.root, [])
        if owner.type == "bitmap" and names == ["data"]:  # otherwise the selection of the parameter reports the reason
            warn_once(f"{owner.place}: `{key}` is read as floating point", logging.INFO)
            owner.drop("format")
            owner.children.append(owner.new("string", name="format", value="variant"))
            changed = True
    return changed


def _check_meshes(source: object, scene: mi.Scene) -> None:
    """Raise ConfigError for a mesh whose faces refer to missing vertices. Mitsuba would read out of bounds for such a
    mesh.
    """
    for shape in scene.shapes():
        if shape.is_mesh() and shape.face_count() and shape.vertex_count():
            last = int(np.array(shape.faces_buffer()).max())
            if last >= shape.vertex_count():
                has = f"has a face with vertex {last}, but only {shape.vertex_count()} vertices"
                raise ConfigError(source, "", f"the mesh {quoted(shape.id())} {has}; write it again")


def _lost_light(scene: Any) -> str | None:
    """Return the problem of a scene that is far from the origin or tiny, with a remedy, or None.

    Mitsuba offsets the origins of rays from their surface by RayEpsilon (1 + max |p|), in the scene's units. Rays skip
    surfaces that are closer together than the offset. Light is then lost in corners, in all integrators.
    """
    low, high = bounds(scene)
    size = float(np.linalg.norm(high - low))
    reach = float(np.maximum(np.abs(low), np.abs(high)).max())
    offset = mi.math.RayEpsilon * (1 + reach)
    if not np.isfinite(size) or offset <= _LARGEST_OFFSET * size:
        return None
    centre = float(np.linalg.norm((low + high) / 2))
    if centre > size:
        place, advice = f"is {centre:.3g} from the origin and {size:.3g} wide", "move it to the origin"
    else:
        place, advice = f"measures {size:.3g} across", "scale it to about 1"
    return f"the scene {place}: Mitsuba starts rays {offset:.2g} away from surfaces there, and light is lost; {advice}"


@functools.cache
def warn_once(line: str, level: int = logging.WARNING) -> None:
    """Log a message once, because one experiment may load its scene several times."""
    logger.log(level, "%s", line)


# --- a scene of the caller --------------------------------------------------------------------------------------------

#: What to do where an experiment needs the description of its scene, or another process needs the scene.
INSTEAD = "give the scene as a file or as a Mitsuba dictionary"
_MERGED = "Mitsuba merges shapes and materials as it loads a scene, unless `optimize=False`"

#: How often each scene, by its `id`, has got its first values again.
_restored: Counter[int] = Counter()


class SceneInMemory:
    """A scene of the caller, and the values that its parameters had when the caller passed it.

    Raises ConfigError, located in `source`, for a scene that no run can use.
    """

    def __init__(self, scene: mi.Scene, source: object) -> None:
        check_scene(source, scene)
        self.scene = scene
        params = mi.traverse(scene)
        self._values = {key: _copied(params[key]) for key in params.properties}

    @property
    def uses(self) -> int:
        """A number that changes if another experiment, or another call, uses the scene."""
        return _restored[id(self.scene)]

    def restore(self) -> mi.Scene:
        """Give the scene its first values, without derivatives, and return it."""
        params = mi.traverse(self.scene)
        for key, value in self._values.items():
            now = params[key]
            if dr.grad_enabled(now) or not _equal(now, value):
                params[key] = _copied(value)
        params.update()
        _restored[id(self.scene)] += 1
        return self.scene

    def check_merged(self, keys: Iterable[str], objects: Iterable[str], source: object) -> None:
        """Raise ConfigError if Mitsuba has merged an object of the parameters `keys` (or globs), or one of the moved
        `objects`, with other objects.
        """
        params, shapes, keys = mi.traverse(self.scene), self.scene.shapes(), list(keys)
        if any(not shape.id() for shape in shapes):
            ids = {shape.id() for shape in shapes} | {emitter.id() for emitter in self.scene.emitters()}
            lost = [name for name in objects if name not in ids]
            lost += [each for each in keys if not any(is_named(key, [each]) for key in params.properties)]
            if lost:
                raise ConfigError(source, "scene", f"has no `{lost[0]}`, but shapes without ids; {_MERGED}")
        users: dict[Any, list[str]] = {}
        for shape in shapes:
            if shape.bsdf() is not None:
                users.setdefault(shape.bsdf(), []).append(shape.id())
        for key in params.properties:
            if is_named(key, keys):
                node = params.properties[key][2]
                while node is not None and node not in users:
                    node = params.hierarchy[node][0]
                names = users.get(node, [])
                if len(names) > 1 and key.partition(".")[0] in names:
                    raise ConfigError(source, "scene", f"has one material for {', '.join(names)}; {_MERGED}")


def _copied(value: Any) -> Any:
    """Return a value that later changes of the scene do not affect."""
    return type(value)(dr.detach(value))


def _equal(first: Any, second: Any) -> bool:
    if dr.is_array_v(first) or dr.is_tensor_v(first):
        a, b = (np.array(getattr(each, "matrix", each) if "Transform" in type(each).__name__ else each)
                for each in (first, second))  # fmt: skip
        return a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    return bool(first == second)
