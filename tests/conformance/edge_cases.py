"""Cases of test_edges.py: shapes, a lamp, and surfaces on which the shapes' shadows fall. z is up.

`PYTHONPATH=tests python -c "import reslrb_cli, conformance.edge_cases as e; e.main()"` writes edge_values.json, with
the finite differences of all `RECORDED` cases. Names as arguments restrict it to these cases. A case takes a minute or
more.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from conformance.moving import Moving, turned

from reslrb_cli.measure.gradients import integrator, seeds, smooth_weights
from reslrb_cli.measure.scenes.moving import Latents, mesh
from reslrb_cli.measure.scenes.small import diffuse, lit_square, look_at, rectangle, rgb, transform

#: Finite differences (N, K) by the name of a case.
VALUES = Path(__file__).with_name("edge_values.json")
SIZE = 24
#: Motion of each shape: a translation, and the angle of a rotation about an axis through the origin. The unit of the
#: angle is `TURN` degrees, so that all derivatives have a similar size.
MOTION = ("x", "y", "z", "turn")
TURN = 60.0
#: Motion of a sheet by a heightmap: the heights of its corners, with heights in between interpolated. The last two are
#: the heights of one vertex each. Light or view grazes the faces around it.
HEIGHTS = ("h00", "h10", "h01", "h11", "lit", "seen")
PLACES = ("to_world", "position", "vertex_positions")
#: Step of the finite differences, a smaller one for hard shadows on other moving shapes, and one for small shapes that
#: hide a moving one.
STEP, SMALLER, SMALLEST = 0.03, 0.01, 0.005
#: Turn of the balls about z, in degrees. Where the sensor sees a face edge-on, the derivative jumps, and central
#: differences are the mean of both sides. With this turn, no step of the differences leads there.
BALL_TURN = 16.0
OWN = diffuse(0.6, 0.6, 0.8)
GLASS, MIRROR = {"type": "dielectric"}, {"type": "twosided", "bsdf": {"type": "conductor"}}
TWO_SIDED = {"type": "twosided", "bsdf": OWN}


@dataclass(frozen=True)
class EdgeCase:
    """Shapes of `OCCLUDERS`, and a lamp of `LAMPS`, or of `ROOMS` in a room, or one of the `VIEWS`. The shapes move, or
    the lamp moves if `lamp_moves` is true.

    The derivatives are those of each object's `motion`, which has components of `MOTION`, or of `HEIGHTS` for the bumpy
    sheet. `axis` is the axis of the rotation. The gradient of each seed uses `spp` samples per pixel. Finite
    differences have the `step`, and use `reference_spp`, with `reference_seeds` on file. `options` are options of
    `reslrb`. The sensor sees nothing before `near_clip`.
    """

    occluder: str
    lamp: str
    depth: int = 2
    motion: tuple[str, ...] = MOTION
    axis: tuple[float, float, float] = (0.3, 1.0, 0.5)
    spp: int = 256
    reference_spp: int = 2048
    reference_seeds: int = 8
    step: float = STEP
    lamp_moves: bool = False
    near_clip: float = 1e-2
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The name of the test."""
        return f"{self.occluder}-{'moving_' if self.lamp_moves else ''}{self.lamp}-{self.depth}"

    def moving(self) -> Moving:
        """Load the scene. Each moving object has its own motion."""
        shapes = OCCLUDERS[self.occluder]()
        names = ["lamp"] if self.lamp_moves else [*shapes]
        first: dict[str, Any] = {}
        rises = {part: mi.Vector3f(rise.T) for part, rise in bumpy()[2].items()} if self.occluder == "bumpy" else {}

        def place(params: mi.SceneParameters, latents: Latents) -> None:
            for name in names:
                x, y, z, turn = (latents.get(f"{name}.{part}", mi.Float(0)) for part in MOTION)
                motion = turned(TURN * turn, list(self.axis), [x, y, z])
                key = next(f"{name}.{part}" for part in PLACES if f"{name}.{part}" in params)
                if key not in first:
                    first[key] = type(params[key])(params[key])
                if key.endswith("to_world"):
                    params[key] = motion @ mi.AffineTransform4f(first[key].matrix)
                elif key.endswith("position"):
                    params[key] = motion @ mi.Point3f(first[key])
                else:
                    points = dr.unravel(mi.Point3f, first[key])
                    for part, rise in rises.items():
                        points += latents[f"{name}.{part}"] * rise
                    params[key] = dr.ravel(motion @ points)

        start = {f"{name}.{part}": 0.0 for name in names for part in self.motion}
        if self.lamp in VIEWS:
            scene, weights = VIEWS[self.lamp](), ramp()
        else:
            scene, weights = _room(self.lamp) if self.lamp in ROOMS else _open(self.lamp), smooth_weights(SIZE, SIZE)
        scene["camera"]["near_clip"] = self.near_clip
        moving = Moving(scene | STILL.get(self.occluder, dict)() | shapes, start, place)
        moving.weigh(weights)
        return moving

    def gradients(self, count: int = 8, block: int = 0, **options: Any) -> np.ndarray:
        """Return the gradients (N, K) of `reslrb` at `count` seeds. `block` chooses the seeds."""
        tracer = integrator("reslrb", self.depth, **{"estimator": "stack", "edges": "on"} | self.options | options)
        moving = self.moving()
        chosen = seeds(count, block)
        return np.array([np.concatenate([*moving.gradient(tracer, seed, self.spp).values()]) for seed in chosen])

    def differences(self, count: int = 8, block: int = 1) -> np.ndarray:
        """Return finite differences (N, K) of images at `count` other seeds. `block` chooses the seeds.

        The images are those of `path`. Parallel light is found only by `ptracer`. In place of a hidden lamp, the sensor
        sees nothing before a clip plane behind the lamp.
        """
        moving = replace(self, near_clip=BEHIND_THE_VEIL).moving() if self.lamp == "veil" else self.moving()
        path = integrator("ptracer" if self.lamp == "beam" else "path", self.depth)

        def difference(seed: int, name: str) -> float:
            ends = (moving.value(path, seed, self.reference_spp, **{name: step}) for step in (self.step, -self.step))
            return float(np.subtract(*ends) / (2 * self.step))

        return np.array([[difference(seed, name) for name in moving.start] for seed in seeds(count, block)])


