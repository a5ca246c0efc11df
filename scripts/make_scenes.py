#!/usr/bin/env python3
"""Make the assets of the scenes in `scenes/`: textures, an environment map and meshes.

    scripts/make_scenes.py [FOLDER]

The script writes the assets below FOLDER (default: `scenes/` of this repository). The result does not depend on the
machine. Only the last bits of sines and cosines differ, and these are rounded away. A test compares the files in the
repository with the result.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image as Picture

from reslrb_cli.lens.solid import ply_file

SCENES = Path(__file__).resolve().parent.parent / "scenes"
Image = np.ndarray  # (H, W, 3) float32, linear Rec. 709


def main(arguments: list[str]) -> None:
    """Write all assets below the folder that the command line names."""
    folder = Path(arguments[0]) if arguments else SCENES
    for name, image in images().items():
        write_exr(folder / name, image)
    Picture.fromarray(mottled_wall(192, 384)).save(folder / "stiff" / "wall.png", optimize=True)
    Picture.fromarray(np.uint8([[255, 13]])).save(folder / "stiff" / "filter.png")  # a torch's halves: 1 and 0.05
    for name, (*vertices, faces) in meshes().items():
        (folder / name).write_bytes(ply_file(np.hstack(vertices), faces))


def images() -> dict[str, Image]:
    """Return all EXR images. The keys are their paths below the scenes folder."""
    return {
        "cornell_floor/floor.exr": carpet(64),
        "grey_room/planks.exr": planks(96),
        "grey_room/painting.exr": painting(20),
        "grey_room/sky.exr": sky(64),
        "caustic_slab/paper.exr": paper(64),
        "caustic_heightmap/heights.exr": heights(32),
        "lens_pose/beam.exr": beam(64),
        "mixed_room/wallpaper.exr": wallpaper(32),
        "table/planks.exr": planks(96),
    }


def meshes() -> dict[str, tuple[np.ndarray, ...]]:
    """Return all meshes in the format of `height_field`. The keys are their paths below the scenes folder. The slab and
    the handle have no texture coordinates.
    """
    return {
        "caustic_slab/slab.ply": height_field(96, 1.0, slab, texcoords=False),
        "caustic_heightmap/face.ply": height_field(128, 0.805, lambda x, z: 0 * x),
        "lens_pose/lens.ply": height_field(64, 0.6, lens),
        "mixed_room/pane.ply": height_field(64, 0.2, pane),
        "table/vase.ply": revolved(VASE, 40),
        "table/handle.ply": handle(24, 10),
        "table/glass.ply": revolved(glass_ball(0.27, 0.5, 28), 72, (1.2, 0.7)),
    }


# ---- Textures -------------------------------------------------------------------------------------------------------


def carpet(size: int) -> Image:
    """Return a woven carpet with borders, corners and a medallion. Each stitch is a texel with its own shade."""
    x, y = grid(size)
    square = np.maximum(abs(x), abs(y))
    diamond = abs(x) + abs(y)
    octagon = np.maximum(square, diamond / np.sqrt(2))
    petals = octagon * (1 + 0.12 * np.cos(8 * np.arctan2(y, x)))

    color = np.empty((size, size, 3))
    color[:] = (0.10, 0.16, 0.42)  # field, indigo
    lattice = (np.floor(x).astype(int) + 2 * np.floor(y).astype(int)) % 5 == 0
    color[lattice] = (0.82, 0.62, 0.16)  # single stitches of gold
    corner = np.hypot(size / 2 - abs(x), size / 2 - abs(y)) < size * 0.30
    color[corner] = (0.07, 0.42, 0.34)
    color[corner & (np.floor(diamond).astype(int) % 4 == 0)] = (0.80, 0.72, 0.52)

    ring = np.floor(petals / (size * 0.052)).astype(int)
    palette = [(0.86, 0.68, 0.18), (0.62, 0.06, 0.08), (0.84, 0.76, 0.60), (0.08, 0.35, 0.50), (0.88, 0.38, 0.10)]
    palette += [(0.55, 0.05, 0.12)]
    for k, value in enumerate(palette):
        color[ring == k] = value

    stitch = (np.floor(x).astype(int) + np.floor(y).astype(int)) % 2 == 0
    border = square > size * 0.40
    color[border] = (0.62, 0.07, 0.07)
    color[border & (np.floor(diamond).astype(int) % 6 < 2)] = (0.86, 0.74, 0.50)
    edge = square > size * 0.47
    color[edge] = np.where(stitch[..., None], (0.10, 0.12, 0.30), (0.85, 0.66, 0.22))[edge]
    color[(square > size * 0.385) & ~border] = (0.84, 0.78, 0.62)

    shade = 0.65 + 0.6 * noise(size, size, 1)[..., None] + 0.16 * (noise(size, size, 3, channels=3) - 0.5)
    return quantise(np.clip(color * shade, 0.05, 0.95))


def planks(size: int) -> Image:
    """Return a floor of oak planks, eight across, with grain along the planks and dark joints."""
    rows, columns = np.mgrid[0:size, 0:size]
    width, length = size // 8, size // 2
    plank = columns // width
    offset = (plank * 19) % length
    piece = plank * 7 + (rows + offset) // length
    tone = noise(64, 1, 5)[piece % 64, 0]
    grain = noise(size, size, 7)
    grain = (grain + np.roll(grain, 1, 0) + np.roll(grain, 2, 0) + np.roll(grain, 3, 0)) / 4
    joint = (columns % width == 0) | ((rows + offset) % length == 0)
    shade = (0.62 + 0.5 * tone + 0.45 * (grain - 0.5)) * np.where(joint, 0.45, 1.0)
    return quantise(np.clip(shade[..., None] * np.array([0.44, 0.27, 0.15]), 0.02, 0.95))


def painting(size: int) -> Image:
    """Return a landscape of sky, sun and hills in flat colours."""
    x, y = grid(size)
    x, y = x / size, -y / size
    color = np.empty((size, size, 3))
    color[:] = (0.20, 0.42, 0.62)
    color += (0.5 - y)[..., None] * np.array([0.30, 0.16, 0.02])
    color[np.hypot(x - 0.2, y - 0.2) < 0.13] = (0.92, 0.62, 0.16)
    color[y < 0.02 + 0.12 * np.sin(7 * x + 1)] = (0.16, 0.30, 0.26)
    color[y < -0.12 + 0.10 * np.sin(5 * x - 1.2)] = (0.34, 0.42, 0.12)
    color[y < -0.30 + 0.07 * np.sin(9 * x + 2)] = (0.56, 0.26, 0.09)
    return quantise(np.clip(color * (0.92 + 0.16 * noise(size, size, 11)[..., None]), 0.03, 0.95))


def paper(size: int) -> Image:
    """Return warm paper with a printed grid and a frame."""
    x, y = grid(size)
    color = np.empty((size, size, 3))
    color[:] = (0.78, 0.74, 0.66)
    line = (np.floor(x).astype(int) % 8 == 0) | (np.floor(y).astype(int) % 8 == 0)
    color[line] = (0.38, 0.56, 0.68)
    square = np.maximum(abs(x), abs(y))
    color[(square > size * 0.44) & (square < size * 0.47)] = (0.62, 0.22, 0.14)
    return quantise(color)


def wallpaper(size: int) -> Image:
    """Return a printed wall with rows of flowers in two colours on a light ground. Each texel has its own shade."""
    x, y = grid(size)
    color = np.empty((size, size, 3))
    color[:] = (0.62, 0.58, 0.44)
    step = size / 4
    row = np.floor(y / step).astype(int)
    u = (x + row % 2 * step / 2) % step - step / 2
    v = y % step - step / 2
    radius, angle = np.hypot(u, v), np.arctan2(v, u)
    color[radius < step * (0.36 + 0.10 * np.cos(5 * angle))] = (0.58, 0.16, 0.14)
    other = (row % 2 == 0) & (radius < step * (0.36 + 0.10 * np.cos(5 * angle)))
    color[other] = (0.14, 0.30, 0.52)
    color[radius < step * 0.13] = (0.82, 0.66, 0.20)
    color[abs(y) > size * 0.46] = (0.22, 0.40, 0.24)
    shade = 0.85 + 0.3 * noise(size, size, 13)[..., None]
    return quantise(np.clip(color * shade, 0.05, 0.95))


def heights(size: int) -> Image:
    """Return the heights of smooth waves of glass, in scene units. Two to four ripples across are so shallow that light
    does not fold.
    """
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size
    ripples = [((2, 2), 0.4, 1.4e-3), ((-3, 1), 1.9, 1.1e-3), ((1, -3), 4.1, 1.1e-3), ((3, 2), 2.7, 0.8e-3)]
    value = waves(2 * np.pi * x, 2 * np.pi * y, ripples)
    return quantise(np.repeat((value - value.mean())[:, :, None], 3, axis=2), 2.0**-20)


def beam(size: int) -> Image:
    """Return the cross-section of a beam with soft dots, five across."""
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size * 2 * np.pi * 5
    value = 0.1 + 0.9 * ((0.5 + 0.5 * np.cos(x)) * (0.5 + 0.5 * np.cos(y))) ** 1.5
    return quantise(np.repeat(value[:, :, None], 3, axis=2))


def mottled_wall(width: int, height: int) -> np.ndarray:
    """Return soft waves of grey, linear, as (H, W) uint8. The waves have no detail finer than a pixel of the
    picture.
    """
    y, x = (np.mgrid[0:height, 0:width] + 0.5) / height
    value = 0.45 + 0.17 * np.sin(3 * np.pi * x + 1) + 0.17 * np.cos(4 * np.pi * y + 0.5)
    return np.round(255 * quantise(value)).astype(np.uint8)


def sky(height: int) -> Image:
    """Return a small latitude-longitude sky with haze, blue and ground. The sun is bright but wider than a texel.

    The scene rotates this map. Therefore the horizon is perpendicular to UP and does not lie on a row of texels.
    """
    v, u = (np.mgrid[0:height, 0 : 2 * height] + 0.5) / height
    theta, phi = v * np.pi, u * np.pi
    direction = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], -1)
    sun = np.array(SUN) / np.linalg.norm(SUN)
    cosine = direction @ sun
    elevation = direction @ (np.array(UP) / np.linalg.norm(UP))
    above = np.clip(elevation, 0, 1)[..., None]
    color = np.array([0.95, 1.0, 1.05]) * (1 - above) ** 4 + np.array([0.30, 0.55, 1.0]) * (1 - (1 - above) ** 4)
    color = np.where(elevation[..., None] > 0, color * 1.6, np.array([0.26, 0.24, 0.20]))
    glow = 260 * np.exp((cosine - 1) * 900) + 2.5 * np.exp((cosine - 1) * 30)
    color += np.array([1.0, 0.86, 0.62]) * glow[..., None]
    return quantise(color, 1 / 256)


# What grey_room/scene.xml turns (25 degrees about x, then -40 about y) into the sun's direction, (-0.83, 0.52, 0.23),
# and into the vertical.
SUN = (-0.487, 0.766, 0.421)
UP = (0.0, 0.9063, -0.4226)


# ---- Mesh -----------------------------------------------------------------------------------------------------------


def slab(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the heights of the glass slab's rippled lower face. Its waves make 2 to 4 ripples across the slab."""
    return waves(x, z, [
        ((5.1, 2.3), 0.4, 0.0135), ((-3.7, 5.9), 1.9, 0.0120), ((7.9, -4.6), 4.1, 0.0062),
        ((2.2, -8.8), 2.7, 0.0055), ((-9.6, -7.1), 5.2, 0.0032), ((11.8, 3.9), 0.9, 0.0028),
    ])  # fmt: skip


