"""Scenes in which something moves light, and their differentiated parameters, for test_attached.py and
test_moving_*.py.

Light starts in parallel or in a cone. It passes through glass or is reflected by a mirror, and reaches a receiver. A
camera looks down on the receiver. y is up. The camera sees only the receiver, and no emitter.
"""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.integrators.protocol import StepIntegrator
from reslrb_cli.measure.gradients import Case, embed
from reslrb_cli.measure.scenes.analytic import DOWN, UP
from reslrb_cli.measure.scenes.moving import Place, Placement, grid, mesh, waves
from reslrb_cli.measure.scenes.small import camera as room_camera
from reslrb_cli.measure.scenes.small import diffuse, glass, lit_square, load, look_at, rectangle, rgb, sphere, texture

SIZE = 32


class Moving:
    """Scene whose parameters are a function of `start` (`Placement`)."""

    def __init__(self, scene: dict[str, Any], start: dict[str, Any], place: Place | None = None, sensor: int = 0):
        self.loaded = load(scene)
        self.case = Case(self.loaded, start, sensor, Placement(self.loaded, start, place))
        self.start, self.params = self.case.initial, self.case.params
        self.weigh, self.set = self.case.weigh, self.case.set

    def gradient(self, integrator: StepIntegrator, seed: int = 1, spp: int = 16) -> dict[str, np.ndarray]:
        """Return the derivative of sum(image * weights) with respect to each latent, from one step at the start. The
        image of the step is `image`.
        """

        def step(*arguments: Any, **options: Any) -> None:
            self.image = np.array(self.case.known_step(*arguments, **options).image, np.float64)

        leaves = self.case.leaves(self.start)
        flat = self.case.gradient_of(leaves, integrator, seed, spp, step=step)
        self.case.release(leaves)
        return {name: flat[at] for name, at in self.case.places.items()}

    def value(self, integrator: StepIntegrator, seed: int, spp: int, **shifts: float) -> float:
        """Return the objective, with some of the latents shifted."""
        self.set({name: value + shifts.get(name, 0.0) for name, value in self.start.items()})
        return self.case.weighted(self.case.image(integrator, seed, spp))

    def difference(self, integrator: StepIntegrator, name: str, step: float, seed: int = 1, spp: int = 16) -> float:
        """Return the central difference for one latent, at common random numbers. The difference is of fourth order,
        from two step sizes.
        """
        along = embed(self.case, name, np.ones(1))
        near, far = (self.case.difference(integrator, along, seed, spp, h) for h in (step, 2 * step))
        return (4 * near - far) / 3


# ---- Things ----


def rippled(y: float, cells: int, ripples: float = 1.0, side: float = 1.0) -> tuple[np.ndarray, ...]:
    """Return the vertices (N, 3), faces and texture coordinates of a `sheet`."""
    return grid(cells, lambda x, z: y + ripples * waves(x / side, z / side), side)


def sheet(name: str, bsdf: dict[str, Any], y: float, cells: int = 12, ripples: float = 1.0, side: float = 1.0,
          **things: Any) -> mi.Mesh:  # fmt: skip
    """Return a horizontal mesh that faces up. The mesh is a rippled square of `cells` x `cells`, with interpolated
    normals and texture coordinates. `things` are added to its dictionary, for example an emitter.
    """
    positions, faces, uv = rippled(y, cells, ripples, side)
    return mesh(positions, faces, bsdf, uv, True, name, **things)


def camera(rfilter: str = "gaussian", size: int = SIZE, sensor: str = "perspective", **film: Any) -> dict[str, Any]:
    """Return a camera that looks down on the receiver."""
    lens = {"focus_distance": 1.2} if sensor == "thinlens" else {}
    above = {"fov": 90, "to_world": look_at([0, 1, 0], [0, 0, 0], [0, 0, -1])}
    return room_camera(rfilter, size, sensor, **film) | above | lens


def flat(bsdf: dict[str, Any], y: float = 0.0, scale: float = 1.0, **things: Any) -> dict[str, Any]:
    """Return a rectangle that faces up."""
    return rectangle(bsdf, translate=[0, y, 0], rotate=UP, scale=scale) | things


def beam(scale: float = 0.8, y: float = 3.0) -> dict[str, Any]:
    """Return an emitter of parallel light that shines straight down."""
    lamp = lit_square(rgb(3.2, 3.0, 2.6), None, "directionalarea", translate=[0, y, 0], rotate=DOWN, scale=scale)
    return {key: value for key, value in lamp.items() if key != "bsdf"}


GLASS = glass()
WHITE = diffuse(0.8, 0.7, 0.6)


def under_glass(bsdf: dict[str, Any] | None = None, cells: int = 12, **changes: Any) -> dict[str, Any]:
    """Return a scene in which parallel light passes through a slab onto the receiver. The slab is flat above and
    rippled below (`slab`).

    `changes` replace or add objects. The value None removes an object.
    """
    bsdf = bsdf or GLASS
    scene = {
        "type": "scene",
        "camera": camera(),
        "receiver": flat(WHITE),
        # Light comes from inside of the glass: its outside is below.
        "top": flat(bsdf, 2.2),
        "slab": sheet("slab", bsdf, 2.0, cells),
        "lamp": beam(),
    } | changes
    return {key: value for key, value in scene.items() if value is not None}


def textured() -> dict[str, Any]:
    """Return a receiver with its own texture, `receiver.bsdf.reflectance.data`."""
    return flat(diffuse(texture(4, 4)))


def enclosed(bsdf: dict[str, Any] | None = None, albedo: float = 0.7, **changes: Any) -> dict[str, Any]:
    """Return the scene of `under_glass` inside a sphere, where light continues after it has met the receiver."""
    shell = sphere(diffuse(albedo, 0.9 * albedo, albedo), [0, 1.3, 0], 2.0) | {"flip_normals": True}
    return under_glass(bsdf, shell=shell, **changes)


def turned(angle: Any, axis: Any, shift: list[Any]) -> Any:
    """Return a rotation by `angle` (degrees), followed by a translation. The result follows the derivatives of `angle`
    and `shift`.
    """
    return mi.AffineTransform4f().translate(mi.Vector3f(*shift)) @ mi.AffineTransform4f().rotate(axis, angle)
