"""What commands print and log: keys, names and paths are a user's or a file's, and must not command the terminal."""

from __future__ import annotations

import logging

import click

from reslrb_cli.errors import printable


def echo(line: object) -> None:
    """Print one line on standard output, with what is not printable in it escaped."""
    click.echo(printable(line))


class LineFormatter(logging.Formatter):
    """Formats a record as its message alone, in one line, with what is not printable in it escaped."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        return printable(record.getMessage())
