"""Search for the best settings of an experiment: the combination of each trial, which Optuna proposes.

The folder of the sweep is the only record of a search: `sweep.json` has the trials and the run folders have their
results. Optuna's study is made anew from them for each proposal. The proposal of a trial depends only on the seed of
the search, the number of the trial, and the results so far. A search that continues is therefore the same search.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from reslrb_cli.config.loader import check_code, dump, load, read_text
from reslrb_cli.errors import ConfigError, ExitCode, one_line
from reslrb_cli.records.sweeps import Combination, Failure, SweepPlan, config_file, run_name
from reslrb_cli.report.page.sweep import incomparable, objective, run_record, run_records, trial_values
from reslrb_cli.report.sources import SweepRuns, read_run, read_sweep_runs
from reslrb_cli.runs.loggers import package
from reslrb_cli.runs.sweep import RANGE, PreparedSweep, Varied, is_left, named, parse_vary, with_chosen
from reslrb_cli.seeds import seed

#: Numbers of proposals for one trial, by Optuna and then at random. All of them can be combinations of earlier trials.
BY_OPTUNA, AT_RANDOM = 10, 100

#: Significant digits of a proposed number, which is part of the name of a folder.
DIGITS = 4


def load_optuna() -> Any:
    """Return the package Optuna, silenced. Raises ConfigError without it."""
    optuna = package("optuna", "search")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna


def check_search(plan: PreparedSweep) -> None:
    """Raise ConfigError if nothing is varied, Optuna is missing, or no figure of the trials can be compared."""
    if not plan.sweep.keys:
        raise ConfigError("--search", "", f"needs settings to choose, such as --vary 'optimizer.learning_rate={RANGE}'")
    load_optuna()
    targets = [config.target for config in plan.configs.values()]
    known = all(target.render is not None or target.truth for target in targets)
    if incomparable(plan.sweep, "loss") and (incomparable(plan.sweep, "error") or not known):
        raise _not_comparable(plan.sweep)


def _not_comparable(sweep: SweepPlan) -> ConfigError:
    key = incomparable(sweep, "loss")
    return ConfigError("--search", "", f"losses of different `{key}` are not of the same; vary other settings")


class Remaining:
    """Runs of a sweep that are still to be done, and its plan `sweep`. A search gets its next trial when no run is
    left.
    """

    def __init__(self, folder: Path, sweep: SweepPlan) -> None:
        self._folder, self.sweep = folder, sweep
        names = [run_name(*run) for run in sweep.runs]
        self._begun = {name for name in names if not is_left(folder, sweep, name)}
        self._results = {each.name: each for each in run_records(read_sweep_runs(folder))} if sweep.search else {}
        self._is_exhausted = False

    @property
    def variant(self) -> str:
        """The variant of the runs."""
        files = [file for each in self.sweep.combinations if (file := config_file(self._folder, each)).is_file()]
        return load(files[0]).variant if files else load(Path(self.sweep.config), self.sweep.overrides).variant

    def number(self, name: str) -> int:
        """Return the place of the run `name`, from 1 on."""
        return [run_name(*run) for run in self.sweep.runs].index(name) + 1

    def next(self) -> tuple[str, Combination, int] | None:
        """Return the next run: its name, its combination and its seed. Return None if no run is left.

        Raises ConfigError if the results of a search cannot be compared.
        """
        while True:
            for run in self.sweep.runs:
                name = run_name(*run)
                if name not in self._begun and not self._has_failed(run[0]):
                    self._begun.add(name)
                    return name, *run
            search, results = self.sweep.search, list(self._results.values())
            if search is None or len(self.sweep.combinations) >= search.trials or self._is_exhausted:
                return None
            if any(result.is_done for result in results) and not objective(self.sweep, results):
                raise _not_comparable(self.sweep)
            grown = with_trial(self._folder, self.sweep, trial_values(self.sweep, results))
            if grown is None:
                self._is_exhausted = True  # until there is another result
                return None
            self._keep(grown)

    def end(self, name: str, code: int, line: str) -> None:
        """Keep how the run `name` has ended: the exit code of its process, and its last line."""
        if code != ExitCode.DONE:
            self._keep(replace(self.sweep, failures={**self.sweep.failures, name: Failure(code, one_line(line))}))
        self._is_exhausted = False
        if self.sweep.search:
            (run,) = (run for run in self.sweep.runs if run_name(*run) == name)
            runs = {name: read_run(self._folder / name, name)} if (self._folder / name).is_dir() else {}
            self._results[name] = run_record(SweepRuns(self._folder, "", self.sweep, runs), *run)

    def _has_failed(self, combination: Combination) -> bool:
        """Whether a trial of a search has failed. Its other seeds are then left out."""
        names = [run_name(combination, seed) for seed in self.sweep.seeds]
        return self.sweep.search is not None and any(name in self.sweep.failures for name in names)

    def _keep(self, sweep: SweepPlan) -> None:
        self.sweep = sweep
        sweep.write(self._folder)


def with_trial(folder: Path, sweep: SweepPlan, values: Mapping[str, float | None]) -> SweepPlan | None:
    """Return the search with one more trial, whose configuration is written into `folder`. Return None if Optuna
    proposes nothing new.

    `values` maps the name of each finished trial to its figure, infinity if it diverged, or to None if it failed. Other
    trials are at work. If the configuration of the new trial is not valid, the trial has failed.
    """
    assert sweep.search is not None
    varied = [parse_vary(f"{key}={json.dumps(given)}", search=True) for key, given in sweep.search.space.items()]
    settings = propose(varied, sweep, values)
    if settings is None:
        return None
    combination = named(settings, sweep.combinations)
    sweep = replace(sweep, combinations=[*sweep.combinations, combination])
    chosen = [each.at(settings[each.key]) for each in varied]
    try:
        path = Path(sweep.config)
        config = with_chosen(read_text(path), path, sweep.overrides, chosen, bool(sweep.codes))
        check_code(config)
    except ConfigError as error:
        failure = Failure(int(ExitCode.USAGE), one_line(str(error)))
        sweep = replace(sweep, failures={**sweep.failures, run_name(combination, sweep.seeds[0]): failure})
    else:
        file = config_file(folder, combination)
        file.parent.mkdir(exist_ok=True)
        file.write_text(dump(config), encoding="utf-8")
    return sweep


def propose(varied: Sequence[Varied], sweep: SweepPlan, values: Mapping[str, float | None]) -> dict[str, Any] | None:
    """Return the settings of the next trial, or None if all proposals are combinations of earlier trials."""
    optuna = load_optuna()
    space, State = {each.key: _distribution(optuna, each) for each in varied}, optuna.trial.TrialState
    earlier = []
    for combination in sweep.combinations:
        value = values.get(combination.name)
        state = State.RUNNING if combination.name not in values else State.FAIL if value is None else State.COMPLETE
        params = {each.key: _to_optuna(each, combination.settings[each.key]) for each in varied}
        earlier.append(optuna.trial.create_trial(state=state, value=value, params=params, distributions=space))
    known = [combination.settings for combination in sweep.combinations]
    for attempt in range(BY_OPTUNA + AT_RANDOM):
        number = seed(sweep.seeds[0], len(known), attempt, "search")
        # trials at work count as bad ones, so that runs at the same time differ
        sampler = (
            optuna.samplers.TPESampler(seed=number, constant_liar=True)
            if attempt < BY_OPTUNA
            else optuna.samplers.RandomSampler(number)
        )
        study = optuna.create_study(sampler=sampler)
        study.add_trials(earlier)
        params = study.ask(space).params
        settings = {each.key: _from_optuna(each, params[each.key]) for each in varied}
        if settings not in known:
            return settings
    return None


def _distribution(optuna: Any, varied: Varied) -> Any:
    """Return the values of a setting in Optuna's form. A range has whole numbers if both ends are whole numbers."""
    if not varied.is_range:
        return optuna.distributions.CategoricalDistribution([json.dumps(value) for value in varied.given])
    low, high, log = varied.given["low"], varied.given["high"], varied.given.get("log", False)
    whole = isinstance(low, int) and isinstance(high, int)
    kind = optuna.distributions.IntDistribution if whole else optuna.distributions.FloatDistribution
    return kind(low, high, log=log)


def _to_optuna(varied: Varied, value: Any) -> Any:
    return value if varied.is_range else json.dumps(value)


def _from_optuna(varied: Varied, value: Any) -> Any:
    """Return a proposed value as a setting. Numbers are rounded, within their range."""
    if not varied.is_range:
        return json.loads(value)
    if isinstance(value, int):
        return value
    return min(max(float(f"{value:.{DIGITS}g}"), varied.given["low"]), varied.given["high"])