def waves(x: np.ndarray, z: np.ndarray, parts: list[tuple[tuple[float, float], float, float]]) -> np.ndarray:
    """Return a sum of waves. Each wave has a wave vector, a phase and an amplitude."""
    return sum(amplitude * np.sin(kx * x + kz * z + phase) for (kx, kz), phase, amplitude in parts)


def grid_faces(cells: int) -> np.ndarray:
    """Return the triangles of a grid of (cells + 1)^2 vertices, row by row, as (F, 3) int32."""
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return faces.astype(np.int32)


def height_field(cells: int, half: float, height: Callable[[np.ndarray, np.ndarray], np.ndarray], texcoords: bool = True
                 ) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Return a surface y = height(x, z) over [-half, half]^2, with normals downwards, u along x and v along z.

    The arrays are positions and normals (V, 3), texture coordinates (V, 2) if requested, and triangles (F, 3).
    Triangles are int32, and the other arrays are float32.
    """
    axis = np.linspace(-half, half, cells + 1)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    y, step = height(x, z), 1e-5
    dx = (height(x + step, z) - height(x - step, z)) / (2 * step)
    dz = (height(x, z + step) - height(x, z - step)) / (2 * step)
    normal = np.stack([dx, -np.ones_like(x), dz], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    positions = quantise(np.stack([x, y, z], -1).reshape(-1, 3), 2.0**-20)
    uv = np.stack([x + half, z + half], -1).reshape(-1, 2) / (2 * half)
    vertices = [positions, *(quantise(each, 2.0**-20) for each in (normal.reshape(-1, 3), uv)[: 1 + texcoords])]
    return (*vertices, grid_faces(cells))


def lens(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the heights of a lens's lower face. The lens is stronger along x than along z and has coma, so that every
    rotation of the lens is visible.
    """
    return x**2 / 1.6 + z**2 / 3.2 + 0.2 * x**3 + 0.2 * x * z**2 + 0.15 * z**3


