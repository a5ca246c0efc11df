"""`reslrb gradcheck --suite`: cases of its own in place of a configuration."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import click

from reslrb_cli.cli.output import echo
from reslrb_cli.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from reslrb_cli.records.gradcheck import GradcheckRecord

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
    from reslrb_cli.backend.device import device_name
    from reslrb_cli.backend.variant import set_variant
    from reslrb_cli.cli.interrupts import Interrupts
    from reslrb_cli.cli.keeping import Keeper, read_earlier
    from reslrb_cli.cli.measured import origin_of
    from reslrb_cli.report.gradcheck_table import summary_lines

    chosen = _estimators(estimators)
    variant = set_variant("auto")

    from reslrb_cli.measure.earlier import Earlier
    from reslrb_cli.measure.extreme import CASES, resuming, run_suite

    for name in names:
        if name not in CASES:
            near = difflib.get_close_matches(name, list(CASES), n=1, cutoff=0)
            raise ConfigError("--case", "", f"there is no case `{name}`; did you mean {near[0]}?")
    settings = resuming.settings(chosen, seeds, variant, device_name(variant))
    done: dict[str, list[GradcheckRecord]] = {}
    to_do = list(names or CASES)
    if resumed is not None:
        earlier = Earlier(resuming.KIND, resumed, *read_earlier(resumed))
        earlier.check(settings)
        done = resuming.restore(earlier)
        to_do = [name for name in to_do if name not in done]
        if not to_do:
            raise earlier.complete("all these cases", "others with --case")
    echo(f"{device_name(variant)}, {variant}")
    for case, rows in done.items():
        echo(_case_line(case, rows))

    def lines() -> list[GradcheckRecord]:
        return [record for rows in done.values() for record in rows]

    keeper = Keeper(json_file, origin_of(variant), lines, lambda: [], lambda: resuming.kept(settings, done))
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
    from reslrb_cli.measure.cases import parse_estimators

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
    from reslrb_cli.report.suite_table import limits, suite_table

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
