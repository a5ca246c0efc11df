"""The graph of a scene's objects, and its lamps: what there is, what uses what, and what emits.

- `SceneGraph`: the objects and all parents of each.
- `Lamp`: a shape that emits light, and what its emitter does.
- `emitted_rays`: rays as the emitters of a scene send them out, where Mitsuba can sample them.
- `small_lamps`: lamps in view that are smaller than a pixel, which rays through the pixels hardly ever hit.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.errors import UnsupportedScene


@dataclass
class SceneGraph:
    """All objects below a scene, each once, in order of traversal.

    Unlike `mi.traverse`, which lists an object below the first that uses it, it knows all parents of each.
    """

    objects: list[Any] = field(default_factory=list)
    parents: dict[Any, list[Any]] = field(default_factory=dict)

    @classmethod
    def of(cls, scene: Any) -> SceneGraph:
        """The graph of `scene`."""

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
            for child in callback.found:
                if child not in graph.parents:
                    graph.objects.append(child)
                    graph.parents[child] = []
                    waiting.append(child)
                graph.parents[child].append(parent)
        return graph

    def of_type(self, kind: Any) -> list[Any]:
        """All objects that are instances of `kind`, such as `mi.BSDF`."""
        return [item for item in self.objects if isinstance(item, kind)]

    def shapes(self) -> list[Any]:
        """All shapes that rays can hit, also those inside of groups that are instanced."""
        return [shape for shape in self.of_type(mi.Shape) if shape.class_name() not in ("Instance", "ShapeGroupPlugin")]

    def is_shown(self, shape: Any) -> bool:
        """Whether rays may meet a shape: it does not stand in a group alone, where nothing is instanced."""
        grouped = all(parent.class_name() == "ShapeGroupPlugin" for parent in self.parents[shape])
        return not grouped or any(item.class_name() == "Instance" for item in self.objects)

    def surface_bsdfs(self) -> list[Any]:
        """The BSDFs that shapes have (not those nested in others), each once."""
        found: dict[Any, None] = {}
        for shape in self.shapes():
            if shape.bsdf() is not None:
                found[shape.bsdf()] = None
        return list(found)

    def owning_bsdfs(self, item: Any) -> list[Any]:
        """The outermost BSDFs that use `item` (a texture, or a nested BSDF) at any depth."""
        owners: dict[Any, None] = {}
        waiting = [item]
        while waiting:
            current = waiting.pop()
            above = [p for p in self.parents.get(current, []) if isinstance(p, (mi.BSDF, mi.Texture))]
            if isinstance(current, mi.BSDF) and len(above) < len(self.parents.get(current, [])):
                owners[current] = None
            waiting += above
        return list(owners)


@dataclass(frozen=True)
class Lamp:
    """A shape that emits; `emitter` is its emitter, and `index` the number of that in `scene.emitters()`.

    `parallel`: light leaves along the normal alone (`directionalarea`). `texture`: what its points are sampled in
    proportion to; None: evenly over its area.
    """

    shape: mi.Shape
    emitter: mi.Emitter
    index: int
    parallel: bool
    texture: mi.Texture | None

    @cached_property
    def is_sphere(self) -> bool:
        """Whether the shape is a sphere."""
        return self.shape.class_name() == "Sphere"

    @cached_property
    def faces_by_area(self) -> bool:
        """Whether one of its faces is drawn in proportion to its area, as Mitsuba has it now."""
        return self.has_faces and self.texture is None

    @cached_property
    def has_faces(self) -> bool:
        """Whether the shape is a mesh of which each vertex can move."""
        return self.shape.is_mesh() and self.shape.class_name() != "Rectangle"


def find_lamps(scene: mi.Scene, graph: SceneGraph) -> tuple[Lamp, ...]:
    """All shapes of `scene` that emit, in the order of `scene.emitters()`."""
    found = []
    for index, emitter in enumerate(scene.emitters()):
        shape = emitter.get_shape()
        if shape is None:
            continue
        parallel = emitter.class_name() == "DirectionalArea"
        textures = [item for item in graph.of_type(mi.Texture) if emitter in graph.parents[item]]
        varying = [texture for texture in textures if texture.is_spatially_varying()]
        found.append(Lamp(shape, emitter, index, parallel, varying[0] if varying and not parallel else None))
    return tuple(found)


def emitted_rays(
    scene: mi.Scene, wavelength: mi.Float, place: mi.Point2f, direction: mi.Point2f
) -> tuple[mi.Ray3f, mi.Spectrum]:
    """Rays from all emitters, and their weights, of random numbers in [0, 1).

    Raises UnsupportedScene, which names it, where there is an emitter that Mitsuba cannot sample, such as a lamp or a
    spot with a checkerboard.
    """
    try:
        ray, weight, _ = scene.sample_emitter_ray(0, wavelength, place, direction, True)
    except RuntimeError as error:
        if "not implemented" not in str(error):
            raise
        names = ", ".join(emitter.id() for emitter in scene.emitters() if not _can_be_sampled(emitter))
        reason = " ".join(str(error).split())
        raise UnsupportedScene(
            f"Mitsuba cannot sample the rays of emitter {names}: {reason}; give it a `bitmap`"
        ) from None
    return ray, weight


def _can_be_sampled(emitter: mi.Emitter) -> bool:
    try:
        emitter.sample_ray(0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5), True)
    except RuntimeError:
        return False
    return True


#: What a lamp's diameter on the film is below, in pixels.
SMALL = 1.0


#: Lamps, at the most: of those, light is told from all other by comparing each in turn.
MOST = 64


#: Points of a lamp along each side of a grid, by which it is found to be in view.
POINTS = 16


def small_lamps(scene: mi.Scene, sensor: mi.Sensor, lamps: Iterable[Lamp]) -> tuple[Lamp, ...]:
    """Those of the lamps that `sensor` sees directly as less than a pixel; none where there are more than MOST.

    Lamps that shine along their normal alone are not seen at all.
    """
    found = [lamp for lamp in lamps if not lamp.parallel and _pixels(sensor, lamp.shape) < SMALL]
    if len(found) > MOST:
        return ()
    return tuple(lamp for lamp in found if _is_in_view(scene, sensor, lamp.shape))


def _pixels(sensor: mi.Sensor, shape: mi.Shape) -> float:
    """The diameter on the film, in pixels, of the sphere around the shape's bounding box, wherever the sensor looks."""
    box = shape.bbox()
    radius = float(np.linalg.norm(np.ravel(box.max) - np.ravel(box.min))) / 2
    eye = np.ravel(sensor.world_transform().translation())
    distance = float(np.linalg.norm((np.ravel(box.max) + np.ravel(box.min)) / 2 - eye))
    if not distance > radius:
        return np.inf
    half = np.tan(np.deg2rad(float(mi.traverse(sensor)["x_fov"][0])) / 2)
    return float(radius / distance / half * int(sensor.film().size()[0]))


def _is_in_view(scene: mi.Scene, sensor: mi.Sensor, shape: mi.Shape) -> bool:
    """Whether any of a grid of points on the shape is before the lens, with nothing in between."""
    lane = dr.arange(mi.UInt32, POINTS**2)
    sample = (mi.Point2f(lane % POINTS, lane // POINTS) + 0.5) / POINTS
    with dr.suspend_grad():
        si = mi.SurfaceInteraction3f(shape.sample_position(sensor.shutter_open(), sample), mi.Color0f())
        ds, _ = sensor.sample_direction(si, mi.Point2f(0.5), True)
        seen = ds.pdf > 0
        return bool(dr.any(seen & ~scene.ray_test(si.spawn_ray_to(ds.p), seen)))
