"""Solid with a face of heights: a closed mesh in millimetres, its files, and measurements for manufacturing.

The solid has the scene's axes. The face is near z = 0 with its outside towards +z, the flat back is at z = -thickness,
and y points up. The front consists of the traced triangles, except where a round outline cuts them. A flat rim may
surround the face. The rim is slightly lower than the face's lowest edge, so it casts no shadow on the face.

The face is a height field over a grid, so no two points of it lie above each other. Front and back therefore cross
exactly where the thickness along z is zero or negative.
"""

from __future__ import annotations

import locale
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.errors import ConfigError

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

#: From the lowest point of a face's edge to its rim, in mm: walls without height would be triangles without area.
RIM_STEP = 0.1

#: Vertices closer to a round outline than this part of the grid's pitch are moved onto it, which avoids slivers.
_NEAR = 0.1

#: Share of the face that the largest ball must reach.
REACHED = 0.99

#: Height of the scallops between two passes of the tool, in mm.
SCALLOP = 0.005

#: Tolerances relative to the size of a face, for equal positions and for its centre.
_SAME, _SIZE = 1e-5, 1e-3


@dataclass(frozen=True)
class Sheet:
    """A face over a grid.

    - `points` (ny nx, 3) are in mm. The points form rows of equal y, starting with the least y. `x` (nx,) and `y` (ny,)
        are the coordinates of columns and rows.
    - `triangles` (n, 3) are counterclockwise as seen from +z.
    - `name` is the id of the face's mesh.
    - `smooth` is true if the mesh has interpolated normals. Flat triangles would send light elsewhere than this mesh.
    """

    name: str
    points: Array
    triangles: Indices
    x: Array
    y: Array
    smooth: bool = False

    @property
    def z(self) -> Array:
        """z of the vertices (ny, nx)."""
        return self.points[:, 2].reshape(len(self.y), len(self.x))

    @property
    def half(self) -> tuple[float, float]:
        """Half of its width and height."""
        return float(np.ptp(self.x)) / 2, float(np.ptp(self.y)) / 2


@dataclass(frozen=True)
class Solid:
    """A closed mesh: `points` (n, 3) in mm, `triangles` (m, 3), counterclockwise as seen from outside."""

    points: Array
    triangles: Indices

    @property
    def volume(self) -> float:
        """The volume in mm^3, by the divergence theorem."""
        a, b, c = (self.points[self.triangles[:, k]] for k in range(3))
        return float(np.sum(np.cross(a, b) * c)) / 6

    @property
    def extent(self) -> list[float]:
        """Width, height and depth in mm."""
        return [float(side) for side in np.ptp(self.points, axis=0)]


# ---- from meshes to a solid


def as_sheet(name: str, points: Array, triangles: Indices, smooth: bool = False) -> Sheet:
    """Convert a mesh to a grid. The mesh has vertices (n, 3) and triangles (m, 3), in either orientation.

    Raises ConfigError, with the key `fabrication.face`, if the mesh is no grid or no height field.
    """
    points = np.asarray(points, np.float64)

    def fail(why: str) -> ConfigError:
        return ConfigError("", "fabrication.face", f"`{name}` {why}; a solid needs a rectangular grid of heights "
                                                    "along z, as written by `reslrb lens`")  # fmt: skip

    if not np.all(np.isfinite(points)):
        raise fail("has vertices that are not finite")
    lines, at = [], []
    for axis in (0, 1):
        values = np.sort(points[:, axis])
        new = np.flatnonzero(np.diff(values, prepend=-np.inf) > _SAME * max(np.ptp(values), 1e-30))
        lines.append(values[new])
        at.append(np.searchsorted(values[new], points[:, axis] + _SAME * np.ptp(values)) - 1)
    (x, y), (column, row) = lines, at
    place = row * len(x) + column
    if min(len(x), len(y)) < 3 or len(points) != len(x) * len(y) or len(np.unique(place)) < len(points):
        raise fail(f"has {len(points)} vertices that are not on a grid")
    if any(np.ptp(np.diff(line)) > 1e-2 * np.diff(line).mean() for line in (x, y)):
        raise fail("has vertices at unequal distances")
    ordered = np.empty_like(points)
    ordered[place] = points
    corners = place[np.asarray(triangles, np.int64)]
    area = _areas(ordered, corners)
    if area.sum() < 0:
        corners, area = corners[:, ::-1], -area
    if area.min(initial=1.0) <= 0 or abs(area.sum() / (np.ptp(x) * np.ptp(y)) - 1) > 1e-4:
        raise fail("folds, or has holes")
    return Sheet(name, ordered, corners, x, y, smooth)


