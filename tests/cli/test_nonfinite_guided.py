"""`inspect --nonfinite` of guided runs: the step's paths start where the tables of then had them start."""

from __future__ import annotations

import re
from types import ModuleType

import drjit as dr
import numpy as np
import pytest
from cli.test_nonfinite import experiment, inspect, optimize  # noqa: F401 (a fixture)
from turns import a_few

from reslrb_cli.cli import nonfinite
from reslrb_cli.guiding.tables import Guiding
from reslrb_cli.integrators import reslrb
from reslrb_cli.measure import nonfinite_trace
from reslrb_cli.measure.nonfinite_trace import Witness

#: So few paths that the spoilt texel is met for the first time behind many iterations.
SETTINGS = ["integrator.guiding=on", "scene.options={wall: spoilt.exr}", "run.iterations=60", "run.on_nonfinite=stop"]
#: Ways to take a step; `again` has tables learn between the batches of a step.
WAYS = {
    "correlated": ["run.adjoint=correlated", "run.spp=2"],
    "independent": ["run.adjoint=independent", "run.spp=2"],
    "batched": ["run.adjoint=batched", "run.spp=4"],
    "again": ["run.adjoint=batched", "run.first_batch=again", "run.batches=3", "run.spp=3"],
}
#: Seeds that are tried in turn until one meets the texel when tables have learned; what they meet changes with whatever
#: changes tables. Of `again` these meet it in the third batch of a step whose second one taught them.
SEEDS = {"again": [5, 15, 16, 28, 23]}
Drawn = list[tuple[int, dict[str, np.ndarray] | None]]


def note(monkeypatch: pytest.MonkeyPatch, module: ModuleType) -> Drawn:
    """The seed of all samples that `module` makes from now on, and the table that they are drawn from, if any."""
    drawn: Drawn = []
    passes = module.passes

    def noting(plan, scene, sensor, seed, spp, samples_per_pass, table=None):
        entries = {} if table is None else {name: value for name, value in vars(table).items() if dr.is_array_v(value)}
        held = None if table is None else {name: np.array(value) for name, value in entries.items()}
        drawn.append((int(seed[0]), held))
        return passes(plan, scene, sensor, seed, spp, samples_per_pass, table)

    monkeypatch.setattr(module, "passes", noting)
    return drawn


def differences(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], way: str) -> list[str]:
    """What is not of the run's last step in what its replay looked at."""
    taken, looked_at = note(monkeypatch, reslrb), note(monkeypatch, nonfinite_trace)
    for seed in SEEDS.get(way, [1, 2, 3, 4, 5, 6, 7, 8]):
        taken.clear()
        _, err = optimize(capsys, *SETTINGS, *WAYS[way], f"run.seed={seed}")
        told = re.search(r"not finite in iteration (\d+): .*the first at pixel \((\d+), (\d+)\)", err)
        if told is not None and int(told[1]) > 0:
            break
    run = taken[:]
    assert told is not None, err
    assert int(told[1]) > 0  # tables have learned
    iteration, offenders, _ = inspect(capsys, err)
    assert iteration == int(told[1])
    seeds = list(dict.fromkeys(seed for seed, _ in looked_at))
    found = [] if len(seeds) == len({seed for seed, _ in run if seed in seeds}) > 0 else ["other seeds"]
    for seed in seeds:
        own, there = ([table for number, table in drawn if number == seed] for drawn in (run, looked_at))
        found += [] if len(there) == 2 * len(own) else [f"{len(there)} sets in place of {len(own)}"]
        for one, other in zip(own, there, strict=False):  # it was inspected twice
            assert one is not None
            assert one
            if other is None or any(not np.array_equal(other[name], value) for name, value in one.items()):
                found.append("another table")
    for each in offenders:
        x, y, _ = each["where"]["position"]
        spoilt = each["where"]["surface"] == "wall_shape" and (int(x + 4), int(y + 4)) == (1, 4)
        found += [] if spoilt and each["pixel"] == [int(told[2]), int(told[3])] else ["another vertex"]
    return found


@pytest.mark.parametrize("way", a_few(WAYS, ["correlated", "again"]))
def test_it_is_the_step_of_the_run(experiment, capsys, monkeypatch, way):  # noqa: F811
    assert differences(monkeypatch, capsys, way) == []


@pytest.mark.parametrize("fault", ["untaught", "not learned on", "out of order"])
def test_other_tables_are_seen(experiment, capsys, fault, monkeypatch):  # noqa: F811
    """Tables that know nothing, that do not learn between the batches of a step, or that are those of another batch."""
    if fault == "untaught":
        monkeypatch.setattr(nonfinite, "_teach", lambda problem, saved, archive: None)
    elif fault == "not learned on":
        monkeypatch.setattr(Witness, "learn", lambda self, number, samples, adjoint: self.drawn.pop())
    else:
        monkeypatch.setattr(Witness, "learn", Guiding.learn)
    assert "another table" in differences(monkeypatch, capsys, "again")
