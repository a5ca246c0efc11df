"""Options and arguments that commands share, and the loading of configurations and variants.

Commands that measure save their results with `Keeper`. The file of `--json` starts with the device and the variant,
then has one object per line. The file is updated while the command runs.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from reslrb_cli.backend.doctor import device_name
from reslrb_cli.cli.terminal import Interrupts, echo
from reslrb_cli.config.loader import load, loads
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError, ExitCode
from reslrb_cli.records.measurement_files import Line, LivePage, Origin, is_stream, write_lines
from reslrb_cli.records.measurements import BenchStatus

if TYPE_CHECKING:
    from reslrb_cli.measure.engine import Engine
    from reslrb_cli.measure.methods import MeasurementPlan


def origin_of(variant: str) -> Origin:
    """Return the device and the variant on which this process measures."""
    return Origin(device_name(variant), variant)


class Keeper:
    """Writer of a JSON file. If the process is killed, only seconds of work are lost.

    `origin` is the first line. `lines` returns the current state of all other lines. Without a file, the writer does
    nothing. An earlier file is only replaced at the end: until then, `FILE.partial` has the lines.
    """

    def __init__(self, json_file: Path | None, origin: Line, lines: Callable[[], Sequence[Line]]) -> None:
        self._file = self._partial = json_file
        self._is_live = json_file is not None and not is_stream(json_file)
        if json_file is not None and self._is_live and json_file.exists() and json_file.stat().st_size:
            self._partial = json_file.with_name(f"{json_file.name}.partial")
        self._origin, self._lines = origin, lines
        self._live = LivePage(lambda: self._write(self._partial), "the file of --json")

    def refresh(self) -> None:
        """Write the file every few seconds. Writing takes only a small share of the time. Call this method between
        steps.
        """
        if self._is_live:  # a stream gets only the final lines
            self._live.refresh()

    def finish(self, interrupted: bool) -> None:
        """Write all lines in their final state. If the measurement was `interrupted`, keep an earlier file. Raises
        OSError.
        """
        self._write(self._partial if interrupted else self._file)
        if self._file is None or self._partial == self._file:
            return
        if interrupted:
            echo(f"--json: {self._file} has not changed; the interrupted measurement is in {self._partial}")
        elif self._partial is not None:
            with contextlib.suppress(OSError):
                self._partial.unlink()

    def _write(self, file: Path | None) -> None:
        if file is not None:
            write_lines(file, [self._origin, *self._lines()])


E = TypeVar("E", bound="Engine")


@contextmanager
def measuring(
    kind: Callable[..., E], plan: MeasurementPlan, began: float, say: Callable[[str], None] = echo, **options: Any
) -> Iterator[tuple[E, Interrupts]]:
    """Yield a session that measures `plan`, and the session's `Interrupts`. The session's processes end with it.

    `began` is the `monotonic` time at which the command was called. `options` are further arguments of `kind`. Raises
    ConfigError.
    """
    from reslrb_cli.measure.processes import abandon_all

    with Interrupts(last_act=abandon_all) as interrupts:
        spent_s = time.monotonic() - began
        session = kind(plan, lambda: interrupts.requested, say, spent_s=spent_s, **options)
        echo(f"{plan.device}, {plan.variant}; {allowance(plan.budget_s, plan.rounds, 'round')}")
        yield session, interrupts


def exit_code(interrupted: bool, done: bool, states: set[BenchStatus]) -> ExitCode:
    """Return the exit code of a comparison. The code is INTERRUPTED if `interrupted`, whatever was measured.

    Otherwise, the code is DONE if `done`. `done` is true if anything was measured. If nothing was measured, the code is
    OUT_OF_MEMORY if all `states` are, and CHECK_FAILED if not.
    """
    if interrupted:
        return ExitCode.INTERRUPTED
    memory = states == {BenchStatus.OUT_OF_MEMORY}
    return ExitCode.DONE if done else ExitCode.OUT_OF_MEMORY if memory else ExitCode.CHECK_FAILED


#: Type of an argument or an option that names the folder of a run, or of a sweep.
FOLDER = click.Path(file_okay=False, path_type=Path)


#: Type of a count, such as samples, depths or seeds: 31 bits, as in a configuration.
COUNT = click.IntRange(min=1, max=2**31 - 1)


class Counts(click.ParamType):
    """Different numbers of samples, such as `4,16,64`."""

    name = "list"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        parts: list[Any] = str(value).split(",")
        counts = [COUNT.convert(part, param, ctx) for part in parts]
        if len(set(counts)) < len(counts):
            self.fail(f"`{value}` has a number twice", param, ctx)
        return tuple(counts)


budget_option = click.option(
    "--budget", type=click.FloatRange(min=0), default=240.0, show_default=True, metavar="SECONDS",
    help=
        "Time limit, including loading and compiling. A measurement ends earlier after its usual number of rounds.",
)  # fmt: skip


#: `--set` (`overrides`).
overrides_option = click.option(
    "--set", "overrides", multiple=True, metavar="KEY=VALUE",
    help="Override a setting, e.g. --set run.spp=32; the value is YAML. May be repeated.",
)  # fmt: skip

#: `--json` (`json_file`) of a command that measures.
json_option = click.option(
    "--json", "json_file", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help=
        "Write one JSON object per line as results come.",
)  # fmt: skip

#: `--draws` (`draws`) of a command whose draws are kept.
draws_option = click.option(
    "--draws", type=click.Path(path_type=Path, dir_okay=False), metavar="FILE",
    help="Keep all draws in FILE (.npz). Draws that FILE has are not drawn again.",
)  # fmt: skip

#: `--allow-code` (`allow_code`) of a command that runs users' own code.
allow_code_option = click.option(
    "--allow-code", is_flag=True,
    help="Run the files of Python code that CONFIG or a list names (type: custom, FILE.py:NAME), with all your rights.",
)  # fmt: skip


def allowance(budget_s: float, number: int | None, of: str) -> str:
    """Return text that states when a measurement ends: after a time limit, or after `number` units of work. `of` names
    the unit.
    """
    if number is not None:
        return f"{number} {of}{'' if number == 1 else 's'}, without a time limit"
    return f"budget {budget_s:g} s, including loading and compiling"


def experiment_arguments(function: Callable[..., Any], required: bool = True) -> Callable[..., Any]:
    """Add CONFIG (`config_file`) and `--set` (`overrides`) to a command."""
    metavar = "CONFIG" if required else "[CONFIG]"
    argument = click.argument("config_file", metavar=metavar, required=required, type=click.Path(path_type=Path))
    return argument(overrides_option(function))


#: Adds CONFIG and `--set` to a command in which CONFIG is optional. Without CONFIG, `config_file` is None.
optional_experiment_arguments = functools.partial(experiment_arguments, required=False)


@dataclass(frozen=True)
class ExperimentOptions:
    """The options of commands that run an experiment, by the names of their parameters."""

    config_file: Path | None
    overrides: tuple[str, ...]
    allow_code: bool

    def config(self) -> Config:
        """Load the configuration, or that of the built-in Cornell box if no file is given. Raises ConfigError."""
        return read_or_box(self.config_file, self.overrides).with_code(self.allow_code)


@dataclass(frozen=True)
class ComparisonOptions(ExperimentOptions):
    """The options of commands that compare integrators by measurements (`comparison_options`)."""

    integrators: str | None
    budget: float
    rounds: int | None
    json_file: Path | None


def comparison_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of `ComparisonOptions` to a command, except CONFIG, `--set` and `--integrators`."""
    rounds = click.option(
        "--rounds", type=click.IntRange(min=1, max=COUNT.max), metavar="N",
        help="Number of rounds, without a time limit: the same steps on every machine.",
    )  # fmt: skip
    return allow_code_option(budget_option(rounds(json_option(function))))


