"""What an error comes to on the command line: those of its own arguments, and all others (`recording.telling`)."""

from __future__ import annotations

import click

from reslrb_cli.errors import ExitCode, one_line
from reslrb_cli.recording import telling


def tell(error: BaseException) -> tuple[str, int] | None:
    """The line and the exit code for `error`; None for a fault of ours, whose traceback is wanted."""
    if isinstance(error, click.Abort):
        return "interrupted", ExitCode.INTERRUPTED
    if isinstance(error, click.ClickException):
        context = getattr(error, "ctx", None)
        where = context.command_path if context else "reslrb"
        return f"{where}: {one_line(error.format_message()).rstrip('.')}. See `{where} --help`.", ExitCode.USAGE
    return telling.tell(error)
