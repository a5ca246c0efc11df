"""What a run found: values and errors of its parameters at its start and its end, and whether its loss fell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.optimization.errors import nearest
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.trend import LEAST_ITERATIONS, find_trend, got_worse
from reslrb_cli.optimization.views import View
from reslrb_cli.records.metrics import Record, finite

Array = np.ndarray[Any, Any]

#: A parameter of at most so many numbers is told by them, a larger one by its mean and range.
MOST_NUMBERS = 4


class Results:
    """Collects the results of one run of `problem`: `begin` before its first iteration, `add` each, `end` after all.

    `to_json` can be asked for at any time; what is not known yet is null there.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, self.meter = problem, problem.error_meter()
        self._first: dict[str, float] = {}
        self._last: dict[str, float] = {}
        self._values: dict[str, dict[str, Any]] = {key: {} for key in problem.selection.keys}
        self._losses: list[float] = []
        self._image_losses: dict[str, list[float]] = {"initial": [], "final": []}
        self._held_out: dict[str, list[float]] = {"initial": [], "final": []}
        self._errors: dict[str, list[float]] = {}

    def begin(self) -> None:
        """Take the parameters as they are for those of the start."""
        self._first = self.meter.errors(self.problem.selection.array)
        self._take("initial")
        for key, true in self.problem.truth.items():
            self._values[key]["true"] = summary(true, self.problem.masks.get(key))

    def recall(self, images: Mapping[str, list[float]]) -> None:
        """Go on from what `images_seen` said of the start."""
        self._image_losses["initial"], self._held_out["initial"] = images["trained"], images["held_out"]

    def images_seen(self) -> dict[str, list[float]]:
        """The losses of the images of the start: of views that are trained on, and of those held out."""
        return {"trained": self._image_losses["initial"], "held_out": self._held_out["initial"]}

    def add(self, record: Record) -> None:
        """Take one iteration."""
        self._losses.append(record.loss)
        for key, error in record.parameter_errors.items():
            self._errors.setdefault(key, []).append(error)

    def end(self) -> None:
        """Take the parameters as they are for those of the end."""
        self._last = self.meter.errors(self.problem.selection.array)
        self._take("final")

    def see(self, moment: str, view: View, image: Array) -> None:
        """Take the saved image (H, W, C) of a view, at `initial` or `final`; every view in turn."""
        if moment in self._image_losses:
            loss = view.objective(mi.TensorXf(np.ascontiguousarray(image, dtype=np.float32)))
            (self._held_out if view.held_out else self._image_losses)[moment].append(float(loss[0]))

    def _take(self, moment: str) -> None:
        for key, value in self.problem.values().items():
            self._values[key][moment] = summary(value, self.problem.masks.get(key))

    def to_json(self) -> dict[str, Any]:
        """For the manifest.

        `parameter_rmse` and `relative_error` (over the root mean square of the truth) are errors by key, initial and
        final; `rmse` is that of all parameters together, null where their units differ. `parameters` are, by key,
        quantity and shape, the share of entries that light and sensor reach, the root mean square of the truth over
        those (`scale`), and `initial`, `final` and `true` values (`summary`). `loss_trend` says how loss and noise were
        at the start and the end, null for a short run; `image_loss` is that of the saved images, which have less noise,
        of views that are trained on, and `held_out` the mean of those that are not; `worse` are the keys whose error
        ended above its start. `samples` are those of a step and of a rendered target, null without one.
        """
        trend = find_trend(self._losses)
        run, render = self.problem.config.run, self.problem.config.target.render
        first, last = self._first, self._last
        relative = self.meter.relative(first), self.meter.relative(last)
        worse = [key for key, error in last.items() if got_worse(self._errors.get(key, []), error)]
        if len(self._losses) < min(run.iterations, LEAST_ITERATIONS):  # of a run that goes on nothing is known yet
            worse = []
        found = {
            "rmse": {"initial": self.meter.total(first), "final": self.meter.total(last)},
            "parameter_rmse": {key: _pair(key, first, last) for key in first | last},
            "relative_error": {key: _pair(key, *relative) for key in relative[0] | relative[1]},
            "parameters": {key: self._about(key) | values for key, values in self._values.items()},
            "image_loss": {
                moment: float(np.sum(losses)) if len(losses) == len(self.problem.trained) else None
                for moment, losses in self._image_losses.items()
            },
            "held_out": {moment: float(np.mean(losses)) for moment, losses in self._held_out.items() if losses},
            "loss_trend": None if trend is None else trend.to_json(),
            "worse": worse,
            "samples": {"step": run.spp, "target": None if render is None else render.spp},
        }
        return {name: finite(value) for name, value in found.items()}

    def _about(self, key: str) -> dict[str, Any]:
        mask = self.problem.masks.get(key)
        return {
            "quantity": self.problem.quantities.get(key, ""),
            "shape": list(self.problem.selection.array(key).shape),
            "reached": None if mask is None else float(mask.mean()),
            "scale": self.meter.scales.get(key),
            "initial": None,
            "final": None,
            "true": None,
        }


def summary(value: Array, mask: Array | None = None) -> dict[str, Any]:
    """A parameter in a few numbers: all of them as `value`, or, over the entries in `mask`, `mean`, `min` and `max`.

    The mean of a texture (H, W, C) has a number for each channel. A mask of another resolution is read where the
    texels' centres are; one that is empty counts for nothing.
    """
    if value.ndim < 3 and value.size <= MOST_NUMBERS:
        return {"value": value.tolist()}
    chosen = value
    if mask is not None and mask.any():
        if value.ndim == 3 and mask.shape != value.shape[:2]:
            mask = nearest(mask, (value.shape[0], value.shape[1]))
        chosen = value[mask]
    channels = value.shape[2] if value.ndim == 3 else 1
    mean = chosen.reshape(-1, channels).mean(axis=0, dtype=np.float64)
    return {"mean": mean.tolist(), "min": float(chosen.min()), "max": float(chosen.max())}


def _pair(key: str, first: dict[str, float], last: dict[str, float]) -> dict[str, float | None]:
    return {"initial": first.get(key), "final": last.get(key)}
