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

    The shape is a `rectangle`, a mesh of four vertices that form a parallelogram, or a mesh that is a flat grid over a
    parallelogram. The shape's position and material do not change. Raises ConfigError at `place` for any other shape.
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
        p, q, d, inside_out = corners
        normal = np.cross(q - p, d - p)
        matrix = np.eye(4)
        matrix[:3] = np.stack([(q - p) / 2, (d - p) / 2, normal / np.linalg.norm(normal), (q + d) / 2], axis=1)
        first = element.new("matrix", value=" ".join(f"{value:.9g}" for value in matrix.ravel()))
        transform = next((item for item in kept if item.tag == "transform"), None)
        if transform is None:
            transform = element.new("transform", name="to_world")
            kept.append(transform)
        transform.children.insert(0, first)
    else:
        inside_out = False
    element.attributes["type"] = "ply"
    element.children[:] = [element.new("string", name="filename", value=str(_grid_file(*size, inside_out))), *kept]


#: Parameters that a rectangle passes to its grid.
_KEPT_OF_GRID = ("to_world", "flip_normals", "face_normals")


Corners = tuple[np.ndarray, np.ndarray, np.ndarray, bool]


def _corners_of(element: Element, description: Description) -> Corners | None:
    """Return the parallelogram that a mesh file describes, or None for other meshes.

    The result contains a corner, and the ends of the corner's edges along u and along v. The result also tells whether
    the v edge is to the right of the u edge, seen from outside. If four vertices have no texture coordinates, u runs
    along the edge that has the mesh on its left.
    """
    name = element.find("filename")
    path = None if name is None else description.find_file(name.value)
    if path is None or element.type not in ("ply", "obj"):
        return None
    mesh = mi.load_dict({"type": element.type, "filename": str(path)})
    if mesh.vertex_count() != 4 or mesh.face_count() != 2:
        return _corners_of_grid(mesh)
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
    return points[loop[0]], points[loop[1]], points[loop[3]], False


def _corners_of_grid(mesh: mi.Mesh) -> Corners | None:
    """Return the parallelogram of a mesh with at least four vertices and with texture coordinates.

    Returns None unless the positions are an affine function of the texture coordinates, and the mesh covers the whole
    parallelogram.
    """
    if mesh.vertex_count() < 4 or not mesh.has_vertex_texcoords():
        return None
    points = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
    uv = np.array(mesh.vertex_texcoords_buffer(), dtype=np.float64).reshape(-1, 2)
    low, high = uv.min(axis=0), uv.max(axis=0)
    if min(high - low) <= 0:
        return None
    design = np.column_stack([np.ones(len(uv)), (uv - low) / (high - low)])
    p, along, up = np.linalg.lstsq(design, points, rcond=None)[0]
    corner = points[np.array(mesh.faces_buffer()).reshape(-1, 3)]
    areas = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    whole = np.cross(along, up)
    flat = np.abs(design @ np.stack([p, along, up]) - points).max() < 1e-4 * np.ptp(points, axis=0).max()
    covered = np.linalg.norm(areas, axis=1).sum() / 2
    if not flat or abs(covered - np.linalg.norm(whole)) > 1e-3 * np.linalg.norm(whole):
        return None
    return p, p + along, p + up, bool(areas.sum(axis=0) @ whole < 0)


@functools.cache
def _grid_file(width: int, height: int, inside_out: bool) -> Path:
    """Return a temporary file with a grid over [-1, 1] x [-1, 1], facing up or down. It exists until the process
    ends.
    """
    path = Path(_grid_folder().name) / f"grid_{width}x{height}{'_down' * inside_out}.ply"
    path.write_bytes(face_ply(Setting(size=(2.0, 2.0), thickness=0.0), width, height, back=inside_out))
    return path


@functools.cache
def _grid_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="reslrb-")
