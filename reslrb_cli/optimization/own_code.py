"""A user's own Python code, named as FILE.py:NAME or handed over, and the loss that it may be (`loss.type: custom`).

A file is run with the user's rights, and nothing looks at what it does: so it is run only where the command line, or
the caller in Python, allows it (`Config.with_code`), which no YAML can, and not before it is called for. Commands that
read, show or export a run call for nothing.
"""

from __future__ import annotations

import hashlib
import inspect
import secrets
import sys
import traceback
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.config.files import read_file
from reslrb_cli.config.loader import check_code
from reslrb_cli.config.optimizers import CODE_BYTES, Custom
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, describe, is_machine_fault, is_out_of_memory


def load_named(file: Path, name: str, source: object, key: str) -> Callable[..., Any]:
    """What the file calls `name`, once it is run. Files beside it can be imported by it, behind all other modules.

    Raises ConfigError, located at `key` of `source`, where it cannot be read or run, or has nothing callable of that
    name.
    """
    try:
        text = read_file(file, CODE_BYTES)
    except ConfigError as error:
        raise ConfigError(source, key, f"{file}: {error.message}") from None
    module = types.ModuleType(f"reslrb_own_{hashlib.blake2b(str(file).encode(), digest_size=6).hexdigest()}")
    module.__file__ = str(file)
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    sys.modules[module.__name__] = module  # dataclasses and pickle look it up there
    with_place = Guard(source, key, file, "the file")
    with with_place:
        exec(compile(text, str(file), "exec"), module.__dict__)
    found = getattr(module, name, None)
    if not callable(found):
        what = "nothing" if not hasattr(module, name) else f"a {type(found).__name__}, not a function,"
        raise ConfigError(source, key, f"{file} has {what} of the name `{name}`")
    return found


class Guard:
    """While this is entered, what a user's code raises becomes one located line; what the machine raises stays."""

    def __init__(self, source: object, key: str, file: Path | None, what: str) -> None:
        self.source, self.key, self.file, self.what = source, key, file, what

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: Any) -> None:
        if error is None or not isinstance(error, Exception | SystemExit) or isinstance(error, ConfigError):
            return
        if is_out_of_memory(error) or is_machine_fault(error):
            return
        lines = [each.lineno for each in traceback.extract_tb(trace) if self.file and each.filename == str(self.file)]
        if isinstance(error, SyntaxError) and error.filename == str(self.file):
            lines = [error.lineno]
        where = f" in line {lines[-1]}" if lines else ""
        said = f"{type(error).__name__}: {error}".rstrip(": ") if str(error) else describe(error)
        raise ConfigError(self.source, self.key, f"{self.what} raises{where} {said}") from error


class OwnLoss:
    """A loss that a user has written: `loss(image, target)`, or `loss(image, target, weights)`.

    Both images are (H, W, C), `weights` None or of that shape with a mean of 1. Without `weights` pixels that are left
    out are the same in both images, and what is left has to weigh the same. It returns the loss, as an array of width 1
    or as a tensor of one entry. Code is run when it is first called, or tried: before that nothing is loaded.
    """

    def __init__(self, config: Config, key: str, spec: Custom) -> None:
        self.source, self.key, self.spec, self._config = config.source, key, spec, config
        self._function = None if spec.file is not None else config.own_loss
        self._takes_weights: bool | None = None
        self._token = secrets.token_hex(8)
        self._even: mi.TensorXf | None = None

    def function(self) -> Callable[..., Any]:
        """The user's function, loaded. Raises ConfigError."""
        if self._takes_weights is None:
            check_code(self._config, {self.key: self.spec})
            if self.spec.path is not None:
                self._function = load_named(self.spec.path, self.spec.name, self.source, self.key)
            assert self._function is not None
            self._takes_weights = _takes(self._function, 3)
        return self._function  # type: ignore[return-value]

    def __call__(self, image: mi.TensorXf, target: mi.TensorXf, weights: mi.TensorXf | None = None, /) -> mi.Float:
        """The loss, of width 1, attached. Raises ConfigError for what is none."""
        function, what = self.function(), "it"
        given: tuple[mi.TensorXf | None, ...] = (image, target, weights)
        if not self._takes_weights:
            self._check_even(weights)
            given = given[:2]
        with Guard(self.source, self.key, self.spec.path, what):
            value = function(*given)
        if isinstance(value, mi.TensorXf):
            value = value.array
        if not isinstance(value, mi.Float):
            raise self._wrong(f"returns {type(value).__name__}, not mi.Float (for one dr.mean(..., axis=None))")
        if dr.width(value) != 1:
            raise self._wrong(f"returns {dr.width(value)} numbers, not one: a mean over pixels and channels is wanted")
        if dr.grad_enabled(image) and not dr.grad_enabled(value):
            raise self._wrong(
                "returns what has no derivative by the image: it has to be computed from `image` by Dr.Jit"
            )
        return value

    def attempt(self, target: mi.TensorXf, weights: mi.TensorXf | None) -> None:
        """Call it once, of an image that is not the target; raise ConfigError where loss or derivative are not finite.

        Later ones are a run's own affair (`run.on_nonfinite`).
        """
        values = np.array(target)
        pattern = 0.5 + 0.3 * np.cos(np.arange(values.size)).reshape(values.shape)
        image = mi.TensorXf(np.ascontiguousarray(values * pattern + 0.1 * values.mean() + 1e-3, dtype=np.float32))
        dr.enable_grad(image)
        with dr.resume_grad():
            value = self(image, target, weights)
            with Guard(self.source, self.key, self.spec.path, "its derivative"):
                dr.backward(value)
        loss, gradient = float(dr.detach(value)[0]), np.array(dr.grad(image))
        if not np.isfinite(loss):
            raise self._wrong(f"returns {loss} of a target and a darker image, not a finite number")
        if not np.isfinite(gradient).all():
            raise self._wrong("has a derivative that is not finite, of a target and a darker image")

    def digest(self) -> str:
        """The code in short, of which what is measured depends; a function that was handed over is like no other."""
        return code_digest(self.spec.path) if self.spec.path is not None else self._token

    def _check_even(self, weights: mi.TensorXf | None) -> None:
        if weights is None or weights is self._even:
            return
        kept = np.unique(np.array(weights))
        if len(kept[kept > 0]) > 1:
            raise self._wrong("takes no weights, which this view's mask has: give it a third argument, `weights`")
        self._even = weights

    def _wrong(self, reason: str) -> ConfigError:
        return ConfigError(self.source, self.key, reason)


def code_digest(file: Path) -> str:
    """What is in a file of code, in short; what it imports is not in it. Raises ConfigError."""
    return hashlib.blake2b(read_file(file, CODE_BYTES), digest_size=16).hexdigest()


def _takes(function: Callable[..., Any], count: int) -> bool:
    """Whether so many arguments can be given by their place."""
    try:
        inspect.signature(function).bind(*range(count))
    except (TypeError, ValueError):
        return False
    return True
