"""Output on the terminal, error messages, and signals.

- `echo` and `LogLines` print and log lines. Keys, names and paths come from users and files, so control characters in
    them are escaped.
- `tell` turns an error into a line and an exit code.
- `Interrupts` handles SIGINT, SIGTERM and SIGHUP.

A signal handler never raises an exception. An exception inside Mitsuba or Dr.Jit could crash the program or cause an
unrelated error, for example in a half-imported module. The first signals therefore only set a flag, which the program
checks when it is safe to stop. One more signal ends the process at once, after its last message.

Python runs signal handlers in the main thread, between two instructions. If two signals arrive while a kernel runs,
Python merges the two signals into one call of the handler. A separate thread therefore counts the signals. The thread
reads the file descriptor to which Python's C code writes each signal. This thread runs while a kernel runs, but not
while one is compiled.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TextIO

import click

from reslrb_cli import errors
from reslrb_cli.errors import ExitCode, one_line, printable
from reslrb_cli.records.atomic import remove_unfinished

#: Signals of Ctrl-C, of `kill` and batch systems, and of a terminal that closes.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
#: Seconds within which the same signal counts once. A terminal that closes sends SIGHUP twice: the kernel sends it to
#: the foreground processes, and the shell to its jobs.
SAME_S = 0.5
_LEAVE = b"\0"  # no signal has the number 0


class Interrupts:
    """Context manager in which `requested` is True after a signal.

    More signals than `tolerated` end the process. The same signal counts once within `SAME_S` seconds. A thread calls
    `last_act`, removes unfinished files, prints `interrupted`, and exits with 130. The context prints `notice` at the
    first tolerated signal. Signals that were ignored at the start of the program (`nohup`) stay ignored. An inner
    context replaces an outer one. Outside of the main thread, the context does nothing.
    """

    def __init__(
        self, tolerated: int = 1, last_act: Callable[[], None] = lambda: None, notice: str | None = None
    ) -> None:
        self.requested = False
        self.last_act = last_act
        self._tolerated, self._notice, self._count = tolerated, notice, 0
        self._last = (0, 0.0)
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
        """Ignore the signals from now on, because the program ends in a moment."""
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
        """Count the signals; runs in a separate thread."""
        assert self._pipe is not None
        while True:
            for number in os.read(self._pipe[0], 64):
                if number == _LEAVE[0]:
                    return
                if number in self._before:
                    self._see(number)

    def _see(self, number: int) -> None:
        now = time.monotonic()
        if number == self._last[0] and now - self._last[1] < SAME_S:
            return
        self.requested, self._last = True, (number, now)
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
    """Print a line on standard error without Python's buffers and locks. If writing would block, print nothing."""
    with contextlib.suppress(OSError, ValueError):
        if select.select([], [2], [], 0)[1]:
            start = "\n" if os.isatty(2) else ""  # after a progress bar or the terminal's ^C
            os.write(2, f"{start}{line}\n".encode())


def echo(line: object) -> None:
    """Print one line on standard output; escape characters that are not printable."""
    click.echo(printable(line))


def fill(template: str, filters: Mapping[str, Callable[..., object]], **values: object) -> str:
    """Fill in a template of `templates/`. In `values`, escape line breaks and all characters that are not printable."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(Path(__file__).with_name("templates"))
    made = Environment(
        loader=loader, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True,
        finalize=printable,
    )  # fmt: skip
    made.filters.update(filters)
    return made.get_template(template).render(values)


def has_room(stream: TextIO) -> bool:
    """Whether a stream is a terminal with room for a progress bar. Some terminals of containers and scripts have a
    width of 0.
    """
    if not stream.isatty():
        return False
    try:
        return os.get_terminal_size(stream.fileno()).columns > 0
    except (OSError, ValueError):  # the width is unknown
        return True


class LogLines(logging.Handler):
    """Handler that writes messages above a progress bar on the current standard error. Messages are escaped as in
    `echo`.
    """

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
    """Return the line and the exit code for `error`. Return None for a bug in reslrb, which needs a traceback."""
    if isinstance(error, click.Abort):
        return "interrupted", ExitCode.INTERRUPTED
    if isinstance(error, click.ClickException):
        context = getattr(error, "ctx", None)
        where = context.command_path if context else "reslrb"
        said = one_line(error.format_message()).rstrip(".")
        end = "" if said.endswith("?") else "."
        return f"{where}: {said}{end} See `{where} --help`.", ExitCode.USAGE
    return errors.tell(error)
