"""Terms that attached gradients lack: silhouettes, shadow edges, and light that leaves the film.

`integrator.edges` adds silhouettes and shadow edges (`estimators/edges.py`). Some terms are still missing. Finite
differences of the image at common random numbers contain all of these terms (`Missing`). F_k is the finite difference
along direction k, and g_k is the gradient along direction k. There are K directions.

    m_k = F_k - g_k,   share = sqrt(sum_k m_k^2 / sum_k F_k^2)

E(h) (`extrapolated`) combines the differences of two steps, so that their leading errors cancel. Steps are halved
repeatedly. The measurement uses the step around which E changes least. Larger steps have truncation errors. Smaller
steps have rounding errors, or errors of paths that change discontinuously. Rounding errors of the scene's geometry are
the same for all seeds. The remaining change of E counts as an error if it exceeds the noise. The contribution of noise
to the squares is subtracted. The reported standard error is the error of the mean over seeds. `MissingCheck` implements
`gradcheck --missing` for an experiment. With the steps of `choose_step` and no extrapolation, the complete derivative
of configs/lens_pose.yaml seems to lack 1.1 %.

`check_missing` measures the missing share before a run's first iteration, and decides `edges: auto`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from reslrb_cli.config.parameters import HEIGHTMAP
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.measure.gradients import (
    REACH,
    STEPS,
    UNITS,
    Case,
    Direction,
    all_directions,
    embed,
    extrapolated,
    moves_light,
    seeds,
    smooth_rows,
)
from reslrb_cli.measure.methods import NEVER, parse_cases
from reslrb_cli.measure.participants import MOVING_DIRECTIONS, PATHS
from reslrb_cli.measure.references import ends
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.sampling import as_decided, is_auto
from reslrb_cli.optimization.optimizers import SMALL
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import take_gradient, unrecorded
from reslrb_cli.optimization.views import View
from reslrb_cli.records.decisions import Decision
from reslrb_cli.records.measurements import NOTHING, MissingRecord
from reslrb_cli.scene.deformation import where_moved
from reslrb_cli.scene.edges import has_edges
from reslrb_cli.scene.needs import camera_finds_all
from reslrb_cli.statistics import jackknife_variance

#: Seeds for choosing steps, and the minimum for a share.
PILOT_SEEDS, FEWEST = 4, 4

#: Number of times that the largest step is halved.
HALVINGS = 8


@dataclass
class Missing:
    """Samples of one parameter's derivatives along K directions, for N seeds. `ours` has N arrays (K,), and
    `differences` has N arrays (3, K).

    The three differences use one, two and four times the direction's step.
    """

    directions: list[Direction]
    ours: list[np.ndarray] = field(default_factory=list)
    differences: list[np.ndarray] = field(default_factory=list)

    @staticmethod
    def of(case: Case, differenced: Any, directions: Sequence[Direction], spp: int) -> Missing:
        """Create a collection without samples. Choose a step for each direction."""
        return Missing([_with_step(case, differenced, direction, spp) for direction in directions])

    def take(self, case: Case, tracer: Any, differenced: Any, seed: int, spp: int, step: Callable) -> None:
        """Add one seed. `step` is the gradient step with known dL/dI."""
        gradient = case.gradient(tracer, seed, spp, step=step)
        along = self.directions
        self.ours.append(np.array([gradient @ one.vector for one in along]))
        found = [_differences(case, differenced, one, [one.step * k for k in (1, 2, 4)], seed, spp) for one in along]
        self.differences.append(np.transpose(found))

    @property
    def count(self) -> int:
        """The number of seeds."""
        return len(self.ours)

    def share(self) -> tuple[float, float] | None:
        """Return the share and its standard error, or None if the differences are not significantly different
        from 0.
        """
        near, far, farthest = np.stack(self.differences, 1)
        whole = extrapolated(near, far)
        missing = whole - np.stack(self.ours)
        change, noise = _mean(whole - extrapolated(far, farthest))
        left = np.square(np.where(np.abs(change) > NOTHING * noise, change, 0))
        return share_of(whole, missing, left)


def share_of(whole: np.ndarray, missing: np.ndarray, left: np.ndarray) -> tuple[float, float] | None:
    """Return the share of `missing` in `whole`, and the share's standard error. Both arguments are samples (N, K).

    Returns None if `whole` is not significantly different from 0. `left` (K,) has the squared errors of `whole` that
    are equal for all seeds.
    """
    mean, error = _mean(whole)
    size = np.square(mean).sum() - np.square(error).sum()
    if size <= NOTHING**2 * np.square(error).sum():
        return None
    part, error = _mean(missing)
    found = _ratio(missing, whole)
    if np.square(part).sum() <= NOTHING**2 * (np.square(error) + left).sum():
        return found, float(np.sqrt((np.square(error) + left).sum() / size))
    # The noise of the part and of the whole: leave out one seed at a time (jackknife).
    without = [_ratio(np.delete(missing, i, 0), np.delete(whole, i, 0)) for i in range(len(whole))]
    variance = jackknife_variance(np.array(without))
    truncation = (np.square(part) @ left) / np.square(part).sum() / size
    # An error of the whole changes the share more if the whole is small.
    return found, float(np.sqrt(variance + truncation * max(found, 1.0) ** 2))


def _ratio(missing: np.ndarray, whole: np.ndarray) -> float:
    """Return rms(`missing`) / rms(`whole`) for samples (N, K), where rms is the root mean square. The part due to noise
    is subtracted.
    """
    squares = [np.square(mean).sum() - np.square(error).sum() for mean, error in (_mean(missing), _mean(whole))]
    return float(np.sqrt(max(squares[0], 0.0) / squares[1]))


def _with_step(case: Case, differenced: Any, direction: Direction, spp: int) -> Direction:
    steps = [STEPS[0] / 2**number for number in range(HALVINGS)]
    pilot = seeds(PILOT_SEEDS, 9)
    found = np.transpose([_differences(case, differenced, direction, steps, seed, spp) for seed in pilot])
    change, noise = _mean(np.diff(extrapolated(found[1:], found[:-1]), axis=0).T)
    # Difference from step to step; agreement with both neighbours is no coincidence.
    changed = np.abs(change) + noise
    return replace(direction, step=steps[2 + int(np.argmin(changed[:-1] + changed[1:]))])


def _differences(
    case: Case, differenced: Any, direction: Direction, steps: Sequence[float], seed: int, spp: int
) -> list[float]:
    return [case.difference(differenced, direction.vector, seed, spp, step, direction.sides) for step in steps]


def _mean(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (K,) of samples (N, K), and its standard error."""
    return samples.mean(0), samples.std(0, ddof=1) / np.sqrt(len(samples))


