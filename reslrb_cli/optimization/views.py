"""View: one sensor, its target image, and their comparison.

- `Exposure` is the factor of a view's image before the comparison. The factor is a number or a recovered parameter. The
    model is target = exposure * image, with one exposure E for all channels or one for each channel. The derivative of
    a loss L(E I) with respect to E is the sum over pixels of dL/dI I / E. This sum uses the samples of the other
    derivatives. If dL/dI comes from other samples than I, the sum is as unbiased as the other derivatives.
- `Masked` has the masked pixels of a view, and `View` is the view itself. Its settings come from `views` or, for a
    single view, from `target` (`make_views`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.config.optimizers import Custom, loss_keys
from reslrb_cli.config.optimizers import Loss as LossConfig
from reslrb_cli.config.parameters import Settings
from reslrb_cli.config.response import Response
from reslrb_cli.config.schema import Config
from reslrb_cli.config.views import Mask, ViewSpec, recovered_exposure
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators.protocol import first_channels
from reslrb_cli.optimization.loading import choose_sensors, find_sensor
from reslrb_cli.optimization.losses import SSIM_SIDE, Loss, OwnLoss, blur, l2, make_loss, weighted
from reslrb_cli.optimization.regularizers import Cost
from reslrb_cli.optimization.response import RecoveredResponse, Smoothness
from reslrb_cli.records.run_folder import exposed
from reslrb_cli.scene.cameras import read_cameras, sensor_id
from reslrb_cli.scene.parameters import Selection
from reslrb_cli.scene.response import LIMITS, start
from reslrb_cli.scene.visibility import sees_specular

Array = np.ndarray[Any, Any]

#: Keys of an exposure and of a response that all views share.
SHARED, RESPONSE = "exposure", "response"


@dataclass
class Exposure:
    """Exposure of one view: `fixed`, or the value of `key` in `values` if `key` is not empty.

    A recovered exposure begins with `start`, which has one number, or one for each colour channel.
    """

    fixed: float = 1.0
    key: str = ""
    start: Sequence[float] = (1.0,)
    values: Mapping[str, Any] = field(default_factory=dict)

    def now(self) -> mi.Float | mi.Color3f | float:
        """Return the current exposure, without derivatives: an array of width 1, one number per channel, or the fixed
        number.
        """
        return dr.detach(self.values[self.key]) if self.key else self.fixed

    def applied(self, image: mi.TensorXf) -> mi.TensorXf:
        """Return E I for an image (H, W, C). The result is attached if the image is."""
        value = self.now()
        if isinstance(value, (int, float)):
            return image if value == 1 else image * value
        if dr.size_v(value) == 3:
            channel = dr.arange(mi.UInt32, dr.width(image.array)) % image.shape[2]
            factor = dr.select(channel == 0, value.x, dr.select(channel == 1, value.y, value.z))
            return mi.TensorXf(image.array * factor, image.shape)
        return mi.TensorXf(image.array * value, image.shape)

    def add_gradient(self, leaf: Any, products: mi.Float) -> None:
        """Add dL/dE to the gradient of `leaf`. `products` are dL/dI I by pixel and channel."""
        if dr.size_v(leaf) == 3:
            pixel = dr.arange(mi.UInt32, dr.width(products) // 3)
            total = mi.Color3f(*(dr.sum(dr.gather(mi.Float, products, 3 * pixel + channel)) for channel in range(3)))
        else:
            total = dr.sum(products)
        dr.accum_grad(leaf, total / dr.detach(leaf))


def pixel_products(channels: int, image: mi.TensorXf, gradient: mi.TensorXf) -> mi.Float:
    """Return dL/dI I by pixel and channel, for an image (H, W, `channels` or more) and its dL/dI."""
    product = first_channels(image, channels) * first_channels(gradient, channels)
    # Excluded pixels may hold any value and have no derivative.
    return dr.select(first_channels(gradient, channels).array != 0, product.array, 0)


def _held_out(config: Config, scene: mi.Scene, sensors: list[int]) -> set[int]:
    """Return the indices of the sensors in `run.held_out`. Raises ConfigError for a sensor without a view."""
    ids, found = [sensor.id() for sensor in scene.sensors()], set()
    for place, given in enumerate(config.run.held_out):
        sensor = find_sensor(given, ids, config.source, key := f"run.held_out[{place}]")
        if sensor not in sensors:
            raise ConfigError(config.source, key, f"is {given}, which is not the sensor of a view")
        found.add(sensor)
    return found


def _view_specs(config: Config, sensors: list[int]) -> list[ViewSpec]:
    """Return the settings of each view. The source is `views`, if configured. Otherwise, `target` gives the settings
    for the scene's sensor or cameras.
    """
    if config.views is not None:
        return config.views
    return [ViewSpec.model_construct(sensor=sensor, target=config.target.file) for sensor in sensors]


@dataclass
class Masked:
    """Masked pixels of one view, as a boolean array (H, W) for each kind. `left_out` has the excluded pixels. A pixel
    may have several kinds.

    `weights` (H, W) come from a weights file. Without such a file, `weights` is None.
    """

    left_out: dict[str, Array] = field(default_factory=dict)
    weights: Array | None = None

    def total(self, shape: tuple[int, int]) -> Array:
        """Return the weight of each pixel, float32 (H, W). Excluded pixels have 0. Without a file, the others
        have 1.
        """
        total = np.ones(shape, np.float32) if self.weights is None else self.weights.astype(np.float32)
        for pixels in self.left_out.values():
            total = np.where(pixels, np.float32(0), total)
        return total

    def counts(self) -> dict[str, int]:
        """Return the number of pixels that each kind excludes. Kinds without pixels are left out."""
        return {kind: count for kind, pixels in self.left_out.items() if (count := int(pixels.sum()))}


@dataclass
class View:
    """View through the scene's sensor with the index `sensor`. `share` is its weight in the loss. The shares of
    training views sum to 1.

    - `made` is the target (H, W, C) without alpha. Before the target exists, `made` is None, and `target` raises
        LookupError.
    - `weights` have the target's shape and a mean of 1. Entries that `masked` excludes have the weight 0. `weights` is
        None if all weights are equal.
    - A `held_out` view is not trained on, and has its own loss.
    - `file` is the file of the target, or None if the target is rendered. `file_key` and `mask_key` are the places of
        file and mask in the configuration.
    - `decoded_by` is the response that decodes the file, or None for the usual encoding. `response` is the response
        that is recovered, or None.
    - `codes` are the user's losses.
    - `blur` is the standard deviation in pixels of the blur of this iteration (`run.blur`).
    - `fixed` are the weights (H, W) without the mask of moving glass and mirrors (`follow`). `fixed` is None if no such
        mask is used.
    """

    sensor: int
    loss: Loss
    share: float = 1.0
    made: mi.TensorXf | None = None
    weights: mi.TensorXf | None = None
    exposure: Exposure = field(default_factory=Exposure)
    held_out: bool = False
    decoded_by: Response | None = None
    response: RecoveredResponse | None = None
    file: Path | None = None
    file_key: str = "target.file"
    mask: Mask = field(default_factory=Mask)
    mask_key: str = "target.mask"
    masked: Masked = field(default_factory=Masked)
    codes: list[OwnLoss] = field(default_factory=list)
    blur: float = 0.0
    fixed: Array | None = None
    _kept: tuple[float, Any, Any] = (0.0, None, None)

    @property
    def target(self) -> mi.TensorXf:
        """The target (H, W, C), without alpha. Raises LookupError before it exists."""
        if self.made is None:
            raise LookupError(f"view {self.sensor} has no target yet")
        return self.made

    def see(self, target: Array, weights: Array | None = None) -> None:
        """Set a target (H, W, C). The target must be finite wherever its weights (H, W) are not 0. Excluded entries
        become 0.
        """
        if weights is not None and not np.all(weights == 1):
            target = np.where(np.isfinite(target), target, 0)
        self.take(to_tensor(target))
        self.weigh(weights)

    def take(self, target: mi.TensorXf) -> None:
        """Set the target (H, W, C), without weights."""
        self.made = target
        if self.response is not None:
            self.response.see(target)

    def weigh(self, weights: Array | None) -> None:
        """Set weights (H, W) for the current target. None weights all pixels equally."""
        self.weights = None
        if weights is not None and not np.all(weights == 1):
            share = weights / weights.mean(dtype=np.float64)
            self.weights = to_tensor(np.broadcast_to(share[:, :, None], self.target.shape))

    def follow(self, scene: mi.Scene) -> None:
        """Exclude the pixels that currently show glass or mirrors."""
        if self.fixed is None:
            return
        seen = sees_specular(scene, scene.sensors()[self.sensor])
        weights = np.where(seen, np.float32(0), self.fixed)
        if weights.any():  # glass before the whole film would leave no pixels, so the mask stays
            self.weigh(weights)

    def exposed(self, image: mi.TensorXf) -> mi.TensorXf:
        """Return an image (H, W, C) without alpha, with the view's exposure and the gain of its response."""
        image = self.exposure.applied(first_channels(image, self.target.shape[2]))
        return image if self.response is None else self.response.applied(image)

    def exposed_array(self, image: Array) -> Array:
        """Return an image (H, W, C or more) with the view's exposure, and the gain of its response. Channels beyond the
        target's are unchanged.
        """
        image = exposed(image, np.array(self.exposure.now(), np.float32).ravel(), self.target.shape[2])
        return image if self.response is None else self.response.scaled(image)

    def shown_array(self, image: Array) -> Array:
        """Return an image (H, W, C or more) as the view's camera would show it, to be compared with the target by eye.
        Without a recovered response, it is the exposed image.
        """
        image = exposed(image, np.array(self.exposure.now(), np.float32).ravel(), self.target.shape[2])
        return image if self.response is None else self.response.shown(image, self.target.shape[2])

    def compare(self, image: mi.TensorXf) -> mi.Float:
        """Return the attached loss of an image (H, W, C), with width 1. The view's exposure is applied."""
        return self.judge(self.exposed(image))

    def judge(self, image: mi.TensorXf) -> mi.Float:
        """Return the loss of an image. The exposure is already applied, and the image has the target's channels.

        With `blur`, the derivative is that of the loss of blurred images.
        """
        loss = self._loss(image, 0.0)
        if not self.blur or not dr.grad_enabled(image):
            return loss
        return dr.replace_grad(dr.detach(loss), self._loss(image, self.blur))

    def _loss(self, image: mi.TensorXf, sigma: float) -> mi.Float:
        target = self.target
        if self.weights is not None:
            # Excluded pixels, even with non-finite values, have neither loss nor derivative.
            image = dr.select(self.weights > 0, image, target)
        given = () if self.weights is None else (self.weights,)
        if sigma:
            finite = dr.select(dr.isfinite(image), image, target)  # a blur would spread a NaN to all pixels
            image, target = blur(finite, sigma), self._blurred_target(sigma)
        return self.loss(image, target, *given)

    def _blurred_target(self, sigma: float) -> mi.TensorXf:
        """Return the target blurred by `sigma` pixels. An iteration needs it several times, so it is kept."""
        if self._kept[0] != sigma or self._kept[1] is not self.made:
            self._kept = sigma, self.made, blur(self.target, sigma)
        return self._kept[2]

    def curvature(self, known: bool) -> Array:
        """Return the loss's curvature (H, W) in each pixel, scaled to a mean of 1. If it is not `known`, return that of
        l2.

        Excluded pixels have 0. The noise of each channel is assumed to be proportional to the target.
        """
        target, loss = np.array(self.target), self.loss if known else l2
        change = np.abs(target) + 1e-3
        change_of_slope = slope(lambda image: loss(image, self.target, self.weights), target + change)
        curvature = np.linalg.norm(change_of_slope, axis=2) / np.linalg.norm(change, axis=2)
        return np.asarray(curvature / curvature.mean())

    def kept(self, image: Array) -> Array:
        """Return an image of the target's shape with excluded pixels set to 0."""
        return image if self.weights is None else np.where(np.array(self.weights) > 0, image, 0)

    def blurred(self, image: Array) -> Array:
        """Return an image (H, W, C) with the blur of this iteration."""
        return np.array(blur(to_tensor(image), self.blur), dtype=np.float64) if self.blur else image

    def objective(self, image: mi.TensorXf) -> mi.Float:
        """Return the view's term in the loss of all views."""
        return self.compare(image) * self.share

    def blurred_objective(self, image: mi.TensorXf) -> mi.Float:
        """Return the view's term in the loss of all views for an exposed image, with the blur of this iteration."""
        return self._loss(image, self.blur) * self.share


