"""`reslrb gradcheck`: whether the gradients of a scene can be trusted.

- `--missing` (`run_missing`): what of a scene's derivatives is in no attached gradient.
- `--suite` (`run_suite_command`): cases of its own in place of a configuration.
"""

from __future__ import annotations

import difflib
import logging
import os
import time
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.options import COUNT, allowance, check_writable, optional_experiment_arguments, resume_option
from reslrb_cli.cli.terminal import echo
from reslrb_cli.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from reslrb_cli.config.schema import Config
    from reslrb_cli.measure.gradcheck import Gradcheck, Result
    from reslrb_cli.records.measurements import GradcheckRecord, MissingRecord


#: Options that say something about comparisons, of which there is none.
FOREIGN = {"suite": "--suite", "cases": "--case", "estimators": "--estimators", "markdown_file": "--markdown",
           "folder": "--images"}  # fmt: skip


def refuse_comparisons(context: click.Context) -> None:
    """Raise ConfigError where an option of the command has no part in this."""
    for name, option in FOREIGN.items():
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise ConfigError(option, "", "does not go with --missing, which compares no estimators; leave out one")
    if context.params["config_file"] is None:
        raise ConfigError("--missing", "", "needs a CONFIG, whose parameters and loss it looks at")


def run_missing(
    config: Config,
    variant: str,
    budget: float,
    seeds: int | None,
    spp: int | None,
    along: int | None,
    json_file: Path | None,
    resumed: Path | None,
) -> int:
    """Measure, print and write; returns the exit code. `variant` must be set."""
    from reslrb_cli.backend.doctor import device_name
    from reslrb_cli.cli.options import Keeper, origin_of, read_earlier
    from reslrb_cli.cli.terminal import Interrupts
    from reslrb_cli.measure.missing import KIND, MissingCheck
    from reslrb_cli.measure.resume_store import Earlier, settings

    to_keep = settings(config, variant, device_name(variant), spp=spp, directions=along)
    earlier = None
    if resumed is not None:
        earlier = Earlier(KIND, resumed, *read_earlier(resumed))
        earlier.check(to_keep)
    check = MissingCheck(config, budget, seeds, spp, along, earlier)
    echo(check.conditions())
    records: list[MissingRecord] = []
    keeper = Keeper(
        json_file,
        origin_of(variant),
        lambda: records,
        lambda: check.known()[len(records) :],
        lambda: check.kept(to_keep),
    )
    with Interrupts() as interrupts:
        for record in check.run(lambda: interrupts.requested, keeper.refresh):
            records.append(record)
            echo(record.line())
        keeper.finish(check.known())
        return ExitCode.INTERRUPTED if interrupts.requested else ExitCode.DONE


#: Options of `gradcheck` that mean nothing without a configuration, by their parameters' names.
_FOREIGN = {
    "config_file": "CONFIG",
    "overrides": "--set",
    "budget": "--budget",
    "spp": "--spp",
    "folder": "--images",
}


def refuse_foreign(context: click.Context) -> None:
    """Raise ConfigError where an option is given that a suite has no use for."""
    for name, option in _FOREIGN.items():
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise ConfigError(
                "--suite", "", f"{option} has no effect on a suite, whose cases have their own; remove it"
            )


