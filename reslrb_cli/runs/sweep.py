"""Planning of a sweep: every combination of settings is made and checked before any run starts.

The module also finds the runs that are still to be done. Each run is a separate process that the caller starts.
`command` returns the arguments for `reslrb`.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from reslrb_cli.config.base import SEED_END, code_file
from reslrb_cli.config.files import NAME_BYTES, open_file
from reslrb_cli.config.loader import Override, check_code, dump, loads, parse_override, read_text, replaces
from reslrb_cli.config.run import folder_name
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import Location, format_location
from reslrb_cli.errors import ConfigError, MachineError, is_machine_fault, one_line
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.records.checkpoint import newest_checkpoint
from reslrb_cli.records.lock import FolderLock, InUse
from reslrb_cli.records.manifest import Status, read_manifest
from reslrb_cli.records.sweeps import (
    Combination,
    SweepPlan,
    SweepSearch,
    config_file,
    in_words,
    is_sweep,
    read_sweep,
    run_name,
    short_keys,
)
from reslrb_cli.scene.files import digest_of, file_digests, files_of

#: Maximum number of runs of a sweep. Each has a folder and a line on the page.
MOST_RUNS = 1000

#: Maximum wait for the end of a killed process, in seconds; releasing GPU memory takes time.
RELEASE_SECONDS, _POLL_SECONDS = 15.0, 0.05

#: Bytes for the seed in the name of a run.
_SEED_BYTES = len(f"-seed={SEED_END}")

#: Settings that the sweep itself chooses.
OWN: dict[Location, str] = {
    ("run", "seed"): "use --seeds N",
    ("run", "name"): "runs are named by their settings",
    ("run", "output"): "use -o FOLDER",
}


#: An example of a search, and the form of a range.
SEARCH = "--search optuna --trials 20"
RANGE = "{low: 0.01, high: 0.3, log: true}"


@dataclass(frozen=True)
class Varied:
    """Varied setting, with one override per value. The values of a range (`is_range`) are its two ends. `given` is the
    list or the range as the user wrote it.
    """

    key: str
    location: Location
    overrides: tuple[Override, ...]
    given: Any
    is_range: bool = False

    def at(self, value: Any) -> Override:
        """Return the override that sets `value`."""
        label = f"--vary {one_line(f'{self.key}={in_words(value)}', 100)}"
        return Override(label, self.location, value)


@dataclass(frozen=True)
class PreparedSweep:
    """Checked sweep. `configs` maps each combination's name to its configuration with the first seed. Those of a search
    are combinations that were only checked.
    """

    sweep: SweepPlan
    configs: dict[str, Config]


def parse_vary(text: str, search: bool = False) -> Varied:
    """Parse a varied setting such as `a.b=[1, 2]`, or in a search also a range. Raises ConfigError if `text` has
    another form.
    """
    given = parse_override(text, "--vary", "KEY=[VALUE, ...], such as run.spp=[16, 32]")
    key = format_location(given.location)
    if reason := OWN.get(given.location[:2]):
        raise ConfigError(given.label, "", f"cannot be varied: {reason}")
    is_range = isinstance(given.value, dict)
    if is_range and not search:
        raise ConfigError(given.label, "", f"must be a list of values; a range needs --search, as in {SEARCH}")
    if is_range:
        _check_range(given.label, given.value)
    elif not isinstance(given.value, list) or not given.value:
        wanted = f", or a range such as {key}={RANGE}" if search else ""
        raise ConfigError(given.label, "", f"must be a list of values, such as {key}=[16, 32]{wanted}")
    values = [given.value["low"], given.value["high"]] if is_range else given.value
    seen: list[str] = []
    for value in values:
        if (kept := json.dumps(value, sort_keys=True)) in seen:
            raise ConfigError(given.label, "", f"has {one_line(in_words(value), 100)} twice")
        seen.append(kept)
    varied = Varied(key, given.location, (), given.value, is_range)
    return replace(varied, overrides=tuple(map(varied.at, values)))


def _check_range(label: str, given: dict[str, Any]) -> None:
    """Raise ConfigError if `given` is not a range."""
    low, high, log = given.get("low"), given.get("high"), given.get("log", False)
    numbers = [end for end in (low, high) if isinstance(end, (int, float)) and not isinstance(end, bool)]
    if len(numbers) < 2 or not isinstance(log, bool) or set(given) - {"low", "high", "log"}:
        raise ConfigError(label, "", f"must be a list of values, or a range such as {RANGE}")
    if not numbers[0] < numbers[1] < math.inf or (log and numbers[0] <= 0):
        positive = ", and above 0 with log: true" if log else ""
        raise ConfigError(label, "", f"must have a low end below the high end{positive}")


def make_plan(
    path: Path,
    vary: Sequence[str],
    seeds: int,
    overrides: Sequence[str],
    allow_code: bool = False,
    trials: int | None = None,
) -> PreparedSweep:
    """Make every combination of the varied settings, check its configuration, and plan `seeds` seeds for each.

    With `trials`, plan a search with this number of combinations. It checks every value of every list, and both ends of
    every range.

    The seeds start at the configuration's `run.seed`. Raises a ConfigError that names the first wrong setting, or the
    first setting with code that is not allowed. Also raises it for a missing scene file.
    """
    varied = [parse_vary(text, trials is not None) for text in vary]
    for place, each in enumerate(varied):
        if reason := replaces(each.location, {f"--vary {other.key}": other.location for other in varied[:place]}):
            raise ConfigError(f"--vary {each.key}", "", reason)
    sizes = [len(each.overrides) for each in varied] if trials is None else [trials]
    count = math.prod(sizes) * seeds
    if count > MOST_RUNS:
        product = " x ".join(map(str, [*sizes, f"{seeds} seeds"]))
        raise ConfigError(
            "--vary" if trials is None else "--trials",
            "",
            f"{product} are {count} runs; a sweep has at most {MOST_RUNS}",
        )
    text = read_text(path)
    first = with_chosen(text, path, overrides, [each.overrides[0] for each in varied], allow_code).run.seed
    if first + seeds > SEED_END:
        raise ConfigError("--seeds", "", f"exceeds the last seed, {SEED_END - 1}, from run.seed: {first}")
    combinations: list[Combination] = []
    configs: dict[str, Config] = {}
    for chosen in itertools.product(*(each.overrides for each in varied)) if trials is None else _one_by_one(varied):
        config = with_chosen(text, path, overrides, chosen, allow_code)
        check_code(config)
        check_code(config, config.run.code_callbacks)
        open_file(config.scene.file).close()
        if config.run.seed != first:
            reason = f"is {config.run.seed}, but {first} in the first combination; {OWN['run', 'seed']}"
            raise ConfigError("--vary", "run.seed", reason)
        combinations.append(
            named({each.key: override.value for each, override in zip(varied, chosen, strict=True)}, combinations)
        )
        configs[combinations[-1].name] = config
    own = {one.path for config in configs.values() for one in config.codes.values() if one.path is not None}
    own |= {code_file(place) for config in configs.values() for place in config.run.code_callbacks.values()}
    files = own.union(*(files_of(config).values() for config in configs.values()))
    search = None
    if trials is not None:  # later trials read the file again
        path = path.absolute()
        files.add(path)
        combinations, search = [], SweepSearch(trials, {each.key: each.given for each in varied})
    digests = file_digests({str(file): file for file in sorted(files)})
    codes = {str(file): digests.pop(str(file)) for file in sorted(own)}
    run_seeds = list(range(first, first + seeds))
    plan = SweepPlan(str(path), list(overrides), combinations, run_seeds, codes=codes, files=digests, search=search)
    return PreparedSweep(plan, configs)


def _one_by_one(varied: Sequence[Varied]) -> Iterator[tuple[Override, ...]]:
    """Yield the combination of the first values, and those that differ from it in one value."""
    first = tuple(each.overrides[0] for each in varied)
    yield first
    for place, each in enumerate(varied):
        for override in each.overrides[1:]:
            yield (*first[:place], override, *first[place + 1 :])


def with_chosen(
    text: str, path: Path, overrides: Sequence[str], chosen: Sequence[Override], allow_code: bool
) -> Config:
    """Return the experiment with one value of each varied setting. Raises ConfigError.

    If the value of `integrator` is a string, the string names a method, as in `convergence --integrators`. The named
    method keeps the depth and the shared options of the experiment's own integrator.

    All runs of a sweep have the same rendered target: settings of the integrator that vary do not apply to it.
    """
    own = [each for each in chosen if each.location[0] == "integrator"]
    methods = [each for each in own if each.location == ("integrator",) and isinstance(each.value, str)]
    others = [each for each in chosen if each not in methods]
    config = loads(text, path, [*overrides, *others]).with_code(allow_code)
    for each in methods:
        cases = parse_cases(each.value, "--vary integrator")
        if len(cases) > 1:
            raise ConfigError(each.label, "", "names several integrators in one value; write [prb, reslrb:stack]")
        config = cases[0].at(config, config.integrator.max_depth, known=False, auto=True)
    render = config.target.render
    if own and render is not None and render.integrator is None:
        base = loads(text, path, [*overrides, *(each for each in chosen if each not in own)])
        render = render.model_copy(update={"integrator": base.integrator})
        config = config.model_copy(update={"target": config.target.model_copy(update={"render": render})})
    return config


def named(settings: dict[str, Any], others: Sequence[Combination]) -> Combination:
    """Return the combination of `settings`. Its name differs from those of the `others`, regardless of case."""
    short = short_keys(list(settings))
    taken = {other.name.casefold() for other in others}
    name = wanted = _bounded("-".join(f"{short[key]}={_named(value)}" for key, value in settings.items()))
    for number in itertools.count(2):
        if name.casefold() not in taken:
            break
        name = f"{wanted}-{number}"
    return Combination(name, settings)


def _named(value: Any) -> str:
    """Return a value as part of a folder name. The name of a section starts with the value of the section's `type`."""
    if isinstance(value, Mapping):
        first = [str(value["type"])] if "type" in value else []
        return "-".join(first + [f"{key}={_named(each)}" for key, each in value.items() if key != "type"])
    if isinstance(value, list):
        return "-".join(map(_named, value))
    return value if isinstance(value, str) else in_words(value)


