"""A gradcheck that goes on from another one: at the same seeds it comes to what a single one comes to."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from measure.test_gradcheck import SMALL  # the same kernels
from measure.test_sampling import NAMES, Pretended

from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure import sampling
from reslrb_cli.measure.gradcheck import Gradcheck
from reslrb_cli.measure.methods import parse_estimators
from reslrb_cli.measure.participants import Settings
from reslrb_cli.measure.resume_store import Earlier
from reslrb_cli.measure.sampling import FEWEST, KIND, Sampling, settings
from reslrb_cli.measure.scenes import small
from reslrb_cli.records.measurement_files import read_samples, write_samples
from reslrb_cli.records.measurements import GradcheckRecord, Reference, Verdict


def check(
    seeds: int, file: Path, earlier: Earlier | None = None, after: int = 10**6
) -> tuple[list[GradcheckRecord], Earlier]:
    """The records, and what the check keeps, by way of the disk; it is stopped after so many looks at the clock."""
    config = loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, SMALL)
    what = Settings(config, parse_estimators("stack"), 0, seeds)
    made, looks = Gradcheck(what, earlier=earlier), iter(range(10**6))
    records = [result.record for result in made.run(lambda: next(looks) > after, lambda line: None)]
    kept = made.kept(settings(what, "llvm_ad_rgb", ""))
    assert kept is not None
    write_samples(file, *kept)
    return records, Earlier(KIND, Path("g.jsonl"), *read_samples(file))


def test_more_seeds_are_added_to_those_of_the_file(llvm: None, tmp_path: Path) -> None:
    """One was interrupted in the midst of its differences, whose step had been chosen."""
    whole, _ = check(6, tmp_path / "a.npz")
    part, earlier = check(4, tmp_path / "b.npz", after=15)
    assert {record.seeds for record in part if record.reference is Reference.FINITE_DIFFERENCE} < {3, 4}
    assert earlier.head["steps"]
    more, _ = check(6, tmp_path / "c.npz", earlier)
    assert [(r.reference, r.verdict, r.seeds) for r in more] == [(r.reference, r.verdict, r.seeds) for r in whole]
    for one, other in zip(more, whole, strict=True):
        # What differs by rounding alone has no figures that would be the same twice.
        noisy = one.reference is Reference.PTRACER
        for name in ("relative_l2", "z_max", "z_rms", "variance_ratio") if noisy else ("relative_l2",):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-2, abs=1e-4), (one.reference, name)
    assert {record.verdict for record in more} == {Verdict.HOLDS}
    with pytest.raises(ConfigError, match=r"g\.jsonl has 6 seeds already; name more with --seeds"):
        check(6, tmp_path / "d.npz", Earlier(KIND, Path("g.jsonl"), *read_samples(tmp_path / "c.npz")))


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"spp": 8}, "spp is None there, 8 here"),
        ({"integrators": parse_estimators("event")}, "estimators is ['reslrb:stack'] there"),
        ({"config": loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE, ["run.seed=3"])}, "run.seed is 0 there, 3 here"),
    ],
)
def test_only_the_same_is_gone_on_from(change: dict[str, Any], line: str) -> None:
    what = Settings(loads(small.CORNELL_BOX, small.CORNELL_BOX_SOURCE), parse_estimators("stack"), 0, 4)
    head = {"version": 2, "kind": KIND, "settings": settings(what, "llvm_ad_rgb", "")}
    with pytest.raises(ConfigError) as caught:
        Earlier(KIND, Path("g.jsonl"), head, {}).check(settings(replace(what, **change), "llvm_ad_rgb", ""))
    assert f"--resume: g.jsonl is of another measurement: {line}" in str(caught.value)


# --- how the budget of what goes on is spent, with samples that only pretend ------------------------------------------


class Directed(Pretended):
    """Participants that write down which seeds they are asked for."""

    seeds: dict[str, list[int]] = {}  # noqa: RUF012 (looked at by the test)

    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        Directed.seeds = {}

    def gradient(self, label: str, seed: int) -> np.ndarray:
        Directed.seeds.setdefault(label, []).append(seed)
        return super().gradient(label, seed)

    def choose_steps(self, key: str) -> None:
        super().choose_steps(key)
        self.directions[key] = [replace(self.directions[key][0], step=0.01, truncation=0.5)]


def sampled(budget_s: float, earlier: Earlier | None = None, seeds: int | None = None) -> tuple[Sampling, float]:
    clock = [0.0]
    listed = [SimpleNamespace(label="reslrb:event"), SimpleNamespace(label="reslrb:stack")]
    what: Any = SimpleNamespace(budget_s=budget_s, seeds=seeds, integrators=listed, clock=clock, spent_s=0.0)
    made = Sampling(what, lambda: clock[0], earlier)
    made.expect(NAMES)
    for name in NAMES:
        made.take(name, lambda: False, lambda line: None)
    return made, clock[0]


def again(made: Sampling) -> Earlier:
    kept = made.kept({})
    assert kept is not None
    return Earlier(KIND, Path("g.jsonl"), *kept)


def test_a_second_budget_adds_seeds_that_are_new_and_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "Participants", Directed)
    first, _ = sampled(60.0)
    before = {name: len(first.of(name)) for name in NAMES if len(first._samples.get(name, ())) > 0}
    firsts = dict(Directed.seeds)
    second, seconds = sampled(90.0, again(first))
    assert seconds <= 90.0
    assert all(len(second.of(name)) > before.get(name, 0) for name in NAMES)
    for label, seeds in Directed.seeds.items():
        assert not set(seeds) & set(firsts.get(label, ()))
    # The step of differences is that of the first session, and is not chosen again.
    assert second.participants.directions["a"][0].step == 0.01
    assert second.participants.directions["a"][0].truncation == 0.5
    assert ("differences", "a") not in before or ("choose", "a") not in second.participants.known


@pytest.mark.parametrize("budget_s", [12.0, 30.0])
def test_a_budget_that_is_too_small_says_what_the_fewest_take(budget_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sampling, "Participants", Directed)
    made, _ = sampled(budget_s)
    assert any(len(made._samples.get(name, ())) < FEWEST for name in NAMES)
    needed_s = made.needed_s()
    assert needed_s is not None
    assert needed_s > budget_s
    enough, seconds = sampled(1.3 * needed_s)
    assert {name: len(enough._samples[name]) >= FEWEST for name in NAMES} == dict.fromkeys(NAMES, True)
    assert seconds <= 1.3 * needed_s