def _areas(points: Array, triangles: Indices) -> Array:
    """Return the areas (m,) of triangles as seen from +z. Clockwise triangles have negative areas."""
    a, b, c = (points[triangles[:, k], :2] for k in range(3))
    u, v = b - a, c - a
    return np.asarray((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2)


def make_solid(sheet: Sheet, plan: Fabrication) -> Solid:
    """Make the solid between a face and the flat back.

    Raises ConfigError, with a key below `fabrication`, if front and back cross, or if the face is not centred.
    """
    middle = sheet.x.mean(), sheet.y.mean()
    if max(map(abs, middle)) > _SIZE * max(sheet.half):
        raise ConfigError("", "fabrication.face", f"the centre of `{sheet.name}` is at x = {middle[0]:.3g}, y = "
                                                  f"{middle[1]:.3g}; it must be at 0")  # fmt: skip
    low, high = float(sheet.z.min()), float(sheet.z.max())
    beyond = (high - low) + _SIZE * max(sheet.half)
    if low > beyond or high < -beyond:
        raise ConfigError("", "fabrication.face", f"`{sheet.name}` is at z = {low:.4g} to {high:.4g}; it must be about "
                                                  "z = 0, because the thickness starts there")  # fmt: skip
    thin = least_thickness(sheet, plan)
    if thin <= 0:
        raise ConfigError("", "fabrication.thickness", f"{plan.thickness:g} mm: front and back overlap by {-thin:.3g} "
                                                       f"mm; it must be above {plan.thickness - thin:.4g}")  # fmt: skip
    build = _Building(sheet.half)
    outer = build.add_face(sheet, plan)
    below = build.copy(outer, -plan.thickness)
    build.add_wall(below, outer)
    # A point in the middle and the outline suffice: the flat back needs no grid.
    center = build.add(np.array([[0.0, 0.0, -plan.thickness]]))[0]
    build.triangles.append(np.stack([np.full_like(below, center), np.roll(below, -1), below], 1))
    solid = Solid(np.concatenate(build.points), np.concatenate(build.triangles))
    if not is_closed(solid.triangles):
        raise ConfigError("", "fabrication.face", f"`{sheet.name}` does not form a closed solid: its edge is not one "
                                                  "outline")  # fmt: skip
    return solid


class _Building:
    """Vertices and triangles of a solid in progress. Loops of vertices are counterclockwise as seen from +z."""

    def __init__(self, half: tuple[float, float]) -> None:
        self.half = np.array(half)
        self.points: list[Array] = []
        self.triangles: list[Indices] = []
        self._count = 0

    def add(self, points: Array) -> Indices:
        """Add vertices and return their indices."""
        self.points.append(points)
        self._count += len(points)
        return np.arange(self._count - len(points), self._count)

    def copy(self, loop: Indices, z: float, scale: Array | float = 1.0) -> Indices:
        """Add vertices at the height `z`, with the x and y of `loop` multiplied by `scale`."""
        at = np.concatenate(self.points)[loop]
        return self.add(np.column_stack([at[:, :2] * scale, np.full(len(at), z)]))

    def add_face(self, sheet: Sheet, plan: Fabrication) -> Indices:
        """Add a face with its rim. Return the loop of vertices around face and rim."""
        points, triangles = cut(sheet, plan)
        first = self.add(points)[0]
        self.triangles.append(first + triangles)
        edge = first + edge_loop(triangles)
        if plan.rim == 0:
            return edge
        z = float(np.min(points[edge - first, 2])) - RIM_STEP
        inner = self.copy(edge, z)
        outer = self.copy(edge, z, 1 + plan.rim / self.half)
        self.add_wall(inner, edge)
        self.add_wall(outer, inner)
        return outer

    def add_wall(self, lower: Indices, upper: Indices) -> None:
        """Add the wall between a loop of vertices and its copy. The wall's outside points outwards."""
        after, above = np.roll(lower, -1), np.roll(upper, -1)
        self.triangles += [np.stack([lower, after, upper], 1), np.stack([after, above, upper], 1)]


def edge_loop(triangles: Indices) -> Indices:
    """Return the vertices around a sheet, counterclockwise. Each edge of the loop belongs to only one triangle.

    If there are several loops, one of them is returned.
    """
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    n = int(edges.max()) + 1
    open_ones = edges[~np.isin(edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0])]
    after = dict(open_ones.tolist())
    start = vertex = int(open_ones[0, 0])
    loop = [start]
    while (vertex := after[vertex]) != start and len(loop) <= len(after):
        loop.append(vertex)
    return np.array(loop, np.int64)


