"""Light through glass onto a receiver: what bends it is displaced, tilted and moved."""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.measure.analytic_scenes import camera
from reslrb_cli.measure.attached.amplitudes import Displacement, Move, Number, Pose
from reslrb_cli.measure.attached.meshes import ball, grid, mesh, smooth_fields, waves
from reslrb_cli.measure.attached.scene import FILTER, SIZE, AttachedScene
from reslrb_cli.measure.small_scenes import bitmap, diffuse, rgb, transform

GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
ROUGH = {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.1}
TOP = "top.vertex_positions"


def setting(size: int = SIZE, **objects: Any) -> dict:
    """A receiver at y = 0, and a camera at y = 1 that sees the part within 1 of the axis; the rest are `objects`."""
    seen = camera([0, 1, 0], [0, 0, 0], [0, 0, -1], 90, size)
    seen["film"]["rfilter"] = FILTER
    floor = {"type": "rectangle", "to_world": transform(rotate=([1, 0, 0], -90), scale=50),
             "bsdf": diffuse(0.8, 0.7, 0.6)}  # fmt: skip
    return {"type": "scene", "camera": seen, "floor": floor} | objects


def spot(origin: tuple = (0.05, 3.2, -0.04), target: tuple = (0, 0, 0), cutoff: float = 14) -> dict:
    """A lamp whose light ends smoothly."""
    import mitsuba as mi

    aim = mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=[0, 0, 1])
    return {
        "type": "spot",
        "intensity": rgb(9, 8, 7),
        "cutoff_angle": cutoff,
        "beam_width": cutoff / 3,
        "to_world": aim,
    }


def sheet(y: float, up: bool, bsdf: dict, tilt: float = 0, scale: float = 3) -> dict:
    """A flat surface; light that comes through it from the side that it faces enters the glass."""
    turn = (-90 if up else 90) + tilt
    return {"type": "rectangle", "bsdf": bsdf,
            "to_world": transform(translate=[0, y, 0], rotate=([1, 0, 0], turn), scale=scale)}  # fmt: skip


def slab(bsdf: dict = GLASS, cells: int = 64, half: float = 1.0, wide: float = 0, lamp: Any = None, y: float = 1.8,
         **objects: Any) -> dict:  # fmt: skip
    """A slab whose upper surface, at `y`, has waves, under a lamp."""
    positions, faces, uv = grid(cells, lambda x, z: y + waves(x, z), half, wide)
    return setting(
        lamp=spot() if lamp is None else lamp,
        top=mesh(positions, faces, bsdf, uv),
        bottom=sheet(y - 0.2, False, bsdf, scale=max(3, half)),
        **objects,
    )


def rough_surface() -> dict:
    """Rough glass with waves, and the receiver inside of it."""
    scene = slab(ROUGH)
    del scene["bottom"]
    return scene


def vertices(scene: Any, name: str) -> np.ndarray:
    """Positions (V, 3) of a mesh."""
    import mitsuba as mi

    return np.array(mi.traverse(scene)[f"{name}.vertex_positions"], float).reshape(-1, 3)


def waving(scene: Any, name: str = "top", height: float = 1.8, count: int = 10) -> list[Move]:
    """The waves of a sheet by their size, and smooth displacements."""
    positions = vertices(scene, name)
    amplitude = np.zeros_like(positions)
    amplitude[:, 1] = (positions[:, 1] - height) * 3
    return [Displacement(f"{name}.vertex_positions", np.stack([amplitude, *smooth_fields(positions, count, 1.0)]))]


def moving_sphere(name: str, pivot: tuple[float, float, float]) -> list[Move]:
    return [Pose(f"{name}.to_world", ("tx", "ty", "tz", "s"), pivot)]


def beam(half: float = 0.3) -> dict:
    """Parallel light from a square, at thirty degrees."""
    import mitsuba as mi

    aim = mi.ScalarTransform4f().look_at(origin=[0.9, 3.2, -0.04], target=[0.05, 1.8, 0], up=[0, 0, 1])
    light = {"type": "directionalarea", "radiance": rgb(9, 8, 7)}
    return square_lamp() | {"to_world": aim @ mi.ScalarTransform4f().scale(half), "emitter": light}


def square_lamp(half: float = 0.25, y: float = 3.2) -> dict:
    """An area light that shines down."""
    return {"type": "rectangle", "bsdf": diffuse(0, 0, 0), "emitter": {"type": "area", "radiance": rgb(9, 8, 7)},
            "to_world": transform(translate=[0.05, y, -0.04], rotate=([1, 0, 0], 90), scale=half)}  # fmt: skip


