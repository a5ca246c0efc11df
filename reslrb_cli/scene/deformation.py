"""Scene parameters as functions of what is recovered: motions of shapes and emitters, and heightmaps on meshes.

A mesh has positions p = M(p0 + h n0), p0 and n0 its own positions and normals, h the heightmap where it has one, at the
vertex's texture coordinates, and M the motion where it has one,

    M(p) = c + t + Rz Ry Rx s (p - c)      c the pivot, t the translation, R the rotation about each axis, s the scale

An analytic shape, and an emitter without a surface, is placed by M after its own `to_world`; of emitters s scales the
place alone. What the scene gets are values without a graph (leaves): a step adds its gradient to these, and `collect`
brings it on to what is recovered, once, however many views, batches and passes the step has. In forward mode `push`
takes tangents the other way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import HEIGHTMAP
from .movable import Movable


@dataclass(frozen=True)
class Motion:
    """A motion of `items` about the point `pivot`; `names` are those of its values, by word."""

    items: tuple[Movable, ...]
    pivot: Sequence[float]
    names: Mapping[str, str]

    def matrix(self, values: Mapping[str, Any], scaled: bool = True) -> mi.AffineTransform4f:
        """M, or, not `scaled`, its rotation alone."""
        transform = mi.AffineTransform4f
        pivot = mi.Vector3f(self.pivot)
        result = transform().translate(pivot) if scaled else transform()
        if scaled and "translation" in self.names:
            result = transform().translate(pivot + values[self.names["translation"]])
        if "rotation" in self.names:
            angles = values[self.names["rotation"]]
            for axis in (2, 1, 0):
                result = result @ transform().rotate([float(axis == k) for k in range(3)], angles[axis])
        if scaled and "scale" in self.names:
            result = result @ transform().scale(values[self.names["scale"]])
        return result @ transform().translate(-pivot) if scaled else result


@dataclass(frozen=True)
class Heightmap:
    """A displacement of meshes, `items`, by the texture `name`, (height, width, 1)."""

    items: tuple[Movable, ...]
    name: str


def identity(word: str, resolution: tuple[int, int] | None = None) -> Any:
    """The value of a motion's word, or of a heightmap of (width, height) texels, that moves nothing."""
    if word == HEIGHTMAP:
        assert resolution is not None, "a heightmap has one"
        value = dr.zeros(mi.TensorXf, (resolution[1], resolution[0], 1))
    else:
        value = mi.Float(1) if word == "scale" else mi.Vector3f(0)
    dr.make_opaque(value)
    return value


@dataclass
class _Moved:
    """One scene parameter that is a function: where it began, what moves it, and its value with and without graph."""

    item: Movable
    base: Any
    motion: Motion | None = None
    heightmap: Heightmap | None = None
    normals: Any = None
    texcoords: Any = None
    tracked: Any = None
    leaf: Any = None


@dataclass
class Deformation:
    """All motions and heightmaps of a scene with these `params`, and their current `values` by name."""

    params: mi.SceneParameters
    values: dict[str, Any] = field(default_factory=dict)
    #: `length`, `degrees` or `scale`, by name: what has one of these units adds up.
    quantities: dict[str, str] = field(default_factory=dict)
    _moved: dict[str, _Moved] = field(default_factory=dict)
    _corners: dict[tuple[str, int, int], tuple[list[mi.UInt32], list[mi.Float]]] = field(default_factory=dict)

    @property
    def keys(self) -> list[str]:
        """The scene parameters that are functions of the values."""
        return list(self._moved)

    def add_motion(self, items: tuple[Movable, ...], pivot: Sequence[float] | None, words: Sequence[str]
                   ) -> None:  # fmt: skip
        """Move `items`, none of which has a motion yet, about `pivot`; None: the centre of their bounding box."""
        names = {word: f"{items[0].id}.{word}" for word in words}
        motion = Motion(items, pivot or _centre(self.params, items), names)
        for item in items:
            self._place(item).motion = motion
        for word, name in names.items():
            self.values[name] = identity(word)
            self.quantities[name] = {"translation": "length", "rotation": "degrees"}.get(word, word)

    def add_heightmap(self, items: tuple[Movable, ...], resolution: tuple[int, int]) -> None:
        """Displace the meshes `items`, none of which has a heightmap yet."""
        heightmap = Heightmap(items, f"{items[0].id}.{HEIGHTMAP}")
        for item in items:
            moved, mesh = self._place(item), item.node
            moved.heightmap = heightmap
            sign = -1.0 if mesh.has_flipped_normals() else 1.0
            moved.normals = _opaque(sign * _vertex_normals(mesh))
            moved.texcoords = _opaque(dr.unravel(mi.Point2f, mesh.vertex_texcoords_buffer()))
        self.values[heightmap.name] = identity(HEIGHTMAP, resolution)
        self.quantities[heightmap.name] = "length"

    def moves(self, key: str) -> bool:
        """Whether the scene parameter `key` is a function already."""
        return key in self._moved

    def place(self) -> list[Any]:
        """Give the scene what follows from the values; `params.update()` has to follow. Returns what to evaluate."""
        for key, moved in self._moved.items():
            moved.tracked = self._function(moved)
            moved.leaf = _opaque(type(moved.tracked)(dr.detach(moved.tracked)))
            if dr.grad_enabled(moved.tracked):
                dr.enable_grad(moved.leaf)
            self.params[key] = moved.leaf
        return [moved.leaf for moved in self._moved.values()]

    def collect(self) -> None:
        """Add the gradient that steps left at the scene's parameters to that of the values, and clear it there."""
        tracked = [moved for moved in self._moved.values() if moved.leaf is not None and dr.grad_enabled(moved.leaf)]
        for moved in tracked:
            dr.set_grad(moved.tracked, dr.grad(moved.leaf))
            dr.clear_grad(moved.leaf)
            dr.enqueue(dr.ADMode.Backward, moved.tracked)
        if tracked:
            # Edges stay, for the next step from the same values.
            dr.traverse(dr.ADMode.Backward, dr.ADFlag.ClearVertices)

    def push(self) -> None:
        """Give the scene's parameters, and what follows from them, the tangents that have reached what they are."""
        tracked = [moved for moved in self._moved.values() if moved.leaf is not None and dr.grad_enabled(moved.leaf)]
        for moved in tracked:
            dr.set_grad(moved.leaf, dr.grad(moved.tracked))
            dr.enqueue(dr.ADMode.Forward, moved.leaf)
        if tracked:
            dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)

    def _place(self, item: Movable) -> _Moved:
        if item.key not in self._moved:
            value = dr.detach(self.params[item.key])
            kind: Any = type(value)
            if item.by_vertices:
                value, kind = dr.unravel(mi.Point3f, value), mi.Point3f
            self._moved[item.key] = _Moved(item, _opaque(kind(value)))
        return self._moved[item.key]

    def _function(self, moved: _Moved) -> Any:
        item, motion, base = moved.item, moved.motion, moved.base
        if moved.heightmap is not None:
            base = base + moved.normals * self._heights(moved)
        if motion is None:
            return dr.ravel(base)
        if item.by_vertices:
            return dr.ravel(motion.matrix(self.values) @ mi.Point3f(base))
        if item.is_point or item.is_shape:
            return motion.matrix(self.values) @ base
        # An emitter's frame has no scale: its place moves, and its directions turn.
        to, turned = mi.AffineTransform4f, motion.matrix(self.values, scaled=False)
        place = base @ mi.Point3f(0)
        there = motion.matrix(self.values) @ place
        return to().translate(there) @ turned @ to().translate(-place) @ base

    def _heights(self, moved: _Moved) -> mi.Float:
        """h at each vertex, bilinear between the centres of the texels."""
        assert moved.heightmap is not None
        values = self.values[moved.heightmap.name]
        height, width = values.shape[:2]
        place = (moved.item.key, width, height)
        if place not in self._corners:
            self._corners[place] = _corners(moved.texcoords, width, height)
        indices, weights = self._corners[place]
        return dr.custom(_Lookup, values.array, indices, weights)


