"""Rectangles as grids of vertices that a heightmap can displace (`heightmap.grid`)."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np

from reslrb_cli.lens.experiment import face_ply
from reslrb_cli.lens.surface import Setting
from reslrb_cli.scene.values import Place
from reslrb_cli.scene.xml.read import Description, Element


def make_grid(description: Description, id: str, size: tuple[int, int], place: Place) -> None:
    """Replace the rectangle `id` of a description by a mesh, before the scene is built. `size` has the vertex counts
    along the rectangle's edges.

    The shape is a `rectangle`, or a mesh of four vertices that form a parallelogram. The shape's position and material
    do not change. Raises ConfigError at `place` for any other shape.
    """
    element = description.root.by_id().get(id)
    if element is None or element.tag != "shape":
        return  # the selection of the parameter reports the reason
    kept = [item for item in element.children if not item.is_value or item.name in _KEPT_OF_GRID]
    if element.type != "rectangle":
        corners = _corners_of(element, description)
        if corners is None:
            raise place.fail("heightmap.grid", f"`{id}` is neither a rectangle nor a rectangular mesh of four "
                                               "vertices; remove `grid`, or use a mesh as fine as the map")  # fmt: skip
        p, q, d = corners
        normal = np.cross(q - p, d - p)
        matrix = np.eye(4)
        matrix[:3] = np.stack([(q - p) / 2, (d - p) / 2, normal / np.linalg.norm(normal), (q + d) / 2], axis=1)
        first = element.new("matrix", value=" ".join(f"{value:.9g}" for value in matrix.ravel()))
        transform = next((item for item in kept if item.tag == "transform"), None)
        if transform is None:
            transform = element.new("transform", name="to_world")
            kept.append(transform)
        transform.children.insert(0, first)
    element.attributes["type"] = "ply"
    element.children[:] = [element.new("string", name="filename", value=str(_grid_file(*size))), *kept]


#: Parameters that a rectangle passes to its grid.
_KEPT_OF_GRID = ("to_world", "flip_normals", "face_normals")


def _corners_of(element: Element, description: Description) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the parallelogram that a mesh file of four vertices describes, or None for other meshes.

    The result contains a corner, and the ends of the corner's edges along u and along v. Without texture coordinates,
    u runs along the edge that has the mesh on its left.
    """
    name = element.find("filename")
    path = None if name is None else description.find_file(name.value)
    if path is None or element.type not in ("ply", "obj"):
        return None
    mesh = mi.load_dict({"type": element.type, "filename": str(path)})
    if mesh.vertex_count() != 4 or mesh.face_count() != 2:
        return None
    points = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    one, other = (list(face) for face in np.array(mesh.faces_buffer()).reshape(2, 3))
    [alone], [apart] = [k for k in one if k not in other] or [-1], [k for k in other if k not in one] or [-1]
    if min(alone, apart) < 0:
        return None
    at = one.index(alone)
    loop = [one[at - 1], alone, one[(at + 1) % 3], apart]
    if not np.allclose(points[loop[0]] + points[loop[2]], points[loop[1]] + points[apart], atol=1e-5 * np.ptp(points)):
        return None
    if mesh.has_vertex_texcoords():
        least = np.array(mesh.vertex_texcoords_buffer()).reshape(-1, 2).sum(axis=1)
        start = int(np.argmin(least[loop]))
        loop = loop[start:] + loop[:start]
    return points[loop[0]], points[loop[1]], points[loop[3]]


@functools.cache
def _grid_file(width: int, height: int) -> Path:
    """Return a temporary file with a grid over [-1, 1] x [-1, 1], facing up. It exists until the process ends."""
    path = Path(_grid_folder().name) / f"grid_{width}x{height}.ply"
    path.write_bytes(face_ply(Setting(size=(2.0, 2.0), thickness=0.0), width, height))
    return path


@functools.cache
def _grid_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="reslrb-")
