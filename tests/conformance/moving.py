"""Scenes in which something moves light, and their differentiated parameters, for test_attached.py and
test_moving_*.py.

Light starts in parallel or in a cone. It passes through glass or is reflected by a mirror, and reaches a receiver. A
camera looks down on the receiver. y is up. The camera sees only the receiver, and no emitter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.integrators.protocol import StepIntegrator
from reslrb_cli.integrators.step import known_step, render_image
from reslrb_cli.measure.scenes.small import diffuse, load, rgb, texture, transform

SIZE = 32
#: Amplitude, wave vector and phase of each wave. The slopes bend light but do not fold it.
WAVES = ((0.0135, (5.1, 2.3), 0.4), (0.012, (-3.7, 5.9), 1.9), (0.0062, (7.9, -4.6), 4.1), (0.0055, (2.2, -8.8), 2.7))

#: Numbers, or arrays of numbers, with respect to which a case is differentiated.
Latents = dict[str, Any]
Place = Callable[[mi.SceneParameters, Latents], None]


@dataclass
class Moving:
    """Scene whose parameters are a function of `start`, which has a number or a row of numbers for each name.

    If a name is a key of the scene, its value is set directly. If `start` has None for this name, the scene's own value
    is the start. `place(params, latents)` gets all other values as Dr.Jit arrays. It sets parameters of the scene,
    which follow the derivatives of these values.
    """

    scene: dict[str, Any]
    start: dict[str, Any]
    place: Place | None = None
    sensor: int = 0
    seed: int = 7
    loaded: mi.Scene = field(init=False)
    params: mi.SceneParameters = field(init=False)
    weights: mi.TensorXf = field(init=False)
    image: np.ndarray = field(init=False)  # image of the last step

    def __post_init__(self) -> None:
        self.loaded = load(self.scene)
        self.params = mi.traverse(self.loaded)
        self.start = {
            name: np.array(self.params[name], np.float64).ravel() if value is None else np.float64(value)
            for name, value in self.start.items()
        }
        film = self.loaded.sensors()[self.sensor].film()
        width, height = film.crop_size()
        shape = (int(height), int(width), int(film.base_channels_count()))
        self.weigh(np.random.default_rng(self.seed).uniform(0.2, 1.8, shape))

    def weigh(self, weights: np.ndarray) -> None:
        """Set dL/dI, with shape (H, W, C)."""
        self.weights = mi.TensorXf(np.ascontiguousarray(weights, np.float32)) + dr.opaque(mi.Float, 0)
        dr.make_opaque(self.weights)

    def set(self, latents: Latents) -> None:
        """Set the scene's parameters to the values of the latents."""
        for key in latents.keys() & self.params.properties.keys():
            self.params[key] = _as(self.params[key], latents[key])
        if self.place is not None:
            self.place(self.params, {name: value for name, value in latents.items() if name not in self.params})
        self.params.update()

    def gradient(self, integrator: StepIntegrator, seed: int = 1, spp: int = 16) -> dict[str, np.ndarray]:
        """Return the derivative of sum(image * weights) with respect to each latent, from one step."""
        leaves = {name: _leaf(value) for name, value in self.start.items()}
        dr.enable_grad(list(leaves.values()))
        # Pass copies, because a parameter may be the same object as a latent, and `update` may replace the parameter.
        self.set({name: type(leaf)(leaf) for name, leaf in leaves.items()})
        step = known_step(integrator, self.loaded, self.sensor, self.weights, seed=seed, spp=spp, params=self.params)
        self.image = np.array(step.image, np.float64)
        result = {name: np.array(dr.grad(leaf), np.float64).ravel() for name, leaf in leaves.items()}
        self.set({name: dr.detach(leaf) for name, leaf in leaves.items()})
        return result

    def value(self, integrator: StepIntegrator, seed: int, spp: int, **shifts: float) -> float:
        """Return the objective, with some of the latents shifted."""
        self.set({name: _leaf(value + shifts.get(name, 0.0)) for name, value in self.start.items()})
        image = np.array(render_image(integrator, self.loaded, self.sensor, seed, spp), np.float64)
        return float(np.sum(image * np.array(self.weights, np.float64)))

    def difference(self, integrator: StepIntegrator, name: str, step: float, seed: int = 1, spp: int = 16) -> float:
        """Return the central difference for one latent, at common random numbers. The difference is of fourth order,
        from two step sizes.
        """
        near, far = (
            (self.value(integrator, seed, spp, **{name: h}) - self.value(integrator, seed, spp, **{name: -h})) / (2 * h)
            for h in (step, 2 * step)
        )
        self.set({key: _leaf(value) for key, value in self.start.items()})
        return (4 * near - far) / 3


def _leaf(value: Any) -> mi.Float:
    """Return a number or a row as an array in its own memory. With NumPy's memory, kernels would depend on the
    alignment of this memory.
    """
    leaf = mi.Float(np.atleast_1d(np.asarray(value, np.float32))) + dr.opaque(mi.Float, 0)
    dr.make_opaque(leaf)
    return leaf


