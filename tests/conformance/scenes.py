"""Small scenes for the conformance tests. A stage has a floor, a wall and an object, and any emitter can light it.

y is up. The camera stands in front of the stage and looks slightly down on it. The camera sees the floor, the wall, the
object and, above them, the background behind the stage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np
from agreement import Agreement, compare

import reslrb_cli
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.step import render_image
from reslrb_cli.measure.scenes.small import texels

#: Largest allowed relative difference between images from the same random numbers.
SAME = 3e-4
#: Share of the samples that `agreement` takes. The share is smaller for tests that use `samples` (conftest.py).
SHARE = 1.0
WHITE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.7, 0.6]}}
RED = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.2]}}


def transform() -> Any:
    """Return an identity transformation, from which others are built."""
    return mi.ScalarTransform4f()


def rgb(*value: float) -> dict[str, Any]:
    """Return a colour."""
    return {"type": "rgb", "value": list(value)}


def bitmap(width: int, height: int, seed: int = 1, low: float = 0.1, high: float = 1.0, channels: int = 3) -> Any:
    """Return a random texture."""
    data = np.random.default_rng(seed).uniform(low, high, (height, width, channels)).astype(np.float32)
    return {"type": "bitmap", **texels(data)}


def camera(width: int = 32, height: int = 24, rfilter: str = "box", film: dict[str, Any] | None = None,
           **changes: Any) -> dict[str, Any]:  # fmt: skip
    """Return a camera in front of the stage. `changes` replace its entries."""
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
    """Return a camera that looks straight down on the floor in front of the ball. Of the ball, the camera sees only the
    light that the ball throws there.
    """
    to_world = transform().look_at(origin=[0, 1.5, 1.2], target=[0, 0, 1.2], up=[0, 0, -1])
    return camera(to_world=to_world, fov=40) | changes


def rectangle(bsdf: Any, to_world: Any, **changes: Any) -> dict[str, Any]:
    """Return a square of side 2. It faces +z before `to_world` is applied."""
    return {"type": "rectangle", "bsdf": bsdf, "to_world": to_world} | changes


def ball(bsdf: Any, center: Any = (0, 0.7, 0), radius: float = 0.5) -> dict[str, Any]:
    """Return a sphere above the floor."""
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf}


def lamp(side: float = 0.5, position: Any = (0.5, 1.9, 0.6), target: Any = (0, 0, 0), **emitter: Any) -> dict[str, Any]:
    """Return a square area light that looks at the stage. The light is outside the camera's view unless `position`
    places it in the view.
    """
    emitter = {"type": "area", "radiance": rgb(8, 7, 6)} | emitter
    to_world = transform().look_at(origin=list(position), target=list(target), up=[0.1, 0.9, 0.2])
    return rectangle(WHITE, to_world @ transform().scale(side / 2), emitter=emitter)


def stage(emitters: dict[str, Any] | None = None, sensor: Any = None, **things: Any) -> Any:
    """Return the scene with a floor and a wall. A white ball is present unless `ball` replaces it or is None. A lamp is
    present unless `emitters` is given.
    """
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
    """Return an integrator as Mitsuba's users load it. Roulette is off by default, and `reslrb` has no automatic
    settings.
    """
    reslrb_cli.register()
    return mi.load_dict({"type": name, "max_depth": max_depth, "rr_depth": rr_depth, **_plain(name), **options})


def _plain(name: str) -> dict[str, str]:
    """Return the estimator for tests that name none. Without it, the settings of `reslrb` would be automatic."""
    return {"estimator": "reservoir"} if name == "reslrb" else {}


def images(scene: Any, integrator: str, seeds: range, spp: int, sensor: int = 0, **options: Any) -> np.ndarray:
    """Return images rendered with each of the `seeds`, with shape (N, H, W, C)."""
    renderer = make_integrator(integrator, **(_plain(integrator) | options))
    return np.stack([np.array(render_image(renderer, scene, sensor, s, spp), np.float64) for s in seeds])


def agreement(scene: Any, reference: str = "path", *, spp: int = 256, seeds: int = 8, border: int = 0,
              reslrb: dict[str, Any] | None = None, **options: Any) -> Agreement:  # fmt: skip
    """Compare the image of `reslrb` with the image of `reference`, from independent seeds.

    `options` go to both integrators. The defaults are max_depth 5 and no roulette. The options `reslrb` go to our
    integrator alone. The comparison leaves out a `border` of this many pixels. It also leaves out alpha, for which
    light tracing gives no result.
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
    """Return the mean absolute difference from `ptracer`'s image with the same random numbers, divided by that image's
    mean.

    The difference is not exactly zero. `ptracer` takes the direction of its shadow ray from a point slightly off the
    surface.
    """
    options = {"max_depth": 6, "rr_depth": 3, "hide_emitters": True} | options
    if mi.is_spectral:
        options["rr_depth"] = 100  # our roulette weighs wavelengths as the film sees them
    ours = images(scene, "reslrb", range(2), spp, **options, **(reslrb or {}))
    theirs = images(scene, "ptracer", range(2), spp, **options)
    assert theirs.mean() > 1e-3, "no pixel to compare"
    colors = 3 if ours.shape[-1] >= 3 else 1
    return float(np.abs(ours - theirs)[..., :colors].mean() / theirs[..., :colors].mean())


@dataclass(frozen=True)
class ImageCase:
    """A scene whose image is compared with the image of `path`, and with `ptracer` at equal seeds if `stock`.

    `options` go to both integrators. The comparison with `path` takes `spp` samples, and leaves out a `border` of this
    many pixels.
    """

    name: str
    scene: Callable[[], Any]
    stock: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    spp: int = 256
    border: int = 0

    def check(self) -> None:
        """Assert that all images agree."""
        scene = self.scene()
        result = agreement(scene, spp=self.spp, border=self.border, **self.options)
        assert result, result
        if self.stock:
            assert difference_from_ptracer(scene, **self.options) < SAME
