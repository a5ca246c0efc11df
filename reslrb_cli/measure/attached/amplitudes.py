"""Scenes that move along a few directions: amplitudes as parameters, of which what moves is a function."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.own_memory import own_memory
from reslrb_cli.scene.graph import SceneGraph

#: The name of the amplitudes among the parameters.
AMPLITUDES = "amplitudes"
#: Degrees that an amplitude of 1 turns by.
DEGREES = 57.29577951308232


class Move(Protocol):
    """Something in a scene that amplitudes move; all zero, it stands as the scene has it."""

    @property
    def key(self) -> str:
        """What it moves, as `mi.traverse` names it."""
        ...

    @property
    def size(self) -> int:
        """How many amplitudes there are."""
        ...

    def value(self, initial: Any, amplitudes: list[mi.Float]) -> Any:
        """The value of `key`, with its derivative by the amplitudes, of which each has width 1."""
        ...


@dataclass(frozen=True)
class Displacement:
    """The vertices of a mesh move by the sum of amplitude k times `fields[k]`, of shape (K, V, 3)."""

    key: str
    fields: np.ndarray

    @property
    def size(self) -> int:
        return len(self.fields)

    def value(self, initial: mi.Float, amplitudes: list[mi.Float]) -> mi.Float:
        result = mi.Float(initial)
        for row, amplitude in zip(self.fields, amplitudes, strict=True):
            result += amplitude * own_memory(mi.Float, row.ravel().astype(np.float32))
        return result


@dataclass(frozen=True)
class Pose:
    """A `to_world`, or a position, moves by these degrees of freedom, in their order.

    They are `tx` `ty` `tz` (scene units), `rx` `ry` `rz` (radians) and `s` (scale, 1 + amplitude), the last two kinds
    about `pivot`.
    """

    key: str
    freedom: tuple[str, ...]
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def size(self) -> int:
        return len(self.freedom)

    def value(self, initial: Any, amplitudes: list[mi.Float]) -> Any:
        zero = dr.opaque(mi.Float, 0)
        T, result = mi.AffineTransform4f, mi.AffineTransform4f()
        there, back = (T().translate([dr.opaque(mi.Float, s * x) for x in self.pivot]) for s in (1, -1))
        for name, amplitude in zip(self.freedom, amplitudes, strict=True):
            axis = [1 if name[-1] == other else 0 for other in "xyz"]
            if name[0] == "t":
                step = T().translate([amplitude if on else zero for on in axis])
            elif name[0] == "r":
                step = there @ T().rotate(axis, amplitude * DEGREES) @ back
            else:
                step = there @ T().scale([1 + amplitude] * 3) @ back
            result = step @ result
        if isinstance(initial, mi.Point3f):
            return result @ initial
        return result @ mi.AffineTransform4f(initial)


@dataclass(frozen=True)
class Number:
    """A number such as a roughness, to which the one amplitude is added."""

    key: str
    size: int = 1

    def value(self, initial: Any, amplitudes: list[mi.Float]) -> Any:
        return type(initial)(initial + amplitudes[0])


@dataclass
class Displaced:
    """The `measure.values.Values` of a scene that `moves` move: AMPLITUDES, all of theirs in a row."""

    scene: mi.Scene
    moves: Sequence[Move]
    params: mi.SceneParameters = field(init=False)

    def __post_init__(self) -> None:
        self.params = mi.traverse(self.scene)
        self._amplitudes = dr.opaque(mi.Float, 0, sum(move.size for move in self.moves))
        self._initial = {move.key: _copy(self.params[move.key]) for move in self.moves}
        self._meshes = [shape for shape in SceneGraph.of(self.scene).shapes() if shape.is_mesh()]

    def value(self, key: str) -> Any:
        """The amplitudes (K,)."""
        return self._amplitudes if key == AMPLITUDES else self.params[key]

    def hand_over(self, values: Mapping[str, Any]) -> None:
        """Set the amplitudes, and move what they move."""
        at, moved = 0, []
        self._amplitudes = values[AMPLITUDES]
        for move in self.moves:
            own = [dr.gather(mi.Float, self._amplitudes, at + k) for k in range(move.size)]
            at += move.size
            moved.append(move.value(self._initial[move.key], own))
            self.params[move.key] = moved[-1]
        self.params.update()
        # Normals follow the positions: left to the tracing that comes, they would be computed for each ray.
        dr.eval(moved, [mesh.vertex_normals_buffer() for mesh in self._meshes])

    def collect(self) -> None:
        """Gradients of one step find their way back by themselves."""

    def push(self) -> None:
        """So do tangents."""


def _copy(value: Any) -> Any:
    result = type(value)(dr.detach(value))
    dr.make_opaque(result)
    return result
