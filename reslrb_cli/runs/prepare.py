"""Preparation of a run, and its progress: the state of the iterations, the results so far, and their checkpoints.

- `plan_record` is the entry in a run's manifest that describes how the first view is traced.
- `changes` and `check_changes` tell which settings of an experiment may change when its run is resumed.
- `prepare` makes a problem from a configuration. The problem is ready to run. `manifest_of` makes the problem's
    manifest.
- `with_freed` adds entries of `parameters` to a configuration.
- `PreparedRun` is a run that is ready to start or to resume. `begin` makes a `PreparedRun` for a new run.
- `RunProgress` has the state and the results of a run.
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
from reslrb_cli.config.integrators import ReslrbConfig
from reslrb_cli.config.loader import changed, dump
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import flattened
from reslrb_cli.errors import ConfigError, printable
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.measure.missing import check_missing
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.sampling import plan_rows
from reslrb_cli.optimization.loading import load_configured
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.results import Images, Results
from reslrb_cli.optimization.state import Settled, State, load, noted_of, on_file, put, standing
from reslrb_cli.optimization.uncertainty.measuring import Certainty
from reslrb_cli.optimization.views import RESPONSE, own_channels, view_records
from reslrb_cli.records.checkpoint import entries_below, save_checkpoint
from reslrb_cli.records.decisions import DecisionCache
from reslrb_cli.records.manifest import Manifest, commit_of
from reslrb_cli.records.metrics import NonFiniteTally, Record, RegularizedTally
from reslrb_cli.records.run_folder import RunFolder
from reslrb_cli.records.tree import Arrays, Stored, entries, entry, expected
from reslrb_cli.report.tonemap import exposure_for
from reslrb_cli.runs.callbacks import Callback, Calls, RunInfo
from reslrb_cli.runs.log import collected
from reslrb_cli.scene.catalog import describe
from reslrb_cli.scene.files import file_digests, files_of
from reslrb_cli.scene.needs import unsupported_part
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.visibility import sees_lamps


def plan_record(problem: Problem) -> dict[str, Any]:
    """Return the integrator, its estimator, and which features the kernels of the first view contain, with reasons.

    `rows` is empty for integrators without a plan, and `estimator` is None for integrators without an estimator.
    """
    config, integrator = problem.config.integrator, problem.integrator
    if not isinstance(integrator, Reslrb):
        return {"integrator": config.type, "estimator": None, "rows": []}
    plan = integrator.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]], problem.selection.params)
    rows = [vars(row) for row in plan_rows(plan, problem.decisions)]
    estimator = type(integrator.estimator).__name__.removesuffix("Estimator").lower()
    assert isinstance(config, ReslrbConfig)
    return {"integrator": config.type, "estimator": estimator, "rows": rows}


#: Settings that do not affect the iterations done so far. A change of any other setting would make it another run.
MAY_CHANGE = re.compile(
    r"run\.(iterations|name|output|checkpoint_every|certainty|on_nonfinite|max_seconds|callbacks)(\..*)?"
    r"|optimizer\.learning_rate|parameters\[\d+\]\.learning_rate(\..*)?"
)

#: Settings for the place of a new run.
PLACE = ("run.name", "run.output")

Change = tuple[Any, Any]


def changes(before: Config, now: Config) -> dict[str, Change]:
    """Return the old and the new value of each setting that differs, by key. A missing value is None."""
    first, second = flat(before), flat(now)
    return {
        key: (first.get(key), second.get(key))
        for key in dict.fromkeys((*first, *second))
        if first.get(key) != second.get(key)
    }


def check_changes(
    found: Mapping[str, Change], blame: Callable[[str], object], run: Path, now: Config
) -> dict[str, Change]:
    """Return the changed settings of the experiment `now`. Settings that only determine the run's place do not count as
    changes. The place of a file may change, because `check_files` compares the contents.

    Raises ConfigError, located at the first setting that must not change. `blame` returns the source of this setting.
    """
    refused = (key for key, each in found.items() if not MAY_CHANGE.fullmatch(key) and not moves(key, each, now))
    wrong = next(refused, None)
    if wrong is not None:
        before, after = map(_shown, found[wrong])
        reason = f"is {after}, {before} in the run; {run} may change only iterations, learning rates, and paths"
        raise ConfigError(blame(wrong), wrong, reason)
    return {key: change for key, change in found.items() if key not in PLACE}


def moves(key: str, change: Change, config: Config) -> bool:
    """Return True if the setting `key` of `config` names another place of a file, and for code the same class."""
    before, now = change
    if key not in config.paths or before is None or now is None:
        return False
    return key not in config.codes or before.rpartition(":")[2] == now.rpartition(":")[2]


def flat(config: Config) -> dict[str, Any]:
    """Return all settings that are not None, by their keys as in `--set`."""
    return flattened(config.model_dump(mode="json", exclude_none=True))


def _shown(value: Any) -> str:
    text = "not set" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


Say = Callable[[str], None]


def prepare(config: Config, variant: str, say: Say, warn: Say, interrupted: Callable[[], bool] = lambda: False
            ) -> tuple[RunProgress, Manifest]:  # fmt: skip
    """Assemble a new run and make the measurements before its first iteration. A variant must be set.

    `say` is called with lines about slow steps, `warn` with warnings. Raises ConfigError and UnsupportedScene, and
    KeyboardInterrupt soon after `interrupted()` is true.
    """
    problem = replace(assemble(config, say, DecisionCache(), to_run=True), interrupted=interrupted)
    problem, missing = check_missing(problem, say, warn)
    if missing:  # the check moves geometry, possibly beyond the bounding sphere of the lamps at infinity
        problem = problem.afresh(problem.values())
    manifest = manifest_of(problem, variant, config.source)
    manifest.incomplete = [asdict(record) for record in missing]
    return RunProgress(problem, variant), manifest


def manifest_of(problem: Problem, variant: str, config_file: Path) -> Manifest:
    """Return the manifest of a run of `problem`, with the entries that the problem determines."""
    manifest = Manifest(
        variant=variant,
        device=device_name(variant),
        seed=problem.config.run.seed,
        config=printable(config_file),
        commit=commit_of(config_file.absolute().parent),
    )
    manifest.plan = plan_record(problem)
    manifest.views = view_records(problem.views)
    for record, view in zip(manifest.views, problem.views, strict=True):
        sensor = problem.scene.sensors()[view.sensor]
        # Primary rays may fail, too, in a scene that light paths do not support.
        lamps = sees_lamps(problem.scene, sensor) if unsupported_part(problem.scene, sensor) is None else None
        record["shown"] = exposure_for(np.array(view.target), lamps)
        if channels := own_channels(sensor.film()):
            record["channels"] = channels
        elif (balance := problem.config.target.white_balance) is not None and view.file is not None:
            record["white"] = balance.scene
    manifest.decisions = [each.to_json() for each in problem.decisions]
    return manifest


def settled_of(problem: Problem, variant: str) -> Settled:
    """Return the description of the experiment that every checkpoint contains. Another process can assemble the problem
    from the description.

    The parameters must have their initial values.
    """
    initial, halo = on_file(problem, standing(problem).values)
    return Settled(
        dump(problem.config), variant, digests(problem.config), problem.decisions, initial, halo,
        problem.masks, noted_of(problem),
    )  # fmt: skip


def digests(config: Config) -> dict[str, str]:
    """Return digests of the files that a run needs to resume. Files of initial values are left out, because the values
    are part of the state.
    """
    return file_digests({key: path for key, path in files_of(config).items() if ".initial." not in key})


def check_files(before: Mapping[str, str], config: Config, run: str = "the run") -> None:
    """Raise ConfigError if a file of the experiment has changed since the run began. `before` are digests."""
    here, paths = digests(config), config.paths
    for key, digest in before.items():
        if here.get(key) != digest:
            what = "has changed" if key in here else "is missing"
            place = f"{paths[key]} " if key in paths else ""
            reason = f"{place}{what} since {run} began; put it back, name its new place, or start a new run"
            raise ConfigError(config.source, key, reason)


Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class SavedResults:
    """Results in a checkpoint. `last` is the record of the last iteration. `history` has an array with one number for
    each iteration: `loss`, `rate` (the schedule's factor) and `error/KEY`.
    """

    images: Images
    last: Record | None
    nonfinite: NonFiniteTally
    regularized: RegularizedTally
    history: Arrays = field(default_factory=dict, metadata=entry("history"))
    last_steps: Arrays = field(default_factory=dict, metadata=entry("last steps"))


class RunProgress:
    """State and results of a run. The parameters of `problem` must have their initial values at construction.

    `state` is the state after the last complete iteration, without any part of the current one.
    """

    def __init__(self, problem: Problem, variant: str) -> None:
        self._settled, self.problem = settled_of(problem, variant), problem
        self.state, self.results = standing(problem), Results(problem)
        self.certainty = Certainty(problem)
        self.nonfinite, self.regularized = NonFiniteTally(), RegularizedTally()
        self.last: Record | None = None

    def stop_when(self, interrupted: Callable[[], bool]) -> None:
        """Stop long measurements soon after `interrupted()` is true."""
        self.problem = replace(self.problem, interrupted=interrupted)

    def compute_with(self, engine: Callable[..., Any]) -> None:
        """Let `engine` (`shards.Engine`) compute the shards of a step."""
        self.problem = replace(self.problem, engine=engine)

    @property
    def files(self) -> dict[str, str]:
        """Digests of the experiment's files at the start of the run. The keys are the settings that name the files."""
        return self._settled.files

    @property
    def done(self) -> int:
        """The number of finished iterations."""
        return self.state.iteration

    def add(self, state: State, record: Record) -> None:
        """Add one iteration, with the `state` after it."""
        self.last = record
        self.certainty.rates.append(record.lr / self.problem.config.optimizer.learning_rate)
        self.results.add(record)
        self.nonfinite.add(record)
        self.regularized.add(record)
        self.certainty.see(self.state, state)
        self.state = state

    def values(self) -> dict[str, Array]:
        """Return the newest values, in the form of `Problem.values`."""
        return self.shown(self.state.values)

    def go_on(self) -> None:
        """Clear the stop of an earlier process, because the stopping criteria may have changed."""
        if self.state.stopped:
            self.state = replace(self.state, stopped="")

    def stand(self) -> None:
        """Reset the problem to `state` if an iteration was interrupted."""
        if self.problem.optimizer.stands_at is not self.state:
            put(self.problem, self.state)

    def shown(self, values: Mapping[str, Any]) -> dict[str, Array]:
        """Convert optimiser values or gradients, by key, to the form of `problem.values()`."""
        return {key: self.problem.selection.shown(key, value) for key, value in values.items()}

    # --- checkpoints --------------------------------------------------------------------------------------------------

    def save(self, folder: Path) -> int:
        """Save the state after the last complete iteration in `folder`, and return the iteration count. Raises
        OSError.
        """
        save_checkpoint(folder, self.done, *self._entries(self.state))
        return self.done

    def _entries(self, state: State) -> tuple[Arrays, dict[str, Any]]:
        """Return the arrays and the other values that a checkpoint stores for `state`, in the form of
        `tree.entries`.
        """
        history = {"rate": self.certainty.rates, **self.results.history}
        met = SavedResults(
            self.results.images["initial"], self.last, self.nonfinite, self.regularized,
            {name: np.array(numbers, dtype=np.float64) for name, numbers in history.items()}, self.certainty.last,
        )  # fmt: skip
        return entries(self._settled, state.on_file(self.problem), met)

    def restore(self, stored: Stored) -> None:
        """Restore the state from a checkpoint.

        Raises a ConfigError that names the file if the content does not fit the run.
        """
        problem, met = self.problem, stored.read(SavedResults)
        self.state = load(problem, stored)
        last = dict.fromkeys(entries_below(stored.arrays, "last steps/"))
        numbers = expected((self.done,))
        history = dict.fromkeys(("loss", "rate", *entries_below(stored.arrays, "history/")), numbers)
        met = stored.fill(replace(met, last_steps=last, history=history))
        if (-1 if met.last is None else met.last.iteration) != self.done - 1:
            raise stored.wrong("last", f"is not the record of iteration {self.done - 1}")
        found = {name: array.tolist() for name, array in met.history.items()}
        self.certainty.rates, self.results.history = found.pop("rate"), found
        self.results.images["initial"] = met.images
        self.certainty.last = dict(met.last_steps)
        self.last, self.nonfinite, self.regularized = met.last, met.nonfinite, met.regularized


@dataclass(frozen=True)
class PreparedRun:
    """Run that is ready to start or to resume.

    `place` creates the run folder or takes it over, and locks it while the block runs. `said` has the log lines of the
    preparation.
    """

    course: RunProgress
    manifest: Manifest
    place: Callable[[], contextlib.AbstractContextManager[RunFolder]]
    said: list[str] = field(default_factory=list)

    def calls(self, callbacks: Sequence[Callback], folder: Path | None) -> Calls:
        """Return the calls of the run's callbacks."""
        course, config = self.course, self.course.problem.config
        keys = course.problem.selection.keys

        def value(key: str) -> Array:
            return course.shown({key: course.state.values[key]})[key]

        shapes = {key: course.problem.selection.array(key).shape for key in keys}
        run = RunInfo(config.run.name, folder, flat(config), config.run.iterations, course.done, shapes, value)
        return Calls(callbacks, run, self.manifest)


def begin(
    config: Config, variant: str, say: Say, warn: Say, folder: str = "",
    interrupted: Callable[[], bool] = lambda: False,
) -> PreparedRun:  # fmt: skip
    """Prepare a new run in its own folder, which `folder` names, or else `run.name`. A variant must be set.

    Call `check_output` first, to check that the folder can be made. Raises ConfigError and UnsupportedScene, and
    KeyboardInterrupt soon after `interrupted()` is true.
    """
    with collected() as said:
        course, manifest = prepare(config, variant, say, warn, interrupted)
    run = config.run
    return PreparedRun(
        course,
        manifest,
        lambda: RunFolder.create(config.source, run.output, folder or run.folder_name, dump(config), manifest),
        said,
    )


def with_freed(config: Config, keys: Sequence[str], source: str) -> Config:
    """Return the experiment that also recovers the scene's parameters `keys`, within their usual bounds. They start at
    the values of the scene. `response` recovers the curve of the camera. A variant must be set.

    Raises a ConfigError, located by `source`, for a key that the scene does not have, that cannot be recovered, or that
    the experiment recovers already.
    """
    from reslrb_cli.scene.proposal import bounds_of, spec_of  # late, because few runs need them

    if wrong := [key for key in keys if not isinstance(key, str) or not key]:
        raise ConfigError(source, "", f"is {wrong[0]!r}; give a key that `reslrb inspect` lists")
    keys = list(dict.fromkeys(keys))
    if RESPONSE in keys:
        config = changed(config, [f"target.{RESPONSE}={{curve: auto}}"])
        keys = [key for key in keys if key != RESPONSE]
    if not keys:
        return config
    scene = load_configured(config, keys=[own for key in keys for own in spec_of(key).keys])
    try:
        specs = [*config.parameters, *map(spec_of, keys)]
        params = select_parameters(scene, specs, config.source).params
    except ConfigError as error:
        place = re.match(r"parameters\[(\d+)\]", error.key)
        if place is None or int(place[1]) < len(config.parameters):
            raise
        raise ConfigError(source, "", error.message) from None
    owners = [spec_of(key).keys[0] for key in keys]
    if globs := [key for key in owners if key not in params.properties]:
        raise ConfigError(source, "", f"`{globs[0]}` is a glob; name each parameter")
    infos = (describe(params, key, values=True) for key in owners)
    bounds = (bounds_of(params, info, key != info.key) for key, info in zip(keys, infos, strict=True))
    freed = [spec_of(*each) for each in zip(keys, bounds, strict=True)]
    return config.model_copy(update={"parameters": [*config.parameters, *freed]})
