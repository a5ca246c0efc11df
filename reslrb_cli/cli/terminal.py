"""The terminal: what is printed on it, what an error comes to, and signals.

What commands print and log (`echo`, `LogLines`): keys, names and paths are a user's or a file's, and must not
command the terminal.

What an error comes to on the command line (`tell`): those of its own arguments, and all others (`errors.tell`).

SIGINT, SIGTERM and SIGHUP (`Interrupts`) are the wish to stop, and the end at once. Nothing is ever raised out of a
signal handler: an exception that comes up in the midst of what Mitsuba and Dr.Jit are doing ends in a crash (a module
that is half imported), or in an error that names something else (a recording without its end). So the first signals
only leave a mark, which is looked at where it is safe to stop; and one too many ends the process where it stands, after
what has to be said has been said.

Python runs its handlers in the main thread, between two of its instructions, and takes two signals that come while a
kernel runs for one. The signals are therefore counted by a thread of their own, which gets each of them from the
descriptor that Python's C code writes to. It can do its work while a kernel runs, but not while one is compiled.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import click

from reslrb_cli import errors
from reslrb_cli.errors import ExitCode, one_line, printable
from reslrb_cli.records.atomic import remove_unfinished

#: What a terminal sends for Ctrl-C, what `kill` and batch systems send, and what a terminal sends when it is closed.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
_LEAVE = b"\0"  # no signal has the number 0


class Interrupts:
    """While entered, `requested` tells whether there was a signal; the one after `tolerated` of them ends the process.

    That prints `interrupted`, calls `last_act` before, removes files that are not finished, and exits with 130; it
    happens in another thread than the main one. `notice` is printed at the first signal that is tolerated. Signals that
    the program was started to ignore (`nohup`) are ignored. May be entered within another, whose place it takes; in
    another thread than the main one it does nothing.
    """

    def __init__(
        self, tolerated: int = 1, last_act: Callable[[], None] = lambda: None, notice: str | None = None
    ) -> None:
        self.requested = False
        self.last_act = last_act
        self._tolerated, self._notice, self._count = tolerated, notice, 0
        self._before: dict[int, Any] = {}
        self._pipe: tuple[int, int] | None = None
        self._wakeup_before = -1
        self._thread = threading.Thread(target=self._watch, name="interrupts", daemon=True)

    def __enter__(self) -> Interrupts:
        if threading.current_thread() is not threading.main_thread():
            return self
        self._pipe = os.pipe()
        os.set_blocking(self._pipe[1], False)
        self._thread.start()
        self._wakeup_before = signal.set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
        for number in SIGNALS:
            before = signal.getsignal(number)
            if before != signal.SIG_IGN:
                self._before[number] = before
                signal.signal(number, self._mark)
        return self

    def __exit__(self, *_: object) -> None:
        for number, before in self._before.items():
            signal.signal(number, before)
        self._stop()

    def ignore(self) -> None:
        """Ignore the signals from now on, in place of leaving: what is left to do is over in a moment."""
        for number in self._before:
            signal.signal(number, signal.SIG_IGN)
        self._before = {}
        self._stop()

    def _stop(self) -> None:
        if self._pipe is None:
            return
        signal.set_wakeup_fd(self._wakeup_before)
        os.write(self._pipe[1], _LEAVE)
        self._thread.join()
        for descriptor in self._pipe:
            os.close(descriptor)
        self._pipe = None

    def _mark(self, number: int, frame: FrameType | None) -> None:
        self.requested = True

    def _watch(self) -> None:
        """Count the signals, in a thread of their own."""
        assert self._pipe is not None
        while True:
            for number in os.read(self._pipe[0], 64):
                if number == _LEAVE[0]:
                    return
                if number in self._before:
                    self._see()

    def _see(self) -> None:
        self.requested = True
        self._count += 1
        if self._count > self._tolerated:
            self._end()
        elif self._count == 1 and self._notice is not None:
            _say(self._notice)

    def _end(self) -> NoReturn:
        with contextlib.suppress(Exception):
            self.last_act()
        remove_unfinished()
        _say("interrupted")
        os._exit(ExitCode.INTERRUPTED)


def _say(line: str) -> None:
    """Print a line on standard error, past Python's buffers and locks, unless that would have to wait."""
    with contextlib.suppress(OSError, ValueError):
        if select.select([], [2], [], 0)[1]:
            start = "\n" if os.isatty(2) else ""  # behind a progress bar, or the ^C that a terminal shows
            os.write(2, f"{start}{line}\n".encode())


def echo(line: object) -> None:
    """Print one line on standard output, with what is not printable in it escaped."""
    click.echo(printable(line))


def fill(template: str, filters: Mapping[str, Callable[..., object]], **values: object) -> str:
    """The text of a template in `templates/`; what is not printable in `values` is escaped, and ends no line."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(Path(__file__).with_name("templates"))
    made = Environment(
        loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
        finalize=printable,
    )  # fmt: skip
    made.filters.update(filters)
    return made.get_template(template).render(values)


class LogLines(logging.Handler):
    """Writes each message as a line on what is the standard error at that moment, above a progress bar where there is
    one, with what is not printable in it escaped."""

    def emit(self, record: logging.LogRecord) -> None:
        try:
            line, bars = printable(record.getMessage()), sys.modules.get("tqdm")
            if bars is None:
                click.echo(line, err=True)
            else:
                bars.tqdm.write(line, file=sys.stderr)
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
