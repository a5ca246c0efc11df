"""Measurements as aligned tables: bench, gradcheck and convergence, each with its summary."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from reslrb_cli.measure.comparison import MOST_FREEDOM
from reslrb_cli.measure.judgement import CONFIDENCE, ConvergenceResults
from reslrb_cli.measure.methods import with_option
from reslrb_cli.records.measurement_files import Line
from reslrb_cli.records.measurements import (
    TARGETS,
    BenchRecord,
    BenchStatus,
    GradcheckRecord,
    Kind,
    MethodRecord,
    Range,
    Reference,
    ReferenceRecord,
    Spread,
    SummaryRecord,
    Verdict,
)
from reslrb_cli.report.format import Columns, interval, number, shorten
from reslrb_cli.statistics import special


def bench_columns(labels: Sequence[str], swept: str = "depth") -> Columns:
    """Return the columns of a bench. The first column shows the `swept` quantity, and the second is wide enough for all
    `labels`.
    """
    titles = (swept, "", "step ms", "over baseline", "kernel ms", "over baseline", "codegen", "tracing", "cold ms",
              "peak MiB", "scratch B", "n")  # fmt: skip
    return Columns(titles, (7, max(map(len, labels)), 9, 21, 9, 21, 7, 7, 8, 9, 9, 3), "><>")


def bench_cells(record: BenchRecord, value: int) -> tuple[str, ...]:
    """Return the cells of one result at the `value` of the swept quantity: medians, and ratios with minimum and
    maximum.
    """
    named = (str(value), record.method.label)
    if record.step_ms is None or record.kernel_ms is None:
        return *named, record.status.value
    return (
        *named, _milliseconds(record.step_ms), _ratio(record.step_ratio), _milliseconds(record.kernel_ms),
        _ratio(record.kernel_ratio), _milliseconds(record.codegen_ms), _milliseconds(record.tracing_ms),
        f"{record.cold_ms or 0:.0f}", f"{record.peak_mib or 0:.1f}", str(record.scratch_bytes), str(record.repeats),
    )  # fmt: skip


def _milliseconds(time: Spread | None) -> str:
    return "" if time is None else f"{time.median:.1f}"


def _ratio(ratio: Spread | None) -> str:
    return "" if ratio is None else interval(ratio.median, ratio.min, ratio.max)


HEAD = ("parameter", "integrator", "reference", "seeds", "rel. L2", "z rms", "max |z|", "cosine", "variance",
        "detectable", "verdict")  # fmt: skip

_REFERENCES = {Reference.FINITE_DIFFERENCE: "differences", Reference.FORWARD_MODE: "forward mode"}
_KINDS = {Kind.EQUAL_SEEDS: ", equal seeds"}


def cells(record: GradcheckRecord) -> tuple[str, ...]:
    """Return one cell for each column of HEAD. If a number has a limit, the cell shows the limit after the number."""
    return (
        parameter_name(record),
        integrator_name(record),
        reference_name(record),
        str(record.seeds),
        _limited(record.relative_l2, record.relative_l2_limit, ".1e"),
        _limited(record.z_rms, record.z_rms_limit, ".2f"),
        _limited(record.z_max, record.z_max_limit, ".1f"),
        "" if record.cosine is None else f"{record.cosine:.4f}",
        "" if record.variance_ratio is None else f"{record.variance_ratio:.3g}",
        "" if record.detectable is None else f"{record.detectable:.1%}" if record.detectable >= 1e-3
        else f"{record.detectable:.0e}",
        record.verdict.value.replace("_", "-"),
    )  # fmt: skip


def parameter_name(record: GradcheckRecord) -> str:
    """Return the parameter's name, or `image` or `all` for a record without a parameter."""
    return record.parameter or ("image" if record.kind is Kind.IMAGE else "all")


def integrator_name(record: GradcheckRecord) -> str:
    """Return the name of the integrator, such as `reslrb:stack`. The name includes the kind of paths if the integrator
    does not use light paths.
    """
    name, paths = record.label, record.options.get("paths", "light")
    return name if paths == "light" or "paths=" in name else with_option(name, f"paths={paths}")


def reference_name(record: GradcheckRecord) -> str:
    """Return the reference, with a note if the comparison uses equal seeds."""
    return _REFERENCES.get(record.reference, record.reference.value) + _KINDS.get(record.kind, "")