def is_closed(triangles: Indices) -> bool:
    """True if each edge belongs to two triangles, which run along the edge in opposite directions."""
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    n = int(edges.max()) + 1
    there, back = edges[:, 0] * n + edges[:, 1], edges[:, 1] * n + edges[:, 0]
    return len(np.unique(there)) == len(there) and np.array_equal(np.sort(there), np.sort(back))


def cut(sheet: Sheet, plan: Fabrication) -> tuple[Array, Indices]:
    """Return vertices and triangles of a face within its outline."""
    return cut_round(sheet, sheet.half) if plan.outline == "round" else (sheet.points, sheet.triangles)


def cut_round(sheet: Sheet, half: tuple[float, float]) -> tuple[Array, Indices]:
    """Return vertices and triangles of a face within the ellipse with the half axes `half`. Triangles on the ellipse
    are cut.
    """
    points, triangles = sheet.points.copy(), sheet.triangles
    axes = np.array(half)
    far = np.linalg.norm(points[:, :2] / axes, axis=1)
    pitch = min(sheet.x[1] - sheet.x[0], sheet.y[1] - sheet.y[0])
    near = np.abs(far - 1) * min(half) < _NEAR * pitch
    slope_y, slope_x = np.gradient(sheet.z, sheet.y, sheet.x)
    moved = points[near, :2] * (1 / far[near] - 1)[:, None]
    points[near, 2] += slope_x.ravel()[near] * moved[:, 0] + slope_y.ravel()[near] * moved[:, 1]
    points[near, :2] += moved
    side = np.where(near, 0, np.sign(far - 1)).astype(np.int64)
    sides = side[triangles]
    kept = triangles[np.all(sides <= 0, axis=1)]
    made: list[Array] = []
    known: dict[tuple[int, int], int] = {}

    def crossing(p: int, q: int) -> int:
        """Return the vertex where the edge from `p`, inside, to `q`, outside, meets the ellipse."""
        if (p, q) not in known:
            a, d = points[p, :2] / axes, (points[q, :2] - points[p, :2]) / axes
            half_b, c = a @ d, a @ a - 1
            t = -c / (half_b + np.sqrt(half_b**2 - (d @ d) * c))  # the positive root, without cancellation
            known[p, q] = len(points) + len(made)
            made.append(points[p] + t * (points[q] - points[p]))
        return known[p, q]

    clipped = []
    for corners in triangles[np.any(sides < 0, axis=1) & np.any(sides > 0, axis=1)].tolist():
        polygon = []
        for p, q in zip(corners, [*corners[1:], corners[0]], strict=True):
            if side[p] <= 0:
                polygon.append(p)
            if side[p] * side[q] < 0:
                polygon.append(crossing(p, q) if side[p] < 0 else crossing(q, p))
        clipped += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
    everything = np.concatenate([points, np.array(made).reshape(-1, 3)])
    both = np.concatenate([kept, np.array(clipped, np.int64).reshape(-1, 3)])
    used, renamed = np.unique(both, return_inverse=True)
    return everything[used], renamed.reshape(-1, 3).astype(np.int64)


# ---- data for the maker


def within(sheet: Sheet, plan: Fabrication) -> NDArray[np.bool_]:
    """Return which vertices (ny, nx) are inside the outline."""
    if plan.outline == "rectangle":
        return np.ones(sheet.z.shape, bool)
    a, b = sheet.half
    return np.asarray((sheet.x[None, :] / a) ** 2 + (sheet.y[:, None] / b) ** 2 <= 1)


def least_thickness(sheet: Sheet, plan: Fabrication) -> float:
    """Return the least thickness along z inside the outline, including the rim, in mm. It is negative if front and back
    cross.
    """
    lowest = float(sheet.z[within(sheet, plan)].min())
    if plan.rim > 0:
        points, triangles = cut(sheet, plan)
        lowest = min(lowest, float(points[edge_loop(triangles), 2].min()) - RIM_STEP)
    return lowest + plan.thickness


