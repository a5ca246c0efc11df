"""The files that `reslrb lens` writes for a face: the scene, its mesh, and the configuration that refines the face.

The module contains only text and arrays, in millimetres, with the axes of `surface.py`. The lamp for parallel light has
the size of the face as seen along the light. For a rectangular mirror in oblique light, the lamp is wider, because
parts of the relief stand out of the plane. A light with the sun's angular diameter consists of `SUNS` distant lamps,
which are slightly larger. A point light is a spot. The spot's cone ends at the corners of a rectangular face. For a
round face, the cone has the mean angle to the edge. The mount around the face is black. The camera is a point on the
receiver's normal, and throws no shadow.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.lens import transport
from reslrb_cli.lens.solid import as_sheet, make_solid, measured, ply_file, summary
from reslrb_cli.lens.surface import Array, Rays, Setting, Surface, transmitted

#: Reflectance of the receiver, and its width in widths of the picture.
ALBEDO, SCREEN = 0.8, 3.0

#: Margin around the picture on the film, as a fraction of its longer side; light in it counts as lost.
MARGIN = 0.125

#: Distance of the camera before the receiver, as a multiple of the receiver's distance.
_CAMERA = 0.75

#: Distance between a lens's lamp and its plane face, in mm.
_GAP = 1.0

#: Number of directions of sunlight; the light of each is parallel.
SUNS = 19

#: Thickness as a fraction of the longer side; a thinner plate is penalised, so that the face stays away from the back.
_LEAST = 0.02


def leaving(surface: Surface) -> float:
    """Return the light that leaves the face.

    The value is in mm^2 for parallel light of irradiance 1, and in steradians for a point light of intensity 1.
    """
    setting = surface.setting
    h, (ny, nx) = surface.heights, surface.heights.shape
    gy, gx = (np.gradient(h, step, axis=i) for i, step in enumerate((setting.size[1] / ny, setting.size[0] / nx)))
    x, y = transport.grid((ny, nx), setting.size)
    light = float(np.sum(Rays(setting).arriving(x, y, h, gx, gy))) * np.prod(setting.size) / (nx * ny)
    if setting.kind == "lens" and not np.isfinite(setting.light_distance):
        light = light * float(transmitted(np.array(1.0), setting.ior))  # a point light's value includes its plane face
    return float(light)


def vertices(setting: Setting, nx: int, ny: int) -> tuple[Array, Array]:
    """Return x and y (ny, nx) of a face's vertices in mm, from edge to edge. Each vertex is at the centre of a texel of
    the map.
    """
    x, y = (np.linspace(-side / 2, side / 2, n) for side, n in zip(setting.size, (nx, ny), strict=True))
    xs, ys = np.meshgrid(x, y)
    return xs, ys


def at_vertices(surface: Surface, nx: int, ny: int) -> Array:
    """Return heights (ny, nx) at `vertices`. Between cells, heights are cubic; at the edges, they are extrapolated by
    parabolas.
    """
    h = surface.heights
    for axis in (0, 1):
        h = np.moveaxis(h, axis, 0)
        h = np.concatenate([[3 * h[0] - 3 * h[1] + h[2]], h, [3 * h[-1] - 3 * h[-2] + h[-3]]])
        h = np.moveaxis(h, 0, axis)
    cells = surface.heights.shape
    at = [np.linspace(0.5, n + 0.5, count) for n, count in zip(cells, (ny, nx), strict=True)]  # of the padded map
    # not ndimage's spline, which mirrors the map at its edges and would bend the edge of a dome
    spline = RectBivariateSpline(*(np.arange(n) for n in h.shape), h)
    return np.asarray(spline(*at))


def face_ply(setting: Setting, nx: int, ny: int) -> bytes:
    """Return the flat face as a binary PLY. The grid has normals along +z and texture coordinates with v along y."""
    x, y = vertices(setting, nx, ny)
    u, v = np.meshgrid((np.arange(nx) + 0.5) / nx, (np.arange(ny) + 0.5) / ny)
    zero = np.zeros_like(x)
    points = np.stack([x, y, zero, zero, zero, zero + 1.0, u, v], axis=-1).reshape(-1, 8)
    return ply_file(points, _triangles(nx, ny))


def _triangles(nx: int, ny: int) -> NDArray[np.int64]:
    """Return the triangles (n, 3) of the face, counterclockwise as seen from +z."""
    corner = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    return np.concatenate([
        np.stack([corner, corner + 1, corner + nx + 1], 1), np.stack([corner, corner + nx + 1, corner + nx], 1)
    ])  # fmt: skip


def solid_lines(setting: Setting, heights: NDArray[Any]) -> list[str]:
    """Return lines about the solid of a face with `heights` (ny, nx) at its vertices. Raises ConfigError if its front
    and back cross.
    """
    ny, nx = heights.shape
    points = np.stack([*vertices(setting, nx, ny), heights], axis=-1).reshape(-1, 3)
    plan = Fabrication(kind=setting.kind, thickness=setting.thickness, outline=setting.outline)
    sheet = as_sheet(plan.face, points, _triangles(nx, ny))
    return summary(measured(make_solid(sheet, plan), sheet, plan))


def target_image(picture: Array, surface: Surface) -> tuple[Array, float]:
    """Return the target image (H, W). Also return the light's irradiance or intensity that gives a mean of 1 inside the
    picture.

    The image shows the luminance of the picture, with row 0 at the top. Pixels darker than the floor are raised to the
    floor. No light is lost.
    """
    setting = surface.setting
    target = on_film(np.maximum(picture, surface.floor * picture.max()))
    return target, float(np.pi / ALBEDO * np.prod(setting.picture_size) / leaving(surface))


def on_film(picture: Array) -> Array:
    """Return a picture (rows, columns) on the film (H, W), which also sees a margin around it. The picture has mean 1,
    and the margin is black.
    """
    beside = round(MARGIN * max(picture.shape))
    height, width = picture.shape[0] + 2 * beside, picture.shape[1] + 2 * beside
    film = np.zeros((height, width))
    film[beside : height - beside, beside : width - beside] = picture / picture.mean()
    return film


def lamps(surface: Surface, power: float, sun: float) -> str:
    """Return the XML of the light. The light is parallel, parallel with the sun's diameter `sun` (degrees), or a point
    light.

    `power` is its irradiance or intensity.
    """
    setting, rays = surface.setting, Rays(surface.setting)
    beam = rays.toward
    if np.isfinite(setting.light_distance):
        angle = np.degrees(_half_cone(surface))
        to = _triple(rays.light + beam)
        return f"""    <emitter type="spot" id="beam">
        <rgb name="intensity" value="{power:.9g}"/>
        <float name="cutoff_angle" value="{angle:.6g}"/>
        <float name="beam_width" value="{angle:.6g}"/>
        <transform name="to_world">
            <lookat origin="{_triple(rays.light)}" target="{to}" up="0, 1, 0"/>
        </transform>
    </emitter>"""
    wide, high = setting.size[0] * float(np.cos(np.radians(setting.incidence))), setting.size[1]
    start = -beam * setting.distance
    if setting.kind == "lens":  # the central ray meets the face's centre, and no part of the lamp touches the lens
        inside, _ = rays.incoming(*np.zeros((3, 1)))
        tilt = float(np.tan(np.radians(abs(setting.incidence))))
        start = -setting.thickness * inside[:, 0] / inside[2, 0] - beam * (_GAP + wide / 2 * tilt)
    if setting.kind == "mirror" and setting.outline == "rectangle":
        # oblique light meets parts beside it that stand out of the plane; light that passes the mirror is lost
        wide += 2 * surface.relief * abs(float(np.sin(np.radians(setting.incidence))))
    shape = "rectangle" if setting.outline == "rectangle" else "disk"
    if not sun:
        return _plane(shape, "lamp", (wide, high), start, beam, np.array([0.0, 1, 0]), _emitter("beam", power))
    # Directions on a sunflower spiral, with equal areas of the disk each. The lamps are so far away that none hides
    # another, and their beams are wider than the face by the depth of its tilt.
    radius = np.radians(sun) / 2
    far = 4 * max(setting.size) / (radius * np.sqrt(np.pi / SUNS))
    side, up, parts = np.cross(np.array([0.0, 1, 0]), beam), np.array([0.0, 1, 0]), []
    wider = 2 * (setting.thickness if setting.kind == "lens" else surface.relief) * radius
    for k in range(SUNS):
        r, turn = radius * np.sqrt((k + 0.5) / SUNS), k * np.pi * (3 - np.sqrt(5))
        toward = beam + r * np.cos(turn) * side + r * np.sin(turn) * up
        toward /= np.linalg.norm(toward)
        parts.append(_plane(shape, f"lamp{k}", (wide + wider, high + wider), -far * toward, toward, up,
                            _emitter(f"beam{k}", power / SUNS)))  # fmt: skip
    return "\n".join(parts)


def _half_cone(surface: Surface) -> float:
    """Return the largest angle (radians) between a point light's axis and its rays to a face's corners. For a round
    face, returns the mean angle to the edge.
    """
    setting, rays = surface.setting, Rays(surface.setting)
    is_round = setting.outline == "round"
    turn = np.radians(np.arange(0, 360, 5) if is_round else np.array([45, 135, 225, 315]))
    radius = 0.5 if is_round else np.sqrt(0.5)
    x, y = radius * setting.size[0] * np.cos(turn), radius * setting.size[1] * np.sin(turn)
    ny, nx = surface.heights.shape
    cells = [(y / setting.size[1] + 0.5) * ny - 0.5, (x / setting.size[0] + 0.5) * nx - 0.5]
    d, _ = rays.incoming(x, y, scipy.ndimage.map_coordinates(surface.heights, cells, order=1, mode="nearest"))
    # of a lens, in the air before its plane face
    angles = np.arccos(rays.toward @ d) if setting.kind == "mirror" else np.arcsin(setting.ior * np.hypot(d[0], d[1]))
    return float(np.mean(angles) if is_round else np.max(angles))


def scene_xml(surface: Surface, film: tuple[int, int], pixels: int, power: float, sun: float = 0.0) -> str:
    """Return the XML of a face's scene. `pixels` is the picture's width in pixels on `film`, which also has a margin.

    `power` and `sun` are as for `lamps`.
    """
    setting, rays = surface.setting, Rays(surface.setting)
    is_lens = setting.kind == "lens"
    away = _CAMERA * setting.distance
    seen = setting.picture_size[0] * film[0] / pixels
    fov = 2 * np.degrees(np.arctan(seen / 2 / away))
    mesh = setting.size[0] / 2, setting.size[1] / 2
    reach = 2 * max(setting.size)
    material = (
        f'<bsdf type="dielectric" id="glass">\n        <float name="int_ior" value="{setting.ior:.9g}"/>\n'
        '        <float name="ext_ior" value="1"/>\n    </bsdf>'
        if is_lens
        else '<bsdf type="twosided" id="glass">\n        <bsdf type="conductor">\n'
        '            <string name="material" value="none"/>\n        </bsdf>\n    </bsdf>'
    )
    back = (
        _rectangle("back", setting.size, np.array([0, 0, -setting.thickness]), np.array([0.0, 0, -1]),
                   np.array([0.0, 1, 0]), '<ref id="glass"/>')
        if is_lens else ""
    )  # fmt: skip
    beside, across = reach - mesh[0], reach - mesh[1]
    edges = [(beside, 2 * reach, sign * (reach + mesh[0]) / 2, 0.0) for sign in (1, -1)]
    edges += [(2 * mesh[0], across, 0.0, sign * (reach + mesh[1]) / 2) for sign in (1, -1)]
    mount = "\n".join(
        _rectangle(f"mount{i or ''}", (w, h), np.array([x, y, 0.0]), np.array([0.0, 0, 1]), np.array([0.0, 1, 0]),
                   '<ref id="black"/>')
        for i, (w, h, x, y) in enumerate(edges)
    ) if is_lens else ""  # fmt: skip
    screen = _rectangle(
        "screen", (SCREEN * setting.picture_size[0], SCREEN * setting.picture_size[1]), rays.middle, -rays.normal,
        rays.up, f'<bsdf type="diffuse">\n            <rgb name="reflectance" value="{ALBEDO:g}"/>\n        </bsdf>',
    )  # fmt: skip
    camera = rays.middle - away * rays.normal
    return f"""<?xml version="1.0" encoding="utf-8"?>
