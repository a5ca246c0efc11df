"""Losses between an image and its target, by functions that Dr.Jit differentiates.

Each loss takes the image I and the target T, both (H, W, C) in linear radiance. I is attached to the AD graph. Optional
weights have the same shape and a mean of 1. A loss is an array of width 1. A loss is a mean over pixels and channels.
The value depends neither on the resolution nor on the number of masked pixels.

`weighted` returns a weighted sum of losses. `OwnLoss` is a user's loss (`loss.type: custom`), from a file FILE.py:NAME,
or from Python.
"""

from __future__ import annotations

import functools
import inspect
import math
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.code import guarded, load_named
from reslrb_cli.config.loader import check_code
from reslrb_cli.config.optimizers import Custom
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.statistics import scale_frequencies

#: A loss with bound options, as a function of an image, its target, and optional weights.
Loss = Callable[..., "mi.Float"]


def _mean(values: mi.TensorXf, weights: mi.TensorXf | None) -> mi.Float:
    return dr.mean(values if weights is None else values * weights, axis=None).array


def l1(image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
    """Return mean |I - T|. Its gradient is 0 where I = T."""
    return _mean(dr.abs(image - target), weights)


def l2(image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
    """Return mean (I - T)²."""
    return _mean(dr.square(image - target), weights)


def relative_l2(
    image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /, epsilon: float = 1e-2
) -> mi.Float:
    """Return mean (I - T)² / (T² + ε), with ε in squared units of radiance.

    The denominator uses the target, which is constant. The computed gradient is therefore the gradient of the complete
    loss. A denominator with the detached noisy image would contain the same noise as the numerator. Noise of the target
    darkens the minimum by the factor 1 - 2 v / (T² + ε), with the variance v (docs/losses.md).
    """
    return _mean(dr.square(image - target) / (dr.square(target) + epsilon), weights)


#: SSIM's Gaussian window, standard deviation and side in pixels, and the constants K_1 and K_2 (Wang et al.).
SSIM_SIGMA, SSIM_SIDE, SSIM_K = 1.5, 11, (0.01, 0.03)


def ssim(image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
    """Return 1 - mean SSIM (Wang, Bovik, Sheikh and Simoncelli 2004, equation 13), for images of at least 11x11 pixels.

        SSIM = (2 μ_I μ_T + C_1) (2 σ_IT + C_2) / ((μ_I² + μ_T² + C_1) (σ_I² + σ_T² + C_2)),  C_k = (K_k L)²

    SSIM is computed for each channel and window. SSIM's windows are Gaussian, with a standard deviation of 1.5 pixels
    and a width of 11 pixels. Variances within a window are population variances, without the sample correction. The
    result equals scikit-image's with `gaussian_weights=True, use_sample_covariance=False`. The mean is over the windows
    that lie within the image, each with the weight of its central pixel. A masked pixel must be the same in both
    images. `View.judge` ensures equal values. L is the largest value of the target. Raises ValueError for smaller
    images.
    """
    if min(image.shape[:2]) < SSIM_SIDE:
        raise ValueError(f"SSIM needs images of {SSIM_SIDE}x{SSIM_SIDE} pixels, not {image.shape[1]}x{image.shape[0]}")
    mean_i, mean_t = _windows(image), _windows(target)
    most = dr.max(target.array if weights is None else dr.select(weights.array > 0, target.array, 0))
    extent = dr.select(most > 0, most, 1)
    first, second = (dr.square(factor * extent) for factor in SSIM_K)
    # About the means of the images, on which variances do not depend: squares of bright pixels lose digits.
    level = dr.detach(dr.mean(target, axis=None).array)
    i, t = image - level, target - level
    at_i, at_t = mean_i - level, mean_t - level
    across = _windows(i * t) - at_i * at_t
    both = _windows(dr.square(i) + dr.square(t)) - dr.square(at_i) - dr.square(at_t)
    above = (2 * mean_i * mean_t + first) * (2 * across + second)
    unlike = 1 - above / ((dr.square(mean_i) + dr.square(mean_t) + first) * (both + second))
    if weights is None:
        return _mean(unlike, None)
    margin = SSIM_SIDE // 2
    inner = weights[margin : image.shape[0] - margin, margin : image.shape[1] - margin]
    return dr.sum(unlike * inner, axis=None).array / dr.maximum(dr.sum(inner, axis=None).array, 1e-30)


def _windows(image: mi.TensorXf) -> mi.TensorXf:
    """Return the mean of an image (H, W, C) over each SSIM window. The result (H - 10, W - 10, C) is attached."""
    margin = SSIM_SIDE // 2
    raw = [math.exp(-0.5 * (place / SSIM_SIGMA) ** 2) for place in range(-margin, margin + 1)]
    factors = [each / sum(raw) for each in raw]
    for axis in (0, 1):
        shape = list(image.shape)
        step = math.prod(shape[axis + 1 :])
        extent = shape[axis]
        shape[axis] -= 2 * margin
        lane = dr.arange(mi.UInt32, math.prod(shape))
        inner = step * shape[axis]
        start = lane // inner * (step * extent) + lane % inner
        total = dr.zeros(mi.Float, math.prod(shape))
        for place, factor in enumerate(factors):
            # Entries have several destinations in one kernel, so atomics add up the derivative.
            total += factor * dr.gather(mi.Float, image.array, start + place * step)
        image = mi.TensorXf(total, tuple(shape))
    return image


class _Blur(dr.CustomOp):
    """Gaussian blur of an image (H, W, C), reflected at its borders. The blur is a symmetric linear operator, and its
    own adjoint.
    """

    def eval(self, image: mi.TensorXf, sigma: float) -> mi.TensorXf:
        self.sigma = sigma
        return self._blurred(image)

    def _blurred(self, image: mi.TensorXf) -> mi.TensorXf:
        decay = [np.exp(-0.5 * np.square(np.pi * self.sigma / size * np.arange(size))) for size in image.shape[:2]]
        factors = np.multiply.outer(*decay)[:, :, None].astype(np.float32)
        return mi.TensorXf(np.ascontiguousarray(scale_frequencies(np.array(image), factors)))

    def backward(self) -> None:
        self.set_grad_in("image", self._blurred(self.grad_out()))

    def name(self) -> str:
        return "blur"


def blur(image: mi.TensorXf, sigma: float) -> mi.TensorXf:
    """Return an image (H, W, C) blurred by a Gaussian with a standard deviation of `sigma` pixels, attached."""
    result: mi.TensorXf = dr.custom(_Blur, image, sigma)
    return result


LOSSES: dict[str, Loss] = {"l1": l1, "l2": l2, "relative_l2": relative_l2, "ssim": ssim}

#: Losses with a derivative linear in the image, so that its noise averages out.
QUADRATIC = ("l2", "relative_l2")


def make_loss(type: str, **options: float) -> Loss:
    """Return the loss named `type` with its options. Raises KeyError for an unknown name."""
    return functools.partial(LOSSES[type], **options)


def weighted(
    losses: Sequence[tuple[float, Loss]],
    image: mi.TensorXf,
    target: mi.TensorXf,
    weights: mi.TensorXf | None = None,
    /,
) -> mi.Float:
    """Return the sum of losses, each multiplied by its weight."""
    first, *others = (factor * loss(image, target, weights) for factor, loss in losses)
    return sum(others, first)


# --- losses of the user -----------------------------------------------------------------------------------------------


class OwnLoss:
    """A user's loss: `loss(image, target)`, or `loss(image, target, weights)`.

    Both images are (H, W, C). `weights` is None, or has the images' shape and a mean of 1. If the function has no
    parameter `weights`, masked pixels have equal values in both images. The weights of all unmasked pixels must then be
    equal. The function returns an array of width 1, or a tensor of one entry. The file is loaded when the loss is first
    called or tried. If a function was passed in Python, errors name the function as their location.
    """

    def __init__(self, config: Config, key: str, spec: Custom) -> None:
        self.source: object = config.source
        self.key, self.spec, self._config = key, spec, config
        self._place, self._file = key, spec.path
        self._function = None if spec.file is not None else config.own_loss
        if self._function is not None:
            self.source, self.key = "loss", _name_of(self._function)
            code = getattr(self._function, "__code__", None)
            self._file = None if code is None else Path(code.co_filename)
        self._takes_weights: bool | None = None
        #: Digest of a given function, which equals no other; for a file, the digest of its contents.
        self.token = "" if self._function is None else secrets.token_hex(8)
        self._even: mi.TensorXf | None = None

    def function(self) -> Callable[..., Any]:
        """Return the user's function, loaded. Raises ConfigError."""
        if self._takes_weights is None:
            check_code(self._config, {self._place: self.spec.file})
            if self.spec.path is not None:
                self._function = load_named(self.spec.path, self.spec.name, self.source, self.key)
            assert self._function is not None
            self._takes_weights = _takes_weights(self._function)
        return self._function  # type: ignore[return-value]

    def __call__(self, image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
        """Return the loss, of width 1, attached. Raises ConfigError for an invalid result."""
        function, what = self.function(), "it"
        # copies, because a function may change its arguments in place
        given = [None if each is None else mi.TensorXf(each) for each in (image, target, weights)]
        if not self._takes_weights:
            self._check_even(weights)
            given = given[:2]
        with guarded(self.source, self.key, self._file, what):
            value = function(*given)
        if isinstance(value, mi.TensorXf):
            value = value.array
        if not isinstance(value, mi.Float):
            raise self._wrong(f"returns {type(value).__name__}, not mi.Float (such as dr.mean(..., axis=None))")
        if dr.width(value) != 1:
            raise self._wrong(
                f"returns {dr.width(value)} numbers instead of one: return a mean over pixels and channels"
            )
        if dr.grad_enabled(image) and not dr.grad_enabled(value):
            raise self._wrong("returns a value without a derivative by the image: compute it from `image` with Dr.Jit")
        return value

    def attempt(self, target: mi.TensorXf, weights: mi.TensorXf | None) -> None:
        """Call the loss once, with an image other than the target. Raises ConfigError if loss or derivative are not
        finite.

        `run.on_nonfinite` handles later values.
        """
        values = np.array(target)
        pattern = 0.5 + 0.3 * np.cos(np.arange(values.size)).reshape(values.shape)
        image = mi.TensorXf(np.ascontiguousarray(values * pattern + 0.1 * values.mean() + 1e-3, dtype=np.float32))
        dr.enable_grad(image)
        with dr.resume_grad():
            value = self(image, target, weights)
            with guarded(self.source, self.key, self._file, "its derivative"):
                dr.backward(value)
        loss, gradient = float(dr.detach(value)[0]), np.array(dr.grad(image))
        if not np.isfinite(loss):
            raise self._wrong(f"returns {loss} for a target and a darker image, not a finite number")
        if not np.isfinite(gradient).all():
            raise self._wrong("has a derivative that is not finite for a target and a darker image")

    def _check_even(self, weights: mi.TensorXf | None) -> None:
        if weights is None or weights is self._even:
            return
        kept = np.unique(np.array(weights))
        if len(kept[kept > 0]) > 1:
            raise self._wrong("has no argument for the weights of this view's mask: add a third argument, `weights`")
        self._even = weights

    def _wrong(self, reason: str) -> ConfigError:
        return ConfigError(self.source, self.key, reason)


def own_losses(config: Config) -> str:
    """Return a text that names the experiment's custom losses, or "" without custom losses."""
    own = dict.fromkeys(one.file for one in config.losses if isinstance(one, Custom))
    handed = "function" if config.own_loss is None else _name_of(config.own_loss)
    return ", ".join(f"`{file or handed}`" for file in own)


def _name_of(function: Callable[..., Any]) -> str:
    return str(getattr(function, "__name__", type(function).__name__))


def _takes_weights(function: Callable[..., Any]) -> bool:
    """True if `function` accepts three positional arguments."""
    try:
        inspect.signature(function).bind(None, None, None)
    except (TypeError, ValueError):
        return False
    return True
