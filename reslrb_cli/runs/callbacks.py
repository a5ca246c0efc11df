"""Callbacks of a run: the protocol, and the calls.

An error of a callback ends the run as an error of any other user code does: one line that names the callback and its
line, and a complete run folder. After an error of an `optional` callback, the run goes on without it.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.code import guarded
from reslrb_cli.errors import describe
from reslrb_cli.records.manifest import Manifest
from reslrb_cli.records.metrics import Record
from reslrb_cli.report.tonemap import shown_exposures

Array = np.ndarray[Any, Any]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunInfo:
    """Description of a run for its callbacks.

    - `name` is `run.name`, and `folder` is the run folder, or None for a run that writes nothing.
    - `settings` has all settings that are not null, by their keys as in `--set`.
    - `iterations` is the total number of iterations, and `done` the number before this process.
    - `shapes` has the shape of each parameter by key.
    """

    name: str
    folder: Path | None
    settings: Mapping[str, Any]
    iterations: int
    done: int
    shapes: Mapping[str, tuple[int, ...]]
    _value: Callable[[str], Array] = field(repr=False)

    def value(self, key: str) -> Array:
        """Return the current value of the parameter `key`, as `Run.parameters` does."""
        return self._value(key)


class Callback:
    """Receiver of the progress of a run. Derive from it, and override the methods that you need.

    Pass callbacks to `optimize(..., callbacks=[...])`. The run calls the methods between iterations, on its own thread.
    An error in a method ends the run with one line, and with a complete run folder. If `optional` is True, an error
    after `begin` is a warning, and the run goes on without the callback.
    """

    optional = False

    def begin(self, run: RunInfo) -> None:
        """Receive the start of a loop. A loop that continues the run calls `begin` again."""

    def iteration(self, run: RunInfo, record: Record) -> None:
        """Receive a finished iteration. `run.value` returns the values after its update."""

    def image(self, run: RunInfo, name: str, image: Array, exposure: float) -> None:
        """Receive an image: `target`, `initial` or `final`, followed by `-SENSOR` if there are several views.

        `image` is linear, float32, of shape (height, width, channels), with the exposure of the target. Multiply it by
        `exposure` to show it.
        """

    def end(self, run: RunInfo, status: str) -> None:
        """Receive the end of a loop. `status` is `finished`, `interrupted` or `failed`."""


class Calls:
    """Calls of a run's callbacks, in their order. False if there are none."""

    def __init__(self, callbacks: Sequence[Callback], run: RunInfo, manifest: Manifest) -> None:
        self._callbacks, self._run, self._manifest = callbacks, run, manifest

    def __bool__(self) -> bool:
        return bool(self._callbacks)

    def begin(self) -> None:
        """Report the start of the iterations."""
        for each in self._callbacks:
            self._call(each, "begin")

    def iteration(self, record: Record) -> None:
        """Report a finished iteration."""
        for each in self._callbacks:
            self._call(each, "iteration", record)

    def image(self, name: str, suffix: str, image: Array) -> None:
        """Report an image (H, W, C) with the exposure of the target."""
        exposure = shown_exposures(self._manifest.views).get(suffix, 1.0) if self._callbacks else 1.0
        for each in self._callbacks:
            self._call(each, "image", name + suffix, image, exposure)

    def images(self, name: str, images: Mapping[int, Array]) -> None:
        """Report an image of each view, by the index of its sensor."""
        for sensor, image in images.items():
            self.image(name, "" if len(images) == 1 else f"-{sensor}", image)

    def end(self, status: str) -> None:
        """Report the end of the run to every callback, then raise the first error."""
        failure: Exception | None = None
        for each in self._callbacks:
            try:
                self._call(each, "end", status)
            except Exception as error:
                failure = failure or error
        if failure is not None:
            raise failure

    def _call(self, callback: Callback, name: str, *arguments: Any) -> None:
        kind = type(callback)
        file = getattr(sys.modules.get(kind.__module__), "__file__", None)
        try:
            with guarded("callbacks", kind.__name__, None if file is None else Path(file), f"`{name}`"):
                getattr(callback, name)(self._run, *arguments)
        except Exception as error:
            if not callback.optional or name == "begin":
                raise
            self._callbacks = [each for each in self._callbacks if each is not callback]
            logger.warning("%s; the run goes on without this callback", describe(error))
