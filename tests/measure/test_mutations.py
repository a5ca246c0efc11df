"""The code with planted faults. Gradcheck or the extreme suite finds each fault and reports its place."""

from __future__ import annotations

import importlib
import inspect
import re
import textwrap
from collections.abc import Iterable
from functools import cache
from operator import attrgetter

import pytest
from measure.faults import CHECKS, FAULTS, Fault

from reslrb_cli.records.measurements import GradcheckRecord, Verdict

#: The only fault in the default suite. It shows that the machinery works, and all others take minutes.
QUICK = ("stack_without_last_vertex",)


@pytest.fixture(autouse=True)
def _quiet(llvm: str) -> None:
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)


def test_enough():
    assert len(FAULTS) >= 12
    assert {fault.check for fault in FAULTS} == set(CHECKS)
    assert set(QUICK) <= {fault.name for fault in FAULTS}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_the_faults_apply_to_the_code(fault: Fault, monkeypatch: pytest.MonkeyPatch):
    """All faults are planted, also those that only the long suite checks. A change of the code that invalidates a fault
    therefore fails at once.
    """
    plant(fault, monkeypatch)


@pytest.mark.parametrize("name", [pytest.param(f.name, marks=[] if f.name in QUICK else pytest.mark.long)
                                  for f in FAULTS])  # fmt: skip
def test_fault(name: str, monkeypatch: pytest.MonkeyPatch):
    [fault] = [fault for fault in FAULTS if fault.name == name]
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
    return {(r.estimator, r.reference.value) for r in records if r.verdict is Verdict.FAILS}


def plant(fault: Fault, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plant a fault in a function. The fault takes effect in every module that imports the function.

    The function's source must contain the fault's line exactly once. A fault that no longer fits the code fails the
    test.
    """
    module, _, path = fault.where.partition(":")
    function = attrgetter(path)(importlib.import_module(f"reslrb_cli.{module}"))
    function = getattr(function, "__func__", function)
    source = textwrap.dedent(inspect.getsource(function))
    assert source.count(fault.right) == 1, f"{fault.where} has no such line any more: {fault.right}"
    # Annotations name types that are imported only for type checkers.
    broken_source = "from __future__ import annotations\n" + source.replace(fault.right, fault.wrong)
    scope = dict(function.__globals__)
    exec(compile(broken_source, fault.where, "exec", dont_inherit=True), scope)
    broken = scope[function.__name__]
    monkeypatch.setattr(function, "__code__", getattr(broken, "__func__", broken).__code__)
