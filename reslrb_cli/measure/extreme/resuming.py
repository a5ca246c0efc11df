"""Going on with a suite: its cases are whole or not there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from reslrb_cli.measure import earlier
from reslrb_cli.measure.earlier import Earlier
from reslrb_cli.records.gradcheck import GradcheckRecord
from reslrb_cli.records.manifest import versions
from reslrb_cli.records.samples import Kept

#: What is kept says that it is of this.
KIND = "gradcheck --suite"


def settings(estimators: Sequence[str] | None, seeds: int | None, variant: str, device: str) -> dict[str, Any]:
    """What has to be the same in all sessions; None stands for what each case has of its own."""
    return {
        "--estimators": "all" if estimators is None else list(estimators),
        "--seeds": "as the cases have it" if seeds is None else seeds,
        "variant": variant,
        "device": device,
        "versions": versions(),
    }


def restore(before: Earlier) -> dict[str, list[GradcheckRecord]]:
    """The records of an earlier session, by case. Raises ConfigError where they are none."""
    try:
        return {case: [GradcheckRecord.of(row) for row in rows] for case, rows in before.head["cases"].items()}
    except (AttributeError, KeyError, TypeError, ValueError):
        raise before.other("its cases are damaged") from None


def kept(settings: Mapping[str, Any], cases: Mapping[str, Sequence[GradcheckRecord]]) -> Kept | None:
    """What a later session needs to go on; None where no case is done."""
    if not cases:
        return None
    rows = {case: [asdict(record) for record in records] for case, records in cases.items()}
    return earlier.head(KIND, settings, cases=rows), {}
