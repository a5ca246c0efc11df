"""A view: one sensor, the image that it is to see, and how the two are compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import Config
from reslrb_cli.integrators import first_channels
from reslrb_cli.optimization.loading import choose_sensors
from reslrb_cli.optimization.losses import Loss, make_loss

Array = np.ndarray[Any, Any]


@dataclass
class View:
    """What the scene's sensor of index `sensor` is to see, of which `share` (all of them sum to 1) is the loss.

    `made` is the target (H, W, C), without alpha; None until there is one, which `target` raises LookupError for.
    """

    sensor: int
    loss: Loss
    share: float = 1.0
    made: mi.TensorXf | None = None

    @property
    def target(self) -> mi.TensorXf:
        """The target (H, W, C), without alpha. Raises LookupError before it was made."""
        if self.made is None:
            raise LookupError(f"view {self.sensor} has no target yet")
        return self.made

    def compare(self, image: mi.TensorXf) -> mi.Float:
        """The loss of an (H, W, C) image, of width 1, attached; alpha is left out."""
        return self.loss(first_channels(image, self.target.shape[2]), self.target)

    def objective(self, image: mi.TensorXf) -> mi.Float:
        """What the view adds to the loss of all views."""
        return self.compare(image) * self.share


def make_views(config: Config, scene: mi.Scene) -> list[View]:
    """The views of an experiment, without their targets. Raises ConfigError for a sensor that is not there."""
    sensors = choose_sensors(config, scene)
    loss = make_loss(config.loss.type, **config.loss.options())
    return [View(sensor, loss, 1 / len(sensors)) for sensor in sensors]


def to_tensor(array: Array) -> mi.TensorXf:
    """An image (H, W, C) in Dr.Jit's own memory: kernels depend on the alignment of NumPy's, which is random."""
    tensor = mi.TensorXf(np.ascontiguousarray(array, dtype=np.float32)) + dr.opaque(mi.Float, 0)
    dr.eval(tensor)
    return tensor


def target_arrays(views: list[View]) -> dict[str, Array]:
    """The views' targets, to be handed to another process, which `set_targets` sets them in."""
    return {f"target-{number}": np.array(view.target) for number, view in enumerate(views)}


def set_targets(views: list[View], arrays: Mapping[str, Array]) -> None:
    """Give views the targets of `target_arrays`."""
    for number, view in enumerate(views):
        view.made = to_tensor(arrays[f"target-{number}"])
