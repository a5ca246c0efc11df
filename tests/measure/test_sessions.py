"""How `gradcheck` spends its budget. All samples only pretend."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from reslrb_cli.measure import gradcheck
from reslrb_cli.measure.gradcheck import FEWEST, LEAST_SEEDS, MOST_SEEDS, Name, Sampling
from reslrb_cli.measure.gradients import Direction
from reslrb_cli.records.measurements import Reference

NAMES: list[Name] = [
    ("image", "walk_ad"), ("image", "ptracer"), ("gradient", "reslrb:event"), ("gradient", "walk_ad"),
    ("gradient", "ptracer"), ("differences", "a"), ("tangents", "a"), ("gradient", "reslrb:stack"),
]  # fmt: skip


class Participants:
    """Participants whose samples cost `sample_s` each, on the tests' own clock. The first sample of each name costs
    `compile_s` more.
    """

    compile_s, sample_s, load_s = 5.0, 0.1, 2.0

    def __init__(self, settings: Any) -> None:
        self.now, self.known, self.exact = settings.clock, set(), {}
        self.stock = {"a": Reference.PTRACER}
        self.case = SimpleNamespace(size=3)
        self.listed = [SimpleNamespace(label="reslrb:event"), SimpleNamespace(label="reslrb:stack")]
        self.integrators = dict.fromkeys(label for _, label in NAMES)
        self.directions = {"a": [Direction(np.ones(3), "both")]}
        self.now[0] += self.load_s

    def sample(self, kind: str, of: str, seed: int) -> np.ndarray:
        self.now[0] += self.sample_s + (0.0 if (kind, of) in self.known else self.compile_s)
        self.known.add((kind, of))
        return np.zeros(3)

    def choose_steps(self, key: str) -> None:
        self.sample("choose", key, 0)
        self.directions[key] = [replace(self.directions[key][0], step=0.01, truncation=0.5)]


@pytest.fixture(autouse=True)
def _pretend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gradcheck, "Participants", Participants)


@dataclass(frozen=True)
class Spent:
    """A gradcheck after its samples: the counts of all names with enough samples, the seconds, and the messages."""

    counts: dict[Name, int]
    seconds: float
    said: list[str]


def spend(budget_s: float, seeds: int | None = None) -> Spent:
    clock, said = [0.0], []
    listed = [SimpleNamespace(label="reslrb:event"), SimpleNamespace(label="reslrb:stack")]
    what: Any = SimpleNamespace(budget_s=budget_s, seeds=seeds, integrators=listed, clock=clock, spent_s=0.0)
    made = Sampling(what, lambda: clock[0])
    made.expect(NAMES)
    counts = {name: len(made.of(name)) for name in NAMES if made.take(name, lambda: False, said.append)}
    return Spent(counts, clock[0], said)


def test_a_sufficient_budget_is_kept_and_used() -> None:
    found = spend(90.0)
    assert list(found.counts) == NAMES
    assert 70.0 < found.seconds <= 90.0
    assert min(found.counts.values()) >= LEAST_SEEDS
    assert max(found.counts.values()) > LEAST_SEEDS
    assert found.said[0].startswith("image walk_ad: seeds ")
    assert found.said[0].endswith("of which the first 5.1 s")


def test_an_unlimited_budget_stops_when_more_is_useless() -> None:
    cheap = [name for name in NAMES if name[0] == "image" or (name[0] == "gradient" and name[1] != "walk_ad")]
    assert spend(1e6).counts == {name: MOST_SEEDS if name in cheap else LEAST_SEEDS for name in NAMES}


@pytest.mark.parametrize("budget_s", [0.0, 1.0, 8.0, 20.0, 40.0])
def test_a_budget_exceeded_by_compilation_runs_over_by_one_sample(budget_s: float) -> None:
    found = spend(budget_s)
    assert found.seconds <= max(budget_s, 2.0) + 5.2 + 0.1
    assert len(found.counts) < len(NAMES)
    assert all(count >= FEWEST for count in found.counts.values())
    assert bool(found.counts) == (budget_s > 2.0)


def test_a_number_of_seeds_is_taken_at_any_cost() -> None:
    found = spend(0.0, seeds=5)
    assert found.counts == dict.fromkeys(NAMES, 5)
    assert found.seconds > 40.0