<!-- {setting.kind.capitalize()} that casts a picture, by reslrb lens. Lengths in mm, y up: docs/lens.md, "Axes". -->
<scene version="3.0.0">
    <default name="resx" value="{film[0]}"/>
    <default name="resy" value="{film[1]}"/>

    <integrator type="ptracer">
        <integer name="max_depth" value="{4 if is_lens else 3}"/>
    </integrator>

    <sensor type="perspective" id="camera">
        <float name="fov" value="{fov:.9g}"/>
        <string name="fov_axis" value="x"/>
        <float name="near_clip" value="{away / 100:.6g}"/>
        <float name="far_clip" value="{away * 100:.6g}"/>
        <transform name="to_world">
            <lookat origin="{_triple(camera)}" target="{_triple(rays.middle)}" up="{_triple(rays.up)}"/>
        </transform>
        <film type="hdrfilm" id="film">
            <integer name="width" value="$resx"/>
            <integer name="height" value="$resy"/>
            <string name="pixel_format" value="rgb"/>
            <rfilter type="tent">  <!-- nearly a pixel, and smooth enough to be differentiated -->
                <float name="radius" value="0.75"/>
            </rfilter>
        </film>
        <sampler type="independent"/>
    </sensor>

    {material}
    <bsdf type="diffuse" id="black">
        <rgb name="reflectance" value="0"/>
    </bsdf>

    <shape type="ply" id="face">
        <string name="filename" value="face.ply"/>
        <boolean name="face_normals" value="true"/>
        <ref id="glass"/>
    </shape>
{back}
{mount}
{screen}
{lamps(surface, power, sun)}
</scene>
"""


def lens_yaml(
    surface: Surface, heights: NDArray[Any], name: str, iterations: int, sun: float, ior: float | str
) -> str:  # fmt: skip
    """Return the configuration. The run starts at `heights` (ny, nx), which are stored in `start.exr`. `ior` is the
    index, or the name of the material.
    """
    s, (ny, nx) = surface.setting, heights.shape
    least = min(_LEAST * max(s.size), float(heights.min()) + s.thickness)
    plate = f"type: thickness, thickness: {s.thickness:.9g}, least: {least:.4g}, weight: {1e6 / max(s.size) ** 4:.4g}"
    also = f" sun: {sun:g}," if sun else ""
    index = ior if isinstance(ior, str) else f"{ior:g}"
    return f"""# {s.kind.capitalize()} that casts {json.dumps(name)}: {surface.summary()}.