#: Light paths of the image at which dL/dI is taken.
IMAGE_PATHS = 2**22

#: Estimator of the checked gradient: exact, and attached if anything moves.
ESTIMATOR = "reslrb:stack"


class MissingCheck:
    """The measurement of missing terms on a loaded experiment. A variant must be set.

    dL/dI is that of the experiment's loss at the initial values, and stays fixed. `count` is the number
    of seeds. Raises ConfigError and UnsupportedScene.
    """

    def __init__(self, config: Config, budget_s: float, count: int | None, spp: int | None) -> None:
        self._budget, self._count, self._start = budget_s, count, time.perf_counter()
        depth = config.integrator.max_depth
        own_paths = config.integrator.options().get("paths", "auto")
        [listed] = parse_cases(ESTIMATOR + ("(paths=auto)" if own_paths == "auto" else ""))
        problem = assemble(listed.at(config, depth, known=True, auto=True).with_exposures_fixed())
        self.source, sensor = str(config.source), problem.sensors[0]
        self.case = Case(problem.scene, problem.selection.keys, sensor, problem.selection)
        height, width, _ = self.case.weights.shape
        self.spp = spp or max(PATHS // (height * width), 1)
        if not _weigh(problem, problem.views[:1], [self.case], max(IMAGE_PATHS // (height * width), 1)):
            reason = "has no derivative at the initial values, which equal those of the target"
            raise ConfigError(self.source, "loss", reason)
        options = problem.config.integrator.options() | {"paths": problem.paths}
        options["edges"] = "off" if config.integrator.options().get("edges") == "off" else "on"
        shared = {name: options[name] for name in ("max_depth", "hide_emitters")} | {"paths": problem.paths}
        self._tracer = make_integrator("reslrb", **options, freeze=True)
        self._differenced = make_integrator("walk_ad", **shared, rr_depth=NEVER if ends(depth) else options["rr_depth"])
        self._directions = all_directions(self.case, problem.selection, MOVING_DIRECTIONS, MOVING_DIRECTIONS)
        #: By parameter, in the order of `case.keys`, as far as measured.
        self._found: dict[str, Missing] = {}

    def conditions(self) -> str:
        """Describe the measurement in one line."""
        height, width, _ = self.case.weights.shape
        return f"{self.source}, film {width}x{height}, {self.spp} spp, dL/dI of the loss at the initial values"

    def run(self, stop: Callable[[], bool], between: Callable[[], None] = lambda: None) -> Iterator[MissingRecord]:
        """Measure the parameters in turn until `stop()`. Each parameter gets a share of the budget. `between` is called
        after each seed.
        """
        for place, key in enumerate(self.case.keys):
            if stop():
                return
            now = time.perf_counter()
            end = now + (self._budget - (now - self._start)) / (len(self.case.keys) - place)
            self._measure(key, end, stop, between)
            yield self._record(key)

    def known(self) -> list[MissingRecord]:
        """Return the results of all parameters with enough seeds, in the order of the parameters."""
        least = min(FEWEST, self._count or FEWEST)
        return [self._record(key) for key, found in self._found.items() if found.count >= least]

    def _measure(self, key: str, end: float, stop: Callable[[], bool], between: Callable[[], None]) -> None:
        found = self._found[key] = Missing.of(self.case, self._differenced, self._directions[key], self.spp)
        for seed in seeds(self._count or 10**6):
            enough = found.count >= FEWEST and (stop() or (self._count is None and time.perf_counter() > end))
            if enough:
                break
            found.take(self.case, self._tracer, self._differenced, seed, self.spp, self.case.known_step)
            between()

    def _record(self, key: str) -> MissingRecord:
        found = self._found[key]
        share, error = found.share() or (None, None)
        return MissingRecord(self.source, key, share, error, len(found.directions), found.count)


def _weigh(problem: Problem, views: Sequence[View], cases: Sequence[Case], spp: int) -> bool:
    """Set the weights of each view's case to dL/dI of the loss at the problem's values. Return whether any is not 0."""
    weights = []
    for case, view in zip(cases, views, strict=True):
        gradient = problem.image_gradient(view, problem.render(view.sensor, spp, 0, "missing"))
        weights.append(np.nan_to_num(gradient.astype(np.float64)[:, :, : case.weights.shape[2]]) * view.share)
    # The size of dL/dI does not affect a share, and tiny numbers would vanish in the rounding of a sum.
    size = max(float(np.abs(each).mean()) for each in weights)
    for case, each in zip(cases, weights, strict=True):
        case.weigh(each / (size or 1.0))
    return size > 0


# --- before a run's first iteration -----------------------------------------------------------------------------------

#: Longest and shortest step of the differences, in tenths of the size of the moving object. A longer step has less
#: noise at edges, and a larger truncation error.
LONGEST, SHORTEST = 0.25, 0.01

#: Maximum numbers of seeds and views.
MOST_SEEDS, MOST_VIEWS = 64, 4


def check_missing(
    problem: Problem, say: Callable[[str], None], warn: Callable[[str], None]
) -> tuple[Problem, list[MissingRecord]]:  # fmt: skip
    """Measure the missing share of the loss's derivative before a run, for each parameter that moves light. Return the
    problem, and one record per parameter.

    With `integrator.edges: auto`, edges are turned on in the returned problem if a significant share is missing
    without them, or if the share is unknown. `say` then receives this decision, and the share is measured again. If
    everything that moves has known edges, and edges are on, records of unknown shares are dropped.

    `warn` receives one line if a derivative is incomplete, or if its missing share is unknown. Raises ConfigError if a
    missing share exceeds one half by more than two standard errors, unless `run.accept_incomplete` is true.
    """
    config, found = problem.config, measure_missing(problem)
    moving = where_moved(problem.selection.params, problem.selection.scene_keys)
    edged = [item for item in moving if not item.is_shape or has_edges(item.node)]
    tracer = problem.integrator if edged and isinstance(problem.integrator, LightTracer) else None
    if tracer is not None and is_auto(config, "edges") and found:
        lacking = [record for record in found if record.is_incomplete]
        why = "no significant part of the derivative is missing without them"
        if lacking:
            clear = next((record for record in lacking if not record.is_unknown), lacking[0])
            amount = "an unknown share" if clear.is_unknown else clear.percent()
            why = f"without them, the derivative of {clear.parameter} lacks {amount}"
        decision = Decision(setting="edges", value="on" if lacking else "off", why=why)
        tracer = as_decided(tracer, [decision])
        problem = replace(problem, decisions=[*problem.decisions, decision], integrator=tracer)
        if lacking:
            say(f"chosen by measurement: {decision.line()}")
            found = measure_missing(problem)
    has_edge_terms = tracer is not None and "edges" in tracer.preparation.sampling.on
    if has_edge_terms and len(edged) == len(moving):
        found = [record for record in found if not record.is_unknown]
    told = [record for record in found if record.is_incomplete]
    if not told:
        return problem, found
    line, way = "; ".join(record.line() for record in told), "integrator.type=prb_projective includes all of it"
    helps = camera_finds_all(problem.scene, config.integrator.max_depth)
    if tracer is not None and not has_edge_terms:
        way, helps = "integrator.edges=on includes silhouettes and shadow edges", True
    if any(record.is_for_the_most_part for record in told) and not config.run.accept_incomplete:
        first = f"--set {way}, and" if helps else "the steps would have wrong directions;"
        raise ConfigError(config.source, "integrator.type", f"{line}; {first} --set run.accept_incomplete=true runs it "
                                                            "anyway")  # fmt: skip
    warn(f"{line}; --set {way}" if helps else line)
    return problem, found


def measure_missing(problem: Problem) -> list[MissingRecord]:
    """Measure the missing share of each parameter that moves light. The sample limit is the fraction `run.measuring` of
    the run's samples.

    The parameters keep their values. If the sample limit is too low for a measurement, the parameter's record has no
    share. Heightmaps with an unknown share are left out, because their rims hardly move. The function restores the
    scene, and leaves no gradients.
    """
    selection, kind = problem.selection, problem.config.integrator.type
    moving = [key for key in selection.keys if key not in selection.factors and moves_light(selection.params, key)]
    if not moving or kind == "custom" or kind.endswith("_projective"):  # these have edges, or may have them
        return []
    problem.apply()
    try:
        found = _Short(problem, moving).measure()
    finally:
        take_gradient(problem)
        problem.apply()
    return [record for record in found if not (record.parameter.endswith(f".{HEIGHTMAP}") and record.is_unknown)]


class _Short:
    """Samples of the loss derivatives along each parameter in `keys`. The run's own integrator takes the samples."""

    def __init__(self, problem: Problem, keys: Sequence[str]) -> None:
        self.problem, self.keys, run = problem, keys, problem.config.run
        self._integrator = unrecorded(problem.integrator)
        if isinstance(self._integrator, LightTracer):
            self._integrator = self._integrator.to_measure()
        self._views = problem.trained[:MOST_VIEWS]
        self._spp = min(max(run.spp // 4, 1), problem.samples_per_pass or run.spp)
        self._left = run.measuring * run.iterations * run.spp * len(problem.drawn(0)) / len(self._views)
        self._cases = [Case(problem.scene, keys, view.sensor, problem.selection) for view in self._views]
        sizes = [_size(item.node.bbox()) for item in where_moved(self._params, problem.selection.scene_keys)
                 if item.is_shape]  # fmt: skip
        self._extent = min([size for size in sizes if size > 0], default=_size(problem.scene.bbox()))
        self._rows = {key: self._directions(key) for key in keys}
        self._ours: list[np.ndarray] = []

    @property
    def _params(self) -> Any:
        return self.problem.selection.params

    def _directions(self, key: str) -> list[np.ndarray]:
        """Return the directions of a parameter. A small parameter has one direction for each entry. A large parameter
        has two smooth directions.
        """
        case = self._cases[0]
        size, value = case.initial[key].size, case.values.value(key)
        if size > SMALL:
            rows = smooth_rows(key, value, self._extent, 2)
        else:
            rows = list((UNITS.get(key.rpartition(".")[2]) or REACH * self._extent) * np.eye(size))
        return [embed(case, key, row) for row in rows]

    def measure(self) -> list[MissingRecord]:
        """Measure all parameters with the shortest step, and those whose share stays open also with longer steps. Each
        of these gets an equal part of the remaining samples.

        If the samples are too few, or if dL/dI is zero, all records have no share.
        """
        image_spp = 2 * self.problem.config.run.spp
        too_few = image_spp + FEWEST * self._spp_of_seed(*self.keys) > self._left
        if too_few or not _weigh(self.problem, self._views, self._cases, image_spp):
            return [self._record(key, []) for key in self.keys]
        self._left -= image_spp
        records = {key: self._record(key, [self._difference(key, SHORTEST, seed) for seed in seeds(FEWEST)])
                   for key in self.keys}  # fmt: skip
        still_open = [key for key, record in records.items() if not record.is_decided]
        for place, key in enumerate(still_open):
            records[key] = self._look_longer(records[key], self._left * (1 - 1 / (len(still_open) - place)))
        return list(records.values())

    def _spp_of_seed(self, *keys: str) -> int:
        """Return the maximum number of samples per pixel for one seed of these parameters."""
        return (1 + 2 * sum(len(self._rows[key]) for key in keys)) * self._spp

    def _look_longer(self, found: MissingRecord, kept: float) -> MissingRecord:
        """Measure a share with longer steps. `found` is the record of the shortest step. It is returned if the samples
        are too few. `kept` samples per pixel remain for other parameters.

        A truncation error of the differences looks like a missing part. If a part seems to be missing, the step is
        therefore halved. The change of the differences is then their error.
        """
        key, step = found.parameter, LONGEST
        cost, before = self._spp_of_seed(key), np.zeros(len(self._rows[key]))
        while step > SHORTEST and self._left - FEWEST * cost >= kept and not found.is_decided:
            samples = [self._difference(key, step, seed) for seed in seeds(FEWEST)]
            found = self._record(key, samples)
            for seed in seeds(MOST_SEEDS)[FEWEST:]:
                if found.is_decided or self._left - cost < kept:
                    break
                samples.append(self._difference(key, step, seed))
                found = self._record(key, samples)
            if found.is_unknown or not found.is_incomplete:
                break
            mean = np.mean(samples, axis=0)
            found, before, step = self._record(key, samples, np.square(mean - before)), mean, step / 2
        return found

    def _record(self, key: str, samples: list[np.ndarray], left: np.ndarray | float = 0.0) -> MissingRecord:
        """Return the parameter's record from samples (K,) of differences. `left` has the squared errors of their
        mean that are equal for all seeds. Without samples, the record has no share.
        """
        share = None
        if samples:
            for seed in seeds(MOST_SEEDS)[len(self._ours) : len(samples)]:
                self._left -= self._spp
                gradient = sum(case.gradient(self._integrator, seed, self._spp, step=case.known_step)
                               for case in self._cases)  # fmt: skip
                self._ours.append(np.asarray(gradient))
            whole = np.array(samples)
            ours = np.array([[row @ gradient for row in self._rows[key]] for gradient in self._ours[: len(whole)]])
            share = share_of(whole, whole - ours, np.broadcast_to(left, whole.shape[1]))
        value, error = share or (None, None)
        source, along = str(self.problem.config.source), len(self._rows[key])
        return MissingRecord(source, key, value, error, along, len(samples))

    def _difference(self, key: str, step: float, seed: int) -> np.ndarray:
        """Return the differences of the loss along all directions of a parameter, (K,)."""
        rows = self._rows[key]
        self._left -= 2 * len(rows) * self._spp
        return np.sum([[case.difference(self._integrator, row, seed, self._spp, step) for row in rows]
                       for case in self._cases], axis=0)  # fmt: skip


def _size(box: Any) -> float:
    return float(np.linalg.norm(np.array(box.max - box.min)))
