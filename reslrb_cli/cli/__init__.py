"""Command line: `main` is the group of commands, and `run` is the program, which also handles signals.

Only `main` turns an error into an exit code. Each command is a click command named `command` in a module of this
package. The module is loaded when the command is called.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import sys
import traceback
from collections.abc import Sequence
from typing import Any

import click

from reslrb_cli.cli.terminal import Interrupts, LogLines, tell
from reslrb_cli.errors import LINE_LENGTH, ExitCode, did_you_mean, one_line
from reslrb_cli.version import __version__

# OpenBLAS reads this when NumPy is loaded. Its idle threads wait actively: on busy cores, a product of two vectors then
# takes 100 times as long. All large arrays of a command belong to Dr.Jit, which has its own threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Summaries for `reslrb --help`, which does not load the commands; in the order of a user's work.
_SUMMARIES = {
    "example": "Copy an experiment that comes with the program.",
    "init": "Write a configuration for a scene, to begin with.",
    "optimize": "Recover scene parameters from target images.",
    "sweep": "Run an experiment at several settings and seeds, and compare.",
    "render": "Render the scene of a configuration.",
    "export": "Write a run's scene, with what it recovered, for Mitsuba alone.",
    "lens": "Write an experiment for a lens that casts a picture.",
    "inspect": "List a scene's parameters and what it contains.",
    "bench": "Measure time and memory of gradient steps.",
    "gradcheck": "Compare gradients with references.",
    "convergence": "Measure error against run time.",
    "report": "Write one page about runs and measurements.",
    "serve": "Show runs in a browser, while they are running.",
    "doctor": "Say which backend is in use, and what is missing.",
}


class _Main(click.Group):
    """Group that loads commands by name and turns every user error into one line and an exit code."""

    debug = False

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_SUMMARIES)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _SUMMARIES:
            return None
        command: click.Command = importlib.import_module(f"{__name__}.{cmd_name}").command
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        hint = did_you_mean(args[0], _SUMMARIES)
        if hint and args[0] not in _SUMMARIES and not ctx.resilient_parsing:
            raise click.UsageError(f"No such command {args[0]!r}; {hint}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(_SUMMARIES.items()))

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> Any:
        """Run the command line `args` and exit with its code. With `standalone_mode=False`, errors pass to the
        caller.
        """
        if not standalone_mode:
            return super().main(args, prog_name, complete_var, standalone_mode=False, **extra)
        self.debug = os.environ.get("RESLRB_DEBUG", "0") not in ("", "0")
        try:
            code = super().main(args, prog_name, complete_var, standalone_mode=False, **extra)
        except BaseException as error:
            told = tell(error)
            if told is None:
                raise
            if self.debug:
                traceback.print_exc()
            line, code = told
            with contextlib.suppress(OSError):  # the terminal may have gone
                click.echo(one_line(line, LINE_LENGTH), err=True)
        sys.exit(code if isinstance(code, int) else ExitCode.DONE)


def _set_debug(ctx: click.Context, _parameter: click.Parameter, value: bool) -> None:
    if value and isinstance(ctx.command, _Main):
        ctx.command.debug = True


@click.command(
    cls=_Main, name="reslrb", no_args_is_help=False, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(__version__, prog_name="reslrb")
@click.option(
    "--debug", is_flag=True, expose_value=False, callback=_set_debug,
    help="Also show the traceback of an error, and details of the measurements before a run.",
)  # fmt: skip
def main() -> None:
    """Recover scene parameters from images by gradients through light paths, with Mitsuba 3."""
    logger = logging.getLogger("reslrb_cli")
    if not logger.handlers:
        logger.addHandler(LogLines())
        logger.setLevel(logging.INFO)
    if main.debug:
        logger.setLevel(logging.DEBUG)
    try:
        os.getcwd()
    except OSError as error:  # it was removed, and Mitsuba does not load without it
        raise OSError(error.errno, error.strerror, "the working directory") from None


def run() -> None:
    """Run the program `reslrb`. A signal ends the program at once, with cleanup, unless the command handles signals
    itself.
    """
    interrupts = Interrupts(tolerated=0)
    with interrupts:
        try:
            main(prog_name="reslrb")
        finally:
            interrupts.ignore()  # the work is complete
