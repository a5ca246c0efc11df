"""What `bench` measures where parameters move light: every integrator that can takes steps, and memory stays flat."""

from __future__ import annotations

import gc

import drjit as dr
import mitsuba as mi
import pytest
from measure.faults import room

from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.measure.stepper import Stepper
from reslrb_cli.records.clock import peak_mib, reset_peak

pytestmark = pytest.mark.usefixtures("llvm")


def peak(name: str, depth: int) -> float:
    """Of a cold step, in MiB, beyond what the scene and what was loaded before it take."""
    [case] = parse_cases(name)
    stepper = Stepper(case.at(room("wavy_glass.xml", "top.vertex_positions"), depth, known=True), "fixed")
    gc.collect()
    dr.flush_malloc_cache()
    reset_peak()
    before = peak_mib(dr.backend_v(mi.Float))
    cold = stepper.step(0, True, False)
    warm = stepper.step(1, False, False)
    assert warm["kernel_ms"] > 0
    return float(cold["peak_mib"]) - before


def peaks(name: str) -> list[float]:
    return [peak(name, depth) for depth in (4, 16)]


@pytest.mark.long
def test_memory_of_stack_does_not_grow_with_depth():
    shallow, deep = peaks("reslrb:stack")
    assert 0 < shallow  # else the watermark sees nothing
    assert deep < 1.1 * shallow  # so small that what the allocator rounds to shows


@pytest.mark.long
def test_memory_of_naive_ad_does():
    shallow, deep = peaks("ptracer")
    assert deep > 2 * shallow > 4 * peak("reslrb:stack", 4)