def slope(loss: Callable[[mi.TensorXf], mi.Float], image: Array) -> Array:
    """Return the derivative of a loss at an image (H, W, C). The loss has width 1. The derivative may be non-finite."""
    leaf = mi.TensorXf(np.ascontiguousarray(image, dtype=np.float32))
    dr.enable_grad(leaf)
    dr.backward(loss(leaf))
    return np.array(dr.grad(leaf))


def view_records(views: list[View]) -> list[dict[str, Any]]:
    """Return each view's entry for the run's manifest: share of the loss, pixel count, number and kinds of excluded
    pixels.
    """
    return [
        {
            "sensor": view.sensor,
            "share": view.share,
            "held_out": view.held_out,
            "exposure": view.exposure.key or view.exposure.fixed,
            "response": None if view.response is None else view.response.key,
            "pixels": math.prod(view.target.shape[:2]),
            "left_out": 0 if view.weights is None else int((np.array(view.weights)[:, :, 0] == 0).sum()),
            "kinds": view.masked.counts(),
        }
        for view in views
    ]


def make_views(config: Config, scene: mi.Scene) -> list[View]:
    """Return the views of an experiment, without their targets.

    Raises ConfigError for a sensor that does not exist, or cannot be held out, and for images that are too small for a
    loss.
    """
    sensors, target, views = choose_sensors(config, scene), config.target, []
    images: dict[int | str, Path] = {}
    if config.scene.cameras is not None and target.render is None:
        for index, camera in enumerate(read_cameras(config.scene.cameras)):
            images[index] = images[sensor_id(camera.name)] = camera.image
    specs, held_out = _view_specs(config, sensors), _held_out(config, scene, sensors)
    _check_trained(config, len(specs) - len(held_out))
    total = sum(spec.weight for spec, sensor in zip(specs, sensors, strict=True) if sensor not in held_out)
    for number, (spec, sensor) in enumerate(zip(specs, sensors, strict=True)):
        place, is_held, own = f"views[{number}]", sensor in held_out, spec.exposure is not None
        exposure = target.exposure if spec.exposure is None else spec.exposure
        word, start = recovered_exposure(exposure)
        if is_held and own and word:
            reason = f"has sensor {sensor}, whose own exposure no image determines; give it a number, or one "
            raise ConfigError(config.source, "run.held_out", f"{reason}exposure to all views")
        response = target.response if spec.response is None else spec.response
        if is_held and spec.response is not None and spec.response.recovered:
            reason = f"has sensor {sensor}, whose own response no image determines; give it numbers, or one "
            raise ConfigError(config.source, "run.held_out", f"{reason}response to all views")
        key = f"{SHARED}.{sensor}" if own else SHARED
        file, file_key = spec.target, "target.file" if config.views is None else f"{place}.target"
        if spec.target is None:
            named = spec.sensor
            file, file_key = images.get(sensor_id(named) if isinstance(named, str) else named), "scene.cameras"
        if file is None and spec.response is not None:
            raise ConfigError(config.source, f"{place}.response", "has no effect on a rendered target; remove it")
        recovered = "" if response is None or file is None else response.recovered
        loss, codes = _make_losses(config, scene.sensors()[sensor].film())
        views.append(
            View(
                sensor,
                loss,
                share=1.0 if is_held else spec.weight / total,
                exposure=Exposure(key=key, start=start) if word else Exposure(start[0]),
                decoded_by=None if response is None else response.fixed(),
                response=RecoveredResponse(recovered, RESPONSE if spec.response is None else f"{RESPONSE}.{sensor}")
                if recovered
                else None,
                held_out=is_held,
                file=file,
                file_key=file_key,
                mask=target.mask if spec.mask is None else spec.mask,
                mask_key="target.mask" if spec.mask is None else f"{place}.mask",
                codes=codes,
            )
        )
    return views


