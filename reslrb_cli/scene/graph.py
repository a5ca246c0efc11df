"""Graph of a scene's objects: objects, their users, emitting lamps, and meshes as arrays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from operator import or_
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.scene.rays import grid, no_wavelengths


@dataclass
class SceneGraph:
    """All objects below a scene, each once, in order of traversal.

    `mi.traverse` lists an object only below the object's first user. The graph contains all users.
    """

    objects: list[Any] = field(default_factory=list)
    parents: dict[Any, list[Any]] = field(default_factory=dict)
    children: dict[Any, list[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Any) -> SceneGraph:
        """Return the graph of `scene`."""

        class Children(mi.TraversalCallback):
            def __init__(self) -> None:
                super().__init__()
                self.found: list[Any] = []

            def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
                if isinstance(value, mi.Object):
                    self.found.append(value)

        graph, waiting = cls(), [scene]
        while waiting:
            parent = waiting.pop()
            callback = Children()
            parent.traverse(callback)
            graph.children[parent] = callback.found
            for child in callback.found:
                if child not in graph.parents:
                    graph.objects.append(child)
                    graph.parents[child] = []
                    waiting.append(child)
                graph.parents[child].append(parent)
        return graph

    def of_type(self, kind: Any) -> list[Any]:
        """Return all objects that are instances of `kind`, such as `mi.BSDF`."""
        return [item for item in self.objects if isinstance(item, kind)]

    def bitmaps(self) -> list[Any]:
        """Return all bitmap textures."""
        return [item for item in self.of_type(mi.Texture) if item.class_name().startswith("BitmapTexture")]

    def shapes(self) -> list[Any]:
        """Return all shapes that rays can hit, including those in instanced groups."""
        return [shape for shape in self.of_type(mi.Shape) if shape.class_name() not in ("Instance", "ShapeGroupPlugin")]

    def has_instances(self) -> bool:
        """Whether there is an instance of a group of shapes."""
        return any(item.class_name() == "Instance" for item in self.objects)

    def is_shown(self, shape: Any) -> bool:
        """Whether rays may meet a shape. Rays never meet a shape in a group without instances."""
        return self.has_instances() or any(item.class_name() != "ShapeGroupPlugin" for item in self.parents[shape])

    def find_lamps(self, scene: mi.Scene) -> tuple[Lamp, ...]:
        """Return all emitting shapes of `scene`, in the order of `scene.emitters()`."""
        textures = self.of_type(mi.Texture)
        found = []
        for index, emitter in enumerate(scene.emitters()):
            shape, parallel = emitter.get_shape(), emitter.class_name() == "DirectionalArea"
            if shape is not None:
                own = [texture for texture in textures if emitter in self.parents[texture]]
                varying = [texture for texture in own if texture.is_spatially_varying() and not parallel]
                shared = bool(varying) and _shares_coordinates(shape)
                texture = None if shared or not varying else varying[0]
                found.append(Lamp(shape, emitter, index, parallel, texture, shared, own[0] if own else None))
        return tuple(found)

    def surface_bsdfs(self) -> list[Any]:
        """Return the BSDFs of shapes, without nested ones, each once."""
        return list(dict.fromkeys(shape.bsdf() for shape in self.shapes() if shape.bsdf() is not None))

    def bsdfs_above(self, item: Any) -> list[Any]:
        """Return the BSDFs that use the texture or BSDF `item` at any depth. A BSDF `item` is included."""
        found: dict[Any, None] = {}
        waiting = [item]
        while waiting:
            current = waiting.pop()
            if isinstance(current, mi.BSDF):
                found[current] = None
            waiting += [parent for parent in self.parents.get(current, []) if isinstance(parent, (mi.BSDF, mi.Texture))]
        return list(found)

    def owning_bsdfs(self, item: Any) -> list[Any]:
        """Return the outermost BSDFs that use `item`. An outermost BSDF has a user that is neither a BSDF nor a
        texture.
        """
        found = ((bsdf, self.parents.get(bsdf, [])) for bsdf in self.bsdfs_above(item))
        return [bsdf for bsdf, parents in found if not all(isinstance(p, (mi.BSDF, mi.Texture)) for p in parents)]

    def nested_bsdfs(self, bsdf: Any) -> list[Any]:
        """Return a BSDF and those nested in it."""
        found = [bsdf]
        for item in found:  # the list grows during the loop
            found += [child for child in self.children[item] if isinstance(child, mi.BSDF) and child not in found]
        return found


@dataclass(frozen=True)
class Lamp:
    """Emitting shape. `emitter` is the shape's emitter, and `index` is the emitter's place in `scene.emitters()`.

    `parallel` tells whether light leaves only along the normal (`directionalarea`). `texture` is the texture from which
    points on the shape are sampled. `texture` is None if points are uniform over the shape's area. `shared` tells
    whether the shape has a texture, but several of its points have the same texture coordinates (`cube`). Mitsuba would
    sample only one of them, so the points are uniform over the area. `radiance` is the emitter's spectrum or texture.
    """

    shape: mi.Shape
    emitter: mi.Emitter
    index: int
    parallel: bool
    texture: mi.Texture | None
    shared: bool = False
    radiance: mi.Texture | None = None

    @cached_property
    def is_sphere(self) -> bool:
        """Whether the shape is a sphere."""
        return self.shape.class_name() == "Sphere"

    @cached_property
    def surrounds(self) -> bool:
        """True if the shape is a sphere that emits inwards with constant radiance.

        Mitsuba samples points of such a sphere uniformly. If rounding puts the vertex outside of the sphere, Mitsuba
        uses the density of a cone instead. Rounding can affect all vertices on the sphere.
        """
        return self.is_sphere and self.texture is None and not self.parallel and self.shape.has_flipped_normals()

    @cached_property
    def is_beam(self) -> bool:
        """Whether light leaves the lamp in a known direction: along its normal, from flat faces."""
        flat = self.shape.class_name() in ("Rectangle", "Disk") or (
            self.has_faces and not interpolates_normals(self.shape)
        )
        return self.parallel and flat

    @cached_property
    def faces_by_area(self) -> bool:
        """True if Mitsuba samples the shape's faces in proportion to the faces' current areas."""
        return self.has_faces and self.texture is None

    @cached_property
    def has_faces(self) -> bool:
        """Whether the shape is a mesh whose vertices can move."""
        return self.shape.is_mesh() and self.shape.class_name() != "Rectangle"


#: Points on each face, and points in all, that decide whether faces share texture coordinates.
FACE_POINTS, MOST_POINTS = 16, 2**20


def _shares_coordinates(shape: mi.Shape) -> bool:
    """True if the texture coordinates of some point of a mesh do not lead back to it: faces overlap in the texture, or
    lie outside of it, or have no texture coordinates.
    """
    if not shape.is_mesh() or shape.class_name() == "Rectangle":
        return False  # other shapes have one point for each coordinate
    if not shape.has_vertex_texcoords():
        return True
    faces = shape.face_count()
    each = max(min(FACE_POINTS, MOST_POINTS // max(faces, 1)), 1)
    with dr.suspend_grad():
        lane = dr.arange(mi.UInt32, faces * each)
        number = lane % each
        place = mi.Point2f((mi.Float(number) + 0.5) / each, mi.Float(dr.brev(number)) * 2**-32 + 2**-6)
        a, b, c = (vertex for vertex in shape.face_indices(lane // each))
        weights = mi.warp.square_to_uniform_triangle(place)

        def at(corner: Any) -> Any:
            first = corner(a)
            return first + weights.x * (corner(b) - first) + weights.y * (corner(c) - first)

        p, uv = at(shape.vertex_position), at(shape.vertex_texcoord)
        there = shape.eval_parameterization(uv, mi.RayFlags.All, True)
        size = dr.norm(shape.bbox().extents())
        found = there.is_valid() & (dr.norm(there.p - p) < 1e-3 * size) & dr.all((uv >= 0) & (uv <= 1))
        return not bool(dr.all(found))


def look_up(texture: mi.Texture) -> mi.Spectrum:
    """Return the value of a texture at its origin. The first lookup sets up the texture's data."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    try:
        return texture.eval(si)
    except RuntimeError:
        if not mi.is_spectral:
            raise
        return texture.eval_3(si)  # such as normals, which are no spectra


