"""The code with planted faults. Gradcheck or the extreme suite finds each fault and reports its place."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache

import pytest
from conformance import (
    attached_cases,
    test_attached,
    test_attached_reservoir,
    test_edges,
    test_moving_emitters,
    test_small_lamps,
    test_weights,
)
from measure.faults import CHECKS, FAULTS, Fault, plant, planted

from reslrb_cli.records.measurements import GradcheckRecord, Verdict


def test_the_faults_apply_to_the_code(monkeypatch: pytest.MonkeyPatch):
    """All faults are planted, also those that only the long suite checks. A change of the code that invalidates a fault
    therefore fails at once.
    """
    assert {fault.check for fault in FAULTS} == set(CHECKS)
    others = [attached_cases.FAULTS, test_attached.FORWARD_FAULTS, test_attached_reservoir.FAULTS,
              test_edges.FAULTS, test_moving_emitters.FAULTS, test_small_lamps.FAULTS, test_weights.FAULTS]  # fmt: skip
    for fault in (*FAULTS, *(fault for faults in others for fault in faults)):
        with monkeypatch.context() as patch:
            plant(fault, patch)


@planted(FAULTS)
def test_fault(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    assert as_it_stands(fault.check) == set()
    plant(fault, monkeypatch)
    found = failures(CHECKS[fault.check]())
    assert fault.fails <= found
    # Only methods with the fault fail. Camera paths beside light paths, or in their place, use the code of the same
    # estimator.
    assert {name and re.sub(r"\(paths=\w+\)$", "", name) for name, _ in found} == {name for name, _ in fault.fails}


@cache
def as_it_stands(check: str) -> set[tuple[str | None, str]]:
    """Return the failures of a check without any fault. The result is computed once for all faults of the check."""
    return failures(CHECKS[check]())


def failures(records: Iterable[GradcheckRecord]) -> set[tuple[str | None, str]]:
    """Return the estimator and the reference of each failing record."""
    return {(r.label.partition(":")[2] or None, r.reference.value) for r in records if r.verdict is Verdict.FAILS}
