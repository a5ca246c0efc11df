"""Where a scene stands and how large it is: as far as single precision cares, and a sensor's clip planes."""

from __future__ import annotations

from itertools import product
from typing import Any

import mitsuba as mi
import numpy as np

#: The largest ray offset, as a fraction of the scene's size, with which no loss of light is to be seen: that of a room
#: of size 3 that stands about 150 from the origin, or measures a fiftieth across.
LARGEST_OFFSET = 5e-3


def lost_light(scene: Any) -> str | None:
    """What is wrong with a scene that is far from the origin, or tiny, and what to do; None where nothing is.

    Mitsuba starts rays off their surface by RayEpsilon (1 + max |p|), in the scene's units, so that they jump over what
    is nearer: light is lost in corners, in all integrators.
    """
    box = scene.bbox()
    low, high = np.array(box.min, float), np.array(box.max, float)
    size = float(np.linalg.norm(high - low))
    reach = float(np.maximum(np.abs(low), np.abs(high)).max())
    offset = mi.math.RayEpsilon * (1 + reach)
    if not np.isfinite(size) or offset <= LARGEST_OFFSET * size:
        return None
    centre = float(np.linalg.norm((low + high) / 2))
    if centre > size:
        place, advice = f"stands {centre:.3g} from the origin and measures {size:.3g} across", "move it to the origin"
    else:
        place, advice = f"measures {size:.3g} across", "scale it to about 1"
    return f"the scene {place}: Mitsuba starts rays {offset:.2g} off surfaces there, and light is lost; {advice}"


def clipped(scene: Any, sensor: Any) -> tuple[bool, bool]:
    """Whether anything of `scene`, as it stands, may be between a perspective or thin-lens sensor and its near clip
    plane, where the sensor looks, and whether anything may be beyond its far clip plane, on any side.

    Told by bounding boxes, and by triangles near the sensor: it may be so where it is not, never the other way round.
    """
    params = mi.traverse(sensor)
    near, far, radius, focus = (
        float(np.ravel(params[key])[0]) if key in params else default
        for key, default in (("near_clip", 0), ("far_clip", np.inf), ("aperture_radius", 0), ("focus_distance", np.inf))
    )
    to_world = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    axes, eye = to_world[:3, :3], to_world[:3, 3]
    box = scene.bbox()
    corners = np.array(list(product(*zip(np.ravel(box.min), np.ravel(box.max), strict=True))), np.float64)
    beyond = bool(((corners - eye) @ axes[:, 2]).max() > far)

    # The box, in the sensor's coordinates, around all that may be between the aperture and the near plane.
    width, height = (int(n) for n in sensor.film().size())
    shift = max((float(np.abs(value).max()) for key, value in params if key.startswith("principal_point")), default=0.0)
    tangent = np.tan(np.deg2rad(float(params["x_fov"][0])) / 2) * max(1, height / width) * (1 + 2 * shift)
    side = near * tangent + radius * (1 + near / focus if focus > 0 else 1)
    half, middle = np.array([side, side, near / 2]), np.array([0, 0, near / 2])
    return any(_touches(shape, axes, eye, middle, half) for shape in scene.shapes()), beyond


def _touches(shape: Any, axes: np.ndarray, eye: np.ndarray, middle: np.ndarray, half: np.ndarray) -> bool:
    """Whether a shape may touch a box, given by its middle and half sizes in the coordinates of `axes` (columns) and
    `eye`."""
    box = shape.bbox()
    low, high = np.ravel(box.min).astype(np.float64), np.ravel(box.max).astype(np.float64)
    centre, extent = (low + high) / 2, (high - low) / 2
    apart = centre - (eye + axes @ middle)
    if (np.abs(apart) > extent + np.abs(axes) @ half).any() or (
        np.abs(apart @ axes) > half + extent @ np.abs(axes)
    ).any():
        return False
    if shape.class_name() == "Sphere":  # which a sensor may stand in
        return bool(np.linalg.norm(apart) + np.linalg.norm(half) > extent.min() * 0.999)
    if not shape.is_mesh():
        return True
    positions = np.array(shape.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    corners = ((positions - eye) @ axes - middle)[np.array(shape.faces_buffer()).reshape(-1, 3)]
    corners = corners[((corners.min(1) <= half) & (corners.max(1) >= -half)).all(1)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return bool((np.abs((normals * corners[:, 0]).sum(1)) <= np.abs(normals) @ half).any())
