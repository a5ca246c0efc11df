"""Whole optimisations as an aligned table, and which method is the best in a sentence."""

from __future__ import annotations

from collections.abc import Sequence

from reslrb_cli.measure.whole_runs.verdict import ALPHA, Verdict
from reslrb_cli.records.bench import BenchStatus
from reslrb_cli.records.whole_runs import Band, RunBestRecord, RunMethodRecord, RunPointRecord
from reslrb_cli.report.words import count, number

_HEAD = ("", "seed", "iterations", "first s", "loss", "error")
_WIDTHS = (0, 8, 20, 20, 30, 30)


class RunsTable:
    """Lines that stand below each other, whose first column fits `labels`."""

    def __init__(self, labels: Sequence[str]) -> None:
        self._width = max(map(len, labels), default=0)

    def head(self) -> str:
        """The first line."""
        return self._line(_HEAD)

    def point(self, point: RunPointRecord, first_s: float | None) -> str:
        """The line of one run, at the end of its time."""
        return self._line((point.method.label, str(point.seed), str(point.iteration), number(first_s, 3),
                           number(point.loss, 4), number(point.parameter_error, 4)))  # fmt: skip

    def line(self, record: RunMethodRecord) -> str:
        """The line of one method: medians, and the least and the greatest of its runs."""
        if record.runs == 0:
            ended = "not measured" if record.status is BenchStatus.OK else record.status.value
            return self._line((record.method.label, "", ended))
        return self._line((record.method.label, count(record.runs, "run"), band(record.iterations, 3),
                           band(record.first_s, 3), band(record.loss, 4), band(record.parameter_error, 4)))  # fmt: skip

    def _line(self, cells: tuple[str, ...]) -> str:
        parts = [f"{cells[0]:<{self._width}}"]
        parts += [f"{cell:>{width}}" for cell, width in zip(cells[1:], _WIDTHS[1:], strict=False)]
        return "  ".join(parts).rstrip()


def band(value: Band | None, digits: int) -> str:
    """A median with its band; nothing for None."""
    return "" if value is None else (
        f"{value.median:.{digits}g} [{value.low:.{digits}g}, {value.high:.{digits}g}]"
    )  # fmt: skip


def best_line(record: RunBestRecord) -> str:
    """A method at its best in one line."""
    words = f"{'loss' if record.of == 'loss' else 'error'} of {record.at or record.label}: {band(record.value, 4)}"
    if record.at is not None:
        words += ", the best of its rates"
        words += ", and the outermost that was tried" if record.outermost else ""
    if record.ratio is not None:
        apart = f"{number(record.ratio.value, 3)} [{number(record.ratio.low, 3)}, {number(record.ratio.high, 3)}]"
        words += f"; {apart} times that of {record.to}{' at its best' if record.at else ''}"
    return words


def notes(records: Sequence[RunMethodRecord]) -> list[str]:
    """What ended before its time, one line a method."""
    return [f"{record.method.label}: {record.message}" for record in records if record.message]


def closing_sentence(loss: Verdict | None, error: Verdict | None, limit_s: float) -> str:
    """Which method is the best for this scene at the end of the time of a run, by the loss and by the error."""
    if loss is None:
        return "Nothing can be said of which method is the best: none came to an iteration and to the end of its time."
    sentence = f"After {number(limit_s, 3)} s of each run, all costs counted: " + _of(loss, "the loss")
    if error is not None:
        sentence += "; " + _of(error, "the error of the parameters")
    if not (loss.tied or loss.beats):
        return sentence + "."
    sentence += f". Told apart by the Mann-Whitney test at {ALPHA:.0%}, corrected for the number of methods"
    return sentence + (f"; so few runs are too few for that, {loss.enough} of each could do." if loss.too_few else ".")


def _of(verdict: Verdict, what: str) -> str:
    words = f"best by {what} is {verdict.best}"
    if not (verdict.tied or verdict.beats):
        return f"{words}, the only one that was measured"
    if verdict.tied:
        words += f", tied with {', '.join(verdict.tied)}"
    if verdict.beats:
        words += f", ahead of {', '.join(verdict.beats)}"
    return words