def _as(current: Any, value: mi.Float) -> Any:
    """Return a row as the type of the parameter's current value."""
    if dr.is_tensor_v(current):
        return type(current)(value, current.shape)
    return dr.unravel(type(current), value, order="C") if dr.depth_v(current) > 1 else value


# ---- Things ----


def height(x: Any, z: Any) -> Any:
    """Return the height of a rippled surface."""
    return sum(a * np.sin(kx * x + kz * z + phase) for a, (kx, kz), phase in WAVES)


def rippled(y: float, cells: int, ripples: float = 1.0, side: float = 1.0) -> np.ndarray:
    """Return the vertices of a `sheet`, with shape (N, 3)."""
    axis = np.linspace(-1, 1, cells + 1)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([side * x, y + ripples * height(x, z), side * z], -1).reshape(-1, 3)


def mesh(
    positions: np.ndarray,
    faces: np.ndarray,
    bsdf: dict[str, Any],
    name: str = "shape",
    normals: np.ndarray | bool = False,
    texcoords: np.ndarray | None = None,
    **things: Any,
) -> mi.Mesh:
    """Return a mesh with flat faces, or with the given `normals`. If `normals` is true, Mitsuba interpolates them.
    `things` are added to the mesh's dictionary, for example an emitter.
    """
    properties = mi.Properties()
    for key, thing in {"bsdf": bsdf, **things}.items():
        properties[key] = mi.load_dict(thing)
    made = mi.Mesh(name, len(positions), len(faces), properties, has_vertex_normals=normals is not False,
                   has_vertex_texcoords=texcoords is not None)  # fmt: skip
    params = mi.traverse(made)
    for part, value in (("positions", positions), ("normals", normals), ("texcoords", texcoords)):
        if isinstance(value, np.ndarray):
            params[f"vertex_{part}"] = value.astype(np.float32).ravel()
    params["faces"] = np.asarray(faces, np.uint32).ravel()
    params.update()
    return made


def sheet(name: str, bsdf: dict[str, Any], y: float, cells: int = 12, ripples: float = 1.0, side: float = 1.0,
          **things: Any) -> mi.Mesh:  # fmt: skip
    """Return a horizontal mesh that faces up. The mesh is a rippled square of `cells` x `cells`, with interpolated
    normals and texture coordinates. `things` are added to its dictionary, for example an emitter.
    """
    axis = np.linspace(-1, 1, cells + 1)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    positions = rippled(y, cells, ripples, side)
    at = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]
    faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    return mesh(positions, faces, bsdf, name, True, np.stack([(x + 1) / 2, (z + 1) / 2], -1), **things)


def camera(rfilter: str = "gaussian", size: int = SIZE, sensor: str = "perspective", **film: Any) -> dict[str, Any]:
    """Return a camera that looks down on the receiver."""
    lens = {"aperture_radius": 0.1, "focus_distance": 1.2} if sensor == "thinlens" else {}
    return {
        "type": sensor, "fov": 90, **lens,
        "to_world": mi.ScalarTransform4f().look_at([0, 1, 0], [0, 0, 0], [0, 0, -1]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb",
                 "rfilter": {"type": rfilter}, **film},
        "sampler": {"type": "independent"},
    }  # fmt: skip


def flat(bsdf: dict[str, Any], y: float = 0.0, scale: float = 1.0, **things: Any) -> dict[str, Any]:
    """Return a rectangle that faces up."""
    return {"type": "rectangle", "to_world": transform(translate=[0, y, 0], rotate=([1, 0, 0], -90), scale=scale),
            "bsdf": bsdf} | things  # fmt: skip


def beam(scale: float = 0.8, y: float = 3.0) -> dict[str, Any]:
    """Return an emitter of parallel light that shines straight down."""
    return {"type": "rectangle", "to_world": transform(translate=[0, y, 0], rotate=([1, 0, 0], 90), scale=scale),
            "emitter": {"type": "directionalarea", "radiance": rgb(3.2, 3.0, 2.6)}}  # fmt: skip


GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
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
    return flat({"type": "diffuse", "reflectance": texture(4, 4)})


def enclosed(bsdf: dict[str, Any] | None = None, albedo: float = 0.7, **changes: Any) -> dict[str, Any]:
    """Return the scene of `under_glass` inside a sphere, where light continues after it has met the receiver."""
    shell = {"type": "sphere", "center": [0, 1.3, 0], "radius": 2.0, "flip_normals": True,
             "bsdf": diffuse(albedo, 0.9 * albedo, albedo)}  # fmt: skip
    return under_glass(bsdf, shell=shell, **changes)


def turned(angle: Any, axis: Any, shift: list[Any]) -> Any:
    """Return a rotation by `angle` (degrees), followed by a translation. The result follows the derivatives of `angle`
    and `shift`.
    """
    return mi.AffineTransform4f().translate(mi.Vector3f(*shift)) @ mi.AffineTransform4f().rotate(axis, angle)
