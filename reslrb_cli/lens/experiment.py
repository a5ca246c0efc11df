"""What `reslrb lens` writes about a face: the scene, its mesh and the configuration that shapes it further.

Text and arrays alone, in millimetres and by the axes of `surface.py`. The lamp is as large as the face looks from it:
its parallel beam meets the face and nothing beside. The mount is black about the face. The camera stands on the
receiver's normal: a point, which throws no shadow.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from reslrb_cli.lens import transport
from reslrb_cli.lens.surface import Array, Rays, Setting, Surface, transmitted

#: Reflectance of the receiver, and its width in pictures.
ALBEDO, SCREEN = 0.8, 3.0

#: Of the distance, where the camera stands before the receiver.
_CAMERA = 0.75

#: Between the lamp of a lens and its plane face, in mm.
_GAP = 1.0


def lit_share(surface: Surface) -> float:
    """Light that leaves the face, over that of a beam as large as a flat face looks from it: slopes, Fresnel's law."""
    setting = surface.setting
    h, (ny, nx) = surface.heights, surface.heights.shape
    gy, gx = (np.gradient(h, step, axis=i) for i, step in enumerate((setting.size[1] / ny, setting.size[0] / nx)))
    x, y = transport.grid((ny, nx), setting.size)
    rays = Rays(setting)
    _, plane = rays.incoming(x, y, h)
    share = rays.arriving(x, y, h, gx, gy) / plane
    if setting.kind == "lens":
        share = share * transmitted(np.array(1.0), setting.ior)
    return float(np.mean(share[surface.inside]))


def vertices(setting: Setting, nx: int, ny: int) -> tuple[Array, Array]:
    """x and y (mm; ny, nx) of the vertices of a face, from edge to edge; each lies at a texel's centre of the map."""
    x, y = (np.linspace(-side / 2, side / 2, n) for side, n in zip(setting.size, (nx, ny), strict=True))
    xs, ys = np.meshgrid(x, y)
    return xs, ys


def at_vertices(surface: Surface) -> Array:
    """Heights (ny, nx) at `vertices`: cubic between the cells of a surface, and parabolas on to its edges."""
    h = surface.heights
    for axis in (0, 1):
        h = np.moveaxis(h, axis, 0)
        h = np.concatenate([[3 * h[0] - 3 * h[1] + h[2]], h, [3 * h[-1] - 3 * h[-2] + h[-3]]])
        h = np.moveaxis(h, 0, axis)
    at = [np.linspace(0.5, n + 0.5, n) for n in surface.heights.shape]  # cells of the padded map
    places = np.stack(np.meshgrid(*at, indexing="ij"))
    return np.asarray(scipy.ndimage.map_coordinates(h, places, order=3, mode="mirror"))


def face_ply(setting: Setting, nx: int, ny: int) -> bytes:
    """The flat face as a binary PLY: a grid with normals along +z and texture coordinates, v along y."""
    x, y = vertices(setting, nx, ny)
    u, v = np.meshgrid((np.arange(nx) + 0.5) / nx, (np.arange(ny) + 0.5) / ny)
    zero = np.zeros_like(x)
    points = np.stack([x, y, zero, zero, zero, zero + 1, u, v], axis=-1).reshape(-1, 8).astype("<f4")
    corner = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
    cells = np.concatenate([
        np.stack([corner, corner + 1, corner + nx + 1], 1), np.stack([corner, corner + nx + 1, corner + nx], 1)
    ])  # fmt: skip
    faces: NDArray[Any] = np.empty(len(cells), dtype=[("n", "u1"), ("at", "<i4", 3)])
    faces["n"], faces["at"] = 3, cells
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz", "u", "v"))
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return head.encode() + points.tobytes() + faces.tobytes()


def film_size(shape: tuple[int, int], margin: float) -> tuple[int, int]:
    """(width, height) of a film that sees a picture of (rows, columns) and `margin` of its longer side about it."""
    beside = round(margin * max(shape))
    return shape[1] + 2 * beside, shape[0] + 2 * beside


def target_image(picture: Array, surface: Surface, margin: float) -> tuple[Array, float]:
    """What the film is to see, and the irradiance of the beam with which its mean inside of the picture is 1.

    (H, W), of the picture (luminance, row 0 at the top) with its dark parts lifted to the floor. No light is lost.
    """
    setting = surface.setting
    lifted = np.maximum(picture, surface.floor * picture.max())
    lifted = lifted / lifted.mean()
    width, height = film_size((picture.shape[0], picture.shape[1]), margin)
    target = np.zeros((height, width))
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    seen = lifted[:, ::-1] if setting.through else lifted
    target[top : top + picture.shape[0], left : left + picture.shape[1]] = seen
    beam = np.prod(lamp_size(setting)) * lit_share(surface)
    return target, float(np.pi / ALBEDO * np.prod(setting.picture_size) / beam)


