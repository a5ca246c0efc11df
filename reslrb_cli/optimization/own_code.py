"""A user's loss (`loss.type: custom`), from a file FILE.py:NAME, or from Python."""

from __future__ import annotations

import inspect
import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.code import Guard, load_named
from reslrb_cli.config.loader import check_code
from reslrb_cli.config.optimizers import Custom
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError


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
            check_code(self._config, {self._place: self.spec})
            if self.spec.path is not None:
                self._function = load_named(self.spec.path, self.spec.name, self.source, self.key)
            assert self._function is not None
            self._takes_weights = _takes(self._function, 3)
        return self._function  # type: ignore[return-value]

    def __call__(self, image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
        """Return the loss, of width 1, attached. Raises ConfigError for an invalid result."""
        function, what = self.function(), "it"
        # copies, because a function may change its arguments in place
        given = [None if each is None else mi.TensorXf(each) for each in (image, target, weights)]
        if not self._takes_weights:
            self._check_even(weights)
            given = given[:2]
        with Guard(self.source, self.key, self._file, what):
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
            with Guard(self.source, self.key, self._file, "its derivative"):
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


def _takes(function: Callable[..., Any], count: int) -> bool:
    """True if `function` accepts `count` positional arguments."""
    try:
        inspect.signature(function).bind(*range(count))
    except (TypeError, ValueError):
        return False
    return True