def is_given(name: str) -> bool:
    """True if the user gave the option with the parameter name `name` to the current command."""
    return click.get_current_context().get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE


def read_or_box(config_file: Path | None, overrides: tuple[str, ...]) -> Config:
    """Load the configuration. If no file is given, load the configuration of the built-in Cornell box. Raises
    ConfigError.
    """
    if config_file is not None:
        return load(config_file, overrides)
    from reslrb_cli.measure.scenes import small

    return loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, overrides)


def start_variant(config: Config) -> str:
    """Set the Mitsuba variant of `config`; return its name. Raises BackendError."""
    from reslrb_cli.backend.variant import set_variant

    return set_variant(config.variant)


def check_writable(option: str, path: Path | None) -> None:
    """Raise ConfigError, located by the option, if the file `path` cannot be written. The check leaves the file
    unchanged.
    """
    if path is None:
        return
    existed = os.path.exists(path)
    try:  # O_NONBLOCK, because opening a pipe without a reader would wait forever
        os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NONBLOCK, 0o666))
    except (OSError, ValueError) as error:
        reason = "the pipe has no reader" if getattr(error, "errno", None) == errno.ENXIO else None
        raise ConfigError(
            option, "", f"cannot write {path}: {reason or getattr(error, 'strerror', None) or error}"
        ) from None
    if not existed:
        os.unlink(os.path.realpath(path))  # a link may lead to a file that does not exist
