"""Small scenes for the conformance tests: a stage (floor, wall, an object) that any emitter can light.

y is up. The camera stands in front of the stage, looks slightly down on it, and sees floor, wall, object, and, above,
what is behind the stage.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from agreement import Agreement, compare

import reslrb_cli
from reslrb_cli.integrators.step import make_integrator, render_image

#: Largest relative difference between images of the same random numbers.
SAME = 3e-4
#: How much of its samples `agreement` takes; less for the tests that use `samples` (conftest.py).
SHARE = 1.0
WHITE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.6]}}
RED = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.2]}}


def transform() -> Any:
    """An identity transformation to build on."""
    return mi.ScalarTransform4f()


def rgb(*value: float) -> dict[str, Any]:
    """A colour."""
    return {"type": "rgb", "value": list(value)}


def bitmap(width: int, height: int, seed: int = 1, low: float = 0.1, high: float = 1.0, channels: int = 3) -> Any:
    """A random texture."""
    data = np.random.default_rng(seed).uniform(low, high, (height, width, channels)).astype(np.float32)
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(data)}


def camera(width: int = 32, height: int = 24, rfilter: str = "box", film: dict[str, Any] | None = None,
           **changes: Any) -> dict[str, Any]:  # fmt: skip
    """A camera in front of the stage; `changes` replaces its entries."""
    result = {
        "type": "perspective",
        "fov": 50,
        "to_world": transform().look_at(origin=[0.4, 1.5, 4], target=[0, 0.7, 0], up=[0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgb",
            "rfilter": {"type": rfilter},
        }
        | (film or {}),
    }
    return result | changes


def floor_camera(**changes: Any) -> dict[str, Any]:
    """A camera that looks straight down on the floor before the ball: it sees what the ball throws there alone."""
    to_world = transform().look_at(origin=[0, 1.5, 1.2], target=[0, 0, 1.2], up=[0, 0, -1])
    return camera(to_world=to_world, fov=40) | changes


def rectangle(bsdf: Any, to_world: Any, **changes: Any) -> dict[str, Any]:
    """A square of side 2, facing +z before `to_world`."""
    return {"type": "rectangle", "bsdf": bsdf, "to_world": to_world} | changes


def ball(bsdf: Any, center: Any = (0, 0.7, 0), radius: float = 0.5) -> dict[str, Any]:
    """A sphere above the floor."""
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf}


def lamp(side: float = 0.5, position: Any = (0.5, 1.9, 0.6), target: Any = (0, 0, 0), **emitter: Any) -> dict[str, Any]:
    """A square area light that looks at the stage, out of the camera's view unless `position` puts it there."""
    emitter = {"type": "area", "radiance": rgb(8, 7, 6)} | emitter
    to_world = transform().look_at(origin=list(position), target=list(target), up=[0.1, 0.9, 0.2])
    return rectangle(WHITE, to_world @ transform().scale(side / 2), emitter=emitter)


def stage(emitters: dict[str, Any] | None = None, sensor: Any = None, **things: Any) -> Any:
    """The scene: floor and wall, a white ball unless `ball` replaces it (None: none), a lamp unless `emitters`."""
    flat = transform().rotate([1, 0, 0], -90) @ transform().scale(2)
    scene = {
        "type": "scene",
        "sensor": sensor or camera(),
        "floor": rectangle(WHITE, flat),
        "wall": rectangle(RED, transform().translate([0, 1, -1.5]) @ transform().scale([2, 1, 1])),
        "ball": ball(WHITE),
        **({"lamp": lamp()} if emitters is None else emitters),
    }
    scene.update(things)
    return mi.load_dict({key: value for key, value in scene.items() if value is not None}, optimize=False)


def plugin(name: str, max_depth: int = 4, rr_depth: int = 1000, **options: Any) -> Any:
    """An integrator as Mitsuba's users get it, without roulette unless asked for."""
    reslrb_cli.register()
    return mi.load_dict({"type": name, "max_depth": max_depth, "rr_depth": rr_depth, **options})


def images(scene: Any, integrator: str, seeds: range, spp: int, sensor: int = 0, **options: Any) -> np.ndarray:
    """Renders with each of `seeds`, (N, H, W, C)."""
    renderer = make_integrator(integrator, **options)
    return np.stack([np.array(render_image(renderer, scene, sensor, s, spp), np.float64) for s in seeds])


def agreement(scene: Any, reference: str = "path", *, spp: int = 256, seeds: int = 8, border: int = 0,
              reslrb: dict[str, Any] | None = None, **options: Any) -> Agreement:  # fmt: skip
    """`reslrb`'s image against `reference`'s, from independent seeds.

    `options` go to both integrators (max_depth 5 and no roulette unless they say otherwise), `reslrb` to ours alone;
    a `border` of so many pixels is left out, and so is alpha, where light tracing has nothing to say.
    """
    options = {"max_depth": 5, "rr_depth": 100} | options
    spp = round(SHARE * spp)
    ours = images(scene, "reslrb", range(seeds), spp, **options, **(reslrb or {}))
    theirs = images(scene, reference, range(1000, 1000 + seeds), spp, **options)
    inner = slice(border, -border or None)
    colors = 3 if ours.shape[-1] >= 3 else 1
    return compare(ours[:, inner, inner, :colors], theirs[:, inner, inner, :colors])


def difference_from_ptracer(
    scene: Any, *, spp: int = 16, reslrb: dict[str, Any] | None = None, **options: Any
) -> float:
    """Mean absolute difference from `ptracer`'s image of the same random numbers, over its mean.

    Not exactly zero, since `ptracer` takes the direction of its shadow ray from a point a little off the surface.
    """
    options = {"max_depth": 6, "rr_depth": 3, "hide_emitters": True} | options
    ours = images(scene, "reslrb", range(2), spp, **options, **(reslrb or {}))
    theirs = images(scene, "ptracer", range(2), spp, **options)
    assert theirs.mean() > 1e-3, "no pixel to compare"
    colors = 3 if ours.shape[-1] >= 3 else 1
    return float(np.abs(ours - theirs)[..., :colors].mean() / theirs[..., :colors].mean())
