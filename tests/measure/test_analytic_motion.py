"""Derivatives of motions against geometrical optics."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import numpy as np
import pytest
from measure.analytic_motion import KnownMotion, ball_lens, lamp_over_plane, tilted_surface

from reslrb_cli.measure.comparison import Family, compare_expectations
from reslrb_cli.measure.gradients import integrator, seeds
from reslrb_cli.records.measurements import Verdict
from reslrb_cli.transport.walk import Segment

MOTIONS: dict[str, Callable[[], KnownMotion]] = {
    "tilted_surface": tilted_surface,
    "ball_lens": ball_lens,
    "lamp_over_plane": lamp_over_plane,
}


@pytest.fixture(autouse=True)
def _quiet(llvm: str) -> None:
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)


def gradients(motion: KnownMotion, count: int = 8, spp: int = 128) -> np.ndarray:
    case = motion.scene.case()
    case.weigh(motion.weights)
    return case.gradients(integrator("reslrb", **motion.scene.options, estimator="stack"), seeds(count), spp)


@pytest.mark.parametrize("name", MOTIONS)
def test_derivatives(name: str):
    motion = MOTIONS[name]()
    ours = gradients(motion)
    largest = float(np.abs(motion.derivatives).max())
    # Of what the formula leaves out, and of each derivative: those of the ball differ by their nature.
    bias = motion.tolerance * np.maximum(np.abs(motion.derivatives), 0.01 * largest)
    found = compare_expectations(ours, motion.derivatives, Family(rows=1, entries=ours.shape[1]), bias=bias)
    print(name, ours.mean(0), motion.derivatives, found)
    assert found.verdict is Verdict.HOLDS
    error = ours.std(0, ddof=1).max() / np.sqrt(len(ours)) / largest
    assert error < 4e-3, "too noisy to see a fault"


def test_a_surface_that_does_not_turn_the_light(monkeypatch: pytest.MonkeyPatch):
    right = Segment.next_ray
    monkeypatch.setattr(Segment, "next_ray", lambda self, attached=False: dr.detach(right(self, attached)))
    motion = tilted_surface()
    ours = gradients(motion, 3)
    assert abs(ours.mean() / motion.derivatives[0] - 1) > 0.1


def test_the_focus_of_a_ball_depends_on_its_index():
    for ior in (1.4, 1.8):
        across, along, grown = ball_lens(ior=ior, radius=2.0, offset=0.02).derivatives
        assert along / across == pytest.approx(-0.02 * 2 * (ior - 1) / (ior * 2.0))
        assert grown / across == pytest.approx(0.02)