def recorded(case: EdgeCase) -> np.ndarray:
    """Return the finite differences (N, K) on file."""
    return np.array(json.loads(VALUES.read_text())[case.name])


# ---- Moving shapes ----


def split_box(center: tuple[float, float, float], half: tuple[float, float, float], degrees: float = 23.0
              ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the vertices (24, 3) and faces (12, 3) of a box turned about z. Each side has its own four vertices."""
    points, faces = [], []
    for axis in range(3):
        for sign in (-1, 1):
            corners = np.full((4, 3), float(sign))
            corners[:, (axis + 1) % 3] = np.array([-1, 1, 1, -1]) * sign
            corners[:, (axis + 2) % 3] = [-1, -1, 1, 1]
            first = 4 * len(faces) // 2
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
            points.append(corners)
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return np.concatenate(points) * half @ turn.T + center, np.array(faces)


def ball(center: tuple[float, float, float], radius: float, rows: int = 6, columns: int = 9, degrees: float = 0.0
         ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the vertices and faces of a coarse ball, turned about z."""
    height = np.linspace(0, np.pi, rows + 1)[1:-1]
    turn = 2 * np.pi * np.arange(columns) / columns + np.deg2rad(degrees)
    rings = np.stack(
        np.broadcast_arrays(
            np.sin(height)[:, None] * np.cos(turn), np.sin(height)[:, None] * np.sin(turn), np.cos(height)[:, None]
        ),
        -1,
    )
    points = np.concatenate([[[0, 0, 1]], rings.reshape(-1, 3), [[0, 0, -1]]])
    at = 1 + np.arange((rows - 1) * columns).reshape(rows - 1, columns)
    beside, last = np.roll(at, -1, 1), len(points) - 1
    faces = [np.stack([np.zeros(columns, int), at[0], beside[0]], 1),
             np.stack([np.full(columns, last), beside[-1], at[-1]], 1)]  # fmt: skip
    for a, b, c, d in zip(at[:-1], at[1:], beside[1:], beside[:-1], strict=True):
        faces += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    return points * radius + center, np.concatenate(faces)


def bumpy(cells: int = 12) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return the vertices (N, 3) and faces of a bumpy sheet, and the motion (N, 3) of its vertices by each of the
    `HEIGHTS`. The sheet leans back, and its bumps hide and shade other parts of it.
    """
    axis = np.linspace(0, 1, cells + 1)
    u, v = (each.ravel() for each in np.meshgrid(axis, axis, indexing="ij"))
    across, up, normal = np.array([1.4, 0, 0]), np.array([0, 0.9, 0.6]), np.array([0, -0.6, 0.9]) / np.hypot(0.6, 0.9)
    height = 0.2 * np.sin(8 * u + 1) * np.cos(9 * v + 0.4)
    points = np.outer(u - 0.5, across) + np.outer(v - 0.5, up) + np.outer(height, normal) + [0.1, 0, 0.7]
    at = np.arange(u.size).reshape(cells + 1, cells + 1)
    a, b, c, d = (corner.ravel() for corner in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    alone = (np.arange(u.size) == at[place] for place in ((cells // 6, cells - 1), (cells - 1, cells - 1)))
    shares = ((1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v, *alone)
    return points, faces, {part: np.outer(share, normal) for part, share in zip(HEIGHTS, shares, strict=True)}


def _box(x: float, y: float, z: float, size: float = 1.0) -> Any:
    return mesh(*split_box((x, y, z), (0.3 * size, 0.25 * size, 0.3 * size)), OWN)


def _sphere(x: float, y: float, z: float, size: float = 1.0) -> Any:
    return {"type": "sphere", "center": [x, y, z], "radius": 0.4 * size, "bsdf": OWN}


def _rectangle(x: float, y: float, z: float, size: float = 1.0) -> Any:
    place = transform(translate=[x, y, z], rotate=([0, 0, 1], 45), scale=[0.5 * size, 0.3 * size, 1])
    return rectangle(TWO_SIDED, place)


def _disk(x: float, y: float, z: float, size: float = 1.0) -> Any:
    place = transform(translate=[x, y, z], rotate=([1, 0.3, 0], 30), scale=0.4 * size)
    return {"type": "disk", "to_world": place, "bsdf": TWO_SIDED}


def _cylinder(x: float, y: float, z: float, size: float = 1.0) -> Any:
    ends = ([x + s * size * a for x, a in zip((x, y, z), (0.3, 0.05, 0.08), strict=True)] for s in (-1, 1))
    return {"type": "cylinder", "radius": 0.2 * size, "bsdf": TWO_SIDED} | dict(zip(("p0", "p1"), ends, strict=True))


def _ball(x: float, y: float, z: float, size: float = 1.0) -> Any:
    return mesh(*ball((x, y, z), 0.4 * size, degrees=BALL_TURN), OWN)


#: Sides of a square that the camera of `VIEWS` sees at a distance of 4.2.
SIDES = (0.7, 0.3, 0.1, 0.05)


def _square(side: float) -> Any:
    return rectangle(TWO_SIDED, transform(translate=[0.1, -0.2, 0.05], rotate=([1, 0, 0], -90), scale=side / 2))


SHAPES: dict[str, Callable[..., Any]] = {
    "box": _box, "sphere": _sphere, "rectangle": _rectangle, "disk": _disk, "cylinder": _cylinder, "ball": _ball,
}  # fmt: skip
#: `flat` has one shape of each kind without a round side. They cast shadows on each other.
FLAT = ("box", "rectangle", "disk", "ball")
OCCLUDERS: dict[str, Callable[[], dict[str, Any]]] = {
    "none": dict,
    **{name: lambda make=make: {"shape": make(0.1, -0.1, 0.9)} for name, make in SHAPES.items()},
    "standing": lambda: {"shape": _box(0.1, -0.1, 0.3)},
    # The camera sees the plate far behind the box.
    "two": lambda: {"shape": _box(0.2, -1.6, 1.35, 0.4),
                    "plate": rectangle(TWO_SIDED, transform(translate=[0.1, 0, 0.5], scale=0.7))},
    **dict.fromkeys(("hidden", "behind", "shaded", "glazed"), lambda: {"shape": _box(0.1, -0.1, 0.9)}),
    "reflector": lambda: {"shape": rectangle(TWO_SIDED, transform(translate=[0, 0, 2.6], scale=0.5))},
    "slab": lambda: {"shape": mesh(*split_box((0.1, 0, 0.5), (0.6, 0.6, 0.1)), GLASS)},
    "mirror": lambda: {"shape": rectangle(MIRROR, transform(translate=[0.2, 0.8, 0.8], rotate=([1, 0, 0], 75),
                                                            scale=0.7))},
    **dict.fromkeys(("reflected", "mapped"), lambda: {"shape": _sphere(0.1, 0, 0.6)}),
    "facing": lambda: {"shape": rectangle(MIRROR, transform(translate=[0.1, 2, 0], rotate=([1, 0, 0], 90), scale=0.4))},
    **{f"square_{side}": lambda side=side: {"shape": _square(side)} for side in SIDES},
    "bumpy": lambda: {"shape": mesh(*bumpy()[:2], TWO_SIDED)},
    # A coarse ball with interpolated normals.
    "smooth": lambda: {"shape": mesh(*ball((0.1, -0.1, 0.9), 0.4, degrees=BALL_TURN), OWN, normals=True)},
    "cleared": lambda: OCCLUDERS["smooth"](),
    "flat": lambda: {name: SHAPES[name](0.9 * (n % 2) - 0.45, 0.9 * (n // 2) - 0.5, 0.5 + 0.1 * n, 0.8)
                     for n, name in enumerate(FLAT)},
}  # fmt: skip


def _mapped() -> Any:
    """Return a mirror with a normal map that changes nothing."""
    normal = {"type": "bitmap", "data": mi.TensorXf([0.5, 0.5, 1.0], (1, 1, 3)), "raw": True}
    return {"type": "twosided", "bsdf": {"type": "normalmap", "normalmap": normal, "bsdf": {"type": "conductor"}}}


def _sheet(bsdf: Any) -> Any:
    return rectangle(bsdf, transform(translate=[0.2, 1.6, 1], rotate=([1, 0, 0], 80), scale=1.3))


#: Shapes that do not move. The camera sees the box behind a sheet, or behind three shapes, and the reflector lights the
#: floor past a sheet.
STILL: dict[str, Callable[[], dict[str, Any]]] = {
    "behind": lambda: {"sheet": STILL["hidden"]()["sheet"]},
    "hidden": lambda: {
        "sheet": rectangle(TWO_SIDED, transform(translate=[0.4, -0.9, 1.1], rotate=([1, 0, 0], 70),
                                                scale=[0.15, 0.3, 1])),
        "ball": {"type": "sphere", "center": [0.05, -0.9, 1.0], "radius": 0.12, "bsdf": OWN},
        "tube": {"type": "cylinder", "p0": [-0.1, -0.9, 0.4], "p1": [-0.2, -0.9, 1.6], "radius": 0.05,
                 "bsdf": TWO_SIDED},
    },
    # The shadow of the sheet falls on the box.
    "shaded": lambda: {"sheet": rectangle(TWO_SIDED, transform(translate=[0.35, 0.05, 1.7], scale=0.2))},
    "reflector": lambda: {"sheet": rectangle(TWO_SIDED, transform(translate=[0.1, 0.1, 1.2], scale=0.4))},
    # All light comes through a pane of glass that the camera does not see.
    "glazed": lambda: {"pane": mesh(*split_box((0.5, 0.1, 2.3), (1.2, 1.2, 0.05)), GLASS)},
    # Light comes through a pane that neither refracts nor reflects it.
    "cleared": lambda: {"pane": mesh(*split_box((0.5, 0.1, 2.3), (1.2, 1.2, 0.05)),
                                     GLASS | {"int_ior": 1.0, "ext_ior": 1.0})},
    # The camera sees the sphere and its shadow in a mirror, too.
    "reflected": lambda: {"sheet": _sheet(MIRROR)},
    "mapped": lambda: {"sheet": _sheet(_mapped())},
}  # fmt: skip

# ---- Lamps, and surfaces that do not move ----

ABOVE, BELOW = [0.8, 0.3, 3.0], [0.0, 0.0, 0.0]


def _towards() -> Any:
    return look_at(ABOVE, BELOW, [0, 1, 0])


LAMPS: dict[str, Callable[[], dict[str, Any]]] = {
    "area": lambda: lit_square(rgb(10, 10, 10), _towards() @ transform(scale=0.3)),
    # It lights the sides that the camera sees.
    "front": lambda: lit_square(rgb(10, 10, 10), look_at([0.9, -2, 2.4], BELOW) @ transform(scale=0.3)),
    # A lamp so near that the solid angle of its parts differs much over a shape.
    "near": lambda: lit_square(rgb(10, 10, 10), translate=[0.4, 0.1, 1.7], rotate=([1, 0, 0], 180), scale=0.3),
    "sphere_lamp": lambda: {"type": "sphere", "center": ABOVE, "radius": 0.3,
                            "emitter": {"type": "area", "radiance": rgb(10, 10, 10)}},
    "point": lambda: {"type": "point", "position": ABOVE, "intensity": rgb(10, 10, 10)},
    "spot": lambda: {"type": "spot", "to_world": _towards(), "cutoff_angle": 40, "intensity": rgb(10, 10, 10)},
    "upward": lambda: {"type": "spot", "to_world": look_at([0.1, 0, 1.6], [0.1, 0, 3], [0, 1, 0]), "cutoff_angle": 40,
                       "intensity": rgb(20, 20, 20)},
    "directional": lambda: {"type": "directional", "direction": [-0.4, -0.15, -1], "irradiance": rgb(3, 3, 3)},
    # Parallel light from the whole sky, as from `directional`.
    "wide_beam": lambda: lit_square(rgb(3, 3, 3), look_at([2.4, 0.9, 6], BELOW) @ transform(scale=4),
                                    "directionalarea"),
    # Parallel light from a part of the sky.
    "beam": lambda: lit_square(rgb(3, 3, 3), _towards() @ transform(scale=0.8), "directionalarea"),
    # A lamp between the camera and the scene.
    "veil": lambda: lit_square(rgb(10, 10, 10), look_at([0.3, -2.3, 1.75], [0, 0, 0.3]) @ transform(scale=0.3)),
    "constant": lambda: {"type": "constant", "radiance": rgb(1, 1, 1)},
}  # fmt: skip


#: Distance from the camera of a plane behind the lamp `veil`.
BEHIND_THE_VEIL = 1.3


def _camera(origin: list[float], target: list[float], fov: float, **rfilter: float) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb",
            "rfilter": {"type": "gaussian", **rfilter}}  # fmt: skip
    return {"type": "perspective", "fov": fov, "to_world": look_at(origin, target), "film": film,
            "sampler": {"type": "independent"}}  # fmt: skip


def _open(lamp: str) -> dict[str, Any]:
    """Return a floor, and a lamp above it."""
    floor = rectangle(diffuse(0.7, 0.5, 0.3), transform(scale=3))
    return {"type": "scene", "camera": _camera([0.4, -3, 2.2], [0, 0, 0.3], 40), "floor": floor, "lamp": LAMPS[lamp]()}


#: Lamps of the room: one shines down, the other at the ceiling.
ROOMS: dict[str, Callable[[], dict[str, Any]]] = {
    "room": lambda: lit_square(rgb(10, 10, 10), translate=[0.5, 0.2, 3.4], rotate=([1, 0, 0], 180), scale=0.35),
    "indirect": lambda: {
        "type": "spot",
        "to_world": look_at([0.5, 0.2, 2.5], [0.5, 0.2, 3.5], [0, 1, 0]),
        "cutoff_angle": 60,
        "intensity": rgb(20, 20, 20),
    },
}


def _room(lamp: str) -> dict[str, Any]:
    """Return a room of five walls and a lamp."""

    def wall(color: tuple[float, float, float], shift: list[float], axis: list[float], angle: float) -> dict[str, Any]:
        bsdf = {"type": "twosided", "bsdf": diffuse(*color)}
        return rectangle(bsdf, transform(translate=shift, rotate=(axis, angle), scale=2))

    grey, red, green = (0.7, 0.7, 0.7), (0.7, 0.2, 0.2), (0.2, 0.7, 0.2)
    return {
        "type": "scene", "camera": _camera([0.3, -1.95, 2.2], [0, 0.3, 0.4], 60),
        "floor": wall((0.7, 0.6, 0.5), [0, 0, 0], [0, 0, 1], 0),
        "ceiling": wall(grey, [0, 0, 3.5], [1, 0, 0], 180), "back": wall(grey, [0, 2, 2], [1, 0, 0], 90),
        "left": wall(red, [-2, 0, 2], [0, 1, 0], 90), "right": wall(green, [2, 0, 2], [0, 1, 0], 90),
        "lamp": ROOMS[lamp](),
    }  # fmt: skip


# ---- A square that the camera does not see directly ----


def ramp() -> np.ndarray:
    """Return weights (H, W, 3) that are 0 at the square's centre and increase with the row and the column. The terms of
    opposite edges then have the same sign, so that a fault of their directions does not cancel.
    """
    half = 4.2 * np.tan(np.deg2rad(VIEW / 2))
    y, x = (np.mgrid[0:SIZE, 0:SIZE] + 0.5) / SIZE - 0.5
    return np.repeat((x - 0.05 / half + y + 0.025 / half)[:, :, None], 3, axis=2)


#: Field of view in degrees of the camera that looks at a square.
VIEW = 25.0


def _around_square(**others: Any) -> dict[str, Any]:
    lamp = {"type": "point", "position": [1.2, 1.2, 1.0], "intensity": rgb(6, 5, 4)}
    return {"type": "scene", "lamp": lamp} | others


def _mirrored(bsdf: Any) -> dict[str, Any]:
    """Return a camera that sees a square in a flat mirror. The filter is so wide that images have no ripples."""
    mirror = rectangle(bsdf, transform(translate=[0, 2, 0], rotate=([1, 0, 0], 90), scale=3))
    return _around_square(camera=_camera([0, 0, 0], [0, 2, 0], VIEW, stddev=0.9), mirror=mirror)


def _paned() -> dict[str, Any]:
    """Return a camera that sees a square through a pane of glass."""
    pane = mesh(*split_box((0, 2.5, 0), (3, 0.05, 3), 0), GLASS)
    return _around_square(camera=_camera([0, 4, 0], [0, 0, 0], VIEW, stddev=0.9), pane=pane)


#: Share of a blended mirror that is not a black diffuse surface.
SHARE = 0.6


def blended(last: bool) -> dict[str, Any]:
    """Return a blend of a mirror and a black diffuse surface. The mirror comes first or `last`."""
    parts = {"type": "conductor"}, diffuse(0, 0, 0)
    first, second = parts[::-1] if last else parts
    return {"type": "blendbsdf", "weight": SHARE if last else 1 - SHARE, "first": first, "second": second}


VIEWS: dict[str, Callable[[], dict[str, Any]]] = {
    "mirrored": lambda: _mirrored({"type": "conductor"}), "paned": _paned,
    # The camera sees a lamp behind it in a mirror.
    "glowing": lambda: _around_square(camera=_camera([0, 0, 0], [0, 2, 0], VIEW, stddev=0.9), lamp=lit_square(
        rgb(4, 4, 4), transform(translate=[0.1, -0.2, 0.05], rotate=([1, 0, 0], -90), scale=0.25))),
    "blended": lambda: _mirrored(blended(False)), "blended_last": lambda: _mirrored(blended(True)),
    # A lamp near the camera covers the square's reflection.
    "covered": lambda: _mirrored({"type": "conductor"}) | {"cover": lit_square(
        rgb(4, 4, 4), transform(translate=[0, 0.2, 0], rotate=([1, 0, 0], 90), scale=0.02))},
}  # fmt: skip

# ---- The cases ----


def standing(lamp: str, depth: int, **options: Any) -> EdgeCase:
    """Return a case of a box that slides and turns on the floor. Derivatives of its height would be one-sided."""
    return EdgeCase("standing", lamp, depth, ("x", "y", "turn"), (0, 0, 1), **options)


BOTH, CAMERA, LIGHT = {"paths": "both"}, {"paths": "camera"}, {"paths": "light"}
HIDDEN = {"hide_emitters": True}
#: Cases of which finite differences are on file.
RECORDED = [
    EdgeCase("flat", "area"), EdgeCase("sphere", "near"),
    EdgeCase("box", "sphere_lamp"),
    EdgeCase("sphere", "point", spp=512), EdgeCase("rectangle", "spot"),
    EdgeCase("cylinder", "directional", spp=2048),
    standing("front", 2, spp=512), standing("room", 3, spp=1024, reference_spp=16384), EdgeCase("two", "area", 3),
    EdgeCase("box", "indirect", 3, spp=512, reference_spp=8192), EdgeCase("sphere", "room", 5),
    EdgeCase("hidden", "point", spp=1024, reference_spp=8192, step=SMALLEST),
    EdgeCase("reflector", "upward", 3, spp=512, reference_spp=8192),
    EdgeCase("shaded", "point", step=SMALLEST, reference_spp=8192),
    EdgeCase("bumpy", "area", motion=HEIGHTS, spp=512, reference_spp=8192, step=SMALLER),
    *(EdgeCase("box", lamp, lamp_moves=True, spp=1024) for lamp in ("area", "spot")),
    EdgeCase("none", "room", 3, lamp_moves=True, spp=512),
    EdgeCase("reflected", "area", 3, spp=512, reference_spp=8192, options=BOTH),
    EdgeCase("mirror", "constant", 3, reference_spp=8192, options=BOTH),
    EdgeCase("glazed", "area", 4, ("x", "z"), spp=1280, reference_spp=8192, options=LIGHT),
    EdgeCase("slab", "area", 4, spp=512, reference_spp=16384, step=0.02, options=BOTH),
    standing("area", 3, spp=768, reference_spp=8192, reference_seeds=32),
    EdgeCase("smooth", "area", spp=2048, reference_spp=65536, step=0.015, options=CAMERA),
    EdgeCase("smooth", "front", spp=1024, reference_spp=8192, step=SMALLER, options=CAMERA),
    EdgeCase("square_0.1", "mirrored", 3, ("x", "z"), spp=384, reference_spp=16384, options=CAMERA),
    EdgeCase("square_0.3", "paned", 4, ("x", "z"), spp=2048, reference_spp=16384, options=CAMERA),
    # The box hides the sky from the floor, and the edge of the floor hides it from the box. Light paths are noisy here.
    standing("constant", 3, spp=768, reference_spp=16384, options=CAMERA),
]  # fmt: skip
CASES = [
    *RECORDED,
    *(EdgeCase(f"square_{side}", view, depth, ("x", "z"), spp=2048, reference_spp=16384, options=CAMERA)
      for view, depth in (("mirrored", 3), ("paned", 4)) for side in SIDES
      if (view, side) not in (("mirrored", 0.1), ("paned", 0.3))),
    *(EdgeCase("box", "veil", spp=512, reference_spp=8192, step=SMALLER, options=options | HIDDEN)
      for options in (CAMERA, BOTH)),
    EdgeCase("box", "beam", spp=512, reference_spp=8192, options=LIGHT),
    EdgeCase("box", "beam", 3, spp=512, reference_spp=8192, options=BOTH),
    *(EdgeCase("flat", lamp, spp=512) for lamp in ("sphere_lamp", "directional")),
    EdgeCase("flat", "point", spp=512, step=SMALLER),
    *(EdgeCase("sphere", lamp) for lamp in ("area", "sphere_lamp", "spot")),
    # Without round shapes at rest, on which the light of a moving lamp has noisy derivatives.
    *(EdgeCase("behind", lamp, lamp_moves=True, spp=1024, step=SMALLER) for lamp in ("point", "sphere_lamp")),
    EdgeCase("hidden", "directional", motion=("turn",), lamp_moves=True, spp=1024, step=SMALLER),
    EdgeCase("box", "room", 3, lamp_moves=True, spp=1024, reference_spp=8192),
    *(EdgeCase("cylinder", lamp, spp=2048) for lamp in ("area", "sphere_lamp")), EdgeCase("box", "room", 3, spp=1024),
    *(EdgeCase("smooth", lamp, 3, spp=2048, reference_spp=8192, options=CAMERA) for lamp in ("area", "constant")),
]  # fmt: skip


def main() -> None:
    """Write the finite differences."""
    mi.set_variant("llvm_ad_rgb")
    values = json.loads(VALUES.read_text()) if VALUES.exists() else {}
    for case in RECORDED:
        if not sys.argv[1:] or case.name in sys.argv[1:]:
            values[case.name] = np.round(case.differences(case.reference_seeds), 4).tolist()
            rows = (f'"{name}": {json.dumps(rows)}' for name, rows in sorted(values.items()))
            VALUES.write_text("{\n" + ",\n".join(rows) + "\n}\n")


if __name__ == "__main__":
    main()
