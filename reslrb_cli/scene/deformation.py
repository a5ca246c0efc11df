"""Scene parameters as functions of recovered values: motions of shapes and emitters, and heightmaps on meshes.

Obstacles and movables: some shapes and emitters have derivatives with respect to their position. For all other shapes
and emitters, a reason explains the missing derivatives. Objects of a motion or a heightmap are found by id, together
with the scene parameter of their position.

Surroundings: emitters without a position (a constant sky, parallel light) send their rays through a sphere around the
scene. Mitsuba sets this sphere when the scene is loaded. Shapes that later leave the sphere would be dark. The sphere
is therefore kept around moving shapes.

Deformation: a mesh has positions p = M(p0 + h n0). p0 and n0 are its own positions and normals, h is its heightmap at
the vertex's texture coordinates, and M is its motion. c is the pivot, t the translation, R a rotation about each axis,
and s the scale.

    M(p) = c + t + Rz Ry Rx s (p - c)

M is applied after the original `to_world` of an analytic shape, or of an emitter without a surface. For emitters, s
scales only the position. The scene parameters get values without a graph (leaves). A step adds its gradient to the
leaves. `collect` propagates the summed gradient to the recovered values once, for any number of views, batches and
passes. In forward mode, `push` propagates tangents from the recovered values to the scene.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.parameters import ANGLES, AXES, HEIGHTMAP
from reslrb_cli.errors import did_you_mean
from reslrb_cli.scene.graph import bounds, face_normals, triangles

#: Analytic shapes whose `to_world` moves their surface interactions and their samples.
MOVING_SHAPES = ("Rectangle", "Disk", "Sphere", "Cylinder")
#: Parameters of a mesh that move light.
MOVING_MESH = ("vertex_positions", "vertex_normals")
#: Emitters without a surface that can move, and their parameters.
MOVING_EMITTERS = {
    "PointLight": "position",
    **dict.fromkeys(("SpotLight", "Projector", "DirectionalEmitter"), "to_world"),
}
#: Parameters with the position of an emitter.
PLACES = ("position", "to_world")
#: Parameters of emitters that are flagged as differentiable, and also change the directions of light.
BEAMS = {
    **dict.fromkeys(("cutoff_angle", "beam_width", "sun_aperture"), "shapes the beam"),
    "sun_direction": "moves the light",
}
#: Parameters with the position of an object; a rectangle also has vertices.
_PLACED = ("to_world", "vertex_positions", "position")


def moving_obstacle(node: mi.Shape | mi.Emitter, key: str) -> str | None:
    """Return the reason why the parameter `key` of a shape or a surfaceless emitter has no derivative. Return None if
    there is a derivative.

    The parameter determines the position or the direction of the object.
    """
    kind, name = node.class_name(), key.rpartition(".")[2]
    if not isinstance(node, mi.Shape):
        if name == MOVING_EMITTERS.get(kind):
            return None
        if name in BEAMS:
            return f"{name} changes the direction of the light of a {kind}, which has no derivative here"
        if kind in ("EnvironmentMapEmitter", "SunskyEmitter"):
            return f"a rotating {kind} has no derivative here: its directions are sampled by its radiance in each"
        return f"a moving {kind} has no derivative here"
    if node.is_mesh() and kind not in MOVING_SHAPES:  # Mitsuba treats a rectangle as a mesh, too
        moving = " and ".join(MOVING_MESH)
        return None if name in MOVING_MESH else f"of a mesh, {moving} have derivatives, not {name}"
    if kind in MOVING_SHAPES and name == "to_world":
        return None
    kinds = ", ".join(shape.lower() for shape in MOVING_SHAPES)
    return f"meshes (by their vertices) and {kinds} (by `to_world`) have derivatives, but a {kind} has not"


@dataclass(frozen=True)
class Movable:
    """Object that can move. `id` is the object's id, and `key` the scene parameter of its position.

    The parameter is a mesh's `vertex_positions`, the `to_world` of an analytic shape or an emitter, or a point light's
    `position`.
    """

    id: str
    key: str
    node: mi.Shape | mi.Emitter

    @property
    def by_vertices(self) -> bool:
        """True if the object is a mesh. A mesh moves by its vertices."""
        return self.key.endswith(".vertex_positions")

    @property
    def is_point(self) -> bool:
        """True if the object is a point, without extent and direction. A point cannot be rotated or scaled."""
        return self.key.endswith(".position")

    @property
    def is_shape(self) -> bool:
        """Whether it has a surface."""
        return isinstance(self.node, mi.Shape)

    def heightmap_obstacle(self) -> str | None:
        """Return the reason why no heightmap can displace the object, or None if a heightmap can."""
        if not self.by_vertices:
            return f"`{self.id}` is a {self.node.class_name()}; a heightmap displaces the vertices of a mesh"
        if not self.node.has_vertex_texcoords():
            return f"`{self.id}` has no texture coordinates, which a heightmap needs; give the mesh some"
        return None

    def casts_edges(self, scene: mi.Scene) -> bool:
        """True if the object can have a silhouette or cast a shadow: any shape, except one that encloses all others."""
        others = [shape.bbox() for shape in scene.shapes() if shape.ptr != self.node.ptr]
        return self.is_shape and not all(self.node.bbox().contains(box, strict=True) for box in others)


def find_movable(params: mi.SceneParameters, id: str) -> Movable | str:
    """Return the object with this id, or the reason why it cannot be moved."""
    for name in _PLACED:
        key = f"{id}.{name}"
        if key not in params.properties:
            continue
        node = params.properties[key][2]
        if not isinstance(node, (mi.Emitter, mi.Shape)):
            return f"`{id}` is a {node.class_name()}; shapes and emitters can be moved"
        reason = moving_obstacle(node, key)
        return Movable(id, key, node) if reason is None else f"`{id}` cannot be moved: {reason}"
    if any(key.startswith(f"{id}.") for key in params.properties):
        return f"`{id}` has neither vertices nor a position that can be moved"
    hint = did_you_mean(id, [item.id for item in list_movable(params)], 3, 0, otherwise="nothing here can be moved")
    return f"there is no `{id}` in the scene; {hint}"


def list_movable(params: mi.SceneParameters) -> list[Movable]:
    """Return all movable objects, in the scene's order."""
    split = (key.rpartition(".") for key in params.properties)
    ids = dict.fromkeys(id for id, _, name in split if id and name in _PLACED)
    return [item for item in (find_movable(params, id) for id in ids) if isinstance(item, Movable)]


