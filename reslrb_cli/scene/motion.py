"""What may move: which shapes and emitters have derivatives of where they are, and why others have none."""

from __future__ import annotations

import mitsuba as mi

#: Analytic shapes whose `to_world` moves their surface interactions and their samples.
MOVING_SHAPES = ("Rectangle", "Disk", "Sphere", "Cylinder")
#: What of a mesh moves light.
MOVING_MESH = ("vertex_positions", "vertex_normals")
#: Emitters without a surface that can move, and what moves them.
MOVING_EMITTERS = {"PointLight": "position", "SpotLight": "to_world", "Projector": "to_world",
                   "DirectionalEmitter": "to_world"}  # fmt: skip


def moving_shape_obstacle(shape: mi.Shape, key: str) -> str | None:
    """Why there is no derivative of the parameter `key` of a shape; None where there is one."""
    name = key.rpartition(".")[2]
    if shape.is_mesh() and shape.class_name() not in MOVING_SHAPES:  # Mitsuba takes a rectangle for a mesh, too
        if name not in MOVING_MESH:
            return f"of a mesh, {' and '.join(MOVING_MESH)} have derivatives, not {name}"
        if shape.is_emitter():
            return "a mesh that emits moves by `motion` alone: its faces are sampled by areas that have no derivative"
        return None
    if shape.class_name() not in MOVING_SHAPES or name != "to_world":
        kinds = ", ".join(kind.lower() for kind in MOVING_SHAPES)
        return f"meshes (by their vertices) and {kinds} (by `to_world`) have derivatives, not a {shape.class_name()}"
    return None


def moving_emitter_obstacle(emitter: mi.Emitter) -> str | None:
    """Why there is no derivative of where an emitter without a surface is; None where there is one."""
    if emitter.class_name() not in MOVING_EMITTERS:
        return f"a {emitter.class_name()} that moves has no derivative here"
    return None
