"""Whether low-discrepancy numbers pay, decided on fabricated steps; and what of a run's time may be measured away."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from optimization.deciding import SIZES, World

from reslrb_cli.optimization.autotune.race import (
    GUIDING_SHARE,
    ITERATIONS,
    LEARNINGS,
    LEAST_ROUNDS,
    LOOKS,
    PLANNED,
    SEQUENCE_SHARE,
    Sizes,
)
from reslrb_cli.optimization.autotune.race import SHARE as PILOT_SHARE
from reslrb_cli.optimization.autotune.sampling import SEQUENCE_LONGER, SequencePilot, planned, share_left
from reslrb_cli.optimization.decisions import Allowance
from reslrb_cli.records.decisions import GuidedRecord, SequenceRecord


def world(variance: float, time: float, **options: Any) -> World:
    """Nothing is learned in it, but where `options` say so."""
    return World(variance, time, **{"learns": False, "pilot": SequencePilot, **options})


def sizes(share: float, step: int = 64) -> Sizes:
    return replace(SIZES, step=step, call=step, part=step, longer=SEQUENCE_LONGER, planned=planned(share))


@pytest.mark.parametrize(
    ("options", "on"),
    [
        ({"variance": 0.05, "time": 1.1}, True),
        ({"variance": 0.6, "time": 1.1}, True),
        ({"variance": 1.0, "time": 1.0}, False),
        ({"variance": 0.95, "time": 1.1}, False),
        ({"variance": 2.0, "time": 1.1}, False),
        ({"variance": 0.05, "time": 1.1, "image": 3.0}, False),  # the image would pay for it
        ({"variance": 0.05, "time": 1.1, "image": 0.9}, True),
        ({"variance": 0.05, "time": 1.1, "image": 3.0, "alone": True}, False),  # one switch is for both
        ({"variance": 0.05, "time": 1.1, "image": 0.9, "alone": True}, True),
        ({"variance": 0.05, "time": 1.1, "sparse": True}, True),
    ],
)
def test_it_is_on_where_it_pays(options: dict[str, Any], on: bool) -> None:
    one = world(**options)
    record = one.run(sizes(0.02), 0.02)
    assert record.low_discrepancy == on
    assert record.setting == ("low_discrepancy" if on else "independent")
    assert record.low < 1 / (one.variance * (1.1 if one.time > 1 else 1.0)) < record.high or one.alone
    assert record.line().startswith(f"sequence {record.setting}: {record.gain:.2g} times the efficiency here (")
    assert (record.note != "") == (not on and record.low > 1)
    assert all(call[0] != "learn" for call in one.calls)


def on_by_accident(**options: Any) -> int:
    """Of 100 worlds, in how many it is on."""
    return sum(world(**options, seed=seed).run(sizes(0.05), 0.05).low_discrepancy for seed in range(100))


def test_where_it_gains_nothing_it_is_hardly_ever_on(monkeypatch: pytest.MonkeyPatch) -> None:
    # 2.5 are expected on this side, were times not allowed to be off, and one more for the looks before the last.
    assert on_by_accident(variance=0.9, time=1 / 0.9) <= 9
    # A fault that takes the gain itself for what it is at least is seen by that.
    gain = SequencePilot._gain
    monkeypatch.setattr(SequencePilot, "_gain", lambda *args: (lambda g: (g[0], g[0], g[2]))(gain(*args)))
    assert on_by_accident(variance=0.9, time=1 / 0.9) > 30


def test_a_table_that_has_yet_to_learn_does_so_before_all_steps_that_count() -> None:
    one = world(0.1, 1.1, learns=True)
    record = one.run(sizes(0.05), 0.05)
    assert record.low_discrepancy
    kinds = [call[0] for call in one.calls]
    assert kinds[:4] == [False, False, "learn", "learn"]
    assert kinds.count("learn") == LEARNINGS
    assert kinds[4:] == [True, *[False, True] * record.rounds]
    # Both sides go on learning: what that takes is no part of the gain.
    assert record.gain == pytest.approx(1 / (0.1 * 1.1), rel=0.2)


@pytest.mark.parametrize("share", [0.0, SEQUENCE_SHARE, 0.01, 0.02, PILOT_SHARE])
@pytest.mark.parametrize("step", [8, 64, 1024])
@pytest.mark.parametrize("overhead", [0.0, 0.1, 10.0])
@pytest.mark.parametrize("time", [0.9, 1.1, 3.0])
def test_its_share_is_kept(share: float, step: int, overhead: float, time: float) -> None:
    one = world(0.1, time, overhead=overhead)
    used = sizes(share, step)
    record = one.run(used, share)
    if record.gain is None:
        assert "to measure it would cost more than" in record.note or "too few to tell" in record.note
        assert not record.low_discrepancy
        # A step is what it takes to know what one takes.
        assert record.share * ITERATIONS * (step + overhead) <= max(
            used.trial + overhead, 1.3 * share * ITERATIONS * (step + overhead)
        )
    else:
        assert LEAST_ROUNDS <= record.rounds <= LOOKS * used.rounds
        assert record.share <= share * 1.3


def test_the_more_is_left_the_longer_steps_are() -> None:
    trials = [sizes(share, 1024).trial for share in (0.0, SEQUENCE_SHARE, 0.01, 0.02, 0.05)]
    assert trials == sorted(trials)
    assert trials[0] == 1
    assert 30 < trials[1] < trials[2] < trials[3]
    assert sizes(0.05, 1024).planned == PLANNED
    assert world(0.1, 1.1).run(sizes(SEQUENCE_SHARE, 1024), SEQUENCE_SHARE).low_discrepancy


class Spent:
    """The problem of a run of which measuring has taken these shares so far."""

    def __init__(self, pilot: float | None, guided: float | None) -> None:
        self.pilot = None if pilot is None else SimpleNamespace(share=pilot)
        self.guided = None if guided is None else GuidedRecord(guided=True, share=guided)


@pytest.mark.parametrize("pilot", [None, 0.02, PILOT_SHARE - GUIDING_SHARE])
def test_all_that_is_measured_takes_one_share(pilot: float | None) -> None:
    """What guiding may take, then what the sequence may, and what both have, come what may."""
    ample = Allowance(1.0, 1e9, 0.0, 1.0)
    for_guiding = share_left(Spent(pilot, None), ample, SEQUENCE_SHARE)  # type: ignore[arg-type]
    assert for_guiding == pytest.approx(PILOT_SHARE - SEQUENCE_SHARE - (pilot or 0))
    assert for_guiding >= GUIDING_SHARE - SEQUENCE_SHARE - 1e-12
    left = share_left(Spent(pilot, for_guiding), ample)  # type: ignore[arg-type]
    assert left == pytest.approx(SEQUENCE_SHARE)
    assert share_left(Spent(pilot, 0.5), ample) == 0  # type: ignore[arg-type]


def test_a_record_survives_json_and_nothing_else_is_one() -> None:
    record = world(0.1, 1.1).run(sizes(0.02), 0.02)
    data = record.to_json()
    assert SequenceRecord.from_json(data) == record
    wrong = ({}, {**data, "low_discrepancy": 1}, {**data, "gain": "2"}, {**data, "guided": True})
    for each in wrong:
        with pytest.raises(TypeError):
            SequenceRecord.from_json(each)
    with pytest.raises(TypeError):
        GuidedRecord.from_json(data)


def test_no_noise_is_no_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(World, "_noisy", lambda self, random, variance: np.ones(4))
    record = world(0.1, 1.1).run(sizes(0.02), 0.02)
    assert not record.low_discrepancy
    assert record.note == "gradients have no noise"