def _check_trained(config: Config, trained: int) -> None:
    """Raise ConfigError if there are too few training views."""
    if not trained:
        raise ConfigError(config.source, "run.held_out", "leaves no view for training")
    asked = config.run.views_per_iteration or 1
    if asked > trained:
        raise ConfigError(config.source, "run.views_per_iteration", f"is {asked}; training views: {trained}")
    if config.drawn_views is None and config.run.shards != "auto" and config.shards > trained:
        reason = f"is {config.shards}, above the {trained} training views of scene.cameras; list "
        raise ConfigError(config.source, "run.shards", f"{reason}`views` for shards of a view's samples")


def _make_losses(config: Config, film: mi.Film) -> tuple[Loss, list[OwnLoss]]:
    """Return the loss of a view, and the user's losses in it. Raises ConfigError if the film is too small."""
    width, height = (int(size) for size in film.crop_size())
    parts: list[tuple[float, Loss]] = []
    codes: list[OwnLoss] = []
    for key, kind in loss_keys("type", config.loss):
        if kind.type == "ssim" and min(width, height) < SSIM_SIDE:
            reason = f"ssim needs {SSIM_SIDE}x{SSIM_SIDE} pixels, but the image has {width}x{height}"
            raise ConfigError(config.source, key, reason)
        if isinstance(kind, Custom):
            codes.append(OwnLoss(config, f"{key.removesuffix('type')}file", kind))
            parts.append((kind.weight, codes[-1]))
        else:
            parts.append((kind.weight, make_loss(kind.type, **kind.own_options())))
    return parts[0][1] if isinstance(config.loss, LossConfig) else functools.partial(weighted, parts), codes


