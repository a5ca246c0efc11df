"""Test scenes in which parameters move light. The parameters are amplitudes of motions (`moving_case`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.measure.gradients import Case, smooth_weights
from reslrb_cli.measure.scenes.small import load
from reslrb_cli.scene.graph import SceneGraph

Array = NDArray[np.float64]
#: Numbers, or arrays of numbers, by name, and a function that sets parameters of a scene from them.
Latents = Mapping[str, Any]
Place = Callable[[mi.SceneParameters, Latents], None]

#: Waves of a surface: wave vectors, phases, and amplitudes with a mean slope of about 0.1.
WAVES = (((5.1, 2.3), 0.4, 0.0135), ((-3.7, 5.9), 1.9, 0.012), ((7.9, -4.6), 4.1, 0.0062), ((2.2, -8.8), 2.7, 0.0055))


def waves(x: Array, z: Array) -> Array:
    """Return the heights of a surface with smooth waves."""
    return sum((a * np.sin(kx * x + kz * z + phase) for (kx, kz), phase, a in WAVES), np.zeros_like(x))


def mesh(positions: Array, faces: Array, bsdf: dict, texcoords: Array | None = None, normals: np.ndarray | bool = False,
         name: str = "mesh", **things: Any) -> Any:  # fmt: skip
    """A mesh of vertices (V, 3) and triangles (F, 3), with texture coordinates (V, 2) if given.

    Faces are flat unless vertex `normals` (V, 3) are given, or `normals` is true, and Mitsuba interpolates them.
    `things` are added to the mesh's dictionary, for example an emitter.
    """
    properties = mi.Properties()
    for key, thing in {"bsdf": bsdf, **things}.items():
        properties[key] = mi.load_dict(thing)
    shape = mi.Mesh(name, len(positions), len(faces), properties, has_vertex_normals=normals is not False,
                    has_vertex_texcoords=texcoords is not None)  # fmt: skip
    params = mi.traverse(shape)
    for part, value in (("positions", positions), ("normals", normals), ("texcoords", texcoords)):
        if isinstance(value, np.ndarray):
            params[f"vertex_{part}"] = np.ravel(value).astype(np.float32)
    params["faces"] = np.ravel(faces).astype(np.uint32)
    params.update()
    return shape


def grid(cells: int, height: Callable[[Array, Array], Array], half: float = 1.0, wide: float = 0.0
         ) -> tuple[Array, Array, Array]:  # fmt: skip
    """A sheet over [-half, half]^2 in x and z that faces up. Returns vertices, triangles and texture coordinates.

    With `wide`, cells grow from the middle to the rim. Cell coordinates are proportional to sinh(t), with t between
    -`wide` and `wide`.
    """
    at = np.linspace(-1, 1, cells + 1)
    axis = half * (np.sinh(wide * at) / np.sinh(wide) if wide else at)
    x, z = np.meshgrid(axis, axis, indexing="ij")
    u, v = np.meshgrid((at + 1) / 2, (at + 1) / 2, indexing="ij")
    number = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, c, b), (a, d, c))])
    return np.stack([x, height(x, z), z], -1).reshape(-1, 3), faces, np.stack([u, v], -1).reshape(-1, 2)


def smooth_fields(positions: Array, count: int, span: float) -> Array:
    """Return random smooth displacements of unit size in all three directions, (count, V, 3).

    Each field is a cosine wave with a random wave vector and a random direction of displacement. The wave's phase
    changes by 1.5 to 5 radians over the length `span`.
    """
    random = np.random.default_rng(5)
    found = []
    for _ in range(count):
        direction, wave = random.normal(size=3), random.normal(size=3)
        wave *= random.uniform(1.5, 5.0) / span / np.linalg.norm(wave)
        field = np.cos(positions @ wave + random.uniform(0, 2 * np.pi))
        found.append(field[:, None] * direction / np.linalg.norm(direction))
    return np.stack(found)


def vertices(scene: Any, name: str) -> np.ndarray:
    """Return the positions (V, 3) of a mesh."""
    return np.array(mi.traverse(scene)[f"{name}.vertex_positions"], float).reshape(-1, 3)


#: A wide filter, so that light between two pixels counts as much as light on one. The default width (0.5) changes the
#: slope of a smooth dL/dI by a few percent within each pixel, so steps would have to be small against a pixel.
FILTER = {"type": "gaussian", "stddev": 0.7}

#: Name of the amplitudes among the parameters.
AMPLITUDES = "amplitudes"

#: Degrees of rotation for an amplitude of 1.
DEGREES = 57.29577951308232


@dataclass(frozen=True)
class Move:
    """Motion of a scene object by `size` amplitudes. `key` is as in `mi.traverse`.

    `value` returns the value of `key` for its initial value and the amplitudes, which have the width 1. At amplitudes
    of 0, it is the initial value.
    """

    key: str
    size: int
    value: Callable[[Any, Sequence[mi.Float]], Any]


def displacement(key: str, fields: np.ndarray) -> Move:
    """Move the vertices of a mesh by the sum of amplitude k times `fields[k]`. `fields` has the shape (K, V, 3)."""

    def value(initial: mi.Float, amplitudes: Sequence[mi.Float]) -> mi.Float:
        result = mi.Float(initial)
        for row, amplitude in zip(fields, amplitudes, strict=True):
            result += amplitude * own_memory(mi.Float, row.ravel().astype(np.float32))
        return result

    return Move(key, len(fields), value)


def pose(key: str, freedom: Sequence[str], pivot: Sequence[float] = (0.0, 0.0, 0.0)) -> Move:
    """Move a `to_world` or a position by the degrees of freedom in `freedom`, in their order.

    `tx`, `ty` and `tz` are translations in scene units. `rx`, `ry`, `rz` (radians) and `s` (scale, 1 + amplitude) act
    about `pivot`.
    """

    def value(initial: Any, amplitudes: Sequence[mi.Float]) -> Any:
        T, zero, result = mi.AffineTransform4f, dr.opaque(mi.Float, 0), mi.AffineTransform4f()
        there, back = (T().translate([dr.opaque(mi.Float, s * x) for x in pivot]) for s in (1, -1))
        for name, amplitude in zip(freedom, amplitudes, strict=True):
            axis = [1 if name[-1] == other else 0 for other in "xyz"]
            if name[0] == "t":
                step = T().translate([amplitude if on else zero for on in axis])
            elif name[0] == "r":
                step = there @ T().rotate(axis, amplitude * DEGREES) @ back
            else:
                step = there @ T().scale([1 + amplitude] * 3) @ back
            result = step @ result
        return result @ (initial if isinstance(initial, mi.Point3f) else T(initial))

    return Move(key, len(freedom), value)


def number(key: str) -> Move:
    """Add one amplitude to a number, such as a roughness."""
    return Move(key, 1, lambda initial, amplitudes: type(initial)(initial + amplitudes[0]))


@dataclass
class Placement:
    """Numbers that determine a scene. Replaces a `Selection` in a `Case`.

    `start` has a number or a row of numbers for each name, or None for a key of the scene, which is set directly.
    `place(params, latents)` gets the numbers as Dr.Jit arrays. It sets parameters of the scene, which follow the
    derivatives of these numbers.
    """

    scene: mi.Scene
    start: Mapping[str, Any]
    place: Place | None = None
    params: mi.SceneParameters = field(init=False)

    def __post_init__(self) -> None:
        self.params = mi.traverse(self.scene)
        self._values = {
            name: own_memory(mi.Float, np.atleast_1d(np.float32(value)))
            for name, value in self.start.items() if value is not None
        }  # fmt: skip
        self._meshes = [shape for shape in SceneGraph.of(self.scene).shapes() if shape.is_mesh()]
        self.hand_over({})

    def value(self, key: str) -> Any:
        """Return the current value of a latent, or of a parameter of the scene."""
        return self._values[key] if key in self._values else self.params[key]

    def hand_over(self, values: Mapping[str, Any]) -> None:
        """Set latents, and place the scene's objects."""
        for key, value in values.items():
            (self._values if key in self._values else self.params)[key] = value
        if self.place is not None:
            self.place(self.params, self._values)
        self.params.update()
        # Normals follow the positions now; otherwise the next tracing would compute them for each ray.
        dr.eval([value for _, value in self.params.items()], [mesh.vertex_normals_buffer() for mesh in self._meshes])

    def collect(self) -> None:
        """Do nothing: within one step, gradients and tangents propagate by themselves."""

    push = collect


def moving_case(description: dict, moves: Callable[[Any], Sequence[Move]]) -> Case:
    """Return a case with a loaded scene and a smooth dL/dI. The only parameter is the array of amplitudes of the
    scene's `moves`.
    """
    scene = load(description)
    listed, params = moves(scene), mi.traverse(scene)
    initial = {move.key: _copy(params[move.key]) for move in listed}

    def place(params: mi.SceneParameters, latents: Latents) -> None:
        at = 0
        for move in listed:
            own = [dr.gather(mi.Float, latents[AMPLITUDES], at + k) for k in range(move.size)]
            at += move.size
            params[move.key] = move.value(initial[move.key], own)

    start = {AMPLITUDES: np.zeros(sum(move.size for move in listed))}
    case = Case(scene, start, values=Placement(scene, start, place))
    case.weigh(smooth_weights(*case.weights.shape))
    return case


def _copy(value: Any) -> Any:
    result = type(value)(dr.detach(value))
    dr.make_opaque(result)
    return result