def sphere_lens(radius: float = 0.8, y: float = 1.95, cutoff: float = 18, bsdf: dict = GLASS) -> dict:
    """A ball of glass in a cone of light that it contains."""
    return setting(lamp=spot(cutoff=cutoff, origin=(0.1, 3.6, -0.08), target=(0.05, y, 0)),
                   lens={"type": "sphere", "center": [0, y, 0], "radius": radius, "bsdf": bsdf})  # fmt: skip


def mesh_lens(radius: float = 0.8, y: float = 1.95) -> dict:
    """The same as a mesh."""
    return setting(lamp=spot(cutoff=18, origin=(0.1, 3.6, -0.08), target=(0.05, y, 0)),
                   lens=mesh(*ball(radius, (0, y, 0), 5), GLASS))  # fmt: skip


def bent(scene: Any, name: str = "lens", count: int = 10, span: float = 0.8) -> list[Move]:
    """A mesh by its size along x, about its middle, and smooth displacements."""
    positions = vertices(scene, name)
    wider = np.zeros_like(positions)
    wider[:, 0] = positions[:, 0] - positions[:, 0].mean()
    return [Displacement(f"{name}.vertex_positions", np.stack([wider, *smooth_fields(positions, count, span)]))]


def prism() -> dict:
    """A slab whose flat upper surface is tilted."""
    return setting(lamp=spot(), top=sheet(1.9, True, GLASS, tilt=12), bottom=sheet(1.6, False, GLASS))


def two_lenses() -> dict:
    """A slab with waves over a ball: four surfaces of glass in a row."""
    scene = slab(lamp=spot(cutoff=7, origin=(0.03, 4.4, -0.02)), y=2.8)
    return scene | {"lens": {"type": "sphere", "center": [0, 1.55, 0], "radius": 0.5, "bsdf": GLASS}}


def smooth_texture() -> dict:
    """A receiver whose colours change without a step."""
    at = np.linspace(0, 2 * np.pi, 65)
    x, y = np.meshgrid(at, at)
    texels = np.stack([0.5 + 0.3 * np.sin(3 * x), 0.5 + 0.3 * np.cos(2 * x + y), 0.5 + 0.3 * np.sin(4 * y)], -1)
    floor = setting()["floor"]
    floor["to_world"] = transform(rotate=([1, 0, 0], -90), scale=3)
    return floor | {"bsdf": {"type": "diffuse", "reflectance": bitmap(texels, "bilinear")}}


SCENES = [
    AttachedScene("slab", "a glass slab with waves under a spot light", slab, waving, spp=256),
    AttachedScene("slab_beam", "the same under parallel light with a hard edge", lambda: slab(lamp=beam()), waving,
                  step=0.005),
    AttachedScene("slab_area", "the same, wide and under an area light",
                  lambda: slab(lamp=square_lamp(0.2, 2.3), half=40, wide=6, cells=160), waving, spp=512, seeds=16),
    AttachedScene("slab_depth_6", "the same with what is reflected inside of it twice", slab, waving,
                  options={"max_depth": 6}, step=0.0025, spp=512, seeds=16),
    AttachedScene("slab_texture", "the same over a smooth texture", lambda: slab(floor=smooth_texture()), waving,
                  spp=256),
    AttachedScene("sphere_lens", "a ball of glass, moved and scaled", sphere_lens,
                  lambda scene: moving_sphere("lens", (0, 1.95, 0)), spp=512),
    AttachedScene("mesh_lens", "a ball of glass, a mesh that is bent", mesh_lens, bent,
                  step=0.005, spp=512, seeds=24),
    AttachedScene("prism", "a tilted flat surface, turned and moved", prism,
                  lambda scene: [Pose("top.to_world", ("rx", "rz", "ty"), (0, 1.9, 0))], spp=512, seeds=16),
    AttachedScene("two_lenses", "a slab with waves over a ball", two_lenses,
                  lambda scene: [*waving(scene, height=2.8), *moving_sphere("lens", (0, 1.55, 0))],
                  options={"max_depth": 6}, spp=512, seeds=24),
    AttachedScene("rough_surface", "rough glass with waves, the receiver inside", rough_surface, waving,
                  spp=512, seeds=32, options={"max_depth": 3}),
    AttachedScene("rough_surface_alpha", "the roughness of rough glass", rough_surface,
                  lambda scene: [Number("top.bsdf.alpha.value")], step=0.03, spp=512, seeds=32,
                  options={"max_depth": 3, "attached": True}),
    AttachedScene("rough_surface_eta", "the index of rough glass", rough_surface,
                  lambda scene: [Number("top.bsdf.eta")], step=0.1, spp=1024, seeds=96,
                  options={"max_depth": 3, "attached": True}),
]  # fmt: skip
