"""Whether guided emission pays, decided on fabricated steps: what is on, what is off, at what cost, how sure."""

from __future__ import annotations

from dataclasses import replace
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
    TIMING_NOISE,
    Sizes,
)
from reslrb_cli.optimization.autotune.sampling import GUIDING_LONGER, GuidingPilot
from reslrb_cli.records.decisions import GuidedRecord


def gain(world: World, sizes: Sizes = SIZES) -> float:
    """The true gain of a world: by hand."""
    learning = (world.walk * sizes.part + world.python) / sizes.call
    return 1 / (world.variance * (world.time + learning * sizes.lessons))


@pytest.mark.parametrize(
    ("world", "on"),
    [
        (World(0.1, 2.2), True),
        (World(0.2, 7.0), False),
        (World(1.0, 1.0), False),
        (World(0.5, 1.0), True),
        (World(3.0, 0.5), False),
        (World(0.1, 2.2, image=3.0), False),  # the image would pay for it
        (World(0.1, 2.2, image=0.4), True),
        (World(0.1, 2.2, sparse=True), True),
    ],
)
def test_it_is_on_where_it_pays(world: World, on: bool) -> None:
    record = world.run()
    assert record.guided == record.images == on
    assert record.gain is not None
    assert record.low is not None
    assert record.high is not None
    assert record.low < gain(world) < record.high
    assert record.line().startswith(f"guiding {'on' if on else 'off'}: {record.gain:.2g} times the efficiency here (")
    assert ("the image, of the same samples" in record.line()) == (not on and record.low > 1)


@pytest.mark.parametrize("entries", [3, 200])
@pytest.mark.parametrize("sparse", [False, True])
def test_the_interval_holds_the_gain_as_often_as_it_says(entries: int, sparse: bool) -> None:
    """Without what single times may be off, the level is the nominal one; learning is a part of the gain."""
    inside = 0
    for seed in range(100):
        world = World(0.25, 2.0, walk=3.0, python=40.0, sparse=sparse, entries=entries, seed=seed)
        record = world.run()
        assert record.low is not None
        assert record.high is not None
        inside += record.low * TIMING_NOISE < gain(world) < record.high / TIMING_NOISE
    print(entries, sparse, inside)
    # 95 of 100 are expected; fewer than 86 have a probability of 1e-4.
    assert inside >= 86


def on_by_accident(**world: Any) -> int:
    """Of 100 worlds, in how many it is on."""
    return sum(World(**world, seed=seed).run().guided for seed in range(100))


def test_where_it_does_not_pay_it_is_hardly_ever_on() -> None:
    # What it gains, learning costs again: 0.8 * (1 + 0.1 + 0.15).
    world = {"variance": 0.8, "walk": 0.7, "python": 16.8}
    assert gain(World(**world)) == pytest.approx(1)
    # 2.5 are expected on this side, were times not allowed to be off, and one more for the looks before the last.
    assert on_by_accident(**world) <= 9
    assert on_by_accident(**world, entries=3) <= 9


