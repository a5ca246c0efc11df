"""How a gradcheck spends its budget: with samples that only pretend, on a clock of their own."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from reslrb_cli.measure import sampling
from reslrb_cli.measure.gradients import Direction
from reslrb_cli.measure.sampling import FEWEST, LEAST_SEEDS, MOST_SEEDS, Name, Sampling

NAMES: list[Name] = [
    ("image", "walk_ad"), ("image", "ptracer"), ("gradient", "reslrb:event"), ("gradient", "walk_ad"),
    ("gradient", "ptracer"), ("differences", "a"), ("tangents", "a"), ("gradient", "reslrb:stack"),
]  # fmt: skip


class Pretended:
    """Participants whose samples cost `sample_s` each, and `compile_s` more when they are taken for the first time."""

    compile_s, sample_s, load_s = 5.0, 0.1, 2.0

    def __init__(self, settings: Any) -> None:
        self.now, self.known, self.exact = settings.clock, set(), {}
        self.case = SimpleNamespace(initial={"a": np.zeros(3)})
        self.listed = [SimpleNamespace(label="reslrb:event"), SimpleNamespace(label="reslrb:stack")]
        self.integrators = dict.fromkeys(label for _, label in NAMES)
        self.directions = {"a": [Direction(np.ones(3), "both")]}
        self.now[0] += self.load_s

    def _sample(self, *name: str) -> np.ndarray:
        self.now[0] += self.sample_s + (0.0 if name in self.known else self.compile_s)
        self.known.add(name)
        return np.zeros(3)

    def gradient(self, label: str, seed: int) -> np.ndarray:
        return self._sample("gradient", label)

    def picture(self, label: str, seed: int) -> np.ndarray:
        return self._sample("image", label)

    def differences(self, key: str, seed: int) -> np.ndarray:
        return self._sample("differences", key)

    def tangents(self, label: str, key: str, seed: int) -> np.ndarray:
        return self._sample("tangents", key)

    def choose_steps(self, key: str) -> None:
        self._sample("choose", key)

    def stock_labels(self) -> list[str]:
        return ["ptracer"]


@pytest.fixture(autouse=True)
def _pretend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "Participants", Pretended)


def spent(budget_s: float, seeds: int | None = None) -> tuple[dict[Name, int], float, list[str]]:
    """Samples by name of those that were enough, the time that it took, and what was said."""
    clock, said = [0.0], []
    listed = [SimpleNamespace(label="reslrb:event"), SimpleNamespace(label="reslrb:stack")]
    settings: Any = SimpleNamespace(budget_s=budget_s, seeds=seeds, integrators=listed, clock=clock, spent_s=0.0)
    made = Sampling(settings, now=lambda: clock[0])
    made.expect(NAMES)
    counts = {name: len(made.of(name)) for name in NAMES if made.take(name, lambda: False, said.append)}
    return counts, clock[0], said


def test_a_budget_that_suffices_for_all_is_kept_and_used() -> None:
    counts, seconds, said = spent(90.0)
    assert list(counts) == NAMES
    assert 70.0 < seconds <= 90.0
    assert min(counts.values()) >= LEAST_SEEDS
    assert max(counts.values()) > LEAST_SEEDS
    assert said[0].startswith("image walk_ad: seeds ")
    assert said[0].endswith("of which the first 5.1 s")


def test_a_budget_without_end_takes_no_more_than_is_of_use() -> None:
    counts, _, _ = spent(1e6)
    cheap = [name for name in NAMES if name[0] == "image" or (name[0] == "gradient" and name[1] != "walk_ad")]
    assert {name: MOST_SEEDS if name in cheap else LEAST_SEEDS for name in NAMES} == counts


@pytest.mark.parametrize("budget_s", [0.0, 1.0, 8.0, 20.0, 40.0])
def test_a_budget_that_compiling_exceeds_is_overrun_by_one_first_sample(budget_s: float) -> None:
    counts, seconds, _ = spent(budget_s)
    assert seconds <= max(budget_s, 2.0) + 5.2 + 0.1
    assert len(counts) < len(NAMES)
    assert all(count >= FEWEST for count in counts.values())
    assert bool(counts) == (budget_s > 2.0)


def test_a_number_of_seeds_is_kept_whatever_it_takes() -> None:
    counts, seconds, _ = spent(0.0, seeds=5)
    assert counts == dict.fromkeys(NAMES, 5)
    assert seconds > 40.0