def hollows(sheet: Sheet, plan: Fabrication) -> Array:
    """Return the larger principal curvature (1/mm) of each inner vertex inside the outline. It is positive in hollows.

    The function uses central differences of the heights.
    """
    h, dx, dy = sheet.z, float(np.diff(sheet.x).mean()), float(np.diff(sheet.y).mean())
    c = h[1:-1, 1:-1]
    p, q = (h[1:-1, 2:] - h[1:-1, :-2]) / (2 * dx), (h[2:, 1:-1] - h[:-2, 1:-1]) / (2 * dy)
    r, t = (h[1:-1, 2:] - 2 * c + h[1:-1, :-2]) / dx**2, (h[2:, 1:-1] - 2 * c + h[:-2, 1:-1]) / dy**2
    s = (h[2:, 2:] - h[2:, :-2] - h[:-2, 2:] + h[:-2, :-2]) / (4 * dx * dy)
    w = 1 + p * p + q * q
    mean = ((1 + q * q) * r - 2 * p * q * s + (1 + p * p) * t) / (2 * w**1.5)
    gauss = (r * t - s * s) / w**2
    larger = mean + np.sqrt(np.maximum(mean**2 - gauss, 0))
    return np.asarray(larger[within(sheet, plan)[1:-1, 1:-1]])


def largest_ball_radius(curvature: Array) -> float | None:
    """Return the largest radius (mm) of a ball that fits into the hollows of 99 % of a face, or None if any ball fits.

    `curvature` (n,) is the larger principal curvature at each vertex in 1/mm, positive in hollows. The function
    considers only curvature. A ball may still not reach a narrow gap between ridges.
    """
    if not curvature.size:
        return None
    sharp = float(np.quantile(curvature, REACHED, method="higher"))
    return 1 / sharp if sharp > 1e-9 else None


def stepover(radius: float) -> float:
    """Return the distance (mm) between passes of a ball with this `radius`. The passes leave scallops of SCALLOP."""
    height = min(SCALLOP, radius)
    return float(2 * np.sqrt(2 * radius * height - height**2))


def cutter(curvature: Array) -> dict[str, float | None]:
    """Return the largest radius of a ball cutter for a face, and the step between passes of the cutter, in mm.

    `curvature` is as in `largest_ball_radius`.
    """
    largest = largest_ball_radius(curvature)
    return {"largest_radius": largest, "stepover": None if largest is None else stepover(largest), "scallop": SCALLOP}


def steepest(sheet: Sheet, plan: Fabrication) -> float:
    """Return the largest angle (degrees) between the plane z = 0 and a triangle of the face inside the outline."""
    points, triangles = cut(sheet, plan)
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return float(np.degrees(np.arctan2(np.linalg.norm(normal[:, :2], axis=1), np.abs(normal[:, 2])).max()))


def scaled(heights: Array, inside: NDArray[np.bool_]) -> tuple[NDArray[np.uint16], float, float]:
    """Return heights as 16-bit numbers n with `offset` and `step`, where h = offset + step n. Heights not `inside` are
    clipped.
    """
    low, high = float(heights[inside].min()), float(heights[inside].max())
    step = (high - low) / 65535
    numbers = np.rint((np.clip(heights, low, high) - low) / step) if step > 0 else np.zeros_like(heights)
    return numbers.astype(np.uint16), low, step


def measured(solid: Solid, sheet: Sheet, plan: Fabrication) -> dict[str, Any]:
    """Return the content of fabrication.json, in mm, mm^3 and degrees. `warnings` are sentences."""
    curvature, warnings = hollows(sheet, plan), []
    sharpest = float(curvature.max(initial=0.0))
    face: dict[str, Any] = {
        "grid": [len(sheet.x), len(sheet.y)],
        "relief": float(np.ptp(sheet.z[within(sheet, plan)])),
        "smallest_concave_radius": 1 / sharpest if sharpest > 1e-9 else None,
        "steepest_slope_degrees": steepest(sheet, plan),
        "cutter": cutter(curvature),
    }
    if sheet.smooth:
        warnings.append(f"`{sheet.name}` was shaped with interpolated normals, which a solid does not have, so its "
                        'picture will differ; add <boolean name="face_normals" value="true"/> to the mesh in the '
                        "scene's file, and run `reslrb optimize` again")  # fmt: skip
    return {
        "unit": "mm",
        "kind": plan.kind,
        "outline": plan.outline,
        "extent": solid.extent,
        "thickness": plan.thickness,
        "ior": plan.index if plan.kind == "lens" else None,
        "glass": plan.ior if plan.kind == "lens" and plan.glass is not None else None,
        "least_thickness": least_thickness(sheet, plan),
        "rim": plan.rim,
        "volume_mm3": solid.volume,
        "triangles": len(solid.triangles),
        "faces": {sheet.name: face},
        "warnings": warnings,
    }


