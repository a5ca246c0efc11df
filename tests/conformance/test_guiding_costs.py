"""What guided emission costs a step: nothing where it is off, and no kernel that is compiled anew where it learns."""

from __future__ import annotations

import pytest
from conformance.test_guiding import guided, learn
from conformance.test_kernels import Kernels, nothing_is_compiled_without

from reslrb_cli.integrators.plan_report import GUIDED, LARGE

pytestmark = pytest.mark.usefixtures("llvm")


def test_without_a_guide_nothing_of_it_is_compiled() -> None:
    nothing_is_compiled_without(GUIDED, *guided("two_emitters", 0))


def test_later_steps_compile_nothing() -> None:
    """Though they learn: neither table nor seed reaches a kernel as a literal."""
    scene, ours, _ = guided("two_emitters", 0)
    kernels = Kernels()
    kernels.new(lambda: learn(scene, ours, 0))
    for seed in (1, 2):
        found = kernels.new(lambda: learn(scene, ours, seed))  # noqa: B023
        # Those that copy a table hang on where NumPy has it.
        assert [kernel["operation_count"] for kernel in found if kernel["operation_count"] >= LARGE] == []


def test_a_step_stays_recorded_whatever_its_tables_learn() -> None:
    """A step that is recorded anew for each new table would, after a few of them, not be recorded any more."""
    scene, ours, _ = guided("two_emitters", 0, freeze=True)
    for seed in range(2):
        learn(scene, ours, seed)
    recordings = ours.preparation.recordings
    counts = recordings.counts()
    assert counts["fused"] > 0
    for seed in range(2, 12):
        learn(scene, ours, seed)
    assert recordings.counts() == counts
