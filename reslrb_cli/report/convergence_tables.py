"""Results of `reslrb convergence` as an aligned table and a closing sentence."""

from __future__ import annotations

import math
from collections.abc import Sequence

from reslrb_cli.measure.convergence.judgement import ConvergenceResults
from reslrb_cli.records.measurement_files import Line
from reslrb_cli.records.measurements import (
    TARGETS,
    BenchStatus,
    MethodRecord,
    Range,
    ReferenceRecord,
    SummaryRecord,
)
from reslrb_cli.report.format import Columns, interval, number, shorten

#: Maximum width of a parameter key.
KEY_WIDTH = 28


def method_columns(labels: Sequence[str], parameters: Sequence[str]) -> Columns:
    """Return the columns of the table. The first two columns fit `labels` and `parameters`."""
    figures = ("step s", "steps", "error", "slope", "efficiency", "max |z| (limit)")
    titles = ("", "parameter", *figures, *(f"s to {target:.0%}" for target in TARGETS))
    names = max(len(shorten(key, KEY_WIDTH)) for key in ("parameter", *parameters))
    widths = (max(map(len, labels), default=0), names, 8, 5, 8, 20, 24, 16) + (9,) * len(TARGETS)
    return Columns(titles, widths, "<<>")


def method_cells(record: MethodRecord, parameter: str | None = None) -> tuple[str, ...]:
    """Return the table cells of one record. `parameter`, if given, is shown instead of the record's own parameter."""
    named = (record.method.label, shorten(parameter or record.parameter, KEY_WIDTH))
    if record.relative_rmse is None:
        return *named, record.message if record.status is BenchStatus.OK else record.status.value
    return (
        *named, number(record.step_s, 3), str(record.repeats), number(record.relative_rmse, 3), _range(record.slope),
        _range(record.efficiency), _deviation(record), *(_seconds(record, f"{target:g}") for target in TARGETS),
    )  # fmt: skip


def _range(value: Range | None) -> str:
    return "" if value is None else interval(value.value, value.low, value.high, 3)


def _deviation(record: MethodRecord) -> str:
    if record.bias_z is None:
        return ""
    word = {True: " biased", False: "", None: " open"}[record.biased]
    return f"{abs(record.bias_z):.1f} ({record.bias_z_limit or 0:.1f}){word}"


def _seconds(record: MethodRecord, target: str) -> str:
    """Return a time, with `~` if the time is extrapolated. Return a dash if a bias keeps the error above the target."""
    seconds = record.seconds_to[target]
    if seconds is None:
        return "-"
    return ("~" if target in record.extrapolated else "") + number(seconds, 3)


def notes(records: Sequence[MethodRecord]) -> list[str]:
    """Return remarks on the table, one per line: the size of biases, and why a question is undecided."""
    lines = []
    for record in records:
        where = f"{record.method.label}, {shorten(record.parameter, KEY_WIDTH)}"
        if record.biased:
            size = "" if not record.bias else f" by {record.bias:.2g} of the whole"
            lines.append(f"{where}: biased{size}, against {record.bias_reference}")
        elif record.message and (record.relative_rmse is not None or record.status is not BenchStatus.OK):
            lines.append(f"{where}: {record.message}")
    return lines


def reference_line(record: ReferenceRecord) -> str:
    """Return a line about the reference for the errors of one parameter."""
    floor = record.message if record.reference_rmse is None else f"known to {record.reference_rmse:.2g}"
    words = f"{shorten(record.parameter, KEY_WIDTH)}: {floor}, {record.repeats} steps of {record.method.label}"
    if record.bias_z is not None:
        verdict = {True: "DIFFERS from", False: "agrees with", None: "not decided against"}[record.biased]
        z = f"max |z| {abs(record.bias_z):.1f} (limit {record.bias_z_limit:.1f})"
        words += f"; {verdict} {record.bias_reference}: {z}"
    return words


def result_lines(results: ConvergenceResults) -> list[Line]:
    """Return all records of a convergence, including the closing sentence."""
    summary = SummaryRecord(closing_sentence(results.methods))
    return [*results.points, *results.methods, *results.references, summary]


def closing_sentence(records: Sequence[MethodRecord]) -> str:
    """Return a sentence that names the best method for this scene, for all parameters together. The sentence also gives
    the method's lead.

    A biased method is always called biased. A lead counts only if the interval of the efficiency ratio lies above 1.
    """
    together = [record for record in records if record.parameter in ("all", "image") and record.efficiency is not None]
    if not together:
        return "Nothing can be said of which method is the best: there are too few steps."
    sound = sorted((r for r in together if r.biased is not True), key=_efficiency, reverse=True)
    biased = sorted((r for r in together if r.biased is True), key=_efficiency, reverse=True)
    if not sound:
        return f"All methods are biased; of them the biased {biased[0].method.label} has the highest efficiency."
    best = sound[0]
    sentence = f"Best for this scene: {best.method.label}"
    if best.biased is None:
        sentence += " (whether it is biased is open)"
    if len(sound) == 1:
        sentence += "; of all others a bias was found" if biased else ", the only one that was measured"
    else:
        level = [record for record in sound[1:] if _ratio(best, record)[1] <= 1]
        if level:
            names = ", ".join(f"{record.method.label} ({_times(best, record)})" for record in level)
            sentence += f"; not told apart from it: {names}"
        beaten = next((record for record in sound[1:] if record not in level), None)
        if beaten is not None:
            sentence += f"; {_times(best, beaten)} times as efficient as {beaten.method.label}"
    sentence += "."
    if biased and _efficiency(biased[0]) > _efficiency(best):
        first, times = biased[0], _efficiency(biased[0]) / _efficiency(best)
        sentence += f" The biased {first.method.label} has {times:.2g} times its efficiency"
        sentence += f", but its error stays above {first.bias:.2g}." if first.bias else "."
    return sentence


def _efficiency(record: MethodRecord) -> float:
    assert record.efficiency is not None, "others are left out"
    return record.efficiency.value


def _ratio(one: MethodRecord, other: MethodRecord) -> tuple[float, float, float]:
    """Return the ratio of efficiencies and its interval. Half widths of the logarithms add in quadrature."""
    a, b = one.efficiency, other.efficiency
    assert a is not None, "others are left out"
    assert b is not None, "others are left out"
    ratio = a.value / b.value
    down = math.hypot(math.log(a.value / a.low), math.log(b.high / b.value))
    up = math.hypot(math.log(a.high / a.value), math.log(b.value / b.low))
    return ratio, ratio * math.exp(-down), ratio * math.exp(up)


def _times(one: MethodRecord, other: MethodRecord) -> str:
    return interval(*_ratio(one, other), 2)
