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

#: Parameters that say where an emitter is.
PLACES = ("position", "to_world")
#: Parameters of emitters that are flagged as differentiable, and change where light goes as well.
BEAMS = ("cutoff_angle", "beam_width", "sun_direction", "sun_aperture")


def moving_shape_obstacle(shape: mi.Shape, key: str) -> str | None:
    """Why there is no derivative of the parameter `key` of a shape; None where there is one."""
    name = key.rpartition(".")[2]
    if shape.is_mesh() and shape.class_name() not in MOVING_SHAPES:  # Mitsuba takes a rectangle for a mesh, too
        if name not in MOVING_MESH:
            return f"of a mesh, {' and '.join(MOVING_MESH)} have derivatives, not {name}"
        return None
    if shape.class_name() not in MOVING_SHAPES or name != "to_world":
        kinds = ", ".join(kind.lower() for kind in MOVING_SHAPES)
        return f"meshes (by their vertices) and {kinds} (by `to_world`) have derivatives, not a {shape.class_name()}"
    return None


def moving_emitter_obstacle(emitter: mi.Emitter, key: str | None = None) -> str | None:
    """Why there is no derivative of the parameter `key` of an emitter without a surface, which says where it is or
    where its light goes (None: of whatever moves it); None where there is one."""
    kind = emitter.class_name()
    name = MOVING_EMITTERS.get(kind, "") if key is None else key.rpartition(".")[2]
    if name and name == MOVING_EMITTERS.get(kind):
        return None
    if name in BEAMS:
        return f"{name} changes where the light of a {kind} goes, which has no derivative here"
    if kind in ("EnvironmentMapEmitter", "SunskyEmitter"):
        return f"a {kind} that turns has no derivative here: its directions are drawn from what it shows in each"
    return f"a {kind} that moves has no derivative here"
