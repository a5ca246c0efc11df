"""`reslrb gradcheck`: check the gradients of a scene. `--missing` measures which part of the derivatives the gradients
lack.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.backend.installation import load_packages
from reslrb_cli.backend.variant import set_variant
from reslrb_cli.cli.options import (
    COUNT,
    ExperimentOptions,
    Keeper,
    allow_code_option,
    allowance,
    check_writable,
    draws_option,
    is_given,
    json_option,
    optional_experiment_arguments,
    origin_of,
    read_or_box,
)
from reslrb_cli.cli.terminal import Interrupts, echo
from reslrb_cli.config.integrators import ESTIMATOR_OPTIONS
from reslrb_cli.config.loader import check_code
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, ExitCode, did_you_mean
from reslrb_cli.measure.methods import PATHS_OPTIONS, parse_checked
from reslrb_cli.records.measurements import GradcheckRecord, MissingRecord, Verdict

if TYPE_CHECKING:
    from reslrb_cli.measure.gradcheck import Gradcheck


#: Options of comparisons; `--missing` makes none.
COMPARING = {"suite": "--suite", "integrators": "--integrators", "draws": "--draws"}

#: Options of a configuration; a suite has none but the variant.
CONFIGURED = {"config_file": "CONFIG", "budget": "--budget", "spp": "--spp", "draws": "--draws"}

#: The suites: all cases of the catalogue, and those of each tag.
SUITES = ("extreme", "colours", "lights", "places", "roughness", "films", "glass", "losses", "motion", "unfound")


@dataclass(frozen=True)
class GradcheckOptions(ExperimentOptions):
    """The options of the command, by the names of its parameters."""

    suite: str | None
    integrators: str | None
    budget: float
    seeds: int | None
    json_file: Path | None
    draws: Path | None
    spp: int | None
    missing: bool

    def check(self) -> None:
        """Raise ConfigError if an option has no effect beside another."""
        if self.missing and (option := _given(COMPARING)):
            raise ConfigError(option, "", "has no effect with --missing, which compares nothing; remove one of them")
        if self.missing and self.config_file is None:
            raise ConfigError("--missing", "", "needs a CONFIG with parameters and a loss")
        if self.suite is not None and (option := _given(CONFIGURED)):
            raise ConfigError("--suite", "", f"{option} has no effect on a suite; remove it")
        if self.suite is not None and any(not text.startswith("variant=") for text in self.overrides):
            raise ConfigError("--suite", "", "--set has no effect on a suite, except for variant; remove it")
        if self.suite is not None and self.suite.partition(":")[0] not in SUITES:
            raise ConfigError("--suite", "", f"there is no suite `{self.suite}`; there are {', '.join(SUITES)}")


def _given(options: dict[str, str]) -> str | None:
    """Return the first of `options` that the user gave. The keys of `options` are parameter names."""
    return next((option for name, option in options.items() if is_given(name)), None)


def run_missing(options: GradcheckOptions, config: Config, variant: str) -> int:
    """Measure, print and write; return the exit code. `variant` must be set. Each parameter gets an equal part of the
    time that the earlier ones left.
    """
    from reslrb_cli.measure.missing import MOST_SEEDS, MissingCheck

    begin, check, records = time.monotonic(), MissingCheck.of_config(config, options.spp), list[MissingRecord]()
    echo(check.conditions())
    keeper = Keeper(options.json_file, origin_of(variant), lambda: records)
    with Interrupts() as interrupts:
        for place, key in enumerate(check.keys):
            now = time.monotonic()
            end = math.inf if options.seeds else now + (options.budget - (now - begin)) / (len(check.keys) - place)

            def affords(_: int, end: float = end) -> bool:
                return not interrupts.requested and time.monotonic() < end

            record = check.measured(key, affords, options.seeds or MOST_SEEDS, looks=False)
            if not record.seeds and affords(0):
                raise ConfigError(check.source, "loss", f"has no derivative beside the initial value of {key}")
            if interrupts.requested and not record.seeds:
                break
            records.append(record)
            echo(record.line())
            keeper.refresh()
        keeper.finish(interrupts.requested)
        return ExitCode.INTERRUPTED if interrupts.requested else ExitCode.DONE


def run_suite(options: GradcheckOptions) -> int:
    """Run the named cases, or all cases of the suite without names. Print a line for each case and write the file."""
    chosen = None if options.integrators is None else _estimators(options.integrators)
    variant = set_variant(options.config().variant)

    import mitsuba as mi

    from reslrb_cli.measure.extreme import CASES, case_records
    from reslrb_cli.measure.scenes.catalogue import TAGGED
    from reslrb_cli.report.tables import summary_lines

    suite, _, listed = str(options.suite).partition(":")
    cases = [*CASES] if suite == "extreme" else [case.name for case in TAGGED[suite]]
    names = [name.strip() for name in listed.split(",")] if listed else cases
    for name in names:
        if name not in cases:
            raise ConfigError("--suite", "", f"there is no case `{name}`; {did_you_mean(name, cases, cutoff=0)}")
    echo(f"{device_name(variant)}, {variant}")
    records: list[GradcheckRecord] = []
    keeper = Keeper(options.json_file, origin_of(variant), lambda: records)
    with Interrupts() as interrupts:
        for name in names:
            if mi.is_spectral and (reason := CASES[name].not_spectral):
                echo(f"{name:40s}  left out: {reason}")
                continue
            rows = case_records(lambda: interrupts.requested, name, chosen, options.seeds)
            if interrupts.requested:  # this case may be incomplete
                break
            records += rows
            keeper.refresh()
            echo(_case_line(name, rows))
        interrupted = interrupts.requested
        keeper.finish(interrupts.requested)
    for line in summary_lines(records):
        echo(line)
    return ExitCode.INTERRUPTED if interrupted else _exit_code(records)


def _estimators(text: str) -> list[str]:
    """Parse the estimators for a suite. Estimators accept no option except `paths`, because the cases set their own
    options.
    """
    written = []
    for case in parse_checked(text):
        name, label = case.options.get("estimator"), case.label.partition(":")[2]
        if not case.options.keys() <= {"estimator", *PATHS_OPTIONS}:
            raise ConfigError("--integrators", label, "a suite allows estimators of reslrb, and no option except paths")
        if name not in ESTIMATOR_OPTIONS or name == "auto":
            known = ", ".join(other for other in ESTIMATOR_OPTIONS if other != "auto")
            raise ConfigError("--integrators", "", f"`{name}` is no estimator; there are {known}")
        case.at(read_or_box(None, ()), 4, known=True)
        written.append(label)
    return written


def _case_line(case: str, rows: list[GradcheckRecord]) -> str:
    """Return a line with a case, its largest deviations, and the number of comparisons that hold."""
    z = max((row.z_max for row in rows if row.z_max is not None), default=0.0)
    distance = max((row.relative_l2 or 0.0 for row in rows if row.relative_l2_limit is not None), default=0.0)
    holds, open_ = (sum(row.holds is value for row in rows) for value in (True, None))
    verdict = "FAILS" if holds + open_ < len(rows) else "holds"
    left = f", {open_} open" if open_ else ""
    return f"{case:<40}  max |z| {z:4.1f}  equal seeds {distance:.0e}  {holds} of {len(rows)}{left}  {verdict}"


@click.command("gradcheck")
@optional_experiment_arguments
@click.option("--suite", metavar="extreme|TAG[:CASE,...]",
              help="Run scenes in which gradients often fail in place of CONFIG: all, those of a tag such as glass or "
                   "motion, or only the named cases.")  # fmt: skip
@click.option("--integrators", metavar="LIST",
              help=
        "Check these, separated by commas: estimators, reslrb:ESTIMATOR[(OPTION=VALUE,...)], or your own Mitsuba "
        "integrators, FILE.py:CLASS[(OPTION=VALUE,...)], which need --allow-code. Default: all four estimators, with "
        "the options of CONFIG, and reslrb:stack(paths=both) if CONFIG leaves the paths open and the scene allows "
        "both.")  # fmt: skip
@click.option("--budget", type=click.FloatRange(min=0), default=120.0, show_default=True, metavar="SECONDS",
              help="Time limit, including loading and compiling. Comparisons with too few seeds by then are "
                   "unresolved.")  # fmt: skip
@click.option("--seeds", type=click.IntRange(min=3, max=COUNT.max), metavar="N",
              help="Number of seeds, without a time limit. Default: 16.")  # fmt: skip
@allow_code_option
@json_option
@draws_option
@click.option("--spp", type=COUNT,
              help="Samples per pixel of one gradient. Default: 65536 light paths, at most run.spp.")  # fmt: skip
@click.option("--missing", is_flag=True,
              help=
        "Instead, measure the share of each parameter's derivative that the gradient lacks: light that leaves the "
        "film, and edges of silhouettes and shadows, with integrator.edges unless it is off.")  # fmt: skip
def command(**given: Any) -> int:
    """Compare the gradients of every parameter of CONFIG with references. The parameters have their initial values.

    Each estimator is compared with naive AD of the same paths (walk_ad), with a valid stock integrator (ptracer, else
    prb), with finite differences, and with forward mode. Without CONFIG, the scene is a Cornell box
    (--set scene.options.size=64, ...). The exit code is 1 if a comparison fails; the last lines describe the failures.
    docs/gradcheck.md explains the columns.
    """
    began, options = time.monotonic(), GradcheckOptions(**given)
    load_packages()  # before the imports below need them
    from reslrb_cli.measure.draws import DrawsFile
    from reslrb_cli.measure.gradcheck import Gradcheck
    from reslrb_cli.measure.participants import CheckSettings
    from reslrb_cli.report.tables import summary_lines

    options.check()
    check_writable("--json", options.json_file)
    check_writable("--draws", options.draws)
    if options.suite is not None:
        return run_suite(options)
    config = options.config()
    if options.missing:
        check_code(config)
        variant = set_variant(config.variant)
        echo(f"{device_name(variant)}, {variant}")
        return run_missing(options, config, variant)
    named = None if options.integrators is None else parse_checked(options.integrators)
    checked = CheckSettings(config, named, options.budget, options.seeds, options.spp, time.monotonic() - began)
    variant = set_variant(config.variant)
    check = Gradcheck(checked, file=DrawsFile(options.draws))
    limit = allowance(options.budget, options.seeds, "seed")
    echo(f"{device_name(variant)}, {variant}; {limit if options.seeds else f'{check.seeds} seeds, {limit}'}")
    echo(check.conditions())
    records, interrupted = _run(check, variant, options)
    none = "interrupted before there were enough seeds to compare"
    for line in summary_lines(records) if records else [none]:
        echo(line)
    nothing = all(record.verdict in (Verdict.NOT_MEASURED, Verdict.NO_REFERENCE) for record in records)
    if interrupted:
        return ExitCode.INTERRUPTED
    return ExitCode.CHECK_FAILED if nothing else _exit_code(records)


def _exit_code(records: Iterable[GradcheckRecord]) -> int:
    return ExitCode.CHECK_FAILED if any(record.holds is False for record in records) else ExitCode.DONE


def _run(check: Gradcheck, variant: str, options: GradcheckOptions) -> tuple[list[GradcheckRecord], bool]:
    """Measure, print and write. Return all records, and True if the user interrupted."""
    from reslrb_cli.report.tables import cells, gradcheck_columns

    keeper = Keeper(options.json_file, origin_of(variant), lambda: check.records(interrupts.requested))
    with Interrupts() as interrupts:
        records = list(check.run(lambda: interrupts.requested, echo, keeper.refresh))
        keeper.finish(interrupts.requested)
        table = gradcheck_columns(records)
        echo(table.head())
        for record in records:
            if record.verdict is not Verdict.NOT_MEASURED:  # the last lines say how many there are
                echo(table.line(cells(record)))
    return records, interrupts.requested
