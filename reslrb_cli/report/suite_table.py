"""The results of a suite of cases: one line for each case, with what each estimator came to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from reslrb_cli.records.gradcheck import GradcheckRecord, Kind, Reference, Verdict

_NAMES = {Reference.FINITE_DIFFERENCE: "differences"}


def suite_table(records: Iterable[GradcheckRecord], about: Mapping[str, str]) -> str:
    """A Markdown table; `about` says by case what it is about.

    Under each estimator stand the largest deviation in standard errors of all comparisons over many seeds, then the
    largest relative L2 distance of all comparisons at equal seeds, and what did not hold or could not be decided; a
    dash where it cannot do the case.
    """
    cases: dict[str, list[GradcheckRecord]] = {}
    for record in records:
        cases.setdefault(record.case, []).append(record)
    estimators = list(dict.fromkeys(r.estimator or r.integrator for rows in cases.values() for r in rows))
    head = ("case", "what it is about", "references", "seeds", *estimators)
    lines = [head, ["---"] * len(head)]
    for case, rows in cases.items():
        found = [_cell([r for r in rows if (r.estimator or r.integrator) == name]) for name in estimators]
        lines.append([f"`{case}`", about.get(case, ""), _references(rows), str(rows[0].seeds), *found])
    return "".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |\n" for line in lines)


def limits(records: Iterable[GradcheckRecord]) -> tuple[float, float]:
    """The limit of |z| that all cases share, and the largest of relative L2 at equal seeds; 0 where there is none."""
    found = list(records)
    z = max((r.z_max_limit for r in found if r.z_max_limit is not None), default=0.0)
    return z, max((r.relative_l2_limit for r in found if r.relative_l2_limit is not None), default=0.0)


def _references(rows: Sequence[GradcheckRecord]) -> str:
    gradients = [r.reference for r in rows if r.kind is not Kind.IMAGE]
    images = [r.reference for r in rows if r.kind is Kind.IMAGE]
    parts = [_NAMES.get(name, name.value) for name in dict.fromkeys(gradients)]
    return ", ".join(parts + [f"image: {name.value}" for name in dict.fromkeys(images)])


def _cell(rows: Sequence[GradcheckRecord]) -> str:
    if not rows:
        return "-"
    z = max((r.z_max for r in rows if r.z_max is not None and r.verdict is Verdict.HOLDS), default=None)
    distance = max((r.relative_l2 or 0.0 for r in rows if r.relative_l2_limit is not None), default=None)
    parts = [] if z is None else [f"{z:.1f}"]
    parts += [] if distance is None else [f"{distance:.0e}"]
    parts += [f"**{name}**" for name in dict.fromkeys(_verdict(r) for r in rows) if name]
    return ", ".join(parts) or "exact"


def _verdict(record: GradcheckRecord) -> str:
    """What to say of a record that does not hold."""
    if record.verdict is Verdict.HOLDS:
        return ""
    which = (record.parameter or record.kind.value).split(".")
    name = which[-2] if len(which) > 1 and which[-1] in ("value", "data") else which[-1]
    return f"{record.verdict.value.replace('_', ' ')}: {name}"
