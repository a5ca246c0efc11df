"""A view: one sensor, the image that it is to see, and how the two are compared."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config import Config, Mask
from reslrb_cli.config import Loss as LossConfig
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators import first_channels
from reslrb_cli.optimization.exposure import SHARED, Exposure, add_exposure
from reslrb_cli.optimization.loading import choose_sensors
from reslrb_cli.optimization.losses import Loss, make_loss
from reslrb_cli.optimization.masking import Masked
from reslrb_cli.scene import Selection
from reslrb_cli.scene.cameras import read_cameras

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Wanted:
    """What an experiment says of one view's target: its file, None of one that is rendered, and its mask.

    `file_key` and `mask_key` are where they stand in the configuration. `exposure` is a number, or how it is recovered,
    by which key; `weight` is the view's part of the loss, relative to the others', and `loss` its own, if it has one.
    """

    file: Path | None = None
    file_key: str = "target.file"
    mask: Mask = field(default_factory=Mask)
    mask_mixed: bool = False
    mask_key: str = "target.mask"
    exposure: float | str = 1.0
    exposure_key: str = SHARED
    weight: float = 1.0
    loss: LossConfig | None = None


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
    """The views of an experiment, without their targets.

    Raises ConfigError for a sensor that is not there, and for what is held out and cannot be.
    """
    sensors = choose_sensors(config, scene)
    wanted = _of_views(config) if config.views is not None else _of_sensors(config, sensors)
    if config.scene.cameras is not None and config.target.render is None:
        images = [camera.image for camera in read_cameras(config.scene.cameras)]
        wanted = [
            replace(one, file=images[sensor], file_key="scene.cameras") if one.file is None else one
            for sensor, one in zip(sensors, wanted, strict=True)
        ]
    held_out = _held_out(config, scene, sensors)
    if held_out == set(sensors):
        raise ConfigError(config.source, "run.held_out", "leaves no view to train on")
    trained = [one.weight for sensor, one in zip(sensors, wanted, strict=True) if sensor not in held_out]
    views = []
    for sensor, one in zip(sensors, wanted, strict=True):
        held = sensor in held_out
        if held and isinstance(one.exposure, str) and one.exposure_key != SHARED:
            raise ConfigError(
                config.source,
                "run.held_out",
                f"has sensor {sensor}, whose own exposure nothing else tells; give it a number, or all views one",
            )
        kind = one.loss or config.loss
        loss = make_loss(kind.type, **kind.options())
        share = one.weight / (one.weight if held else sum(trained))
        views.append(View(sensor, loss, share, held_out=held, wanted=one))
    if (config.run.views_per_iteration or 1) > len(trained):
        raise ConfigError(
            config.source,
            "run.views_per_iteration",
            f"is {config.run.views_per_iteration}; views that are trained on: {len(trained)}",
        )
    return views


def _held_out(config: Config, scene: mi.Scene, sensors: list[int]) -> set[int]:
    """The indices of the sensors that `run.held_out` names. Raises ConfigError for one that has no view."""
    names, found = {scene.sensors()[sensor].id(): sensor for sensor in sensors}, set()
    for place, given in enumerate(config.run.held_out):
        sensor = names.get(given, -1) if isinstance(given, str) else given
        if sensor not in sensors:
            raise ConfigError(config.source, f"run.held_out[{place}]", f"is {given}, which is the sensor of no view")
        found.add(sensor)
    return found


def _of_sensors(config: Config, sensors: list[int]) -> list[Wanted]:
    """What the short forms, `scene.sensors` and `target`, say of each view."""
    target = config.target
    files, exposures = target.file or [], target.exposure
    if isinstance(exposures, list) and len(exposures) != len(sensors):
        raise ConfigError(
            config.source,
            "target.exposure",
            f"must have one entry for each sensor; entries: {len(exposures)}, sensors: {len(sensors)}",
        )
    return [
        Wanted(
            file=files[number] if number < len(files) else None,
            file_key="target.file" if len(files) == 1 else f"target.file[{number}]",
            mask=target.mask,
            mask_mixed=target.mask_mixed,
            exposure=exposures[number] if isinstance(exposures, list) else exposures,
            exposure_key=f"{SHARED}.{sensor}" if isinstance(exposures, list) else SHARED,
        )
        for number, sensor in enumerate(sensors)
    ]


def _of_views(config: Config) -> list[Wanted]:
    """What `views` say of each view, and `target` of what they leave open."""
    assert config.views is not None
    assert not isinstance(config.target.exposure, list), "checked with the configuration"
    target, found = config.target, []
    for number, spec in enumerate(config.views):
        own = spec.exposure is not None
        found.append(
            Wanted(
                file=spec.target,
                file_key=f"views[{number}].target",
                mask=target.mask if spec.mask is None else spec.mask,
                mask_mixed=target.mask_mixed if spec.mask_mixed is None else spec.mask_mixed,
                mask_key="target.mask" if spec.mask is None else f"views[{number}].mask",
                exposure=config.target.exposure if spec.exposure is None else spec.exposure,
                exposure_key=f"{SHARED}.{spec.sensor}" if own else SHARED,
                weight=spec.weight,
                loss=spec.loss,
            )
        )
    return found


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
    """An image (H, W, C) in Dr.Jit's own memory: kernels depend on the alignment of NumPy's, which is random."""
    tensor = mi.TensorXf(np.ascontiguousarray(array, dtype=np.float32)) + dr.opaque(mi.Float, 0)
    dr.eval(tensor)
    return tensor


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
