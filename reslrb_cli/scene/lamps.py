"""Shapes that emit light, and what their emitters do."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from reslrb_cli.scene.graph import SceneGraph


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

    @property
    def is_sphere(self) -> bool:
        """Whether the shape is a sphere."""
        return self.shape.class_name() == "Sphere"

    @property
    def faces_by_area(self) -> bool:
        """Whether one of its faces is drawn in proportion to its area, as Mitsuba has it now."""
        return self.has_faces and self.texture is None

    @property
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
