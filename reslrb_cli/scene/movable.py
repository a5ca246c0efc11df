"""Shapes and emitters that a motion or a heightmap can move: found by id, with the scene parameter that places each."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

import mitsuba as mi

from .motion import MOVING_EMITTERS, MOVING_SHAPES, moving_emitter_obstacle, moving_shape_obstacle


@dataclass(frozen=True)
class Movable:
    """An object with this `id`, and the `key` of the scene parameter that says where it is.

    That is a mesh's `vertex_positions`, an analytic shape's or an emitter's `to_world`, or a point light's `position`.
    """

    id: str
    key: str
    node: mi.Shape | mi.Emitter

    @property
    def by_vertices(self) -> bool:
        """Whether it is a mesh, which moves by its vertices."""
        return self.key.endswith(".vertex_positions")

    @property
    def is_point(self) -> bool:
        """Whether it is a point without extent and direction, so that nothing turns or scales it."""
        return self.key.endswith(".position")

    @property
    def is_shape(self) -> bool:
        """Whether it has a surface."""
        return isinstance(self.node, mi.Shape)


def find_movable(params: mi.SceneParameters, id: str) -> Movable | str:
    """The object with this id, or the reason why it cannot be moved."""
    for name in ("to_world", "vertex_positions", "position"):  # a rectangle has its vertices besides
        key = f"{id}.{name}"
        if key not in params.properties:
            continue
        node = params.properties[key][2]
        if isinstance(node, mi.Emitter):
            reason = moving_emitter_obstacle(node)
        elif isinstance(node, mi.Shape):
            reason = moving_shape_obstacle(node, key)
        else:
            return f"`{id}` is a {node.class_name()}; shapes and emitters can be moved"
        return Movable(id, key, node) if reason is None else f"`{id}` cannot be moved: {reason}"
    if any(key.startswith(f"{id}.") for key in params.properties):
        return f"`{id}` has neither vertices nor a place in the scene that can be moved"
    known = [item.id for item in list_movable(params)]
    near = difflib.get_close_matches(id, known, n=3, cutoff=0.4) or known[:3]
    hint = f"; did you mean {' or '.join(f'`{name}`' for name in near)}?" if near else "; nothing here can be moved"
    return f"there is no `{id}` in the scene{hint}"


def list_movable(params: mi.SceneParameters) -> list[Movable]:
    """All that can be moved, in the scene's order."""
    found: dict[str, Movable] = {}
    for key in params.properties:
        id, _, name = key.rpartition(".")
        if id and id not in found and name in ("to_world", "vertex_positions", "position"):
            item = find_movable(params, id)
            if isinstance(item, Movable):
                found[id] = item
    return list(found.values())


def heightmap_obstacle(item: Movable) -> str | None:
    """Why no heightmap can displace an object; None where one can."""
    if not item.by_vertices:
        return f"`{item.id}` is a {item.node.class_name()}; a heightmap displaces the vertices of a mesh"
    if not item.node.has_vertex_texcoords():
        return f"`{item.id}` has no texture coordinates, over which a heightmap is laid; give the mesh some"
    return None


def casts_edges(scene: mi.Scene, item: Movable) -> bool:
    """Whether what moves can have a silhouette or throw a shadow: a shape that does not enclose all others."""
    if not item.is_shape:
        return False
    own = item.node.bbox()
    others = [shape.bbox() for shape in scene.shapes() if shape.ptr != item.node.ptr]
    return not all(own.contains(box, strict=True) for box in others)


def where_moved(params: mi.SceneParameters, keys: list[str]) -> list[Movable]:
    """The objects that the scene parameters `keys` move."""
    kinds = (*MOVING_SHAPES, *MOVING_EMITTERS)
    found = []
    for key in keys:
        id, _, name = key.rpartition(".")
        node = params.properties[key][2]
        if name == "vertex_positions" or (name in ("to_world", "position") and node.class_name() in kinds):
            found.append(Movable(id, key, node))
    return found
