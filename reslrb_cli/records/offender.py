"""Where a step came upon a value that is not finite."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PathVertex:
    """A vertex of a path, and all that the path can be traced again from.

    `samples` says which of the step's samples it belongs to, `seed` is their sampler's, `path` its index among `paths`.
    `vertex` counts from the emitter, 0; `position` is in world space; `surface` is the id of the shape there.
    """

    samples: str
    seed: int
    path: int
    paths: int
    vertex: int
    position: tuple[float, float, float]
    surface: str | None


@dataclass(frozen=True)
class Offender:
    """The first value that is not finite of one view, in the order of the paths and of their vertices.

    `quantity` is what it is, `value` one number a channel, none for a derivative of the loss. `pixel`, (x, y), is where
    it reaches the film. `where` is None for a derivative of the loss; `image` and `target`, what the loss compares
    there, are None for a path.
    """

    sensor: int
    pixel: tuple[int, int] | None
    quantity: str
    value: list[float]
    where: PathVertex | None
    image: list[float] | None = None
    target: list[float] | None = None
