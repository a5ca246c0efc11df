"""The course of a run: what its iterations go on from, and what has been found on the way; kept, and taken up again.

- `plan_record`: what a run's manifest says of the plan of its step.
- `changes`, `check_changes`: what of an experiment may change while its run goes on, and what may not.
- `prepare`, `manifest_of`: from a configuration to a problem that is ready to run, and the manifest that says what was
  settled on the way.
- `Begun`: a run that is to be made, or gone on with; `begin`: one that is new.
- `Course`: the course itself.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.config.integrators import Reslrb as ReslrbConfig
from reslrb_cli.config.loader import dump
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, printable
from reslrb_cli.integrators.plan_report import plan_rows
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.measure.missing import check_missing
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.sampling import explained
from reslrb_cli.optimization.moving import warn_of_border
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.results import WINDOW, Best, Images, Least, Results
from reslrb_cli.optimization.stages import Stages
from reslrb_cli.optimization.state import Settled, State, check_bounds, load, noted_of, on_file, put, standing
from reslrb_cli.optimization.stopping import Averaged, Watch, average_begins
from reslrb_cli.optimization.uncertainty.measuring import Certainty, Noted
from reslrb_cli.optimization.views import view_records
from reslrb_cli.records.checkpoint import save_checkpoint
from reslrb_cli.records.clock import SharedTime
from reslrb_cli.records.decisions import DecisionCache
from reslrb_cli.records.manifest import Manifest
from reslrb_cli.records.metrics import ClampTally, NonFiniteTally, Record, RegularizedTally
from reslrb_cli.records.run_folder import RunFolder
from reslrb_cli.records.tree import Arrays, Stored, entries, entry, expected
from reslrb_cli.report.tonemap import exposure_for
from reslrb_cli.scene.files import file_digests, files_of
from reslrb_cli.scene.needs import unsupported_part
from reslrb_cli.scene.visibility import sees_lamps


def plan_record(problem: Problem) -> dict[str, Any]:
    """The integrator, its estimator, and for the first view what its kernels contain and leave out, and why.

    `rows` is empty for integrators that plan nothing, and `estimator` None for those that have none.
    """
    config, integrator = problem.config.integrator, problem.integrator
    if not isinstance(integrator, Reslrb):
        return {"integrator": config.type, "estimator": None, "rows": []}
    plan = integrator.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]], problem.selection.params)
    rows = [vars(row) for row in explained(plan_rows(plan), problem.decisions)]
    estimator = type(integrator.estimator).__name__.removesuffix("Estimator").lower()
    assert isinstance(config, ReslrbConfig)
    return {"integrator": config.type, "estimator": estimator, "rows": rows}


#: Settings that decide nothing of what the iterations until then were. All others would make it another run.
MAY_CHANGE = re.compile(
    r"run\.(iterations|name|output|checkpoint_every|images_every|certainty|on_nonfinite|stop)(\..*)?"
    r"|optimizer\.learning_rate|parameters\[\d+\]\.learning_rate(\..*)?"
)

#: Those that say where a run is written, which its folder says itself.
_PLACE = ("run.name", "run.output")

#: Differing settings that an error names.
_SHOWN = 3
Change = tuple[Any, Any]


def changes(before: Config, now: Config) -> dict[str, Change]:
    """The settings that differ, by key, as they were and as they are; None where there was or is none."""
    first, second = flat(before), flat(now)
    return {
        key: (first.get(key), second.get(key))
        for key in dict.fromkeys((*first, *second))
        if first.get(key) != second.get(key)
    }


def check_changes(found: Mapping[str, Change], blame: Callable[[str], object], run: Path) -> dict[str, Change]:
    """Of the settings that differ those that may, where the run is written left out.

    Raises ConfigError, located by the first key that must not and by who is to `blame` for it, with the first few of
    them.
    """
    wrong = [key for key in found if not MAY_CHANGE.fullmatch(key)]
    if wrong:
        first, *others = [f"{_shown(found[key][1])}, {_shown(found[key][0])} in the run" for key in wrong[:_SHOWN]]
        more = [f"{key} is {what}" for key, what in zip(wrong[1:], others, strict=False)]
        more += [f"{len(wrong) - _SHOWN} more"] if len(wrong) > _SHOWN else []
        also = f"; also {'; '.join(more)}" if more else ""
        raise ConfigError(
            blame(wrong[0]),
            wrong[0],
            f"is {first}{also}; {run} goes on as it began, but for iterations and learning rates",
        )
    return {key: change for key, change in found.items() if key not in _PLACE}


def flat(config: Config) -> dict[str, Any]:
    """All settings by their keys, as `--set` names them; those of None left out."""
    found: dict[str, Any] = {}

    def add(key: str, value: Any) -> None:
        if isinstance(value, dict):
            for name, each in value.items():
                add(f"{key}.{name}" if key else str(name), each)
        elif isinstance(value, (list, tuple)) and any(isinstance(each, dict) for each in value):
            for place, each in enumerate(value):
                add(f"{key}[{place}]", each)
        elif value is not None:
            found[key] = value

    add("", config.model_dump(mode="json", exclude_none=True))
    return found


def _shown(value: Any) -> str:
    text = "not set" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


Say = Callable[[str], None]


def prepare(config: Config, variant: str, say: Say, warn: Say) -> tuple[Course, Manifest]:
    """Assemble a new run, and measure what is to be known before it; a variant must be set.

    `say` is told what takes long, `warn` what to look at. Raises ConfigError and UnsupportedScene.
    """
    problem = assemble(config, say, DecisionCache(), to_run=True)
    warn_of_border(problem, warn)
    missing = check_missing(problem, warn)
    if missing:  # what was moved for it may have reached beyond the sphere that lamps at infinity shine through
        problem = problem.afresh(problem.values())
    manifest = manifest_of(problem, variant, config.source)
    manifest.incomplete = [asdict(record) for record in missing]
    return Course(problem, variant), manifest


def manifest_of(problem: Problem, variant: str, config_file: Path) -> Manifest:
    """The manifest of a run of `problem`, as far as the problem tells."""
    manifest = Manifest(
        variant=variant, device=device_name(variant), seed=problem.config.run.seed, config=printable(config_file)
    )
    manifest.plan = plan_record(problem)
    manifest.views = view_records(problem.views)
    for record, view in zip(manifest.views, problem.views, strict=True):
        sensor = problem.scene.sensors()[view.sensor]
        # What no light path can deal with, primary rays may not either.
        lamps = sees_lamps(problem.scene, sensor) if unsupported_part(problem.scene, sensor) is None else None
        record["shown"] = exposure_for(np.array(view.target), lamps)
    manifest.decisions = [each.to_json() for each in problem.decisions]
    manifest.memory = None if problem.memory is None else problem.memory.to_json()
    return manifest


def settled_of(problem: Problem, variant: str) -> Settled:
    """What every checkpoint says of the experiment, whose parameters stand at their initial values: by it another
    process assembles the same problem."""
    initial, halo = on_file(problem, standing(problem).values)
    return Settled(
        dump(problem.config), variant, digests(problem.config), problem.decisions, problem.memory, initial, halo,
        problem.masks, noted_of(problem),
    )  # fmt: skip


def digests(config: Config) -> dict[str, str]:
    """Return digests of the files that a run needs to go on; its state has the values that parameters begin with."""
    return file_digests({key: path for key, path in files_of(config).items() if ".initial." not in key})


Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Met:
    """What a run has met on its way, beside the records of its iterations, of which `last` is the newest."""

    images: Images
    certainty: Noted
    best: Least | None = None
    last: Record | None = None
    shared: SharedTime | None = None
    best_values: Arrays = field(default_factory=dict, metadata=entry("best", "finite"))
    squares: Arrays = field(default_factory=dict, metadata=entry("squares"))
    last_steps: Arrays = field(default_factory=dict, metadata=entry("last steps", "finite"))


class Course:
    """Of one run of `problem`, whose parameters stand at their initial values when this is made.

    `state` is that after the last whole iteration; of the one that is at work nothing is in it.
    """

    def __init__(self, problem: Problem, variant: str) -> None:
        self._settled, self.stages = settled_of(problem, variant), Stages(problem)
        self.problem = problem = self.stages.whole
        self.state, self.results = standing(problem), Results(problem)
        self.certainty = Certainty(problem)
        self.best = Best(any(view.held_out for view in problem.views))
        self.nonfinite, self.clamped, self.regularized = NonFiniteTally(), ClampTally(), RegularizedTally()
        self.last: Record | None = None
        self.watch, self.average = Watch(problem.config), Averaged()
        self._shared: SharedTime | None = None
        self._spent: Callable[[], SharedTime] | None = None

    def compute_with(self, engine: Callable[..., Any], spent: Callable[[], SharedTime] | None = None) -> None:
        """Have the shards of a run without stages computed by `engine` (`shards.Engine`); `spent` says what time that
        has taken by now."""
        self.problem = replace(self.problem, engine=engine)
        self.stages = Stages(self.problem)
        self._spent = spent

    @property
    def shared(self) -> SharedTime | None:
        """What the shards of all iterations took that workers computed, those before the run was gone on with included;
        None where there were none."""
        if self._spent is None:
            return self._shared
        return self._spent() if self._shared is None else self._shared + self._spent()

    @property
    def files(self) -> dict[str, str]:
        """The digests of the files that the experiment names, by the keys that name them, when the run began."""
        return self._settled.files

    @property
    def done(self) -> int:
        """The number of finished iterations."""
        return self.state.iteration

    def add(self, state: State, record: Record) -> None:
        """Take one iteration, which leaves `state`."""
        if self._counts(record.iteration):  # losses of other films are not to be compared
            self.best.see(record, self.state.values)
        self._take(record)
        if self.stages.is_whole(state.stage):
            self.certainty.see(self.state, state)
        if state.iteration >= average_begins(self.problem.config):
            shown = {key: np.array(value) for key, value in self.stages.values(state).items()}
            self.average = self.average.add(self.problem.config, state.iteration, shown)
        self.state = state

    def _counts(self, iteration: int) -> bool:
        """Whether the iteration before, which left its values, and this one, whose loss it is, worked on the run's own
        problem."""
        config = self.problem.config
        begun = (max(iteration - 1, 0), iteration)
        return all(self.stages.is_whole(config.stage_number(each / config.run.iterations)) for each in begun)

    def values(self) -> dict[str, Array]:
        """The result as it is now, as `Problem.values` has it: the newest values, or at the end the average."""
        if self.averages:
            return {key: value.astype(np.float32) for key, value in self.average.average.items()}
        return self.stages.values(self.state)

    def bring(self) -> Problem:
        """The run's own problem, at the newest values."""
        self.stages.bring(self.state)
        return self.problem

    def bring_last(self) -> Problem:
        """The run's own problem at its newest values, also where it was brought to an average."""
        if self.averages:
            put(self.problem, self.state)
        return self.bring()

    def bring_result(self) -> Problem:
        """The run's own problem, at what is the result of a run at its end: the newest values, or the average."""
        problem = self.bring()
        if self.averages:
            problem.selection.set_arrays({key: value.astype(np.float32) for key, value in self.average.average.items()})
            for key in problem.selection.keys:
                problem.optimizer.set_value(key, problem.selection.value(key))
            problem.apply()
            problem.optimizer.stands_at = None
        return problem

    @property
    def averages(self) -> bool:
        """Whether the run is at its end, and its result an average."""
        return self.average.average_count > 0 and self.done == self.problem.config.run.iterations

    def go_on(self) -> None:
        """Take back that the run had stopped: other settings say when."""
        if self.state.stopped:
            self.state = replace(self.state, stopped="")

    def stand(self) -> None:
        """Bring the problem back to `state` where an iteration was cut short."""
        now = self.stages.at(self.state.stage)
        if now.optimizer.stands_at is not self.state:
            put(now, self.state)

    def _take(self, record: Record) -> None:
        self.last = record
        if self.problem.config.optimizer.schedule == "plateau":
            self.certainty.rates.append(record.lr / self.problem.config.optimizer.learning_rate)
        self.results.add(record)
        self.nonfinite.add(record)
        self.clamped.add(record)
        self.regularized.add(record)

    def best_values(self) -> dict[str, Array]:
        """The best parameters so far, as `problem.values()` has them; nothing where there are none yet."""
        shown = self.problem.selection.shown
        return {
            key: value if isinstance(value, np.ndarray) else shown(key, value)
            for key, value in self.best.values.items()
        }

    def shown(self, values: Mapping[str, Any]) -> dict[str, Array]:
        """Values by key as the optimiser has them, of a state or its gradients, as `problem.values()` has them."""
        return {key: self.problem.selection.shown(key, value) for key, value in values.items()}

    # --- kept and taken up again --------------------------------------------------------------------------------------

    def save(self, folder: Path) -> int:
        """Keep it in `folder` as it was after its last whole iteration; return how many it had. Raises OSError."""
        met = Met(
            self.results.images["initial"], self.certainty.noted, self.best.least, self.last, self.shared,
            self.best_values(), self.certainty.squares, self.certainty.last_steps(),
        )  # fmt: skip
        found, values = entries(self._settled, self.state.on_file(self.stages.at(self.state.stage)), met,
                                self.average)  # fmt: skip
        save_checkpoint(folder, self.done, {}, found, values)
        return self.done

    def restore(self, stored: Stored, records: Sequence[Record]) -> None:
        """Go on from what was stored, and from the records of all iterations until then.

        Raises ConfigError, located in the file, where something there is not what this run can have left.
        """
        problem, met = self.problem, stored.read(Met)
        self.state = load(self.stages.at(stored.read(State).stage), stored, problem)
        squares = {key: problem.optimizer.squares(key) for key in met.certainty.keys if key in problem.selection.keys}
        wanted = {key: expected(problem.selection.array(key).shape) for key in problem.selection.keys if met.best}
        kept = {key: each[0] for key, each in squares.items() if each is not None}
        last = self.certainty.expects(met.certainty)
        met = stored.fill(replace(met, best_values=wanted, squares=kept, last_steps=last))
        average = stored.read(Averaged)
        if average.average_count and average.average_first == average_begins(problem.config):
            shapes = {key: expected(problem.selection.array(key).shape, np.float64) for key in problem.selection.keys}
            self.average = stored.fill(replace(average, average=shapes))
        for record in records:
            self._take(record)
            self.watch.add(record)
        self.best.recent.extend(record.loss for record in records[-WINDOW:] if self._counts(record.iteration))
        for key, array in met.best_values.items():
            check_bounds(problem, stored, f"best/{key}", key, array)
        self.best.least, self.best.values = met.best, met.best_values
        self.results.images["initial"] = met.images
        self.certainty.restore(met.certainty, met.squares, met.last_steps)
        self._shared = met.shared


@dataclass(frozen=True)
class Begun:
    """A run that is to be made, or gone on with: its course, its manifest, and `place`, which makes its folder or takes
    it over, and has it locked while the block works."""

    course: Course
    manifest: Manifest
    place: Callable[[], contextlib.AbstractContextManager[RunFolder]]


def begin(config: Config, variant: str, force: bool, say: Say, warn: Say) -> Begun:
    """A new run, prepared as `prepare` does, in a folder of its own; a variant must be set.

    Whether there can be one is asked before (`check_output`). Raises ConfigError and UnsupportedScene.
    """
    course, manifest = prepare(config, variant, say, warn)
    run = config.run
    return Begun(
        course,
        manifest,
        lambda: RunFolder.create(config.source, run.output, run.folder_name, force, dump(config), manifest),
    )