def run_suite_command(
    names: tuple[str, ...],
    estimators: str | None,
    seeds: int | None,
    json_file: Path | None,
    markdown_file: Path | None,
    resumed: Path | None,
) -> int:
    """Run the cases of these names, all where there is none; print a line for each, write the files.

    Cases that the file `resumed` has are not run again.
    """
    from reslrb_cli.backend.doctor import device_name
    from reslrb_cli.backend.variant import set_variant
    from reslrb_cli.cli.options import Keeper, origin_of, read_earlier
    from reslrb_cli.cli.terminal import Interrupts
    from reslrb_cli.report.tables import summary_lines

    chosen = _estimators(estimators)
    variant = set_variant("auto")

    from reslrb_cli.measure.extreme import CASES, run_suite, suite
    from reslrb_cli.measure.resume_store import Earlier

    for name in names:
        if name not in CASES:
            near = difflib.get_close_matches(name, list(CASES), n=1, cutoff=0)
            raise ConfigError("--case", "", f"there is no case `{name}`; did you mean {near[0]}?")
    settings = suite.settings(chosen, seeds, variant, device_name(variant))
    done: dict[str, list[GradcheckRecord]] = {}
    to_do = list(names or CASES)
    if resumed is not None:
        earlier = Earlier(suite.KIND, resumed, *read_earlier(resumed))
        earlier.check(settings)
        done = suite.restore(earlier)
        to_do = [name for name in to_do if name not in done]
        if not to_do:
            raise earlier.complete("all these cases", "others with --case")
    echo(f"{device_name(variant)}, {variant}")
    for case, rows in done.items():
        echo(_case_line(case, rows))

    def lines() -> list[GradcheckRecord]:
        return [record for rows in done.values() for record in rows]

    keeper = Keeper(json_file, origin_of(variant), lines, lambda: [], lambda: suite.kept(settings, done))
    with Interrupts() as interrupts:

        def until_interrupted(found: Iterator[GradcheckRecord]) -> Iterator[GradcheckRecord]:
            for record in found:
                if interrupts.requested:
                    return
                yield record

        for case, group in groupby(until_interrupted(run_suite(to_do, chosen, seeds)), lambda r: r.case):
            rows = list(group)
            if interrupts.requested:  # there may be more of this one
                break
            done[case] = rows
            keeper.refresh()
            echo(_case_line(case, rows))
        records, interrupted = lines(), interrupts.requested
        keeper.finish(records)
    for line in summary_lines(records):
        echo(line)
    if markdown_file is not None:
        about = {name: case.about for name, case in CASES.items()}
        markdown_file.write_text(_document(records, about, f"{device_name(variant)}, {variant}"), encoding="utf-8")
    if interrupted:
        return ExitCode.INTERRUPTED
    return ExitCode.CHECK_FAILED if any(record.holds is False for record in records) else ExitCode.DONE


def _estimators(text: str | None) -> list[str] | None:
    """Names of estimators, without options: the cases have their own."""
    from reslrb_cli.config.integrators import ESTIMATOR_OPTIONS
    from reslrb_cli.measure.methods import parse_estimators

    if text is None:
        return None
    names = []
    for case in parse_estimators(text):
        name = case.options["estimator"]
        if len(case.options) > 1:
            raise ConfigError("--estimators", case.label.partition(":")[2], "a suite takes names without options")
        if name not in ESTIMATOR_OPTIONS or name == "auto":
            known = ", ".join(other for other in ESTIMATOR_OPTIONS if other != "auto")
            raise ConfigError("--estimators", "", f"`{name}` is no estimator; there are {known}")
        names.append(name)
    return names


def _case_line(case: str, rows: list[GradcheckRecord]) -> str:
    """A case with its largest deviations, and how many of its comparisons hold."""
    z = max((row.z_max for row in rows if row.z_max is not None), default=0.0)
    distance = max((row.relative_l2 or 0.0 for row in rows if row.relative_l2_limit is not None), default=0.0)
    holds, open_ = (sum(row.holds is value for row in rows) for value in (True, None))
    verdict = "FAILS" if holds + open_ < len(rows) else "holds"
    left = f", {open_} open" if open_ else ""
    return f"{case:<40}  max |z| {z:4.1f}  equal seeds {distance:.0e}  {holds} of {len(rows)}{left}  {verdict}"


def _document(records: list[GradcheckRecord], about: dict[str, str], machine: str) -> str:
    """The page that `--markdown` writes."""
    from reslrb_cli.report.tables import limits, suite_table

    z, distance = limits(records)
    return (
        "# The extreme suite\n\n"
        "Scenes in which gradients of light paths break, each with a reference. Written by\n\n"
        "    reslrb gradcheck --suite extreme --markdown docs/extreme.md\n\n"
        f"on {machine}. Under each estimator stand the largest deviation in standard errors of all comparisons over\n"
        f"many seeds (limit {z:.1f}, the same for all), the largest relative L2 distance at equal seeds (limit\n"
        f"{distance:.0e}), and what does not hold or stays open. References and verdicts: docs/gradcheck.md.\n\n"
        f"{suite_table(records, about)}"
    )


