"""The table of a suite: one line a case, one column an estimator."""

from __future__ import annotations

from typing import Any

from reslrb_cli.records.measurements import GradcheckRecord, Kind, Reference, Verdict
from reslrb_cli.report.tables import suite_table


def record(case: str, estimator: str, **figures: Any) -> GradcheckRecord:
    return GradcheckRecord(
        case, None, "reslrb", estimator, Reference.PTRACER, Kind.EXPECTATION, 8, Verdict.HOLDS, **figures
    )


def test_what_an_estimator_cannot_do_is_a_dash():
    records = [
        record("rest", "gather", z_max=2.0),
        record("rest", "stack", z_max=1.0),
        record("moved", "stack", z_max=3.0),
    ]
    lines = suite_table(records, {"rest": "a room", "moved": "a lens"}).splitlines()
    assert lines[2] == "| `rest` | a room | ptracer | 8 | 2.0 | 1.0 |"
    assert lines[3] == "| `moved` | a lens | ptracer | 8 | - | 3.0 |"
