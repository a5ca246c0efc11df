"""What `bench` measures where parameters move light: every integrator that can takes steps, and memory stays flat."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from unittest import mock

import drjit as dr
import pytest
from measure.faults import room

from reslrb_cli.measure.cases import parse_cases
from reslrb_cli.measure.stepper import Stepper

pytestmark = pytest.mark.usefixtures("llvm")


@pytest.fixture(autouse=True)
def _selectable() -> Iterator[None]:
    """Until configurations take such keys."""
    with mock.patch("reslrb_cli.scene.catalog._obstacle", return_value=None):
        yield


def peak(name: str, depth: int) -> float:
    """Of a cold step, in MiB."""
    [case] = parse_cases(name)
    stepper = Stepper(case.at(room("wavy_glass.xml", "top.vertex_positions"), depth, known=True), "fixed")
    gc.collect()
    dr.flush_malloc_cache()
    cold = stepper.step(0, True, False)
    warm = stepper.step(1, False, False)
    assert warm["kernel_ms"] > 0
    del stepper
    gc.collect()
    return float(cold["peak_mib"])


def test_memory_of_stack_does_not_grow_with_depth():
    peaks = [peak("reslrb:stack", depth) for depth in (4, 16)]
    assert peaks[1] < 1.02 * peaks[0]
    assert peak("ptracer", 4) > 2 * peaks[0]