#: Maximum diameter on the film, in pixels, of a small lamp.
SMALL = 1.0
#: Maximum number of lamps, because each hit is compared with every lamp.
MOST = 64
#: Points of a lamp per side of a grid that decide whether it is in view.
POINTS = 16


def small_lamps(scene: mi.Scene, sensor: mi.Sensor, lamps: Iterable[Lamp]) -> tuple[Lamp, ...]:
    """Return the lamps in direct view of `sensor` that are smaller than a pixel. Return no lamps if the number of lamps
    smaller than a pixel exceeds `MOST`.

    Lamps that emit only along their normal are never visible.
    """
    found = [lamp for lamp in lamps if not lamp.parallel and _pixels(sensor, lamp.shape) < SMALL]
    if len(found) > MOST:
        return ()
    return tuple(lamp for lamp in found if _is_in_view(scene, sensor, lamp.shape))


def _pixels(sensor: mi.Sensor, shape: mi.Shape) -> float:
    """Return the diameter on the film, in pixels, of the sphere around the shape's bounding box. It holds for any view
    direction.
    """
    low, high = bounds(shape)
    radius = float(np.linalg.norm(high - low)) / 2
    eye = np.ravel(sensor.world_transform().translation())
    distance = float(np.linalg.norm((high + low) / 2 - eye))
    if not distance > radius:
        return np.inf
    half = np.tan(np.deg2rad(float(mi.traverse(sensor)["x_fov"][0])) / 2)
    return float(radius / distance / half * int(sensor.film().size()[0]))


