"""Moving shapes and lamps of the kinds that Mitsuba's own tests have, against finite differences, beside
`prb_projective`.

`test_against_mitsuba` prints one row per scene. docs/geometry.md has its table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conformance.edge_cases import ball, split_box
from conformance.moving import Moving
from scipy import stats

from reslrb_cli.measure.comparison import Deviation
from reslrb_cli.measure.gradients import integrator, seeds, smooth_weights
from reslrb_cli.measure.scenes.moving import Latents, mesh
from reslrb_cli.measure.scenes.small import bitmap, diffuse, look_at, rgb, transform

pytestmark = [pytest.mark.usefixtures("llvm"), pytest.mark.long]
SIZE = 32
#: Largest |z| of a row, and largest standard error relative to the derivative.
LIMIT, RESOLUTION = 4.0, 0.2
#: The case in which nothing changes.
CONSTANT = "sheet in an environment"
WHITE, GREY = diffuse(0.8, 0.8, 0.8), diffuse(0.5, 0.5, 0.5)
SKY = {"type": "constant"}
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)


@dataclass(frozen=True)
class Translation:
    """Scene in which the objects `moved` move by theta along `along`, or grow by theta if `along` is None.

    `paths` are the kinds of paths of `reslrb`. `edges` is `off` if the image has no edges that move. The camera has a
    field of view of `fov` degrees and stands at `eye`.
    """

    name: str
    objects: Callable[[], dict[str, Any]]
    moved: tuple[str, ...]
    along: tuple[float, float, float] | None = (1, 0, 0)
    paths: str = "camera"
    depth: int = 2
    fov: float = 40
    eye: float = 4.0
    spp: int = 256
    step: float = 0.03
    edges: str = "on"

    def moving(self) -> Moving:
        """Load the scene."""
        first: dict[str, Any] = {}

        def place(params: mi.SceneParameters, latents: Latents) -> None:
            theta = latents["theta"]
            for name in self.moved:
                key = next(f"{name}.{part}" for part in ("to_world", "vertex_positions") if f"{name}.{part}" in params)
                start = first.setdefault(key, type(params[key])(params[key]))
                if self.along is None:
                    params[key] = start * (1 + theta)
                    continue
                shift = mi.Vector3f(*self.along) * theta
                if key.endswith("to_world"):
                    params[key] = mi.AffineTransform4f().translate(shift) @ mi.AffineTransform4f(start.matrix)
                else:
                    params[key] = dr.ravel(dr.unravel(mi.Point3f, start) + shift)

        film = {
            "type": "hdrfilm",
            "width": SIZE,
            "height": SIZE,
            "pixel_format": "rgb",
            "rfilter": {"type": "gaussian"},
        }
        camera = {"type": "perspective", "fov": self.fov, "film": film, "sampler": {"type": "independent"},
                  "to_world": look_at([0, 0, self.eye], [0, 0, 0], [0, 1, 0]), "near_clip": 0.01}  # fmt: skip
        moving = Moving({"type": "scene", "camera": camera} | self.objects(), {"theta": 0.0}, place)
        moving.weigh(smooth_weights(SIZE, SIZE))
        return moving


def _square(to_world: Any, bsdf: dict[str, Any] = GREY, **things: Any) -> mi.Mesh:
    """Return a square of two triangles, of side 2 before `to_world`, with texture coordinates."""
    matrix, texcoords = np.array(to_world.matrix), np.array([0, 0, 1, 0, 1, 1, 0, 1])
    positions = SQUARE @ matrix[:3, :3].T + matrix[:3, 3]
    return mesh(positions, np.array([[0, 1, 2], [0, 2, 3]]), bsdf, texcoords, name="square", **things)


def _ball(x: float, y: float, z: float, radius: float, bsdf: dict[str, Any] = GREY, **things: Any) -> mi.Mesh:
    """Return a ball of flat faces."""
    positions, faces = ball((x, y, z), radius, 10, 16)
    return mesh(positions, faces, bsdf, **things)


def _light(value: float | dict[str, Any]) -> dict[str, Any]:
    return {"type": "area", "radiance": value if isinstance(value, dict) else rgb(value, value, value)}


def _spots(border: float = 0.0) -> np.ndarray:
    """Return texels of a smooth pattern. With a `border`, texels near the border are black."""
    y, x = np.mgrid[0:32, 0:32] / 31
    value = np.stack([0.5 + 0.4 * np.sin(9 * x + k) * np.cos(7 * y - k) for k in range(3)], -1)
    edge = np.minimum.reduce([x, 1 - x, y, 1 - y])
    return value * (np.clip(edge / border - 0.2, 0, 1)[:, :, None] if border else 1)


def _shown(border: float = 0.0) -> dict[str, Any]:
    return bitmap(_spots(border), "bilinear")


def _tilted(**things: Any) -> mi.Mesh:
    return _square(transform(rotate=([1, 0, 0], 45)), **things)


def _textured_lamp() -> mi.Mesh:
    """Return a large lamp below the view, with a black border."""
    return _square(transform(translate=[0, -1.5, 0], rotate=([1, 0, 0], -90), scale=4), emitter=_light(_shown(0.2)))


def _shadow(receiver: Any, occluder: Any) -> dict[str, Any]:
    """Return a wall, an occluder outside of the view, and a small bright lamp behind it."""
    return {"plane": receiver, "occluder": occluder,
            "light": _ball(4, 0, 4, 0.05, emitter=_light(1000))}  # fmt: skip


def _wall() -> dict[str, Any]:
    return {"type": "rectangle", "bsdf": GREY}


def _right_angle() -> dict[str, Any]:
    """Return a wall and a floor that meet in an edge, and a lamp above and behind the wall."""
    return {
        "wall": _square(transform(translate=[0, 0, -1]), diffuse(0.1, 0.1, 0.4)),
        "floor": _square(transform(translate=[0, -1, -1], rotate=([1, 0, 0], -90)), diffuse(0.4, 0.1, 0.1)),
        "light": {"type": "rectangle", "to_world": transform(translate=[0, 8, -4], scale=[2, 0.5, 1]),
                  "emitter": _light(1)},
    }  # fmt: skip


def _rough_sheets() -> dict[str, Any]:
    glass = {"type": "roughdielectric", "distribution": "beckmann", "alpha": 0.8, "int_ior": 1.001, "ext_ior": 1.1}
    sheets = {name: _square(transform(translate=[0, 0, z], scale=4), glass)
              for name, z in (("front", 1), ("shape", 0), ("back", -1))}  # fmt: skip
    return {**sheets, "light": _square(transform(translate=[0, 0, -2], scale=0.7), emitter=_light(_shown()))}


def _standing(shape: Any) -> dict[str, Any]:
    """Return a shape before a wall, and a lamp that lights both from the side."""
    return {"plane": {"type": "rectangle", "bsdf": WHITE, "to_world": transform(translate=[0, 0, -0.5], scale=2)},
            "shape": shape,
            "light": _square(look_at([2, 1, 3], [0, 0, 0]) @ transform(scale=0.3), emitter=_light(20))}  # fmt: skip


def _welded_box() -> mi.Mesh:
    positions, faces = split_box((0, 0, 0), (0.4, 0.3, 0.35))
    corners, index = np.unique(np.round(positions, 6), axis=0, return_inverse=True)
    return mesh(corners, index.reshape(-1)[faces], GREY)


def _under_projector() -> dict[str, Any]:
    light = {"type": "projector", "irradiance": _shown(), "to_world": look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
             "fov": 60}  # fmt: skip
    return {"plane": _square(transform(scale=3)), "light": light}


def _in_environment() -> dict[str, Any]:
    light = {"type": "envmap", "bitmap": mi.Bitmap(_spots().astype(np.float32))}
    return {"plane": _square(transform(scale=3)), "light": light}


def _sheet_and_lamp() -> dict[str, Any]:
    return {
        "plane": _square(transform(translate=[0, 0, -0.5], rotate=([1, 0, 0], -45), scale=0.4)),
        "light": _square(transform(translate=[0, 2, 0], rotate=([1, 0, 0], 90), scale=0.75), emitter=_light(5)),
    }


def _disk_lamp() -> dict[str, Any]:
    place = transform(translate=[0.2, 0, 0], rotate=([0, 1, 0], 60), scale=0.8)
    return {"disk": {"type": "disk", "to_world": place, "emitter": _light(2)}, "light": SKY | {"radiance": 0.2}}


def _plain(kind: str, **options: Any) -> dict[str, Any]:
    return {"type": kind, "bsdf": GREY, **options}


Z = (0, 0, 1)
CASES = [
    Translation("sheet before a sky", lambda: {"shape": _square(transform()), "light": SKY}, ("shape",)),
    Translation("textured sheet", lambda: {
        "plane": _square(transform(scale=2), {"type": "diffuse", "reflectance": _shown()}), "light": SKY},
        ("plane",), edges="off"),
    Translation(CONSTANT, _in_environment, ("plane",), Z, edges="off"),
    Translation("sheet below a projector", _under_projector, ("plane",), Z, step=0.01, edges="off"),
    Translation("sheet of rough glass", _rough_sheets, ("shape",), Z, "light", 4, eye=2, spp=2048, edges="off"),
    Translation("textured lamp in view", lambda: {"plane": _tilted(emitter=_light(_shown(0.2)))}, ("plane",), Z,
                "light", edges="off"),
    Translation("sheet over a textured lamp", lambda: {"plane": _tilted(), "light": _textured_lamp()}, ("plane",), Z,
                fov=18, edges="off"),
    Translation("textured lamp below a sheet", lambda: {"plane": _tilted(), "light": _textured_lamp()}, ("light",), Z,
                "light", fov=18, spp=4096, edges="off"),
    Translation("square lamp", lambda: {"light": _square(transform(translate=[0.6, 0, 0]), emitter=_light(1))},
                ("light",), paths="light", step=0.01),
    Translation("disk as a lamp", _disk_lamp, ("disk",), paths="light"),
    Translation("ball as a lamp", lambda: {"light": _ball(0.6, 0, 0, 0.7, emitter=_light(1))}, ("light",),
                paths="light"),
    Translation("ball as a lamp, growing", lambda: {"light": _ball(0, 0, 0, 0.9, emitter=_light(1))}, ("light",), None,
                "light"),
    Translation("shadow of a ball", lambda: _shadow(_wall(), _ball(2, 0, 2, 0.25)), ("occluder",), step=0.02),
    Translation("shadow of a `sphere`", lambda: _shadow(_wall(), _plain("sphere", center=[2, 0, 2], radius=0.25)),
                ("occluder",), step=0.02),
    Translation("receiver of a shadow", lambda: _shadow(_square(transform()), _ball(2, 0, 2, 0.25)), ("plane",),
                step=0.02),
    Translation("sheet and lamp together", _sheet_and_lamp, ("plane", "light"), Z, "light"),
    Translation("two sheets at a right angle", _right_angle, ("wall", "floor"), Z, fov=87, eye=1),
    Translation("`sphere` before a wall", lambda: _standing(_plain("sphere", center=[0, 0, 0.1], radius=0.4)),
                ("shape",)),
    Translation("box before a wall", lambda: _standing(_welded_box()), ("shape",)),
    Translation("`cube` before a wall", lambda: _standing(
        _plain("cube", to_world=transform(rotate=([0, 0, 1], 23), scale=[0.4, 0.3, 0.35]))), ("shape",)),
    Translation("turned `rectangle` before a sky", lambda: {"light": SKY, "shape": _plain(
        "rectangle", to_world=transform(rotate=([0, 0, 1], 45), scale=[0.9, 0.3, 1]))}, ("shape",)),
]  # fmt: skip


def _summary(samples: np.ndarray) -> str:
    return f"{samples.mean():.4g} ± {stats.sem(samples):.2g}"


def _z(samples: np.ndarray, reference: np.ndarray) -> float:
    """Return the difference of the means in standard errors."""
    return float(Deviation.of(samples, reference, 1e-5).z())


def _samples(case: Translation, count: int = 8) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return finite differences, derivatives by `reslrb`, and derivatives by `prb_projective`, each at `count` seeds.
    Both derivatives have the same number of samples per pixel.
    """
    moving, path = case.moving(), integrator("path", case.depth)

    def difference(seed: int) -> float:
        ends = (moving.value(path, seed, 2048, theta=step) for step in (case.step, -case.step))
        return float(np.subtract(*ends) / (2 * case.step))

    ours = integrator("reslrb", case.depth, estimator="stack", edges=case.edges, paths=case.paths)
    theirs = integrator("prb_projective", case.depth, guiding="none")
    differences = np.array([difference(seed) for seed in seeds(count, 1)])
    found = [
        np.array([moving.gradient(each, seed, case.spp)["theta"][0] for seed in seeds(count)])
        for each in (ours, theirs)
    ]  # fmt: skip
    return differences, *found


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_against_mitsuba(case: Translation) -> None:
    """`reslrb` agrees with finite differences of images by `path`."""
    reference, ours, theirs = _samples(case)
    row = [case.name, _summary(reference), case.paths]
    for found in (ours, theirs):
        row += [_summary(found), f"{_z(found, reference):+.1f}"]
    print("\n| " + " | ".join(row) + " |")
    assert abs(_z(ours, reference)) < LIMIT
    if case.name != CONSTANT:
        assert np.hypot(stats.sem(ours), stats.sem(reference)) < RESOLUTION * abs(reference.mean())
