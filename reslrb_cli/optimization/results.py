"""Results of a run: whether its loss fell, and values and errors at start and end.

`got_worse` returns true if an error ended above its initial value. Errors are known exactly. `find_trend` does the same
for the loss.

`Results` combines `got_worse` and `find_trend` with the parameters' values and errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.trend import LEAST_ITERATIONS, find_trend, window
from reslrb_cli.optimization.views import View
from reslrb_cli.records.metrics import Figure, Record, finite

Array = np.ndarray[Any, Any]

#: Relative increase above which an error counts as worse, and the same in a run too short to know its fluctuation.
WORSE, WORSE_IF_SHORT = 0.01, 0.1


def got_worse(errors: Sequence[float], final: float) -> bool:
    """True if a parameter's error ended above its initial value. The last error `final` and all errors of the last
    tenth before `final` must exceed the initial error.

    Errors are known exactly, but fluctuate with the noise of the gradients. A short run must therefore end well above
    its initial error to count as worse.
    """
    if not errors:
        return False
    if len(errors) < LEAST_ITERATIONS:
        return final > (1 + WORSE_IF_SHORT) * errors[0]
    limit = (1 + WORSE) * errors[0]
    return min(final, *errors[-window(len(errors)) :]) > limit


#: A parameter of at most this many numbers is printed in full, a larger one by its mean and range.
MOST_NUMBERS = 6


@dataclass
class Images:
    """Losses of the saved images of training views and held-out views."""

    trained: list[Figure] = field(default_factory=list)
    held_out: list[Figure] = field(default_factory=list)


class Results:
    """Results of one run of `problem`. The parameters must have their initial values when the object is constructed.

    Call `add` for each iteration, and `end` afterwards. `to_json` works at any time. Unknown values are null.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, self.meter = problem, problem.meter
        self._first = self.meter.errors(problem.selection.array)
        self._last: dict[str, float] = {}
        self._values: dict[str, dict[str, Any]] = {key: {} for key in problem.selection.keys}
        #: Losses (`loss`) and errors of parameters (`error/KEY`), with one number for each iteration.
        self.history: dict[str, list[float]] = {"loss": []}
        self.images = {"initial": Images(), "final": Images()}
        self._take("initial")
        for key, true in problem.truth.items():
            self._values[key]["true"] = summary(true, problem.masks.get(key))

    def add(self, record: Record) -> None:
        """Record one iteration."""
        self.history["loss"].append(record.loss)
        for key, error in record.parameter_errors.items():
            self.history.setdefault(f"error/{key}", []).append(error)

    def end(self) -> None:
        """Record the current parameters as the final ones."""
        self._last = self.meter.errors(self.problem.selection.array)
        self._take("final")

    def see(self, moment: str, view: View, image: Array) -> None:
        """Record a view's saved image. `moment` is `initial` or `final`. Call this for every view in order."""
        if (images := self.images.get(moment)) is not None:
            loss = view.objective(mi.TensorXf(np.ascontiguousarray(image, dtype=np.float32)))
            (images.held_out if view.held_out else images.trained).append(float(loss[0]))

    def _take(self, moment: str) -> None:
        for key, value in self.problem.values().items():
            self._values[key][moment] = summary(value, self.problem.masks.get(key))

    def to_json(self) -> dict[str, Any]:
        """Return the content for the manifest.

        - `parameter_rmse` and `relative_error` are the initial and final errors for each key. `relative_error` is
            divided by the root mean square of the true value.
        - `rmse` is the error of all parameters together, or null if their units differ.
        - `parameters` has, for each key, the quantity, the shape, and the share of entries that light and sensor reach.
            `scale` is the root mean square of the true value over these entries. `initial`, `final` and `true`
            summarise the values (`summary`).
        - `loss_trend` has loss and noise at the start and the end, or null for a short run.
        - `image_loss` is the loss of the training views' saved images, which have less noise.
        - `held_out` is the mean loss of the held-out views.
        - `worse` has the keys of parameters whose final error is above the initial error.
        - `samples` has the sample counts of a step and of a rendered target. Without a rendered target, the target's
            count is null.
        """
        losses = self.history["loss"]
        trend = find_trend(losses)
        run, render = self.problem.config.run, self.problem.config.target.render
        first, last = self._first, self._last
        relative = self.meter.relative(first), self.meter.relative(last)
        worse = [key for key, error in last.items() if got_worse(self.history.get(f"error/{key}", []), error)]
        if len(losses) < min(run.iterations, LEAST_ITERATIONS):  # a run that continues has no result yet
            worse = []
        found: dict[str, Any] = finite({
            "rmse": {"initial": self.meter.total(first), "final": self.meter.total(last)},
            "parameter_rmse": {key: _pair(key, first, last) for key in first | last},
            "relative_error": {key: _pair(key, *relative) for key in relative[0] | relative[1]},
            "parameters": {key: self._about(key) | values for key, values in self._values.items()},
            "image_loss": {
                moment: float(np.sum(each.trained)) if len(each.trained) == len(self.problem.trained) else None
                for moment, each in self.images.items()
            },
            "held_out": {m: float(np.mean(each.held_out)) for m, each in self.images.items() if each.held_out},
            "loss_trend": None if trend is None else trend.to_json(),
            "worse": worse,
            "samples": {"step": run.spp, "target": None if render is None else render.spp},
        })  # fmt: skip
        return found

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
    """Return a summary of a parameter. The summary has all numbers as `value`, or `mean`, `min` and `max` over the
    entries in `mask`.

    The mean of a texture (H, W, C) has a number for each channel. An empty mask is ignored.
    """
    if value.ndim < 3 and value.size <= MOST_NUMBERS:
        return {"value": value.tolist()}
    chosen = value if mask is None or not mask.any() else value[mask]
    channels = value.shape[2] if value.ndim == 3 else 1
    mean = chosen.reshape(-1, channels).mean(axis=0, dtype=np.float64)
    return {"mean": mean.tolist(), "min": float(chosen.min()), "max": float(chosen.max())}


def _pair(key: str, first: dict[str, float], last: dict[str, float]) -> dict[str, float | None]:
    return {"initial": first.get(key), "final": last.get(key)}