def summary(numbers: dict[str, Any]) -> list[str]:
    """Return the results of `measured` as lines: the solid, its faces, the warnings."""
    wide, high, deep = numbers["extent"]
    lines = [f"{wide:.4g} x {high:.4g} x {deep:.4g} mm, {numbers['volume_mm3'] / 1000:.4g} cm^3, least thickness "
             f"{numbers['least_thickness']:.3g} mm; {numbers['triangles']} triangles"]  # fmt: skip
    for name, face in numbers["faces"].items():
        radius, slope = face["smallest_concave_radius"], face["steepest_slope_degrees"]
        hollow = "nowhere hollow" if radius is None else f"hollows with radii from {radius:.3g} mm"
        ball = face["cutter"]["largest_radius"]
        fits = "any" if ball is None else f"with a radius up to {ball:.3g} mm, for 99 % of the face"
        lines.append(
            f"{name}: {face['relief']:.3g} mm deep, slopes up to {slope:.3g} degrees, {hollow}; ball cutter: {fits}"
        )
    return lines + numbers["warnings"]


# ---- files


def stl(solid: Solid) -> bytes:
    """Return binary STL with normals by the right-hand rule and 32-bit floats. STL has no unit; programs assume mm."""
    corners = solid.points[solid.triangles].astype("<f4")
    a, b, c = (corners[:, k].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    records: NDArray[Any] = np.zeros(len(corners), [("normal", "<f4", 3), ("at", "<f4", (3, 3)), ("extra", "<u2")])
    records["normal"], records["at"] = normal, corners
    # Not "solid": text files start with this word.
    return b"reslrb, millimetres".ljust(80) + np.uint32(len(corners)).astype("<u4").tobytes() + records.tobytes()


def ply_file(vertices: NDArray[Any], triangles: NDArray[Any]) -> bytes:
    """Return a binary PLY. `vertices` are positions, normals and texture coordinates (N, 3, 6 or 8), as 32-bit
    floats.
    """
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")[: vertices.shape[1]]
    faces: NDArray[Any] = np.empty(len(triangles), [("n", "u1"), ("at", "<i4", 3)])
    faces["n"], faces["at"] = 3, triangles
    properties = "".join(f"property float {name}\n" for name in names)
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{properties}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return head.encode() + vertices.astype("<f4").tobytes() + faces.tobytes()


def three_mf(solid: Solid) -> bytes:
    """Return 3MF in mm, written by lib3mf. Raises ImportError if lib3mf is not installed."""
    import lib3mf

    wrapper = lib3mf.get_wrapper()
    model = wrapper.CreateModel()
    model.SetUnit(lib3mf.ModelUnit.MilliMeter)
    mesh = model.AddMeshObject()
    mesh.SetName("solid")
    points, triangles = solid.points.astype("<f4"), solid.triangles.astype("<u4")
    positions = (lib3mf.Position * len(points)).from_buffer_copy(points.tobytes())
    corners = (lib3mf.Triangle * len(triangles)).from_buffer_copy(triangles.tobytes())
    mesh.SetGeometry(positions, corners)
    model.AddBuildItem(mesh, wrapper.GetIdentityTransform())
    before = locale.setlocale(locale.LC_ALL)  # lib3mf leaves the locale at C, in which text files are read as ASCII
    try:
        with tempfile.TemporaryDirectory(prefix="reslrb-3mf-") as folder:
            path = Path(folder) / "solid.3mf"
            model.QueryWriter("3mf").WriteToFile(str(path))
            return path.read_bytes()
    finally:
        locale.setlocale(locale.LC_ALL, before)


#: Writers of a solid, by file suffix.
WRITERS: dict[str, Callable[[Solid], bytes]] = {".stl": stl, ".3mf": three_mf}
