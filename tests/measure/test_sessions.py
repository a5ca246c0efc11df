"""Sessions of `convergence` and `gradcheck`: which stored samples are continued, and how a budget is spent.
All samples only pretend.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from measure.pretended_steps import Pretended, Stage, plan, play

from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure import sampling
from reslrb_cli.measure.convergence import Session
from reslrb_cli.measure.gradients import Direction
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.measure.participants import CheckSettings
from reslrb_cli.measure.sampling import FEWEST, KIND, LEAST_SEEDS, MOST_SEEDS, Name, Sampling
from reslrb_cli.measure.sampling import settings as sampled_as
from reslrb_cli.measure.scenes import small
from reslrb_cli.records.measurement_files import Earlier, Kept, program
from reslrb_cli.records.measurements import Reference

# Gradcheck: participants whose samples cost seconds of the tests' own clock.

NAMES: list[Name] = [
    ("image", "walk_ad"), ("image", "ptracer"), ("gradient", "reslrb:event"), ("gradient", "walk_ad"),
    ("gradient", "ptracer"), ("differences", "a"), ("tangents", "a"), ("gradient", "reslrb:stack"),
]  # fmt: skip


class Participants:
    """Participants whose samples cost `sample_s` each. The first sample of each name costs `compile_s` more. `seeds`
    has the seeds of the gradients of all participants.
    """

    compile_s, sample_s, load_s = 5.0, 0.1, 2.0
    seeds: dict[str, list[int]] = {}  # noqa: RUF012 (looked at by the tests)

    def __init__(self, settings: Any) -> None:
        self.now, self.known, self.exact = settings.clock, set(), {}
        self.stock = {"a": Reference.PTRACER}
        self.case = SimpleNamespace(size=3)
        self.listed = [SimpleNamespace(label="reslrb:event"), SimpleNamespace(label="reslrb:stack")]
        self.integrators = dict.fromkeys(label for _, label in NAMES)
        self.directions = {"a": [Direction(np.ones(3), "both")]}
        self.now[0] += self.load_s
        Participants.seeds = {}

    def sample(self, kind: str, of: str, seed: int) -> np.ndarray:
        if kind == "gradient":
            Participants.seeds.setdefault(of, []).append(seed)
        self.now[0] += self.sample_s + (0.0 if (kind, of) in self.known else self.compile_s)
        self.known.add((kind, of))
        return np.zeros(3)

    def choose_steps(self, key: str) -> None:
        self.sample("choose", key, 0)
        self.directions[key] = [replace(self.directions[key][0], step=0.01, truncation=0.5)]


@pytest.fixture(autouse=True)
def _pretend(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "Participants", Participants)
    Pretended.log, Pretended.ends, Pretended.refusing, Pretended.alive = [], {}, set(), 0


@dataclass(frozen=True)
class Spent:
    """A gradcheck after its samples: the counts of all names with enough samples, the seconds, and the messages."""

    made: Sampling
    counts: dict[Name, int]
    seconds: float
    said: list[str]


def spend(budget_s: float, earlier: Earlier | None = None, seeds: int | None = None) -> Spent:
    clock, said = [0.0], []
    listed = [SimpleNamespace(label="reslrb:event"), SimpleNamespace(label="reslrb:stack")]
    what: Any = SimpleNamespace(budget_s=budget_s, seeds=seeds, integrators=listed, clock=clock, spent_s=0.0)
    made = Sampling(what, lambda: clock[0], earlier)
    made.expect(NAMES)
    counts = {name: len(made.of(name)) for name in NAMES if made.take(name, lambda: False, said.append)}
    return Spent(made, counts, clock[0], said)


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


def test_a_second_budget_adds_new_seeds_and_is_kept() -> None:
    first = spend(60.0).made
    before = {name: len(first.of(name)) for name in NAMES if len(first._samples.get(name, ())) > 0}
    firsts, kept = dict(Participants.seeds), first.kept({})
    assert kept is not None
    second = spend(90.0, Earlier(KIND, Path("g.jsonl"), *kept))
    assert second.seconds <= 90.0
    assert all(len(second.made.of(name)) > before.get(name, 0) for name in NAMES)
    for label, seeds in Participants.seeds.items():
        assert not set(seeds) & set(firsts.get(label, ()))
    # The step of finite differences is the step of the first session. It is not chosen again.
    participants = second.made.participants
    assert (participants.directions["a"][0].step, participants.directions["a"][0].truncation) == (0.01, 0.5)
    assert ("differences", "a") not in before or ("choose", "a") not in participants.known


# All kinds of sessions: what an earlier session has taken is not taken again, and only the same measurement continues.


@dataclass(frozen=True)
class Ended:
    """A finished session: its data to store, the number of samples that it took, and its figures."""

    kept: Kept
    taken: int
    figures: list[Any]


def convergence(folder: Path, earlier: Earlier | None = None, **changes: Any) -> Ended:
    stage = Stage()
    session, results, _ = play(folder, stage, plan(**{"rounds": 4} | changes), earlier=earlier)
    return Ended(session.kept(), len(stage.asked), [record.efficiency for record in results.methods])


CONFIG_OF_CHECK = loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE)


def check_settings(**changes: Any) -> dict[str, Any]:
    what = CheckSettings(CONFIG_OF_CHECK, parse_cases("reslrb:stack"), 0, 4)
    return sampled_as(replace(what, **changes), "llvm_ad_rgb", "")


def gradcheck(folder: Path, earlier: Earlier | None = None, **changes: Any) -> Ended:
    made = spend(0.0, earlier, seeds=5).made
    taken = sum(map(len, Participants.seeds.values()))
    return Ended(made.kept(check_settings(**changes)), taken, [made.of(name).tolist() for name in NAMES])


SESSIONS: dict[str, Callable[..., Ended]] = {"convergence": convergence, KIND: gradcheck}
#: How each kind of session refuses stored samples of other settings.
REFUSE: dict[str, Callable[..., object]] = {
    "convergence": lambda earlier, **changes: Session(
        plan(**{"rounds": 8} | changes), Path(), lambda: False, print, earlier=earlier),
    KIND: lambda earlier, **changes: earlier.check(check_settings(**changes)),
}  # fmt: skip


@pytest.mark.parametrize("kind", SESSIONS)
def test_stored_samples_are_not_taken_again(kind: str, tmp_path: Path) -> None:
    first = SESSIONS[kind](tmp_path)
    second = SESSIONS[kind](tmp_path, Earlier(kind, Path("a.jsonl"), *first.kept))
    assert (first.taken > 0, second.taken) == (True, 0)
    assert second.figures == first.figures
    assert second.figures[0] is not None


@pytest.mark.parametrize(
    ("kind", "change", "line"),
    [
        ("convergence", {"memory_limit": 2**30}, "memory limit is None there, 1073741824 here"),
        ("convergence", {"variant": "cuda_ad_rgb"}, "variant is llvm_ad_rgb there, cuda_ad_rgb here"),
        ("convergence", {"cases": "ptracer"}, "integrators is ['ptracer', 'reslrb:stack', 'reslrb:event'] there"),
        ("convergence", {"objective": "image"}, "objective is fixed there, image here"),
        ("convergence", {"spps": (4, 8)}, "spp is [] there, [4, 8] here"),
        (KIND, {"spp": 8}, "spp is None there, 8 here"),
        (KIND, {"config": loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, ["run.seed=3"])}, "run.seed is 0 there"),
    ],
)
def test_only_the_same_measurement_is_continued(kind: str, change: dict[str, Any], line: str, tmp_path: Path) -> None:
    kept = SESSIONS[kind](tmp_path).kept
    earlier = Earlier(kind, Path("a.jsonl"), *kept)
    with pytest.raises(ConfigError, match=re.escape(f"--json: a.jsonl belongs to another measurement: {line}")):
        REFUSE[kind](earlier, **change)
    REFUSE[kind](earlier)
    with pytest.raises(ConfigError, match="by another version"):
        Earlier(kind, Path("a.jsonl"), kept[0] | {"version": 0}, kept[1])
    with pytest.raises(ConfigError, match=f"it belongs to `{kind}`, this is `render`"):
        Earlier("render", Path("a.jsonl"), *kept)


def test_samples_of_other_code_are_not_continued(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    earlier = Earlier(KIND, Path("g.jsonl"), *gradcheck(tmp_path).kept)
    read_bytes = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read_bytes(path) + b" " * (path.name == "stack.py"))
    changed = {"versions": program.__wrapped__()}
    with pytest.raises(ConfigError, match=r"versions\.code is \w+ there, \w+ here; remove the file"):
        earlier.check(check_settings() | changed)