logger = logging.getLogger(__name__)


@click.command("gradcheck")
@optional_experiment_arguments
@click.option("--suite", type=click.Choice(["extreme"]),
              help="Run scenes of its own in place of CONFIG: extreme, those in which gradients break.")  # fmt: skip
@click.option("--case", "cases", multiple=True, metavar="NAME", help="Run this case of the suite; may be repeated.")
@click.option("--estimators", metavar="LIST",
              help="What to check: ESTIMATOR[(OPTION=VALUE,...)], separated by commas. Default: all four, with the "
                   "options of CONFIG.")  # fmt: skip
@click.option("--budget", type=click.FloatRange(min=0), default=45.0, show_default=True, metavar="SECONDS",
              help="Time for the whole, loading and compiling included; it decides how many seeds there are. What it "
                   "does not suffice for is named, with what it would take.")  # fmt: skip
@click.option("--seeds", type=click.IntRange(min=3, max=COUNT.max), metavar="N",
              help="Number of seeds, whatever time they take, those of --resume included.")  # fmt: skip
@resume_option
@click.option("--spp", type=COUNT,
              help="Samples per pixel of one gradient. Default: 65536 light paths, no more than run.spp.")  # fmt: skip
@click.option("--missing", is_flag=True,
              help="Measure instead what no gradient of this kind has: the share of each parameter's derivative that "
                   "silhouettes, edges of shadows and light that leaves the film make up.")  # fmt: skip
@click.option("--directions", type=click.IntRange(min=1, max=64), metavar="N",
              help="With --missing: along how many directions of each parameter. Default: 3.")  # fmt: skip
@click.option("--json", "json_file", type=click.Path(path_type=Path, dir_okay=False),
              help="Write one object a line, one for each comparison.")  # fmt: skip
@click.option("--markdown", "markdown_file", type=click.Path(path_type=Path, dir_okay=False),
              help="Write the table as Markdown.")  # fmt: skip
@click.option("--images", "folder", type=click.Path(path_type=Path, file_okay=False),
              help="Write maps of the gradients of textures, their references and z into this folder, as PNG and as "
                   "layers of EXR files.")  # fmt: skip