def failure_line(record: GradcheckRecord) -> str:
    """Return a line about a failed comparison, with both sides and the size of the deviation."""
    parts = []
    for name, value, limit in (
        ("relative L2", record.relative_l2, record.relative_l2_limit),
        ("z rms", record.z_rms, record.z_rms_limit),
        ("max |z|", record.z_max, record.z_max_limit),
    ):
        if value is not None and limit is not None and not value < limit:
            parts.append(f"{name} {value:.3g}, limit {limit:.3g}")
    if record.relative_l2 is not None and record.relative_l2_limit is None:
        parts.append(f"the means differ by {record.relative_l2:.2%}")
    parts += [record.message] if record.message else []
    what = f"{parameter_name(record)}: {integrator_name(record)} against {reference_name(record)}"
    return f"{record.case}: {what}: {'; '.join(parts)}"


def summary_lines(records: Sequence[GradcheckRecord]) -> list[str]:
    """Return a summary with the number of comparisons that hold, the undecided comparisons with reasons, and the failed
    comparisons.
    """
    count = {verdict: sum(record.verdict is verdict for record in records) for verdict in Verdict}
    open_ = [record for record in records if record.holds is None]
    held = f"{count[Verdict.HOLDS]} of {len(records)} comparisons hold, {count[Verdict.FAILS]} fail"
    lines = [held + (f", {len(open_)} leave the question open" if open_ else "")]
    if count[Verdict.NOT_MEASURED]:
        message = next(record.message for record in open_ if record.verdict is Verdict.NOT_MEASURED)
        lines.append(f"open: {count[Verdict.NOT_MEASURED]} not measured: {message}")
    for (what, message), group in open_reasons(open_).items():
        pairs = dict.fromkeys(f"{integrator_name(r)} against {reference_name(r)}" for r in group)
        which = "" if group[0].verdict is Verdict.NO_REFERENCE else f"{', '.join(pairs)}: "
        cases = dict.fromkeys(record.case for record in group)
        where = f" in {', '.join(cases)}" if len({record.case for record in records}) > 1 else ""
        lines.append(f"open{where}: {what}: {which}{message}")
    return lines + [f"FAILS: {failure_line(record)}" for record in records if record.verdict is Verdict.FAILS]


def open_reasons(records: Iterable[GradcheckRecord]) -> dict[tuple[str, str], list[GradcheckRecord]]:
    """Return the open comparisons of `records` by parameter and reason, without those that were not measured."""
    found: dict[tuple[str, str], list[GradcheckRecord]] = {}
    for record in records:
        if record.holds is None and record.verdict is not Verdict.NOT_MEASURED:
            found.setdefault((parameter_name(record), record.message), []).append(record)
    return found


def gradcheck_columns(records: Iterable[GradcheckRecord]) -> Columns:
    """Return the columns of a table of `records`. Text columns are as wide as their content."""
    texts = zip(*(cells(record)[:3] for record in records), strict=True)
    widths = [max(map(len, (title, *column))) for title, column in zip(HEAD, texts, strict=False)]
    return Columns(HEAD, (*widths, 5, 17, 11, 11, 8, 8, 10, 0), "<<<>")


def _limited(value: float | None, limit: float | None, spec: str) -> str:
    if value is None or limit is None:
        return "" if value is None else f"{value:{spec}}"
    return f"{value:{spec}} {'<' if value < limit else '>'} {limit:{spec}}"


# --- convergence ------------------------------------------------------------------------------------------------------

#: Maximum width of a parameter key.
KEY_WIDTH = 28

#: Columns of a method: the field, the title and the width.
FIGURES = (
    ("step_s", "step s", 8),
    ("repeats", "steps", 5),
    ("relative_rmse", "error", 8),
    ("efficiency", "efficiency", 24),
    ("bias_z", "max |z| (limit)", 16),
)


def method_columns(labels: Sequence[str], parameters: Sequence[str]) -> Columns:
    """Return the columns of the table. The first two columns fit `labels` and `parameters`."""
    titles = ("", "parameter", *(title for _, title, _ in FIGURES), *(f"s to {t:.0%}" for t in TARGETS))
    names = max(len(shorten(key, KEY_WIDTH)) for key in ("parameter", *parameters))
    widths = (max(map(len, labels), default=0), names, *(width for *_, width in FIGURES), *(9 for _ in TARGETS))
    return Columns(titles, widths, "<<>")


