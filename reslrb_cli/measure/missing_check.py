"""`gradcheck --missing` on an experiment: its scene, the dL/dI of its own loss, and directions for each parameter."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from reslrb_cli.config import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators import known_step, make_integrator
from reslrb_cli.measure.cases import parse_estimators
from reslrb_cli.measure.differences import Direction, directions, moving_directions, natural_bounds
from reslrb_cli.measure.earlier import Earlier, head
from reslrb_cli.measure.gradients import Case, seeds
from reslrb_cli.measure.missing import FEWEST, Missing
from reslrb_cli.measure.moving import moves_light
from reslrb_cli.measure.participants import MOVING_DIRECTIONS, NEVER, PATHS
from reslrb_cli.measure.references import ends
from reslrb_cli.optimization.problem import Problem, assemble
from reslrb_cli.records.missing import MissingRecord
from reslrb_cli.records.samples import Kept
from reslrb_cli.scene.catalog import parameter_kind

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
        self,
        config: Config,
        budget_s: float,
        count: int | None,
        spp: int | None,
        along: int | None,
        earlier: Earlier | None = None,
    ) -> None:
        self._budget, self._count, self._start = budget_s, count, time.perf_counter()
        depth = config.integrator.max_depth
        [listed] = parse_estimators(ESTIMATOR)
        problem = assemble(listed.at(config, depth, True).with_exposures_fixed())
        self.source, sensor = str(config.source), problem.sensors[0]
        self.case = Case.of(problem.scene, problem.selection.keys, sensor, problem.selection)
        height, width, _ = self.case.weights.shape
        self.spp = spp or max(PATHS // (height * width), 1)
        self._weigh(problem, sensor, max(IMAGE_PATHS // (height * width), 1))
        options = problem.config.integrator.options()
        shared = {name: options[name] for name in ("max_depth", "hide_emitters")}
        self._tracer = make_integrator("reslrb", **options)
        self._differenced = make_integrator("walk_ad", **shared, rr_depth=NEVER if ends(depth) else options["rr_depth"])
        self._directions = {key: self._along(problem, key, along or MOVING_DIRECTIONS) for key in self.case.keys}
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
            left = self._budget - (time.perf_counter() - self._start)
            end = time.perf_counter() + left / (len(self.case.keys) - place)
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
            found.take(self.case, self._tracer, self._differenced, seed, self.spp, self._step)
            between()

    def _record(self, key: str) -> MissingRecord:
        found = self._found[key]
        share, error = found.share() or (None, None)
        return MissingRecord(self.source, key, share, error, len(found.directions), found.count)

    def _step(self, integrator: Any, scene: Any, sensor: Any, _objective: Any, **options: Any) -> Any:
        return known_step(integrator, scene, sensor, self.case.adjoint, **options)

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

    def _along(self, problem: Problem, key: str, count: int) -> list[Direction]:
        selection = problem.selection
        if moves_light(self.case.params, key):
            box = problem.scene.bbox()
            return moving_directions(self.case, key, float(np.linalg.norm(np.array(box.max - box.min))), count)
        bounds = selection.spec(key).bounds
        if bounds is None or not np.all(np.isfinite(bounds)):
            bounds = natural_bounds(parameter_kind(self.case.params, key), self.case.initial[key])
        return directions(self.case, key, bounds, count)