class _Lookup(dr.CustomOp):
    """The weighted sum of entries of a buffer; derivatives that are not finite survive, which a gather's may not."""

    def eval(self, buffer: mi.Float, indices: list[mi.UInt32], weights: list[mi.Float]) -> mi.Float:
        self.indices, self.weights, self.size = indices, weights, dr.width(buffer)
        return sum(
            (w * dr.gather(mi.Float, buffer, i) for i, w in zip(indices, weights, strict=True)), start=mi.Float(0)
        )

    def forward(self) -> None:
        tangent = self.grad_in("buffer")
        total = sum(w * dr.gather(mi.Float, tangent, i) for i, w in zip(self.indices, self.weights, strict=True))
        self.set_grad_out(total)

    def backward(self) -> None:
        gradient, total = self.grad_out(), dr.zeros(mi.Float, self.size)
        for i, w in zip(self.indices, self.weights, strict=True):
            # On a CPU atomic sums drop a NaN, but not infinity.
            share = dr.select(dr.isfinite(gradient), w * gradient, dr.inf)
            dr.scatter_add(total, share, i, w != 0)
        self.set_grad_in("buffer", total)

    def name(self) -> str:
        return "heightmap"


def _corners(uv: mi.Point2f, width: int, height: int) -> tuple[list[mi.UInt32], list[mi.Float]]:
    """Indices and weights of the four texels about each of `uv`; row 0 is at v = 0, as in Mitsuba's textures."""
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


def _vertex_normals(mesh: mi.Mesh) -> mi.Normal3f:
    """The normals of a mesh's vertices: its own, or, of one without, those of the faces about each, by area."""
    if mesh.has_vertex_normals():
        return dr.normalize(dr.unravel(mi.Normal3f, mesh.vertex_normals_buffer()))
    positions = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
    a, b, c = (positions[faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    total = np.zeros_like(positions)
    for k in range(3):
        np.add.at(total, faces[:, k], areas)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return mi.Normal3f(np.ascontiguousarray(total.T.astype(np.float32)))


def _centre(params: mi.SceneParameters, items: tuple[Movable, ...]) -> tuple[float, float, float]:
    """The centre of the bounding box of `items`; emitters without a surface are points."""
    corners = []
    for item in items:
        if item.is_shape:
            box = item.node.bbox()
            corners += [np.array(box.min, float), np.array(box.max, float)]
        elif item.node.class_name() != "DirectionalEmitter":  # which is nowhere
            value = params[item.key]
            point = value if item.is_point else value @ mi.Point3f(0)
            corners.append(np.array(point, float).reshape(3))
    if not corners:
        return 0.0, 0.0, 0.0
    x, y, z = (np.min(corners, axis=0) + np.max(corners, axis=0)) / 2
    return float(x), float(y), float(z)


def _opaque(value: Any) -> Any:
    dr.make_opaque(value)
    return value
