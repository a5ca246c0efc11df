"""Progress of an optimisation: a bar on a terminal, plain lines otherwise."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import Any

import click

from reslrb_cli.optimization.problem import ErrorMeter
from reslrb_cli.records.metrics import Record
from reslrb_cli.report.run_summary import descriptions

#: Without a terminal, a line is written after each tenth of the iterations and after this many seconds.
SECONDS_PER_LINE = 10.0

#: Minimum width of the bar; the text beside it is shortened for this.
LEAST_BAR = 8

#: Formats of the line around the bar, from long to short; `{desc}` is a text of `descriptions`.
FRAMES = (
    "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}] {desc}",
    "{percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt}, {remaining} left, {desc}",
    "{percentage:3.0f}%|{bar}| {desc}",
)

#: Format if none of them fits.
LEAST_FRAME = "{percentage:3.0f}%|{bar}|"


class Progress:
    """Progress bar on standard error for a run with `total` iterations. As a context manager, `Progress` closes the bar
    at the end.

    `done` iterations were finished before the run was resumed. `meter` measures the errors of the parameters.
    """

    def __init__(self, total: int, quiet: bool, meter: ErrorMeter, done: int = 0) -> None:
        self._stream = sys.stderr
        quiet = quiet or self._stream is None  # the program was started without one
        self._total, self._quiet, self._meter = total, quiet, meter
        self._bar: Any = None
        self._width: int | None = None
        self._choice = 0
        self._last_line, self._tenth = time.monotonic(), 10 * done // total
        if not quiet and self._stream.isatty():
            from tqdm import tqdm

            self._bar = tqdm(
                total=total, initial=done, file=self._stream, unit="it", dynamic_ncols=True, bar_format=LEAST_FRAME
            )

    def show(self, record: Record) -> None:
        """Show that the iteration of `record` is done. A closed terminal does not end the run."""
        with contextlib.suppress(OSError):
            self._show(record)

    def _show(self, record: Record) -> None:
        if self._bar is not None:
            self._fit(descriptions(record, self._meter))
            self._bar.update()
            if record.iteration + 1 == self._total:  # no iterations follow
                self._bar.close()
            return
        done, now = record.iteration + 1, time.monotonic()
        tenth = 10 * done // self._total
        if self._quiet or (tenth == self._tenth and now - self._last_line < SECONDS_PER_LINE):
            return
        self._tenth, self._last_line = tenth, now
        text = descriptions(record, self._meter)[0]
        click.echo(f"{done}/{self._total}: {text}, {record.elapsed_s:.1f} s", file=self._stream)

    def _fit(self, texts: list[str]) -> None:
        """Choose the longest combination of format and text that leaves room for the bar.

        Numbers in the text vary in length between iterations. To avoid flicker, the bar tries a longer combination
        again only when the terminal's width changes.
        """
        facts = self._bar.format_dict
        full, *short = texts
        choices = [(frame, full) for frame in (FRAMES[:-1] if short else FRAMES)]
        choices += [(frame, text) for text in short for frame in FRAMES]
        if facts["ncols"] != self._width:
            self._width, self._choice = facts["ncols"], 0
        for place in range(self._choice, len(choices)):
            frame, text = choices[place]
            around = self._bar.format_meter(**{**facts, "bar_format": frame.replace("{bar}", ""), "prefix": text})
            if self._width is None or len(around) + LEAST_BAR <= self._width:
                self._choice, self._bar.bar_format = place, frame
                self._bar.set_description_str(text, refresh=False)
                return
        self._choice, self._bar.bar_format = len(choices), LEAST_FRAME

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            with contextlib.suppress(OSError):
                self._bar.close()
