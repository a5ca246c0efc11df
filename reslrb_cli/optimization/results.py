"""The results of a run: its best parameters, whether its loss fell, and values and errors at its start and its end.

`Best`, the best parameters that a run has had, beside the last: the loss of an iteration is noise for the most part, so
that the least of all would be the luckiest. Where views are held out, the best parameters are those of the least loss
of these, which always has the same samples; otherwise those at the end of the WINDOW iterations whose losses have the
least mean.

`find_trend` and `got_worse`, whether a run moved anything: its loss and its errors at the start and at the end, told
from their noise. Compared are the first and the last tenth of the iterations, since a single loss is noise for the most
part. Nothing is said of a run that is too short or too noisy: whoever reads that the loss did not fall has to be able
to rely on it.

- It fell, if the last tenth is surely below the first, by its mean or by its median. A fall is often over within a few
  iterations of the first tenth, so that its spread is no noise; the noise of one iteration is taken from the
  differences between neighbours instead, by their median: s = median |x_{i+1} - x_i| / (√2 Φ⁻¹(3/4)).
- It rose, if the last tenth is surely above the first, by mean and median, of which the latter does not know of single
  outliers (fireflies); or surely above the very first value, from where some runs leap before they come down again.
- It was flat, if it did neither, and surely fell by no more than `MOST_FALL`.

`Results` puts these together with the parameters' values and errors at the start and at the end.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.optimization.errors import nearest
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.state import Count, Number
from reslrb_cli.optimization.views import View
from reslrb_cli.records.metrics import Figure, Record, finite

#: Iterations over which losses are averaged.
WINDOW = 10


@dataclass(frozen=True)
class Least:
    """The least loss so far, and after how many updates it was."""

    iteration: Count
    loss: Number


class Best:
    """The best so far: its loss (None where there is none yet), the values, and the last WINDOW losses (`recent`)."""

    def __init__(self, held_out: bool) -> None:
        self.held_out = held_out
        self.least: Least | None = None
        self.values: dict[str, Any] = {}
        self.recent: deque[float] = deque(maxlen=WINDOW)

    def see(self, record: Record, values: Mapping[str, Any]) -> None:
        """Take one iteration, and the values that it began with, by key; they are kept, not copied."""
        self.recent.append(record.loss)
        if self.held_out:
            loss = math.inf if record.held_out is None else record.held_out
        else:
            loss = sum(self.recent) / WINDOW if len(self.recent) == WINDOW else math.inf
        if loss < (math.inf if self.least is None else self.least.loss):  # which what is not finite is not
            self.least, self.values = Least(record.iteration, loss), dict(values)

    def to_json(self) -> dict[str, Any] | None:
        """For the manifest; None where there is none."""
        kind = "held_out" if self.held_out else f"mean of {WINDOW} iterations"
        return None if self.least is None else {**asdict(self.least), "loss_is": kind}


Array = np.ndarray[Any, Any]

#: A run of fewer iterations is not judged, and so many are the least that are averaged.
LEAST_ITERATIONS, LEAST_WINDOW = 20, 5

#: How sure a difference has to be (one-sided).
CONFIDENCE = 0.99

#: A fall by no more than this share of the start is none, where noise hides it.
MOST_FALL = 0.25

#: An error has to rise by this share to be called worse, and in a run that is too short to know its wandering.
WORSE, WORSE_IF_SHORT = 0.01, 0.1

#: √2 Φ⁻¹(3/4): the median difference of two values from a normal distribution of standard deviation 1.
_MEDIAN_DIFFERENCE = 0.9539

#: The standard error of a median over that of a mean, for a normal distribution.
_MEDIAN_ERROR = 1.2533


@dataclass(frozen=True)
class Level:
    """The mean of some iterations, and its standard error."""

    mean: float
    error: float


class Change(str, enum.Enum):
    """What became of a series, as far as its noise tells."""

    FELL = "fell"
    ROSE = "rose"
    FLAT = "flat"
    UNCLEAR = "unclear"


@dataclass(frozen=True)
class Trend:
    """A series at its start and at its end."""

    start: Level
    end: Level
    change: Change

    def to_json(self) -> dict[str, Any]:
        """As a mapping for JSON."""
        return {**asdict(self), "change": self.change.value}


def find_trend(values: Sequence[float]) -> Trend | None:
    """The trend of a value per iteration; those that are not finite are left out. None where there are too few."""
    series = np.array([value for value in values if math.isfinite(value)], dtype=np.float64)
    if series.size < LEAST_ITERATIONS:
        return None
    width = window(series.size)
    first, last = series[:width], series[-width:]
    start, end = _level(first), _level(last)
    sure = _quantile(2 * (width - 1))
    noise = sure * math.hypot(_noise(first), _noise(last)) / math.sqrt(width)
    spread = sure * math.hypot(start.error, end.error)
    mean, median = end.mean - start.mean, float(np.median(last) - np.median(first))
    above_first = _quantile(width - 1) * end.error * math.sqrt(width + 1)
    if end.mean - series[0] > above_first:
        return Trend(Level(float(series[0]), end.error * math.sqrt(width)), end, Change.ROSE)
    if mean > spread and median > _MEDIAN_ERROR * noise:
        change = Change.ROSE
    elif mean < -noise or median < -_MEDIAN_ERROR * noise:
        change = Change.FELL
    else:
        change = Change.FLAT if spread - mean < MOST_FALL * start.mean else Change.UNCLEAR
    return Trend(start, end, change)


def got_worse(errors: Sequence[float], final: float) -> bool:
    """Whether an error ended above its start: the last one, `final`, and all of the last tenth before it.

    Errors are known exactly, but wander with the noise of the gradients: a short run has to end well above its start.
    """
    if not errors:
        return False
    if len(errors) < LEAST_ITERATIONS:
        return final > (1 + WORSE_IF_SHORT) * errors[0]
    limit = (1 + WORSE) * errors[0]
    return min(final, *errors[-window(len(errors)) :]) > limit


def window(iterations: int) -> int:
    """How many of the first and of the last iterations are averaged."""
    return max(iterations // 10, LEAST_WINDOW)


def _noise(values: Array) -> float:
    return float(np.median(np.abs(np.diff(values)))) / _MEDIAN_DIFFERENCE


def _level(values: Array) -> Level:
    return Level(float(values.mean()), float(np.std(values, ddof=1)) / math.sqrt(len(values)))


def _quantile(freedom: int) -> float:
    from scipy.special import stdtrit  # late: only a run that ends needs it

    return float(stdtrit(freedom, CONFIDENCE))


#: A parameter of at most so many numbers is told by them, a larger one by its mean and range.
MOST_NUMBERS = 4


@dataclass
class Images:
    """The losses of the saved images of views, of those that are trained on, and of those held out."""

    trained: list[Figure] = field(default_factory=list)
    held_out: list[Figure] = field(default_factory=list)


class Results:
    """Collects the results of one run of `problem`, whose parameters stand at their initial values when this is made:
    `add` each iteration, `end` after all.

    `to_json` can be asked for at any time; what is not known yet is null there.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, self.meter = problem, problem.meter
        self._first = self.meter.errors(problem.selection.array)
        self._last: dict[str, float] = {}
        self._values: dict[str, dict[str, Any]] = {key: {} for key in problem.selection.keys}
        self._losses: list[float] = []
        self._iterations = 0
        self._scales: dict[str, float] = {}
        self.images = {"initial": Images(), "final": Images()}
        self._errors: dict[str, list[float]] = {}
        self._take("initial")
        for key, true in problem.truth.items():
            self._values[key]["true"] = summary(true, problem.masks.get(key))

    def add(self, record: Record) -> None:
        """Take one iteration. The losses that are judged are those of whole films, with all samples."""
        self._iterations += 1
        config = self.problem.config
        stage = config.stage(config.stage_number(record.iteration / config.run.iterations))
        if stage.film == 1 and stage.spp in (None, config.run.spp):
            self._losses.append(record.loss)
        for key, error in record.parameter_errors.items():
            self._errors.setdefault(key, []).append(error)

    def end(self) -> None:
        """Take the parameters as they are for those of the end."""
        self._last = self.meter.errors(self.problem.selection.array)
        self._take("final")

    def see(self, moment: str, view: View, image: Array, scale: float = 1.0) -> None:
        """Take the saved image of a view, as its loss takes it (`Problem.see`), at `initial` or `final`, and the
        `scale` that suits the target; every view in turn."""
        if (images := self.images.get(moment)) is not None:
            loss = view.objective(mi.TensorXf(np.ascontiguousarray(image, dtype=np.float32)))
            if view.fits and moment == "final":
                self._scales[str(view.sensor)] = scale
            (images.held_out if view.held_out else images.trained).append(float(loss[0]))

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
        of views that are trained on (`fitted_scale`: what the final ones are multiplied by, by sensor, with
        `loss.scale: fitted` alone), and `held_out` the mean of those that are not; `worse` are the keys whose error
        ended above its start. `samples` are those of a step and of a rendered target, null without one.
        """
        trend = find_trend(self._losses)
        run, render = self.problem.config.run, self.problem.config.target.render
        first, last = self._first, self._last
        relative = self.meter.relative(first), self.meter.relative(last)
        worse = [key for key, error in last.items() if got_worse(self._errors.get(key, []), error)]
        if self._iterations < min(run.iterations, LEAST_ITERATIONS):  # of a run that goes on nothing is known yet
            worse = []
        found = {
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
        }
        if self._scales:
            found["fitted_scale"] = self._scales
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