# Run it:
#     reslrb optimize lens.yaml
scene:
  file: scene.xml
target:
  file: target.exr
  mask: none  # all pixels count, including the brightest pixels and those at the edge
parameters:
  - heightmap: {{mesh: face, resolution: [{nx}, {ny}]}}  # heights along +z, in mm
    initial: {{file: start.exr}}  # computed by optimal transport: docs/lens.md
    precondition: 0.03  # smooths the steps; otherwise the finest ripples limit their length
    regularizers: [{{{plate}}}]  # lengths in mm; keeps the faces apart
integrator:
  type: reslrb
  max_depth: {4 if surface.setting.kind == "lens" else 3}
loss: {{type: l2}}
# Adam would amplify noise, and a rough face scatters light. The steps of gradient descent stay smooth.
optimizer: {{type: sgd, momentum: 0.9, scale: curvature, learning_rate: 1, schedule: cosine}}
run:
  iterations: {iterations}
  spp: 64
  final_spp: 1024  # noise in the final image would lower its SSIM
  certainty: false  # a design has no true values
fabrication:  # lengths in mm; `reslrb export` writes the solid
  {{kind: {s.kind}, thickness: {s.thickness:.9g}, outline: {s.outline}, ior: {index},{also}
   picture: picture.exr}}  # before dark parts were brightened
