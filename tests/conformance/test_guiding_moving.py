"""Guided emission where light is followed: numbers of emission are held, so that its weight is a constant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from agreement import compare
from conformance import attached_cases, moving_lamps
from conformance.test_survival import by_harsh_table
from turns import a_few

from reslrb_cli.integrators.step import make_integrator
from reslrb_cli.measure.gradients import seeds

pytestmark = pytest.mark.usefixtures("llvm")
MOVING = {case.name: case for case in (*attached_cases.CASES, *moving_lamps.CASES)}


@pytest.mark.parametrize("name", a_few(["latents", "spot", "mesh", "bounces_4"], ["spot"]))
def test_means_are_those_of_unguided_samples(name: str) -> None:
    means_hold(name, "stack")


@pytest.mark.long
@pytest.mark.parametrize("name", ["latents", "mesh", "bounces_4"])
def test_means_by_reservoir_are_those_of_unguided_samples(name: str) -> None:
    means_hold(name, "reservoir")


@pytest.mark.parametrize("name", a_few(["latents", "mesh", "bounces_4"], ["bounces_4"]))
@pytest.mark.parametrize("estimator", a_few(["stack", "reservoir"], ["stack"]))
def test_means_hold_where_paths_end_by_a_table(name: str, estimator: str) -> None:
    means_hold(name, estimator, harsh=True)


def means_hold(name: str, estimator: str, harsh: bool = False) -> None:
    moving = MOVING[name].moving()
    found = {}
    for block, guiding in enumerate(("on", "off")):
        ours = make_integrator("reslrb", max_depth=5, rr_depth=1000, estimator=estimator, guiding=guiding)
        if guiding == "on":
            learn(moving, ours)
            if harsh:
                by_harsh_table(ours.preparation.guiding)
        rows = [moving.gradient(ours, seed, 16) for seed in seeds(32, block)]
        found[guiding] = np.stack([np.concatenate(list(row.values())) for row in rows])
    result = compare(found["on"], found["off"], block=None)
    print(name, estimator, result)
    assert np.abs(found["on"]).max() > 0
    assert result


def learn(moving: Any, ours: Any) -> None:
    """Four steps that the tables learn from, after which they learn no more."""
    for seed in range(4):
        moving.gradient(ours, 9000 + seed, 16)
    guiding = ours.preparation.guiding
    assert [learned.calls for learned in guiding.learned.values()] == [4]
    guiding.due = lambda number: False