def expose(views: list[View], scene: mi.Scene, selection: Selection) -> None:
    """Let `selection` recover the unknown exposures and responses of views."""
    for view in views:
        if view.response is not None:
            key, first = view.response.key, start(view.response.kind)
            view.response.values = selection.factors
            if key not in selection.factors:
                value = mi.Float(first.astype(np.float32)) + dr.opaque(mi.Float, 0)
                selection.add_factor(key, value, Settings(initial=first.tolist(), bounds=LIMITS, transform="log"))
        if not (key := view.exposure.key):
            continue
        view.exposure.values = selection.factors
        if key not in selection.factors:  # recovered as a logarithm
            factors = list(view.exposure.start)
            each = len(factors) == 3 and color_channels(scene.sensors()[view.sensor].film()) == 3
            value = mi.Color3f(factors) if each else mi.Float(factors[0])
            selection.add_factor(key, value + dr.opaque(mi.Float, 0), Settings(initial=factors[0], transform="log"))


def response_costs(views: list[View]) -> dict[str, dict[str, Cost]]:
    """Return the costs of recovered curves, by key and type, as `problem.make_regularizers` returns them."""

    def scale(own: list[View]) -> float:
        black = [view.judge(dr.zeros(mi.TensorXf, view.target.shape)) for view in own]
        return sum(view.share * float(loss[0]) for view, loss in zip(own, black, strict=True))

    seen: dict[str, list[View]] = {}
    for view in views:
        if view.response is not None and view.response.kind == "curve" and not view.held_out:
            seen.setdefault(view.response.key, []).append(view)
    return {key: {"smoothness": Smoothness(functools.partial(scale, own))} for key, own in seen.items()}


