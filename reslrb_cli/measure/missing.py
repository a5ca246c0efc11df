"""The part of a derivative that attached gradients lack: silhouettes, edges of shadows, light that leaves the film.

Differences of the image at common random numbers have all of it (`Missing`). Along each of K directions, with F_k the
difference and g_k the attached gradient's,

    m_k = F_k - g_k,   share = sqrt(sum_k m_k^2 / sum_k F_k^2)

D(h), the difference by a step h, is wrong by c h^2 + ..., which two steps cancel (L. F. Richardson, 1911):

    E(h) = (4 D(h) - D(2 h)) / 3

Of steps that halve, the one is taken around which E changes least: at larger ones E is truncated, at smaller ones it is
lost in rounding, which is the same for all seeds where it is the scene that is rounded, or in paths that flip. By how
much E changes there counts as error where it stands out of its noise. What noise adds to the squares is subtracted; the
standard error is that of the mean over seeds. `MissingCheck` is `gradcheck --missing` on an experiment.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators.step import make_integrator
from reslrb_cli.measure.gradients import STEPS, Case, Direction, all_directions, seeds
from reslrb_cli.measure.methods import parse_estimators
from reslrb_cli.measure.participants import MOVING_DIRECTIONS, NEVER, PATHS
from reslrb_cli.measure.references import ends
from reslrb_cli.measure.resume_store import Earlier, head
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.measurement_files import Kept
from reslrb_cli.records.measurements import NOTHING, MissingRecord
from reslrb_cli.statistics import jackknife_variance

#: Seeds that steps are chosen with, and the fewest that a share is made of.
PILOT_SEEDS, FEWEST = 4, 4

#: How often the largest step is halved.
HALVINGS = 8


@dataclass
class Missing:
    """Samples of the derivatives of one parameter along K directions: `ours` N times (K,), `differences` (3, K).

    Of the differences the first are by the step of the direction, the others by twice and four times that.
    """

    directions: list[Direction]
    ours: list[np.ndarray] = field(default_factory=list)
    differences: list[np.ndarray] = field(default_factory=list)

    @staticmethod
    def of(case: Case, differenced: Any, directions: Sequence[Direction], spp: int) -> Missing:
        """With a step for each direction."""
        return Missing([_with_step(case, differenced, direction, spp) for direction in directions])

    def take(self, case: Case, tracer: Any, differenced: Any, seed: int, spp: int, step: Callable) -> None:
        """One more seed; `step` is the gradient step that knows dL/dI."""
        gradient = case.gradient(tracer, seed, spp, step=step)
        along = self.directions
        self.ours.append(np.array([gradient @ one.vector for one in along]))
        found = [_differences(case, differenced, one, [one.step * k for k in (1, 2, 4)], seed, spp) for one in along]
        self.differences.append(np.transpose(found))

    @property
    def count(self) -> int:
        """Seeds so far."""
        return len(self.ours)

    def share(self) -> tuple[float, float] | None:
        """The share and its standard error; None where the differences are not told from 0."""
        near, far, farthest = np.stack(self.differences, 1)
        whole = _extrapolate(near, far)
        missing = whole - np.stack(self.ours)
        change, noise = _mean(whole - _extrapolate(far, farthest))
        left = np.square(np.where(np.abs(change) > NOTHING * noise, change, 0))
        mean, error = _mean(whole)
        size = np.square(mean).sum() - np.square(error).sum()
        if size <= NOTHING**2 * np.square(error).sum():
            return None
        part, error = _mean(missing)
        found = _ratio(missing, whole)
        if np.square(part).sum() <= NOTHING**2 * (np.square(error) + left).sum():
            return found, float(np.sqrt((np.square(error) + left).sum() / size))
        # The part's own noise and that of the whole: by leaving out one seed after the other (jackknife).
        without = [_ratio(np.delete(missing, i, 0), np.delete(whole, i, 0)) for i in range(self.count)]
        variance = jackknife_variance(np.array(without))
        truncation = (np.square(part) @ left) / np.square(part).sum() / size
        return found, float(np.sqrt(variance + truncation))


def _ratio(missing: np.ndarray, whole: np.ndarray) -> float:
    """Root of the mean square of (N, K) samples of the part over that of the whole, without what noise adds."""
    squares = [np.square(mean).sum() - np.square(error).sum() for mean, error in (_mean(missing), _mean(whole))]
    return float(np.sqrt(max(squares[0], 0.0) / squares[1]))


def _with_step(case: Case, differenced: Any, direction: Direction, spp: int) -> Direction:
    steps = [STEPS[0] / 2**number for number in range(HALVINGS)]
    pilot = seeds(PILOT_SEEDS, 9)
    found = np.transpose([_differences(case, differenced, direction, steps, seed, spp) for seed in pilot])
    extrapolated = _extrapolate(found[1:], found[:-1])
    change, noise = _mean(np.diff(extrapolated, axis=0).T)
    # From step to step; one that agrees with both its neighbours is no coincidence.
    changed = np.abs(change) + noise
    return replace(direction, step=steps[2 + int(np.argmin(changed[:-1] + changed[1:]))])


def _differences(
    case: Case, differenced: Any, direction: Direction, steps: Sequence[float], seed: int, spp: int
) -> list[float]:
    return [case.difference(differenced, direction.vector, seed, spp, step, direction.sides) for step in steps]


def _extrapolate(near: np.ndarray, far: np.ndarray) -> np.ndarray:
    return np.asarray(near + (near - far) / 3)


def _mean(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (K,) of samples (N, K), and its standard error."""
    return samples.mean(0), samples.std(0, ddof=1) / np.sqrt(len(samples))


#: Light paths of the image that dL/dI is taken at.
IMAGE_PATHS = 2**22