def pane(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the heights of the lower face of a pane of cast glass. Its ripples in four directions concentrate light at
    arm's length.
    """
    vectors = [((26, 9), 0.4, 5.0e-3), ((-13, 24), 1.9, 4.2e-3), ((37, -20), 4.1, 1.6e-3), ((15, 33), 2.7, 1.4e-3)]
    return waves(x, z, vectors)


#: Radius and height along the walls of a vase, from the foot over the outside to the centre inside. It has no base.
VASE = [
    (0.17, 0), (0.17, 0.02), (0.22, 0.06), (0.29, 0.16), (0.335, 0.29), (0.345, 0.42), (0.32, 0.55), (0.26, 0.67),
    (0.19, 0.77), (0.145, 0.86), (0.13, 0.95), (0.14, 1.03), (0.175, 1.1), (0.165, 1.115), (0.14, 1.1), (0.11, 1.03),
    (0.1, 0.95), (0.11, 0.86), (0.15, 0.77), (0, 0.7),
]  # fmt: skip


def glass_ball(radius: float, height: float, rings: int) -> list[tuple[float, float]]:
    """Return radius and height along a spheroid that stands at height 0."""
    angle = np.linspace(0, np.pi, rings)
    profile = [(radius * np.sin(a), height / 2 * (1 - np.cos(a))) for a in angle]
    return [(0, 0), *profile[1:-1], (0, height)]


def revolved(profile: list[tuple[float, float]], sides: int, axes: tuple[float, float] = (1, 1)
             ) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Return the surface that a profile of radii and heights describes about the z axis. Each cross-section is an
    ellipse with these half-axes, in units of the radius.

    The profile ends on the axis, and the outside is on its right-hand side. u is the angle to the x axis, divided by
    pi, so there is no seam. v is the height, divided by the largest height.
    """
    radius, z = np.array(profile).T
    angle = np.arange(sides) / sides * 2 * np.pi
    ring = np.stack([axes[0] * np.cos(angle), axes[1] * np.sin(angle)], -1)
    is_closed = radius[0] == 0
    inner = slice(1 if is_closed else 0, -1)
    walls = np.concatenate([radius[inner, None, None] * ring, np.repeat(z[inner], sides).reshape(-1, sides, 1)], -1)
    index = np.arange(walls[..., 0].size).reshape(-1, sides)
    following = np.roll(index, -1, 1)
    a, b, c, d = index[:-1], index[1:], following[1:], following[:-1]
    ends = [z[-1], z[0]] if is_closed else [z[-1]]
    positions = np.concatenate([walls.reshape(-1, 3), [[0, 0, end] for end in ends]])
    last = np.full(sides, index.size)
    sheets = [(a, d, c), (a, c, b), (last, index[-1], following[-1])]
    if is_closed:
        sheets.append((last + 1, following[0], index[0]))
    u = np.concatenate([np.tile(1 - abs(1 - angle / np.pi), len(walls)), np.full(len(ends), 0.5)])
    uv = np.stack([u, positions[:, 2] / z.max()], -1)
    return with_normals(positions, np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in sheets]), uv)