def where_moved(params: mi.SceneParameters, keys: list[str]) -> list[Movable]:
    """Return the objects that the scene parameters `keys` move."""
    found = []
    for key in keys:
        id, _, name = key.rpartition(".")
        node = params.properties[key][2]
        is_placed = name in PLACES and node.class_name() in (*MOVING_SHAPES, *MOVING_EMITTERS)
        if is_placed or name == "vertex_positions":
            found.append(Movable(id, key, node))
    return found


class Moves(enum.Enum):
    """What parameters move."""

    NOTHING = "nothing"
    SHAPES = "shapes"
    LAMPS = "lamps"

    def __bool__(self) -> bool:
        return self is not Moves.NOTHING

    @staticmethod
    def of(moved: list[Movable]) -> Moves:
        """Return what the `moved` objects are. Shapes that emit light are lamps."""
        if any(not isinstance(each.node, mi.Shape) or each.node.is_emitter() for each in moved):
            return Moves.LAMPS
        return Moves.SHAPES if moved else Moves.NOTHING


#: Margin of a sphere that has become too small, because each size compiles kernels.
MARGIN = 1.25
#: A sphere larger than this multiple of the needed size wastes light paths.
TOO_LARGE = 2.0


@dataclass(frozen=True)
class Horizon:
    """Sphere around a scene."""

    center: tuple[float, float, float]
    radius: float

    def holds(self, box: mi.ScalarBoundingBox3f) -> bool:
        """Whether the box lies within the sphere."""
        farthest = np.maximum(np.abs(np.subtract(box.min, self.center)), np.abs(np.subtract(box.max, self.center)))
        return float(np.linalg.norm(farthest)) <= self.radius * (1 + 1e-6)