def _bounded(name: str) -> str:
    """Return a valid folder name that is short enough to append a seed and a number."""
    most = NAME_BYTES - _SEED_BYTES - len(f"-{MOST_RUNS}")
    return folder_name(name).encode()[:most].decode(errors="ignore")


# --- the folder -------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def started(folder: Path, plan: PreparedSweep) -> Iterator[SweepPlan]:
    """Start the sweep of `plan` in `folder`, and lock the folder while the block runs.

    Raises ConfigError if the folder holds a sweep or anything else.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(folder, error) from None
    with _locked(folder):
        if is_sweep(folder):
            reason = f"{folder} has a sweep already; `reslrb sweep --resume {folder}` continues it; give another folder"
            raise ConfigError("-o", "", reason)
        _write_configs(folder, plan)
        _write(folder, plan.sweep)
        yield plan.sweep


@contextlib.contextmanager
def resumed(
    folder: Path, seeds: int | None = None, allow_code: bool = False, trials: int | None = None
) -> Iterator[SweepPlan]:
    """Open the sweep in `folder`, and lock it while the block runs.

    `seeds` may add more seeds to the sweep, and `trials` more trials to a search. Runs that failed count as not yet
    done, except in a search.

    Raises ConfigError if the folder holds no sweep, or if user code is not allowed to run, or has changed since the
    start of the sweep.
    """
    if not folder.is_dir():
        raise ConfigError(folder, "", "no such file or folder; start a sweep by `reslrb sweep CONFIG --vary ...`")
    with _locked(folder):
        kept = read_sweep(folder)
        _check_files(folder, kept, allow_code)
        sweep = _grown(kept, seeds, trials)
        sweep = sweep if sweep.search else replace(sweep, failures={})
        _write(folder, sweep)
        yield sweep


def _locked(folder: Path) -> FolderLock:
    """Return the lock of the folder of a sweep. Raises ConfigError."""
    try:
        return FolderLock(folder.resolve())
    except InUse:
        raise ConfigError(folder, "", "is in use by another `reslrb sweep`; end that first") from None
    except OSError as error:
        raise ConfigError(folder, "", f"cannot be opened: {error.strerror}") from None


def _write(folder: Path, sweep: SweepPlan) -> None:
    try:
        sweep.write(folder)
    except OSError as error:
        raise _unwritable(folder, error) from None


def _unwritable(folder: Path, error: OSError) -> ConfigError | MachineError:
    if is_machine_fault(error):
        return MachineError(f"{folder}: {error.strerror}; the sweep has stopped")
    return ConfigError("-o", "", f"cannot write to {folder} ({error.strerror}); give another folder")


def _write_configs(folder: Path, plan: PreparedSweep) -> None:
    """Write the configurations of a new sweep, before its plan. Raises ConfigError if the folder holds other files."""
    # a sweep that was killed at its start has written only configurations
    if others := sorted(path.name for path in folder.iterdir() if path.name != "configs"):
        reason = f"{folder} contains {one_line(others[0], 60)!r}, but no sweep; give a new or empty folder"
        raise ConfigError("-o", "", reason)
    try:
        for combination in plan.sweep.combinations:
            path = config_file(folder, combination)
            path.parent.mkdir(exist_ok=True)
            path.write_text(dump(plan.configs[combination.name]), encoding="utf-8")
    except OSError as error:
        raise _unwritable(folder, error) from None


def _check_files(folder: Path, kept: SweepPlan, allowed: bool) -> None:
    """Raise ConfigError if a file of the sweep has changed, or if the sweep would run code that is not allowed."""
    for file, digest in (kept.codes | kept.files).items():
        if file in kept.codes and not allowed:
            reason = f"would run the code of {file} with all your rights; --allow-code permits it"
            raise ConfigError(folder, "", reason)
        if digest_of(Path(file)) != digest:
            reason = f"has changed since the sweep in {folder} began; put it back, or start another with -o"
            raise ConfigError(file, "", reason)


def _grown(kept: SweepPlan, seeds: int | None, trials: int | None) -> SweepPlan:
    """Return the sweep extended to `seeds` seeds and `trials` trials, if given. Raises ConfigError if the sweep has
    more already.
    """
    if trials is not None:
        if kept.search is None:
            raise ConfigError("--trials", "", "the sweep in the folder is not a search")
        if trials < kept.search.trials:
            raise ConfigError("--trials", "", f"is {trials}; the search has {kept.search.trials} trials already")
        kept = replace(kept, search=replace(kept.search, trials=trials))
    if seeds is not None and seeds < len(kept.seeds):
        raise ConfigError("--seeds", "", f"is {seeds}; the sweep has {len(kept.seeds)} seeds already")
    count = seeds or len(kept.seeds)
    grown = replace(kept, seeds=list(range(kept.seeds[0], kept.seeds[0] + count)))
    if grown.size > MOST_RUNS or grown.seeds[-1] >= SEED_END:
        reason = f"{grown.size // count} x {count} seeds: a sweep has at most {MOST_RUNS} runs"
        raise ConfigError("--seeds" if trials is None else "--trials", "", reason)
    return grown


# --- runs still to be done --------------------------------------------------------------------------------------------


def is_left(folder: Path, sweep: SweepPlan, name: str) -> bool:
    """True if a run of the sweep must still be started or resumed."""
    return name not in sweep.failures and (read_manifest(folder / name) or {}).get("status") != Status.FINISHED


def command(folder: Path, sweep: SweepPlan, combination: Combination, seed: int) -> list[str]:
    """Return the arguments for `reslrb` that start one run, or that resume an interrupted run.

    User code is allowed, because `opened` has checked the permission. Waits for a killed process that still holds the
    run folder. Raises a ConfigError that names the run folder if a process keeps using the folder.
    """
    folder, name = folder.absolute(), run_name(combination, seed)
    allowed = ["--allow-code"] if sweep.codes else []
    run, end = folder / name, time.monotonic() + RELEASE_SECONDS
    while (read_manifest(run) or {}).get("status") == Status.RUNNING:
        if time.monotonic() > end:
            raise ConfigError(run, "", "is in use by another run; end that first")
        time.sleep(_POLL_SECONDS)
    if newest_checkpoint(run / "checkpoint") is not None and read_manifest(run) is not None:
        return ["optimize", "--resume", str(run), *allowed]
    words = ["optimize", str(config_file(folder, combination)), *allowed]
    for key, value in (("run.seed", seed), ("run.output", str(folder)), ("run.name", name)):
        words += ["--set", f"{key}={json.dumps(value)}"]
    if read_manifest(run) is not None:  # the run was killed before its first checkpoint
        shutil.rmtree(run)
    elif os.path.lexists(run):
        raise ConfigError(run, "", "is no run's folder, and a run of the sweep needs the name; remove or rename it")
    return words