def _is_in_view(scene: mi.Scene, sensor: mi.Sensor, shape: mi.Shape) -> bool:
    """True if a grid point on the shape is in front of the lens, without occlusion."""
    with dr.suspend_grad():
        si = mi.SurfaceInteraction3f(shape.sample_position(sensor.shutter_open(), grid(POINTS)), no_wavelengths())
        ds, _ = sensor.sample_direction(si, mi.Point2f(0.5), True)
        seen = ds.pdf > 0
        return bool(dr.any(seen & ~scene.ray_test(si.spawn_ray_to(ds.p), seen)))


def bounds(item: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and the upper corner of the bounding box of a shape or a scene, (3,) float64 each."""
    box = item.bbox()
    low, high = np.ravel(box.min).astype(np.float64), np.ravel(box.max).astype(np.float64)
    if (low > high).any() and isinstance(item, mi.Mesh) and item.vertex_count():
        # Mitsuba computes no bounds for the mesh that it merges from shapes of one material.
        corners = triangles(item)
        low, high = corners.min((0, 1)), corners.max((0, 1))
    return low, high


def is_one_of(pointer: mi.ShapePtr | mi.BSDFPtr, objects: Sequence[mi.Object]) -> mi.Bool:
    """Return the lanes in which the pointer is one of `objects`."""
    return reduce(or_, (pointer == type(pointer)(other) for other in objects), mi.Bool(False))


def interpolates_normals(shape: mi.Shape) -> bool:
    """True if the shape is a mesh whose shading normals differ from its geometric normals as soon as the mesh bends."""
    return shape.is_mesh() and shape.has_vertex_normals() and not shape.has_face_normals()


def triangles(mesh: mi.Mesh) -> np.ndarray:
    """Return the corners of a mesh's faces, (F, 3, 3) float64."""
    return _at_corners(mesh, mesh.vertex_positions_buffer())


def face_normals(corners: np.ndarray) -> np.ndarray:
    """Return normals (F, 3) of triangles (F, 3, 3). A normal's length is twice the area of its triangle."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def bent_faces(mesh: mi.Mesh, cosine: float) -> np.ndarray:
    """Return booleans (F,) that mark faces with a vertex normal whose cosine to the face normal is below `cosine`."""
    if not interpolates_normals(mesh):
        return np.zeros(mesh.face_count(), bool)
    flat, shading = face_normals(triangles(mesh))[:, None], _at_corners(mesh, mesh.vertex_normals_buffer())
    lengths = np.linalg.norm(flat, axis=2) * np.linalg.norm(shading, axis=2)
    return np.asarray(~((flat * shading).sum(2) > cosine * np.maximum(lengths, 1e-30)).all(1))


def _at_corners(mesh: mi.Mesh, buffer: mi.Float) -> np.ndarray:
    return np.array(buffer, np.float64).reshape(-1, 3)[np.array(mesh.faces_buffer()).reshape(-1, 3)]
