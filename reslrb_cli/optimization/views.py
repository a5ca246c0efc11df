"""A view: one sensor, the image that it is to see, and how the two are compared."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.own_memory import own_memory
from reslrb_cli.config import Config
from reslrb_cli.integrators import first_channels
from reslrb_cli.optimization.exposure import Exposure, add_exposure
from reslrb_cli.optimization.losses import Loss, make_loss
from reslrb_cli.optimization.masking import Masked
from reslrb_cli.optimization.wanted import Wanted, wanted_views
from reslrb_cli.scene import Selection

Array = np.ndarray[Any, Any]


@dataclass
class View:
    """What the scene's sensor of index `sensor` is to see, of which `share` (those trained on sum to 1) is the loss.

    `made` is the target (H, W, C), without alpha; None until there is one, which `target` raises LookupError for.
    `weights`, of the same shape with a mean of 1, say what its entries count, 0 of those that `masked` leaves out;
    None where all are the same. What is `held_out` is not trained on, and has a loss of its own.
    """

    sensor: int
    loss: Loss
    share: float = 1.0
    made: mi.TensorXf | None = None
    weights: mi.TensorXf | None = None
    exposure: Exposure = field(default_factory=Exposure)
    held_out: bool = False
    wanted: Wanted = field(default_factory=Wanted)
    masked: Masked = field(default_factory=Masked)

    @property
    def target(self) -> mi.TensorXf:
        """The target (H, W, C), without alpha. Raises LookupError before it was made."""
        if self.made is None:
            raise LookupError(f"view {self.sensor} has no target yet")
        return self.made

    def see(self, target: Array, weights: Array | None = None) -> None:
        """Take a target (H, W, C), finite where its weights (H, W) are not 0: what they leave out is 0 otherwise."""
        self.weights = None
        if weights is not None and not np.all(weights == 1):
            target = np.where(np.isfinite(target), target, 0)
            share = weights / weights.mean(dtype=np.float64)
            self.weights = to_tensor(np.broadcast_to(share[:, :, None], target.shape))
        self.made = to_tensor(target)

    def compare(self, image: mi.TensorXf) -> mi.Float:
        """The loss of an (H, W, C) image, of width 1, attached; alpha is left out, the view's exposure applied."""
        return self.judge(self.exposure.applied(first_channels(image, self.target.shape[2])))

    def judge(self, image: mi.TensorXf) -> mi.Float:
        """The same of an image that has its exposure, and the target's channels."""
        target = self.target
        if self.weights is None:
            return self.loss(image, target)
        # Whatever stands in a pixel that is left out, also if it is not finite, has neither loss nor derivative.
        return self.loss(dr.select(self.weights > 0, image, target), target, self.weights)

    def kept(self, image: Array) -> Array:
        """An image of the target's shape, 0 where pixels are left out."""
        return image if self.weights is None else np.where(np.array(self.weights) > 0, image, 0)

    def situation(self) -> list[Any]:
        """Share, exposure and weights in short, as plain values: two views that have the same count the same."""
        weights = None if self.weights is None else hashlib.blake2b(np.array(self.weights).tobytes()).hexdigest()
        loss = self.wanted.loss
        return [self.share, self.held_out, self.wanted.exposure, loss and loss.model_dump(), weights]

    def objective(self, image: mi.TensorXf) -> mi.Float:
        """What the view adds to the loss of all views."""
        return self.compare(image) * self.share


def slope(loss: Callable[[mi.TensorXf], mi.Float], image: Array) -> Array:
    """The derivative of a loss of images, of width 1, at one of them (H, W, C); finite or not."""
    leaf = mi.TensorXf(np.ascontiguousarray(image, dtype=np.float32))
    dr.enable_grad(leaf)
    dr.backward(loss(leaf))
    return np.array(dr.grad(leaf))


def view_records(views: list[View]) -> list[dict[str, Any]]:
    """What a run's manifest says of its views: share of the loss, pixels, how many are left out, and of which kinds."""
    found = []
    for view in views:
        height, width, channels = view.target.shape
        left_out = 0 if view.weights is None else int((np.array(view.weights) == 0).sum()) // channels
        found.append(
            {
                "sensor": view.sensor,
                "share": view.share,
                "held_out": view.held_out,
                "exposure": view.exposure.key or view.exposure.fixed,
                "pixels": height * width,
                "left_out": left_out,
                "kinds": view.masked.counts(),
                "counted": view.masked.stay,
            }
        )
    return found


def make_views(config: Config, scene: mi.Scene) -> list[View]:
    """The views of an experiment, without their targets. Raises ConfigError as `wanted_views` does."""
    wanted, views = wanted_views(config, scene), []
    total = sum(one.weight for one in wanted if not one.held_out)
    for one in wanted:
        kind = one.loss or config.loss
        share = 1.0 if one.held_out else one.weight / total
        loss = make_loss(kind.type, **kind.options())
        views.append(View(one.sensor, loss, share, held_out=one.held_out, wanted=one))
    return views


def expose(views: list[View], scene: mi.Scene, selection: Selection) -> None:
    """Give views their exposures, and have `selection` recover those that are not known."""
    for view in views:
        wanted = view.wanted
        if isinstance(wanted.exposure, str):
            colors = color_channels(scene.sensors()[view.sensor].film())
            add_exposure(selection, wanted.exposure_key, wanted.exposure, colors)
            view.exposure = Exposure(key=wanted.exposure_key, values=selection.factors)
        else:
            view.exposure = Exposure(fixed=wanted.exposure)


def color_channels(film: mi.Film) -> int:
    """How many channels an image of `film` has without alpha."""
    return 1 if int(film.base_channels_count()) <= 2 else 3


def to_tensor(array: Array) -> mi.TensorXf:
    """An image (H, W, C) in Dr.Jit's own memory."""
    return mi.TensorXf(own_memory(mi.Float, np.ravel(array).astype(np.float32, copy=False)), array.shape)


def target_arrays(views: list[View]) -> dict[str, Array]:
    """The views' targets and weights, to be handed to another process, which `set_targets` sets them in."""
    arrays = {}
    for number, view in enumerate(views):
        arrays[f"target-{number}"] = np.array(view.target)
        if view.weights is not None:
            arrays[f"weights-{number}"] = np.array(view.weights)
    return arrays


def set_targets(views: list[View], arrays: Mapping[str, Array]) -> None:
    """Give views the targets and weights of `target_arrays`."""
    for number, view in enumerate(views):
        view.made = to_tensor(arrays[f"target-{number}"])
        weights = f"weights-{number}"
        view.weights = to_tensor(arrays[weights]) if weights in arrays else None
