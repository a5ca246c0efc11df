"""What moves light: slopes from none to total reflection, grazing light, thin glass, indices, sizes of scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from reslrb_cli.measure.analytic_scenes import camera
from reslrb_cli.measure.attached.amplitudes import Displacement, Move, Pose
from reslrb_cli.measure.attached.glass import TOP, vertices
from reslrb_cli.measure.attached.meshes import grid, mesh, smooth_fields, waves
from reslrb_cli.measure.attached.scene import FILTER
from reslrb_cli.measure.extreme.case import Extrapolated, ExtremeCase
from reslrb_cli.measure.small_scenes import diffuse, rgb, transform

SIZE = 24
#: Ten ray offsets where a thin slab is: 8.9e-5 (1 + max |p|) each.
THIN = 10 * 8.9e-5 * (1 + 2.5)

Moves = Callable[[Any], Sequence[Move]]


def glass(ior: float = 1.5, alpha: float = 0) -> dict:
    """Smooth glass, or rough."""
    index = {"int_ior": ior, "ext_ior": 1.0}
    return {"type": "roughdielectric", "alpha": alpha} | index if alpha else {"type": "dielectric"} | index


def beam(origin: tuple[float, float], target: tuple[float, float], half: float, scale: float = 1) -> dict:
    """Parallel light in the plane z = 0, from (x, y) to (x, y), with a square cross-section."""
    import mitsuba as mi

    start, end = ([scale * x, scale * y, 0.0] for x, y in (origin, target))
    aim = mi.ScalarTransform4f().look_at(origin=start, target=end, up=[0, 0, 1])
    return {
        "type": "rectangle",
        "to_world": aim @ mi.ScalarTransform4f().scale(scale * half),
        "bsdf": diffuse(0, 0, 0),
        "emitter": {"type": "directionalarea", "radiance": rgb(9, 8, 7)},
    }


def steep(scale: float = 1) -> dict:
    """Light from above, at twenty degrees."""
    return beam((0.5, 3), (0.05, 1.8), 0.25, scale)


def pool(
    bsdf: dict,
    light: dict,
    slope: float = 1,
    height: float = 1.8,
    thickness: float = 0,
    scale: float = 1,
    cells: int = 128,
) -> dict:
    """A receiver in glass, whose surface has waves; with a `thickness` it is a slab, and the receiver below it.

    `slope` is that of the waves, as a multiple of one tenth. Everything is `scale` times as large. The faces of its
    `cells` leave an error of their own, which falls with the square of their number (docs/method.md).
    """
    seen = camera([0, scale, 0], [0, 0, 0], [0, 0, -1], 90, SIZE)
    seen["film"]["rfilter"] = FILTER
    seen |= {"near_clip": 1e-2 * scale, "far_clip": 1e3 * scale}
    positions, faces, uv = grid(cells, lambda x, z: height + slope * waves(x, z), 2.5)
    floor = transform(rotate=([1, 0, 0], -90), scale=20 * scale)
    scene = {
        "type": "scene",
        "camera": seen,
        "floor": {"type": "rectangle", "bsdf": diffuse(0.8, 0.7, 0.6), "to_world": floor},
        "lamp": light,
        "top": mesh(scale * positions, faces, bsdf, uv),
    }
    if thickness:
        place = transform(translate=[0, scale * (height - thickness), 0], rotate=([1, 0, 0], 90), scale=3 * scale)
        scene["bottom"] = {"type": "rectangle", "bsdf": bsdf, "to_world": place}
    return scene


def bending(size: float = 1, scale: float = 1) -> Moves:
    """The surface, by three smooth displacements of this size."""

    def moves(scene: Any) -> Sequence[Move]:
        fields = size * scale * smooth_fields(vertices(scene, "top") / scale, 3, 1.0)
        return [Displacement(TOP, fields)]

    return moves


def sliding(scene: Any) -> Sequence[Move]:
    """The surface, within itself."""
    return [Displacement(TOP, smooth_fields(vertices(scene, "top"), 3, 1.0) * np.array([1, 0, 1]))]


def with_lamp(scene: Any) -> Sequence[Move]:
    """The surface, and the lamp."""
    return [*bending()(scene), Pose("lamp.to_world", ("tx", "rz"), (0.5, 3, 0))]


def slab(slope: float = 1, thickness: float = 0.2, scale: float = 1) -> Callable[[], dict]:
    return lambda: pool(glass(), steep(scale), slope, thickness=thickness, scale=scale)


def surface(ior: float = 1.5, alpha: float = 0, slope: float = 1) -> Callable[[], dict]:
    return lambda: pool(glass(ior, alpha), steep(), slope)


def totally_reflected() -> dict:
    """Light in glass that meets its surface from below, beyond the critical angle, and lights the receiver."""
    return pool(glass(), beam((-1.87, 1.0), (-1.6, 1.2), 0.12), slope=0.1, height=1.2, cells=256)


def grazing(degrees: float) -> dict:
    """Light at so many degrees from the surface's normal."""
    theta = float(np.deg2rad(degrees))
    at = -1.2 * float(np.tan(np.arcsin(np.sin(theta) / 1.5)))
    start = (at - 2 * float(np.sin(theta)), 1.2 + 2 * float(np.cos(theta)))
    return pool(glass(), beam(start, (at, 1.2), 0.02), slope=0.1, height=1.2)


def moved(name: str, about: str, scene: Callable[[], dict], step: float = 0.01, depth: int = 3,
          moves: Moves | None = None, left: float = 1e-3, **more: Any) -> ExtremeCase:  # fmt: skip
    return ExtremeCase(name, about, scene, (), Extrapolated(step, left), image="ptracer", seeds=8, signed=True,
                       options={"max_depth": depth}, moves=moves or bending(), **more)  # fmt: skip


CASES = [
    moved("slope_0", "a flat surface of glass that begins to bend", surface(slope=0)),
    moved("slope_1e-6", "slopes of a millionth", surface(slope=1e-5)),
    moved("slope_0.3", "slopes of a third", surface(slope=3), 0.005),
    moved("sliding_faces", "a surface whose faces slide through the light", surface(), moves=sliding),
    moved("total_reflection", "a surface with waves, beyond the critical angle", totally_reflected, 0.0015),
    moved("grazing_85", "light at 85 degrees on glass", lambda: grazing(85), 0.005, moves=bending(0.1)),
    moved("parallel_faces", "a slab with flat faces that begins to bend", slab(0), depth=4),
    moved("thin_slab", "a slab of ten ray offsets", slab(0, THIN), depth=4, moves=bending(THIN), step=0.1, spp=256),
    moved("moved_index_1", "glass of index 1, and the lamp over it", surface(1.0), moves=with_lamp),
    moved("moved_index_3", "glass of index 3", surface(3.0)),
    moved("moved_rough_1.001", "rough glass of index 1.001, and the lamp over it", surface(1.001, 0.1),
          moves=with_lamp, equal=1e-3),
    moved("moved_rough_3", "rough glass of index 3", surface(3.0, 0.1), equal=1e-3),
    moved("millimetres", "a slab a thousand times its size", slab(scale=1e3), depth=4, moves=bending(1, 1e3)),
    moved("shrunk_to_0.03", "a slab three hundredths of its size", slab(scale=0.03), depth=4,
          moves=bending(1, 0.03), left=5e-3),
]  # fmt: skip