class Surroundings:
    """Sphere around the shapes of one scene. There is one object for each scene."""

    def __init__(self) -> None:
        self._horizon: Horizon | None = None

    def follow(self, scene: mi.Scene) -> Horizon:
        """Return a sphere around all current shapes of the scene, and set it in the scene's infinite emitters.

        The sphere does not change while it contains all shapes, and its radius is less than `TOO_LARGE` times the
        needed radius.
        """
        sphere, before = scene.bbox().bounding_sphere(), self._horizon
        if before is not None and before.holds(scene.bbox()) and before.radius < TOO_LARGE * sphere.radius:
            return before
        x, y, z, radius = (float(value) for value in (*sphere.center, sphere.radius))
        bounded = scene
        if before is not None:
            radius *= MARGIN
            # An emitter only asks a scene for its bounds; this scene has the required bounds.
            corner = mi.ScalarTransform4f().translate([x, y, z]).scale(radius / 3**0.5)
            bounded = mi.load_dict({"type": "scene", "box": {"type": "cube", "to_world": corner}})
        self._horizon = Horizon((x, y, z), radius)
        for emitter in scene.emitters():
            if mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite):
                emitter.set_scene(bounded)
        return self._horizon


@dataclass(frozen=True)
class Motion:
    """Motion about the point `pivot`. `names` maps each part of the motion to the name of its value."""

    pivot: Sequence[float]
    names: Mapping[str, str]

    def matrix(self, values: Mapping[str, Any], scaled: bool = True) -> mi.AffineTransform4f:
        """Return M, or only the rotation of M if `scaled` is false."""
        transform = mi.AffineTransform4f
        pivot = mi.Vector3f(self.pivot)
        moved = self._vector(values, "translation", AXES)
        result = transform().translate(pivot + (0 if moved is None else moved)) if scaled else transform()
        angles = self._vector(values, "rotation", ANGLES)
        if angles is not None:
            for axis in (2, 1, 0):
                result = result @ transform().rotate([float(axis == k) for k in range(3)], angles[axis])
        if scaled and "scale" in self.names:
            result = result @ transform().scale(values[self.names["scale"]])
        return result @ transform().translate(-pivot) if scaled else result

    def _vector(self, values: Mapping[str, Any], word: str, parts: Sequence[str]) -> mi.Vector3f | None:
        """Return the value of `word`, or the vector of its free `parts`. If nothing is free, return None."""
        if word in self.names:
            return values[self.names[word]]
        if not any(part in self.names for part in parts):
            return None
        return mi.Vector3f(*(values[self.names[part]] if part in self.names else 0 for part in parts))


@dataclass
class Leaf:
    """Scene parameter that depends on recovered values: its value with graph (`tracked`), and without (`leaf`)."""

    tracked: Any = None
    leaf: Any = None

    def place(self, tracked: Any) -> Any:
        """Take a new value. Returns the value without graph, which the scene gets."""
        self.tracked = tracked
        self.leaf = _opaque(type(tracked)(dr.detach(tracked)))
        if dr.grad_enabled(tracked):
            dr.enable_grad(self.leaf)
        return self.leaf

    @property
    def is_tracked(self) -> bool:
        """Whether the values on which the parameter depends have derivatives."""
        return self.leaf is not None and bool(dr.grad_enabled(self.leaf))


def collect(leaves: Iterable[Leaf]) -> None:
    """Add the gradient at the scene's parameters to the gradient of the values. Clear the gradient in the scene."""
    tracked = [each for each in leaves if each.is_tracked]
    for each in tracked:
        dr.set_grad(each.tracked, dr.grad(each.leaf))
        dr.clear_grad(each.leaf)
        dr.enqueue(dr.ADMode.Backward, each.tracked)
    if tracked:
        # Keep edges for the next step from the same values.
        dr.traverse(dr.ADMode.Backward, dr.ADFlag.ClearVertices)


def push(leaves: Iterable[Leaf]) -> None:
    """Propagate tangents of the values to the scene's parameters."""
    tracked = [each for each in leaves if each.is_tracked]
    for each in tracked:
        dr.set_grad(each.leaf, dr.grad(each.tracked))
        dr.enqueue(dr.ADMode.Forward, each.leaf)
    if tracked:
        dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)


@dataclass(kw_only=True)
class _Moved(Leaf):
    """Scene parameter that depends on recovered values: its initial value, and its motion.

    `heightmap` is the name of the texture (height, width, 1) that displaces a mesh along its own `normals`.
    """

    item: Movable
    base: Any
    motion: Motion | None = None
    heightmap: str | None = None
    normals: Any = None
    texcoords: Any = None


