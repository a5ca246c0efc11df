"""The terminal: streams on which nothing fails, and what an error comes to.

What commands print and log (`echo`, `LineFormatter`): keys, names and paths are a user's or a file's, and must not
command the terminal.

Standard output and error of a command, as streams on which nothing fails: a terminal that was closed, a disk that is
full behind a redirection, a pipe whose reader has gone, a stream that was closed before the program began: none of them
is a reason to end a run of hours. While `forgiving_output` is entered, `sys.stdout` and `sys.stderr` take everything
(of `click.echo`, of the log, of a progress bar), pass on what can be passed on, and drop the rest without a word.

What an error comes to on the command line (`tell`): those of its own arguments, and all others (`errors.tell`).
"""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

import click

from reslrb_cli import errors
from reslrb_cli.errors import ExitCode, one_line, printable


def echo(line: object) -> None:
    """Print one line on standard output, with what is not printable in it escaped."""
    click.echo(printable(line))


class LineFormatter(logging.Formatter):
    """Formats a record as its message alone, in one line, with what is not printable in it escaped."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        return printable(record.getMessage())


#: Errors of a stream after which nothing will ever be written to it again.
_GONE = {errno.EPIPE, errno.EIO, errno.EBADF, errno.ENXIO, errno.ENODEV}


class Forgiving(io.TextIOBase):
    """Passes text on to `stream`, and goes on where that fails; None takes everything and shows nothing.

    It has no `buffer`, so that nobody writes past it.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write what can be written; characters that the stream's encoding lacks become `\\u...`."""
        if self._stream is not None:
            try:
                try:
                    self._stream.write(text)
                except UnicodeEncodeError:
                    encoding = self._stream.encoding or "ascii"
                    self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
            except (OSError, ValueError) as error:
                self._failed(error)
        return len(text)

    def flush(self) -> None:
        """Pass on what is held back, if it can be."""
        if self._stream is not None:
            try:
                self._stream.flush()
            except (OSError, ValueError) as error:
                self._failed(error)

    def settle(self) -> None:
        """Flush for the last time: what still cannot be written is dropped, so that Python does not try it again."""
        if self._stream is not None:
            try:
                self._stream.flush()
            except (OSError, ValueError):
                self._drop()

    def _failed(self, error: OSError | ValueError) -> None:
        if isinstance(error, OSError) and error.errno in _GONE:
            self._drop()

    def _drop(self) -> None:
        """Lead the stream to nowhere, with all that it holds back."""
        stream, self._stream = self._stream, None
        # ValueError: it is closed, or has no descriptor at all.
        with contextlib.suppress(OSError, ValueError, AttributeError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())  # type: ignore[union-attr]
            os.close(nowhere)

    # What others ask a stream for.

    def isatty(self) -> bool:
        try:
            return self._stream is not None and self._stream.isatty()
        except ValueError:  # closed
            return False

    def fileno(self) -> int:
        if self._stream is None:
            raise io.UnsupportedOperation("fileno")
        return self._stream.fileno()

    def writable(self) -> bool:
        return True

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return getattr(self._stream, "encoding", None) or "utf-8"

    @property
    def errors(self) -> str | None:  # type: ignore[override]
        return getattr(self._stream, "errors", None)


@contextmanager
def forgiving_output() -> Iterator[None]:
    """Have `sys.stdout` and `sys.stderr` forgive everything, until the end of the block."""
    _occupy_closed()
    before = sys.stdout, sys.stderr
    forgiving = Forgiving(before[0]), Forgiving(before[1])
    sys.stdout, sys.stderr = forgiving
    try:
        yield
    finally:
        for stream in forgiving:
            stream.settle()
        sys.stdout, sys.stderr = before


def _occupy_closed() -> None:
    """Open standard descriptors that the program was started without.

    The next file to be opened would take their numbers, and what libraries print would end up in it.
    """
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            with contextlib.suppress(OSError):
                os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: this one


class LogLines(logging.Handler):
    """Writes each message as a line on what is the standard error at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            click.echo(self.format(record), err=True)
        except Exception:
            self.handleError(record)


def tell(error: BaseException) -> tuple[str, int] | None:
    """The line and the exit code for `error`; None for a fault of ours, whose traceback is wanted."""
    if isinstance(error, click.Abort):
        return "interrupted", ExitCode.INTERRUPTED
    if isinstance(error, click.ClickException):
        context = getattr(error, "ctx", None)
        where = context.command_path if context else "reslrb"
        return f"{where}: {one_line(error.format_message()).rstrip('.')}. See `{where} --help`.", ExitCode.USAGE
    return errors.tell(error)