def handle(along: int, around: int) -> tuple[np.ndarray, ...]:
    """Return the handle of the vase: a bent tube whose open ends are inside the vase."""
    t = np.linspace(-0.55 * np.pi, 0.62 * np.pi, along + 1)[:, None]
    angle = np.arange(around) / around * 2 * np.pi
    out, up = np.cos(t), np.sin(t)
    thick = 0.032 + 0.008 * np.cos(angle)[None]
    x = 0.22 + (0.24 + thick * np.cos(angle)) * out - 0.06 * up
    z = 0.74 + (0.23 + thick * np.cos(angle)) * up
    y = np.broadcast_to(0.04 * np.sin(angle), x.shape)
    positions = np.stack([x, y, z], -1).reshape(-1, 3)
    index = np.arange(len(positions)).reshape(along + 1, around)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, 1), np.roll(a, -1, 1)
    faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    return with_normals(positions, faces)


def with_normals(positions: np.ndarray, faces: np.ndarray, uv: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """Return a mesh in the format of `height_field`. The normal of a vertex is the mean of the normals of its faces,
    weighted by their angles.
    """
    positions = quantise(positions, 2.0**-20).astype(np.float64)
    corner = positions[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    total = np.zeros_like(positions)
    for k in range(3):
        one, other = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        cosine = (one * other).sum(-1) / np.linalg.norm(one, axis=-1) / np.linalg.norm(other, axis=-1)
        np.add.at(total, faces[:, k], normal * np.arccos(np.clip(cosine, -1, 1))[:, None])
    total /= np.linalg.norm(total, axis=-1, keepdims=True)
    vertices = [total] if uv is None else [total, uv]
    return positions.astype(np.float32), *(quantise(each, 2.0**-20) for each in vertices), faces.astype(np.int32)


# ---- Tools ----------------------------------------------------------------------------------------------------------


def grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of texel centres in texels, with x to the right and y down. The origin is the middle of
    the image.
    """
    y, x = np.mgrid[0:size, 0:size] + 0.5 - size / 2
    return x, y


def noise(rows: int, columns: int, stream: int, channels: int = 0) -> np.ndarray:
    """Return white noise in [0, 1) from an integer hash (PCG's output function). The noise is the same on every machine
    and with every version.
    """
    count = rows * columns * max(channels, 1)
    with np.errstate(over="ignore"):
        state = (np.arange(count, dtype=np.uint32) + np.uint32(stream * 0x9E3779B1 % 2**32)) * np.uint32(747796405)
        state += np.uint32(2891336453)
        word = ((state >> ((state >> np.uint32(28)) + np.uint32(4))) ^ state) * np.uint32(277803737)
    value = ((word >> np.uint32(22)) ^ word) / 2.0**32
    return value.reshape((rows, columns, channels) if channels else (rows, columns))


def quantise(array: np.ndarray, step: float = 1 / 4096) -> np.ndarray:
    """Return an array rounded to multiples of `step`, so that the last bits of libm do not matter."""
    return (np.round(array / step) * step).astype(np.float32)


def write_exr(path: Path, image: Image) -> None:
    """Write an RGB image (H, W, 3) as OpenEXR with 32 bits per channel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(image)}).write(str(path))


if __name__ == "__main__":
    main(sys.argv[1:])
