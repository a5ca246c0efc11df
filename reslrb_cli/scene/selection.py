"""What is recovered of a scene, and the way between its values and the scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..config import Settings
from .deformation import Deformation
from .values import Slot, settle


@dataclass(frozen=True)
class Selection:
    """The parameters that are recovered, by the keys that they are recorded by.

    `params` is all of the scene's `mi.traverse`; `specs` holds the settings of each key, in the order of the
    configuration and, for a glob, of the scene. A key is one of `params`, or a value of `deformation`: a motion's
    `ID.translation`, or a heightmap. `tied` has, by such a key, the others of `params` that have the same value.
    `factors` are values that are none of the scene's: what its images are multiplied by (`add_factor`).
    """

    params: mi.SceneParameters
    specs: dict[str, Settings]
    tied: dict[str, list[str]]
    deformation: Deformation
    factors: dict[str, Any] = field(default_factory=dict)

    def add_factor(self, key: str, value: Any, settings: Settings) -> None:
        """Recover a value that is none of the scene's along with what is."""
        self.specs[key], self.factors[key] = settings, value

    @property
    def keys(self) -> list[str]:
        """The keys of what is recovered."""
        return list(self.specs)

    @property
    def scene_keys(self) -> list[str]:
        """The entries of `params` that what is recovered determines."""
        own = [key for key in self.keys if key not in self.deformation.values and key not in self.factors]
        return [*own, *(other for key in own for other in self.tied.get(key, ())), *self.deformation.keys]

    def spec(self, key: str) -> Settings:
        """What the configuration says about the selected `key`."""
        return self.specs[key]

    def value(self, key: str) -> Any:
        """The current value of `key`, as Dr.Jit has it."""
        return self._holder(key)[key]

    def quantity(self, key: str) -> str | None:
        """What `key` measures: `length`, `degrees` or `scale` of what moves; None of what is the scene's own."""
        return self.deformation.quantities.get(key)

    def array(self, key: str) -> np.ndarray[Any, Any]:
        """The current value of `key`: a texture (H, W, C), a colour (C,), a buffer (N,), a number ().

        An environment map comes without the halo columns that its tensor has.
        """
        return self.slot(key).get()

    def hand_over(self, values: Mapping[str, Any]) -> None:
        """Give the scene these values of keys, as Dr.Jit has them; gradients of a step find their way back to them.

        All is evaluated, so that a step's kernels are the same from the first one on.
        """
        for key, value in values.items():
            if key in self.deformation.values or key in self.factors:
                self._holder(key)[key] = value
            else:
                for each in (key, *self.tied.get(key, ())):
                    self.params[each] = value
        moved = self.deformation.place()
        self.params.update()
        own = [each for key in values for each in (key, *self.tied.get(key, ())) if self._holder(key) is self.params]
        settled = settle(self.params, (*own, *self.deformation.keys))
        dr.eval([self.params[key] for key in own], moved, settled, self.factors)

    def collect(self) -> None:
        """Bring what steps added to the gradients of moved things on to that of the values that move them."""
        self.deformation.collect()

    def push(self) -> None:
        """Bring tangents of the values that move things, once propagated, on to what is moved in the scene."""
        self.deformation.push()

    def shown(self, key: str, value: Any) -> np.ndarray[Any, Any]:
        """Another value of `key`, as Dr.Jit has it, as `array` returns it."""
        return self.slot(key).shown(value)

    def set_arrays(self, values: Mapping[str, np.ndarray[Any, Any]]) -> None:
        """Set parameters in the scene, from arrays as `array` returns them."""
        for key, value in values.items():
            self.slot(key).set(value)
        self.update()

    def update(self) -> None:
        """Have the scene follow values that were set: of tied keys, and of what moves."""
        for key, others in self.tied.items():
            for other in others:
                self.params[other] = type(self.params[other])(self.params[key])
        self.deformation.place()
        self.params.update()

    def slot(self, key: str) -> Slot:
        """The value of `key`, to be read and set; `update` has to follow."""
        return Slot(self._holder(key), key)

    def _holder(self, key: str) -> Any:
        """What has the value of `key` under that name."""
        if key in self.factors:
            return self.factors
        return self.deformation.values if key in self.deformation.values else self.params