"""


def _triple(vector: Array) -> str:
    return ", ".join(f"{value + 0.0:.9g}" for value in vector)


def _emitter(id: str, irradiance: float) -> str:
    return (
        f'<ref id="black"/>\n        <emitter type="directionalarea" id="{id}">\n'
        f'            <rgb name="radiance" value="{irradiance:.9g}"/>\n        </emitter>'
    )


def _rectangle(id: str, size: tuple[float, float], middle: Array, normal: Array, up: Array, content: str) -> str:
    return _plane("rectangle", id, size, middle, normal, up, content)


def _plane(type: str, id: str, size: tuple[float, float], middle: Array, normal: Array, up: Array, content: str) -> str:
    """Return the XML of a rectangle or disk that faces along `normal`. The shape's vertical axis is `up`, projected
    onto the shape's plane.
    """
    across = np.cross(up, normal) / np.linalg.norm(np.cross(up, normal))
    up = np.cross(normal, across)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1] = across * size[0] / 2, up * size[1] / 2
    matrix[:3, 2], matrix[:3, 3] = normal, middle
    values = " ".join(f"{value + 0.0:.9g}" for value in matrix.ravel())
    return f"""    <shape type="{type}" id="{id}">
        <transform name="to_world">
            <matrix value="{values}"/>
        </transform>
        {content}
    </shape>"""