@click.pass_context
def command(
    context: click.Context,
    config_file: Path | None,
    overrides: tuple[str, ...],
    suite: str | None,
    cases: tuple[str, ...],
    estimators: str | None,
    budget: float,
    seeds: int | None,
    resumed: Path | None,
    spp: int | None,
    missing: bool,
    directions: int | None,
    json_file: Path | None,
    markdown_file: Path | None,
    folder: Path | None,
) -> int:
    """Compare the gradients of every parameter of CONFIG with references, at its initial values.

    Each estimator is compared with naive AD of the same paths (walk_ad), with a stock integrator where one counts as a
    reference (ptracer, else prb), with finite differences, with forward mode, and with the exact value where the scene
    is known to have one. Without CONFIG the scene is a Cornell box (--set scene.options.size=64, ...). The exit code is
    1 where a comparison fails; the last lines say which, and by how much. docs/gradcheck.md explains the columns.
    """
    began = time.monotonic()
    from reslrb_cli.backend.doctor import device_name
    from reslrb_cli.backend.installation import load_packages
    from reslrb_cli.backend.variant import set_variant
    from reslrb_cli.cli.options import read_earlier
    from reslrb_cli.config.loader import load, loads

    load_packages()  # before what follows asks for them
    from reslrb_cli.measure.gradcheck import Gradcheck
    from reslrb_cli.measure.methods import all_estimators, parse_estimators
    from reslrb_cli.measure.participants import Settings
    from reslrb_cli.measure.resume_store import Earlier
    from reslrb_cli.measure.sampling import KIND
    from reslrb_cli.measure.sampling import settings as settings_to_keep
    from reslrb_cli.measure.scenes import small
    from reslrb_cli.records.measurements import Verdict

    if missing:
        refuse_comparisons(context)
    elif directions is not None:
        raise ConfigError("--directions", "", "goes with --missing alone")
    json_file = json_file or resumed
    check_writable("--json", json_file)
    check_writable("--markdown", markdown_file)
    if suite is not None:
        refuse_foreign(context)
        return run_suite_command(cases, estimators, seeds, json_file, markdown_file, resumed)
    if cases:
        raise ConfigError("--case", "", "names a case of a suite; take --suite extreme with it")
    if config_file is None:
        config = loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, overrides)
    else:
        config = load(config_file, overrides)
    if missing:
        variant = set_variant(config.variant)
        echo(f"{device_name(variant)}, {variant}")
        return run_missing(config, variant, budget, seeds, spp, directions, json_file, resumed)
    listed = all_estimators(config) if estimators is None else parse_estimators(estimators)
    _check_folder(folder)
    settings = Settings(config, listed, budget, seeds, spp, estimators is not None, time.monotonic() - began)
    settings.configs()  # before anything is loaded
    variant = set_variant(config.variant)
    to_keep = settings_to_keep(settings, variant, device_name(variant))
    earlier = None if resumed is None else Earlier(KIND, resumed, *read_earlier(resumed))
    if earlier is not None:
        earlier.check(to_keep)
    check = Gradcheck(settings, earlier=earlier)
    echo(f"{device_name(variant)}, {variant}; {allowance(budget, seeds, 'seed')}")
    echo(check.conditions())
    records, interrupted = _run(check, variant, to_keep, json_file, folder)
    _finish(records, markdown_file)
    if interrupted:
        return ExitCode.INTERRUPTED
    nothing = all(record.verdict in (Verdict.NOT_MEASURED, Verdict.NO_REFERENCE) for record in records)
    failed = nothing or any(record.holds is False for record in records)
    return ExitCode.CHECK_FAILED if failed else ExitCode.DONE


def _run(
    check: Gradcheck, variant: str, to_keep: dict[str, Any], json_file: Path | None, folder: Path | None
) -> tuple[list[GradcheckRecord], bool]:
    """Measure, print and write; returns all records, and whether the user interrupted."""
    from reslrb_cli.cli.options import Keeper, origin_of
    from reslrb_cli.cli.terminal import Interrupts
    from reslrb_cli.records.measurements import Verdict
    from reslrb_cli.report.tables import Table

    records: list[GradcheckRecord] = []
    drawn = False
    keeper = Keeper(json_file, origin_of(variant), lambda: records, lambda: [], lambda: check.kept(to_keep))
    with Interrupts() as interrupts:
        table = Table(check.expected())
        echo(table.head())
        for result in check.run(lambda: interrupts.requested, logger.info, keeper.refresh):
            records.append(result.record)
            keeper.refresh()
            if result.record.verdict is not Verdict.NOT_MEASURED:  # the last lines say how many there are
                echo(table.line(result.record))
            _draw(result, folder)
            drawn = drawn or result.maps is not None
        keeper.finish(records)
    if folder is not None and drawn:
        echo(f"look at {os.path.relpath(folder)}")
    return records, interrupts.requested


def _draw(result: Result, folder: Path | None) -> None:
    if folder is None or result.maps is None:
        return
    from reslrb_cli.report.plots import plot_maps

    folder.mkdir(parents=True, exist_ok=True)
    plot_maps(result.record, result.maps.gradient, result.maps.reference, result.maps.z, folder)


def _finish(records: list[GradcheckRecord], markdown_file: Path | None) -> None:
    """Print what it comes to, and write the Markdown table."""
    from reslrb_cli.report.tables import markdown_table, summary_lines

    for line in summary_lines(records) if records else ["interrupted before there were enough seeds to compare"]:
        echo(line)
    if markdown_file is not None:
        markdown_file.write_text(markdown_table(records), encoding="utf-8")


def _check_folder(folder: Path | None) -> None:
    """Raise ConfigError where maps could not be written."""
    if folder is None:
        return
    above = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise ConfigError("--images", "", f"cannot write into {above}")