def lamp_size(setting: Setting) -> tuple[float, float]:
    """Width and height (mm) of a beam that covers a face."""
    return setting.size[0] * float(np.cos(np.radians(setting.incidence))), setting.size[1]


def scene_xml(surface: Surface, film: tuple[int, int], pixels: int, irradiance: float) -> str:
    """The scene of a face; `pixels` of the `film`'s width are the picture's."""
    setting, rays = surface.setting, Rays(surface.setting)
    is_lens = setting.kind == "lens"
    beam = rays.toward
    start = -beam * setting.distance if not is_lens else np.array([0.0, 0.0, -setting.thickness - _GAP])
    away = _CAMERA * setting.distance
    seen = setting.picture_size[0] * film[0] / pixels
    fov = 2 * np.degrees(np.arctan(seen / 2 / away))
    wide, high = lamp_size(setting)
    if not is_lens:  # oblique light meets what stands out of the plane beside it; what misses the mirror is lost
        wide += 2 * surface.relief * abs(float(np.sin(np.radians(setting.incidence))))
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
    lamp = _rectangle(
        "lamp", (wide, high), start, beam, np.array([0.0, 1, 0]),
        '<ref id="black"/>\n        <emitter type="directionalarea" id="beam">\n'
        f'            <rgb name="radiance" value="{irradiance:.9g}"/>\n        </emitter>',
    )  # fmt: skip
    camera = rays.middle - away * rays.normal
    return f"""<?xml version="1.0" encoding="utf-8"?>
<!-- A {setting.kind} that throws a picture; written by reslrb lens. Millimetres, y up: docs/lens.md, "Axes". -->
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
            <rfilter type="gaussian"/>
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
{lamp}
</scene>
"""


#: Of the rate with which steps of the finest ripples would begin to grow: tried at 48, 128 and 256 texels.
_STEADY = 0.7


def steady_rate(surface: Surface, film: tuple[int, int], pixels: int) -> float:
    """A rate (mm^2) of gradient descent on the mean squared difference from a target of mean 1.

    A ripple of height a and as fine as the texels (pitch p) turns light by b a / p (b: index - 1, for a mirror 2),
    moves it by the distance f times that, and changes the light of a pixel (q wide) by b f a / (p q) of itself. The
    second derivative by one height is the square of that over the number of pixels, and the rate its inverse.
    """
    setting = surface.setting
    bend = 2.0 if setting.kind == "mirror" else setting.ior - 1
    pitch, pixel = setting.size[0] / surface.heights.shape[1], setting.picture_size[0] / pixels
    return _STEADY * film[0] * film[1] * (pitch * pixel / (bend * setting.distance)) ** 2


def lens_yaml(surface: Surface, name: str, iterations: int, rate: float) -> str:
    """The configuration, which begins at the heights in `start.exr`."""
    ny, nx = surface.heights.shape
    s = surface.setting
    return f"""# The {surface.setting.kind} that throws {json.dumps(name)}: {surface.summary()}.
# Begin with
#     reslrb optimize lens.yaml
scene:
  file: scene.xml
target:
  file: target.exr
  mask: none  # nothing is left out for being bright or at the edge: a design's light counts wherever it falls
parameters:
  - heightmap: {{mesh: face, resolution: [{nx}, {ny}]}}  # mm along +z
    initial: {{file: start.exr}}  # by transport of light: docs/lens.md
integrator:
  type: reslrb
  max_depth: {4 if surface.setting.kind == "lens" else 3}
loss: {{type: l2}}
# Not Adam: it takes steps as large for what noise says as for what the image does, and a rough face folds the light.
# The rate is about what the finest ripples bear; a larger one tears the face, a smaller one takes longer.
optimizer: {{type: sgd, momentum: 0.9, learning_rate: {rate:.3g}, schedule: cosine}}
run:
  iterations: {iterations}
  spp: 64
fabrication:  # mm; what `reslrb export` makes a solid of
  {{kind: {s.kind}, thickness: {s.thickness:.9g}, outline: {s.outline}, ior: {s.ior:g},
   size: [{s.size[0]:.9g}, {s.size[1]:.9g}]}}
"""


def _triple(vector: Array) -> str:
    return ", ".join(f"{value + 0.0:.9g}" for value in vector)


def _rectangle(id: str, size: tuple[float, float], middle: Array, normal: Array, up: Array, content: str) -> str:
    """A rectangle that faces along `normal`, its width across `up`."""
    across = np.cross(up, normal)
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1] = across * size[0] / 2, up * size[1] / 2
    matrix[:3, 2], matrix[:3, 3] = normal, middle
    values = " ".join(f"{value + 0.0:.9g}" for value in matrix.ravel())
    return f"""    <shape type="rectangle" id="{id}">
        <transform name="to_world">
            <matrix value="{values}"/>
        </transform>
        {content}
    </shape>"""