def method_cells(record: MethodRecord, parameter: str | None = None) -> tuple[str, ...]:
    """Return the table cells of one record. `parameter`, if given, is shown instead of the record's own parameter."""
    named = (record.method.label, shorten(parameter or record.parameter, KEY_WIDTH))
    if record.relative_rmse is None:
        return *named, record.message if record.status is BenchStatus.OK else record.status.value
    figures = (_figure(record, name) for name, *_ in FIGURES)
    return *named, *figures, *(_seconds(record, f"{target:g}") for target in TARGETS)


def _figure(record: MethodRecord, name: str) -> str:
    value = getattr(record, name)
    if name == "bias_z":
        return _deviation(record)
    if isinstance(value, Range):
        return interval(value.value, value.low, value.high)
    return number(value, 3) if value is None or isinstance(value, float) else str(value)


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
    summary = SummaryRecord(closing_sentence(results.methods, results.references), results.remark)
    return [*results.points, *results.methods, *results.references, summary]


def closing_sentence(records: Sequence[MethodRecord], references: Sequence[ReferenceRecord] = ()) -> str:
    """Return a sentence that names the best method for this scene, and its lead. The last record is that of all
    parameters together, the only parameter, or the image.

    A biased method is always called biased. A lead counts only if the interval of the efficiency ratio lies above 1.
    The intervals of all pairs of methods hold together with a probability of 95 % (Bonferroni): the best of many
    equal methods leads by chance. If the references of errors and of biases differ, either may be wrong, and so may
    the biases that were found.
    """
    together = [r for r in records if r.parameter == records[-1].parameter and r.efficiency is not None]
    if not together:
        return "Nothing can be said of which method is the best: there are too few steps."
    sound = sorted((r for r in together if r.biased is not True), key=_efficiency, reverse=True)
    biased = sorted((r for r in together if r.biased is True), key=_efficiency, reverse=True)
    if not sound:
        return f"All methods are biased; of them the biased {biased[0].method.label} has the highest efficiency."
    best, pairs = sound[0], math.comb(len(sound), 2)
    sentence = f"Best for this scene: {best.method.label}"
    if best.biased is None:
        sentence += " (whether it is biased is open)"
    if len(sound) == 1:
        sentence += "; of all others a bias was found" if biased else ", the only one that was measured"
    else:
        level = [record for record in sound[1:] if _efficiency_ratio(best, record, pairs)[1] <= 1]
        if level:
            names = ", ".join(f"{record.method.label} ({_times(best, record, pairs)})" for record in level)
            sentence += f"; not told apart from it: {names}"
        beaten = next((record for record in sound[1:] if record not in level), None)
        if beaten is not None:
            sentence += f"; {_times(best, beaten, pairs)} times as efficient as {beaten.method.label}"
    sentence += "."
    if biased and _efficiency(biased[0]) > _efficiency(best):
        first, times = biased[0], _efficiency(biased[0]) / _efficiency(best)
        sentence += f" The biased {first.method.label} has {number(times, 2)} times its efficiency"
        sentence += f", but its error stays above {first.bias:.2g}." if first.bias else "."
    wrong = next((record for record in references if record.biased), None)
    if biased and wrong is not None:
        sentence += f" {wrong.method.label} and {wrong.bias_reference} differ, so either of them may be biased, and the"
        sentence += " methods that agree with it: `reslrb gradcheck` compares them with other references."
    return sentence


def _efficiency(record: MethodRecord) -> float:
    assert record.efficiency is not None, "others are left out"
    return record.efficiency.value


def _efficiency_ratio(one: MethodRecord, other: MethodRecord, pairs: int) -> tuple[float, float, float]:
    """Return the ratio of efficiencies and its interval by Student's t, if it is one of `pairs` ratios."""
    variances, freedoms, tail = [], [], (1 - CONFIDENCE) / 2
    for record in (one, other):
        assert record.efficiency is not None, "others are left out"
        freedoms.append(min(record.efficiency_freedom or MOST_FREEDOM, MOST_FREEDOM))
        half = math.log(record.efficiency.high / record.efficiency.value)
        variances.append((half / float(special().stdtrit(freedoms[-1], 1 - tail))) ** 2)
    total = sum(variances)
    spread = sum(variance**2 / freedom for variance, freedom in zip(variances, freedoms, strict=True))
    freedom = total**2 / spread if spread else MOST_FREEDOM
    factor = math.exp(float(special().stdtrit(freedom, 1 - tail / pairs)) * math.sqrt(total))
    ratio = _efficiency(one) / _efficiency(other)
    return ratio, ratio / factor, ratio * factor


def _times(one: MethodRecord, other: MethodRecord, pairs: int) -> str:
    return interval(*_efficiency_ratio(one, other, pairs))