#: What is kept says that it is of this.
KIND = "gradcheck --missing"

#: The estimator whose gradient is looked at: exact, and attached where anything moves.
ESTIMATOR = "stack"


class MissingCheck:
    """The experiment, loaded; a variant must be set. dL/dI is that of its loss at the initial values, held fixed.

    With an `earlier` session seeds are added to its own; `count` is then that of all. Raises ConfigError, also where
    there is nothing to add, and UnsupportedScene.
    """

    def __init__(
        self, config: Config, budget_s: float, count: int | None, spp: int | None, along: int | None,
        earlier: Earlier | None = None,
    ) -> None:  # fmt: skip
        self._budget, self._count, self._start = budget_s, count, time.perf_counter()
        depth = config.integrator.max_depth
        [listed] = parse_estimators(ESTIMATOR)
        problem = assemble(listed.at(config, depth, True).with_exposures_fixed())
        self.source, sensor = str(config.source), problem.sensors[0]
        self.case = Case(problem.scene, problem.selection.keys, sensor, problem.selection)
        height, width, _ = self.case.weights.shape
        self.spp = spp or max(PATHS // (height * width), 1)
        self._weigh(problem, sensor, max(IMAGE_PATHS // (height * width), 1))
        options = problem.config.integrator.options()
        shared = {name: options[name] for name in ("max_depth", "hide_emitters")}
        self._tracer = make_integrator("reslrb", **options)
        self._differenced = make_integrator("walk_ad", **shared, rr_depth=NEVER if ends(depth) else options["rr_depth"])
        count_of_each = along or MOVING_DIRECTIONS
        self._directions = all_directions(self.case, problem.selection, count_of_each, count_of_each)
        #: By parameter, as far as they have been looked at, in the order of `case.keys`.
        self._found: dict[str, Missing] = {} if earlier is None else self._restore(earlier)
        if earlier is not None and count is not None and len(self._found) == len(self.case.keys):
            least = min(found.count for found in self._found.values())
            if least >= count:
                raise earlier.complete(f"{least} seeds", "more with --seeds")

    def conditions(self) -> str:
        """What is measured, in one line."""
        height, width, _ = self.case.weights.shape
        return f"{self.source}, film {width}x{height}, {self.spp} spp, dL/dI of the loss at the initial values"

    def run(self, stop: Callable[[], bool], between: Callable[[], None] = lambda: None) -> Iterator[MissingRecord]:
        """Measure each parameter for its share of the budget; once `stop()`, no more. `between`: after each seed."""
        for place, key in enumerate(self.case.keys):
            if stop():
                return
            now = time.perf_counter()
            end = now + (self._budget - (now - self._start)) / (len(self.case.keys) - place)
            self._measure(key, end, stop, between)
            yield self._record(key)

    def known(self) -> list[MissingRecord]:
        """What has been found of each parameter that has seeds enough for it, in their order."""
        least = min(FEWEST, self._count or FEWEST)
        return [self._record(key) for key, found in self._found.items() if found.count >= least]

    def kept(self, settings: Mapping[str, Any]) -> Kept | None:
        """What a later session, of the same `settings`, needs to go on; None where nothing has been sampled."""
        taken = {key: found for key, found in self._found.items() if found.count}
        if not taken:
            return None
        steps = {key: [direction.step for direction in found.directions] for key, found in taken.items()}
        arrays = {f"ours/{place}": np.stack(found.ours) for place, found in enumerate(taken.values())}
        arrays |= {f"differences/{place}": np.stack(found.differences) for place, found in enumerate(taken.values())}
        return head(KIND, settings, steps=steps), arrays

    def _restore(self, earlier: Earlier) -> dict[str, Missing]:
        """What an earlier session has found, around its own steps. Raises ConfigError where it is none of that."""
        try:
            found = {}
            for place, (key, steps) in enumerate(earlier.head["steps"].items()):
                along = [replace(one, step=float(h)) for one, h in zip(self._directions[key], steps, strict=True)]
                ours, differences = (earlier.arrays[f"{name}/{place}"] for name in ("ours", "differences"))
                if differences.shape != (len(ours), 3, len(along)) or ours.shape[1:] != (len(along),):
                    raise ValueError("of another shape")
                found[key] = Missing(along, list(ours), list(differences))
        except (AttributeError, KeyError, TypeError, ValueError):
            raise earlier.other("its samples are damaged") from None
        return found

    def _measure(self, key: str, end: float, stop: Callable[[], bool], between: Callable[[], None]) -> None:
        if key not in self._found:
            self._found[key] = Missing.of(self.case, self._differenced, self._directions[key], self.spp)
        found = self._found[key]
        for seed in seeds(self._count or 10**6)[found.count :]:
            enough = found.count >= FEWEST and (stop() or (self._count is None and time.perf_counter() > end))
            if enough:
                break
            found.take(self.case, self._tracer, self._differenced, seed, self.spp, self.case.known_step)
            between()

    def _record(self, key: str) -> MissingRecord:
        found = self._found[key]
        share, error = found.share() or (None, None)
        return MissingRecord(self.source, key, share, error, len(found.directions), found.count)

    def _weigh(self, problem: Problem, sensor: int, spp: int) -> None:
        view = problem.views[0]
        gradient = problem.image_gradient(view, problem.render(sensor, spp, 0, "missing"))
        weights = gradient.astype(np.float64)[:, :, : self.case.weights.shape[2]]
        if not np.any(weights):
            raise ConfigError(
                self.source, "loss", "has no derivative at the initial values, which are the target's own"
            )
        # Its size has no part in a share, and tiny numbers would vanish beside the rounding of a sum.
        self.case.weigh(weights / np.abs(weights).mean())