def test_a_fault_that_forgets_what_learning_costs_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is seen by the tests above: the same worlds are called better then."""
    monkeypatch.setattr(GuidingPilot, "_more_ms", lambda self: 0.0)
    assert on_by_accident(variance=0.8, walk=0.7, python=16.8) > 50


def test_a_run_pays_for_as_much_learning_as_it_has() -> None:
    """What is worth nothing where a table learns from each seventh set of samples is worse where it learns from most of
    them, as in a short run, and better where it rarely does."""
    world, gains = {"variance": 0.8, "walk": 0.7, "python": 16.8}, []
    for lessons in (3 / 4, SIZES.lessons, 1 / 16):
        sizes = replace(SIZES, lessons=lessons)
        by_hand = 1 / (0.8 * (1 + (0.7 * 16 + 16.8) * lessons / 16))
        assert gain(World(**world), sizes) == pytest.approx(by_hand)
        record = World(**world).run(sizes)
        assert record.low < by_hand < record.high
        gains.append(record.gain)
    assert gains[0] < 0.6 * gains[1] < gains[1] < gains[2]


@pytest.mark.parametrize("spp", [1, 4, 16, 64, 1024])
@pytest.mark.parametrize(("overhead", "python"), [(0.0, 0.0), (0.1, 1.0), (1.0, 100.0), (1000.0, 1000.0)])
@pytest.mark.parametrize("time", [1.0, 3.0, 10.0])
def test_its_share_is_kept(spp: int, overhead: float, python: float, time: float) -> None:
    world = World(0.1, time, overhead=overhead, python=python, walk=1.5)
    record = world.run(Sizes(spp, spp, spp, False, 8, 1 / 7, GUIDING_LONGER), GUIDING_SHARE)
    taken = [call for call in world.calls if call[0] is not False]
    assert all(call[2] <= spp for call in world.calls)
    if record.gain is None:
        assert "to measure it would cost more than" in record.note or "too few to tell" in record.note
        assert not record.guided
    else:
        assert record.rounds >= LEAST_ROUNDS
        assert 1 <= [call[0] for call in taken].count("learn") <= LEARNINGS
    # The last round may be longer than those before.
    assert record.share <= GUIDING_SHARE * 1.05
    assert record.share * ITERATIONS * (spp + overhead) == pytest.approx(1e3 * record.measure_s, rel=1e-6)


def test_what_a_step_takes_beside_its_kernels_counts_as_often_as_a_run_has_it() -> None:
    """Half the variance for three times the kernels pays where these are a small part of what is waited for."""
    world = World(0.5, 3.0, overhead=160.0)
    record, trial = world.run(), SIZES.trial
    python = world.overhead * trial / SIZES.call
    learning = (world.walk * SIZES.part + world.python) * SIZES.lessons * trial / SIZES.call
    assert record.low < (trial + python) / (0.5 * (3 * trial + python + learning)) < record.high
    assert record.guided
    assert not World(0.5, 3.0).run().guided
    iteration_ms = SIZES.step + SIZES.step / SIZES.call * world.overhead
    assert record.share * ITERATIONS * iteration_ms == pytest.approx(1e3 * record.measure_s, rel=1e-6)


@pytest.mark.parametrize(("python", "walks"), [(10.0, 2), (30.0, 1), (60.0, 0)])
def test_a_second_walk_is_left_out_where_there_is_no_time_for_it(python: float, walks: int) -> None:
    world = World(0.1, 1.0, overhead=1.0, python=python, walk=1.5)
    record = world.run(Sizes(16, 16, 16, False, 8, 1 / 7, GUIDING_LONGER), GUIDING_SHARE)
    assert [call[0] for call in world.calls].count("learn") == max(walks, 1)  # one, to see what it takes
    assert (record.rounds >= LEAST_ROUNDS) == (walks > 0)
    assert record.share <= GUIDING_SHARE * 1.05


def test_samples_are_no_more_than_those_of_a_pass() -> None:
    world = World(0.1, 2.0)
    record = world.run(replace(SIZES, step=4096, call=1024, part=8))
    assert max(call[2] for call in world.calls) == 8
    assert record.guided


def test_few_entries_are_measured_more_often() -> None:
    assert World(0.02, 2.0, entries=3).run().guided
    assert World(0.02, 2.0, entries=3).run().rounds > World(0.02, 2.0).run().rounds


def test_images_with_samples_of_their_own_are_guided_where_that_pays() -> None:
    for image, image_time, guided in [(0.2, 2.0, True), (2.0, 1.0, False), (0.2, 10.0, False)]:
        record = World(0.05, 2.0, image=image, image_time=image_time, alone=True).run()
        assert record.guided
        assert record.images == guided
        assert record.line().startswith("guiding on: " if guided else "guiding on for gradients, off for images: ")
        # What the image takes is a part of the step.
        own = image_time if guided else 1.0
        learning = (16 + 1) * SIZES.lessons / 16
        assert record.gain == pytest.approx((1 + 1) / (0.05 * (2 + own + learning)), rel=0.2)


def test_what_is_not_clear_is_looked_at_longer() -> None:
    """What is, is not; and nothing is beyond its share."""
    assert World(0.1, 2.2).run().rounds == SIZES.rounds
    assert World(3.0, 1.0).run().rounds == SIZES.rounds
    close = World(0.8, 1.0, walk=0.1)
    assert close.run().rounds == LOOKS * SIZES.rounds
    assert close.run(share=0.3 * GUIDING_SHARE).rounds < SIZES.rounds


def test_no_noise_is_no_gain() -> None:
    class Still(World):
        def _noisy(self, random: np.random.Generator, variance: float) -> np.ndarray:
            return np.ones(4)

    record = Still().run()
    assert not record.guided
    assert record.note == "gradients have no noise"


def test_a_record_survives_json_and_nothing_else_is_one() -> None:
    record = World(0.1, 2.2).run()
    data = record.to_json()
    assert GuidedRecord.from_json(data) == record
    assert GuidedRecord.from_json(World(0.1, 2.2, overhead=1e4, python=1e6).run().to_json()).gain is None
    for wrong in ({}, {**data, "guided": 1}, {**data, "gain": "2"}, {**data, "rounds": 1.5}, {**data, "more": 1}):
        with pytest.raises(TypeError):
            GuidedRecord.from_json(wrong)


def test_walks_that_are_learned_from_come_before_all_steps_that_are_guided() -> None:
    world = World(0.1, 2.2)
    world.run()
    kinds = [call[0] for call in world.calls]
    assert kinds.index(True) > max(k for k, kind in enumerate(kinds) if kind == "learn")
    assert LEARNINGS == kinds.count("learn")