def color_channels(film: mi.Film) -> int:
    """Return how many channels an image of `film` has without alpha."""
    if mi.has_flag(film.flags(), mi.FilmFlags.Spectral):
        return int(film.base_channels_count())
    return 1 if int(film.base_channels_count()) <= 2 else 3


def own_channels(film: mi.Film) -> list[str]:
    """Return the names of a film's channels if they have responses of their own. RGB films return an empty list."""
    if not mi.has_flag(film.flags(), mi.FilmFlags.Spectral):
        return []
    film.prepare([])
    return [field.name for field in film.bitmap().struct_()]


def to_tensor(array: Array) -> mi.TensorXf:
    """Return an image (H, W, C) in Dr.Jit's own memory."""
    return mi.TensorXf(own_memory(mi.Float, np.ravel(array).astype(np.float32, copy=False)), array.shape)


def target_arrays(views: list[View]) -> dict[str, Array]:
    """Return the views' targets and weights for another process, which sets them with `set_targets`."""
    arrays = {}
    for number, view in enumerate(views):
        arrays[f"target-{number}"] = np.array(view.target)
        if view.weights is not None:
            arrays[f"weights-{number}"] = np.array(view.weights)
        if view.fixed is not None:
            arrays[f"fixed-{number}"] = view.fixed
    return arrays


def set_targets(views: list[View], arrays: Mapping[str, Array]) -> None:
    """Set the targets and weights of views from the result of `target_arrays`."""
    for number, view in enumerate(views):
        view.take(to_tensor(arrays[f"target-{number}"]))
        weights = f"weights-{number}"
        view.weights = to_tensor(arrays[weights]) if weights in arrays else None
        view.fixed = arrays.get(f"fixed-{number}")
