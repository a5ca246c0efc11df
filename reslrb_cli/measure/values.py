"""The values that a measurement varies, and the way between them and a scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.values import settle


class Values(Protocol):
    """What `scene.Selection` has of this kind: the parameters of a scene, or what they are functions of."""

    @property
    def params(self) -> mi.SceneParameters:
        """All of the scene's `mi.traverse`."""
        ...

    def value(self, key: str) -> Any:
        """The current value of `key`, as Dr.Jit has it."""
        ...

    def hand_over(self, values: Mapping[str, Any]) -> None:
        """Give the scene these values, and evaluate what follows from them, derivatives included."""
        ...

    def collect(self) -> None:
        """Bring the gradients of what is in the scene on to the values that were handed over."""
        ...

    def push(self) -> None:
        """Bring tangents of the values that were handed over, once propagated, on to what is in the scene."""
        ...


class SceneValues:
    """A scene's own parameters."""

    def __init__(self, scene: mi.Scene) -> None:
        self.params = mi.traverse(scene)

    def value(self, key: str) -> Any:
        """The parameter `key`."""
        return self.params[key]

    def hand_over(self, values: Mapping[str, Any]) -> None:
        """Set parameters. Textures pad their storage, and the normals of meshes follow, ahead of the next step."""
        for key, value in values.items():
            self.params[key] = value
        self.params.update()
        dr.eval([self.params[key] for key in values], settle(self.params, values))

    def collect(self) -> None:
        """They are in the scene: nothing is to be done."""

    def push(self) -> None:
        """They are in the scene: nothing is to be done."""
