"""The results of a gradcheck as an aligned table, and as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from reslrb_cli.records.gradcheck import GradcheckRecord, Kind, Reference, Verdict

HEAD = ("parameter", "integrator", "reference", "seeds", "rel. L2", "z rms", "max |z|", "cosine", "variance",
        "detectable", "verdict")  # fmt: skip
#: The first three columns are text; 0 is as wide as what stands in it.
_WIDTHS = (0, 0, 0, 5, 17, 11, 11, 8, 8, 10, 0)
_REFERENCES = {Reference.FINITE_DIFFERENCE: "differences", Reference.FORWARD_MODE: "forward mode"}
_KINDS = {Kind.EQUAL_SEEDS: ", equal seeds"}


def cells(record: GradcheckRecord) -> tuple[str, ...]:
    """What stands in the columns of HEAD; limits follow the figures that have one."""
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
    """The parameter; `image` or `all` where there is none."""
    return record.parameter or ("image" if record.kind is Kind.IMAGE else "all")


def integrator_name(record: GradcheckRecord) -> str:
    """`reslrb:stack`, or the type alone."""
    return record.integrator if record.estimator is None else f"{record.integrator}:{record.estimator}"


def reference_name(record: GradcheckRecord) -> str:
    """The reference, and how it is compared with, where that is not by expectation."""
    return _REFERENCES.get(record.reference, record.reference.value) + _KINDS.get(record.kind, "")


def failure_line(record: GradcheckRecord) -> str:
    """One line about a comparison that does not hold: which, and by how much."""
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
    """What it comes to: how many comparisons hold, what failed and by how much, and what was left open, and why."""
    count = {verdict: sum(record.verdict is verdict for record in records) for verdict in Verdict}
    open_ = [record for record in records if record.holds is None]
    line = f"{count[Verdict.HOLDS]} of {len(records)} comparisons hold, {count[Verdict.FAILS]} fail"
    lines = [line + (f", {len(open_)} leave the question open" if open_ else "")]
    if count[Verdict.NOT_MEASURED]:
        message = next(record.message for record in open_ if record.verdict is Verdict.NOT_MEASURED)
        lines.append(f"open: {count[Verdict.NOT_MEASURED]} not measured: {message}")
    reasons: dict[tuple[str, str], list[GradcheckRecord]] = {}
    for record in (record for record in open_ if record.verdict is not Verdict.NOT_MEASURED):
        reasons.setdefault((parameter_name(record), record.message), []).append(record)
    for (what, message), group in reasons.items():
        pairs = dict.fromkeys(f"{integrator_name(r)} against {reference_name(r)}" for r in group)
        which = "" if group[0].verdict is Verdict.NO_REFERENCE else f"{', '.join(pairs)}: "
        lines.append(f"open: {what}: {which}{message}")
    return lines + [f"FAILS: {failure_line(record)}" for record in records if record.verdict is Verdict.FAILS]


class Table:
    """Lines of a table of these records; its columns of text are as wide as theirs."""

    def __init__(self, records: Iterable[GradcheckRecord]) -> None:
        columns = zip(*(cells(record)[:3] for record in records), strict=True)
        self._widths = [max(map(len, (head, *column))) for head, column in zip(HEAD, columns, strict=False)]

    def head(self) -> str:
        """The first line."""
        return self._line(HEAD)

    def line(self, record: GradcheckRecord) -> str:
        """The line of one record."""
        return self._line(cells(record))

    def _line(self, values: Sequence[str]) -> str:
        parts = [f"{value:<{width}}" for value, width in zip(values, self._widths, strict=False)]
        parts += [f"{value:>{width}}" for value, width in zip(values[3:], _WIDTHS[3:], strict=True)]
        return "  ".join(parts).rstrip()


def markdown_table(records: Iterable[GradcheckRecord], cases: bool = False) -> str:
    """The same as a Markdown table; with a first column of the records' cases if `cases`."""
    head = ("case", *HEAD) if cases else HEAD
    rows = [(record.case, *cells(record)) if cases else cells(record) for record in records]
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def _limited(value: float | None, limit: float | None, spec: str) -> str:
    if value is None:
        return ""
    return f"{value:{spec}}" if limit is None else f"{value:{spec}} < {limit:{spec}}" if value < limit else (
        f"{value:{spec}} > {limit:{spec}}")  # fmt: skip
