"""Progress of an optimisation: a bar on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any

import click

from reslrb_cli.records.metrics import Record

#: Without a terminal a line is written after each tenth of the iterations, and when this many seconds have passed.
SECONDS_PER_LINE = 10.0


def describe(record: Record) -> str:
    """The record's loss, and parameter RMSE where it is known."""
    text = f"loss {record.loss:.4g}"
    return text if record.parameter_rmse is None else f"{text}, parameter RMSE {record.parameter_rmse:.4g}"


class Progress:
    """Shows each record of `total` on standard error; as a context manager it tidies the terminal up at the end."""

    def __init__(self, total: int, quiet: bool) -> None:
        self._total, self._quiet = total, quiet
        self._stream = sys.stderr
        self._bar: Any = None
        self._last_line, self._tenth = time.monotonic(), 0
        if not quiet and self._stream.isatty():
            from tqdm import tqdm

            self._bar = tqdm(total=total, file=self._stream, unit="it", dynamic_ncols=True)

    def show(self, record: Record) -> None:
        """Show that the iteration of `record` is done."""
        if self._bar is not None:
            self._bar.set_postfix_str(describe(record), refresh=False)
            self._bar.update()
            return
        done, now = record.iteration + 1, time.monotonic()
        tenth = 10 * done // self._total
        if self._quiet or (tenth == self._tenth and now - self._last_line < SECONDS_PER_LINE):
            return
        self._tenth, self._last_line = tenth, now
        click.echo(f"{done}/{self._total}: {describe(record)}, {record.elapsed_s:.1f} s", file=self._stream)

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.close()