def _corners(uv: mi.Point2f, width: int, height: int) -> tuple[list[mi.UInt32], list[mi.Float]]:
    """Return indices and weights of the four texels around each point of `uv`. Row 0 is at v = 0, as in Mitsuba's
    textures.
    """
    x = dr.clip(uv.x * width - 0.5, 0, width - 1)
    y = dr.clip(uv.y * height - 0.5, 0, height - 1)
    x0 = dr.minimum(mi.UInt32(x), width - 2)
    y0 = dr.minimum(mi.UInt32(y), height - 2)
    a, b = x - x0, y - y0
    first = y0 * width + x0
    indices = [first, first + 1, first + width, first + width + 1]
    weights = [(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b]
    dr.make_opaque(indices, weights)
    return indices, weights


@dataclass
class Deformation:
    """All motions and heightmaps of a scene with these `params`, and their current `values` by name."""

    params: mi.SceneParameters
    values: dict[str, Any] = field(default_factory=dict)
    #: `length`, `degrees` or `scale`, by name: values of the same unit can be added.
    quantities: dict[str, str] = field(default_factory=dict)
    #: Extent of each value of a motion: the size of what moves, a quarter turn, or a scale of 1. A quarter of the size
    #: for a heightmap.
    extents: dict[str, float] = field(default_factory=dict)
    _moved: dict[str, _Moved] = field(default_factory=dict)
    _corners: dict[tuple[str, int, int], tuple[list[mi.UInt32], list[mi.Float]]] = field(default_factory=dict)

    @property
    def keys(self) -> list[str]:
        """Scene parameters that are functions of the values."""
        return list(self._moved)

    def add_motion(self, items: tuple[Movable, ...], pivot: Sequence[float] | None, words: Sequence[str]
                   ) -> None:  # fmt: skip
        """Add a motion of `items` about `pivot`. Without a given `pivot`, the pivot is the centre of the items'
        bounding box.

        The items must not have a motion yet.
        """
        names = {word: f"{items[0].id}.{word}" for word in words}
        motion = Motion(pivot or _centre(self.params, items), names)
        for item in items:
            self._place(item).motion = motion
        for word, name in names.items():
            is_number = word in AXES or word in ANGLES
            start = mi.Float(1) if word == "scale" else mi.Float(0) if is_number else mi.Vector3f(0)
            self.values[name] = _opaque(start)
            is_angle = word == "rotation" or word in ANGLES
            self.quantities[name] = "degrees" if is_angle else "scale" if word == "scale" else "length"
            self.extents[name] = 90.0 if is_angle else 1.0 if word == "scale" else _size(self.params, items)

    def add_heightmap(self, items: tuple[Movable, ...], resolution: tuple[int, int]) -> None:
        """Add a heightmap to the meshes `items`. They must not have one yet."""
        name = f"{items[0].id}.{HEIGHTMAP}"
        for item in items:
            moved, mesh = self._place(item), item.node
            moved.heightmap = name
            sign = -1.0 if mesh.has_flipped_normals() else 1.0
            moved.normals = _opaque(sign * _vertex_normals(mesh))
            moved.texcoords = _opaque(dr.unravel(mi.Point2f, mesh.vertex_texcoords_buffer()))
        self.values[name] = _opaque(dr.zeros(mi.TensorXf, (*resolution[::-1], 1)))
        self.quantities[name] = "length"
        self.extents[name] = _size(self.params, items) / 4

    def laid_over(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (N, 3) and texture coordinates (N, 2) of the first mesh with the heightmap `name`, without
        deformation.
        """
        moved = next(each for each in self._moved.values() if each.heightmap == name)
        return np.array(moved.base).T, np.array(moved.texcoords).T

    def place(self) -> list[Any]:
        """Set the scene's parameters from the values. Call `params.update()` afterwards. Returns the arrays to
        evaluate.
        """
        for key, moved in self._moved.items():
            self.params[key] = moved.place(self._function(moved))
        return [moved.leaf for moved in self._moved.values()]

    def collect(self) -> None:
        """Add the gradient at the scene's parameters to the gradient of the values. Clear the gradient in the scene."""
        collect(self._moved.values())

    def push(self) -> None:
        """Propagate tangents of the values to the scene's parameters."""
        push(self._moved.values())

    def _place(self, item: Movable) -> _Moved:
        if item.key not in self._moved:
            value = dr.detach(self.params[item.key])
            value = dr.unravel(mi.Point3f, value) if item.by_vertices else type(value)(value)
            self._moved[item.key] = _Moved(item=item, base=_opaque(value))
        return self._moved[item.key]

    def _function(self, moved: _Moved) -> Any:
        item, motion, base = moved.item, moved.motion, moved.base
        if moved.heightmap is not None:
            base = base + moved.normals * self._heights(moved, self.values[moved.heightmap])
        if motion is None:
            return dr.ravel(base)
        if item.by_vertices:
            return dr.ravel(motion.matrix(self.values) @ mi.Point3f(base))
        if item.is_point or item.is_shape:
            return motion.matrix(self.values) @ base
        # An emitter's frame has no scale: its position moves, and its directions rotate.
        to, place = mi.AffineTransform4f, base @ mi.Point3f(0)
        there, turned = motion.matrix(self.values) @ place, motion.matrix(self.values, scaled=False)
        return to().translate(there) @ turned @ to().translate(-place) @ base

    def _heights(self, moved: _Moved, values: mi.TensorXf) -> mi.Float:
        """Return h at each vertex, interpolated bilinearly between the centres of the texels."""
        height, width = values.shape[:2]
        place = (moved.item.key, width, height)
        if place not in self._corners:
            self._corners[place] = _corners(moved.texcoords, width, height)
        indices, weights = self._corners[place]
        return dr.custom(_Lookup, values.array, indices, weights)


class _Lookup(dr.CustomOp):
    """Weighted sum of entries of a buffer. The sum's derivative keeps non-finite values, unlike the derivative of a
    gather.
    """

    def eval(self, buffer: mi.Float, indices: list[mi.UInt32], weights: list[mi.Float]) -> mi.Float:
        self.indices, self.weights, self.size = indices, weights, dr.width(buffer)
        return self._sum(buffer)

    def _sum(self, buffer: mi.Float) -> mi.Float:
        return sum(w * dr.gather(mi.Float, buffer, i) for i, w in zip(self.indices, self.weights, strict=True))

    def forward(self) -> None:
        self.set_grad_out(self._sum(self.grad_in("buffer")))

    def backward(self) -> None:
        gradient, total = self.grad_out(), dr.zeros(mi.Float, self.size)
        for i, w in zip(self.indices, self.weights, strict=True):
            # On a CPU atomic sums drop a NaN, but not infinity.
            share = dr.select(dr.isfinite(gradient), w * gradient, dr.inf)
            dr.scatter_add(total, share, i, w != 0)
        self.set_grad_in("buffer", total)

    def name(self) -> str:
        return "heightmap"


def _vertex_normals(mesh: mi.Mesh) -> mi.Normal3f:
    """Return a mesh's vertex normals. A mesh without vertex normals gets area-weighted means over adjacent faces."""
    if mesh.has_vertex_normals():
        return dr.normalize(dr.unravel(mi.Normal3f, mesh.vertex_normals_buffer()))
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
    areas, total = face_normals(triangles(mesh)), np.zeros((mesh.vertex_count(), 3))
    for k in range(3):
        np.add.at(total, faces[:, k], areas)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return mi.Normal3f(np.ascontiguousarray(total.T.astype(np.float32)))


def _centre(params: mi.SceneParameters, items: tuple[Movable, ...]) -> tuple[float, float, float]:
    """Return the centre of the bounding box of `items`. Emitters without a surface count as points."""
    corners: list[np.ndarray] = []
    for item in items:
        if item.is_shape:
            corners += bounds(item.node)
        elif item.node.class_name() != "DirectionalEmitter":  # it has no position
            value = params[item.key]
            corners.append(np.ravel(value if item.is_point else value @ mi.Point3f(0)).astype(np.float64))
    if not corners:
        return 0.0, 0.0, 0.0
    x, y, z = (np.min(corners, axis=0) + np.max(corners, axis=0)) / 2
    return float(x), float(y), float(z)


def _size(params: mi.SceneParameters, items: tuple[Movable, ...]) -> float:
    """Return the longest side of the bounding box of `items`. Emitters without a surface have a quarter of the size of
    all shapes.
    """
    nodes = [item.node for item in items if item.is_shape]
    every = [node for _, _, node, *_ in params.properties.values() if isinstance(node, mi.Shape)]
    corners = [corner for node in nodes or every for corner in bounds(node)]
    size = float(np.ptp(corners, axis=0).max()) if corners else 0.0
    return (size if nodes else size / 4) or 1.0


def _opaque(value: Any) -> Any:
    dr.make_opaque(value)
    return value
