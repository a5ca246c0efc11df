"""`guiding: auto`, tested with simulated steps and in whole runs of a small scene. Some tests also cover `sequence:
auto`.
"""

from __future__ import annotations

import gc
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optimization.deciding import SIZES, SMALL, World, begin, fix_times, inspected, is_even, operations
from runs.going_on import begin_alone, differences, left_over, optimize, run_and_kill

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.guiding.tables import Guiding, Purpose
from reslrb_cli.integrators.step import make_integrator
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.optimization import assemble as assembling
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.race import (
    GUIDING_SHARE,
    ITERATIONS,
    LEARNINGS,
    LEAST_ROUNDS,
    LOOKS,
    TIMING_NOISE,
    Sizes,
    Step,
    Turns,
    lessons,
)
from reslrb_cli.optimization.autotune.sampling import (
    FEW_ENTRIES,
    GUIDING_LONGER,
    ROUNDS,
    ROUNDS_OF_FEW,
    GuidingPilot,
    SequencePilot,
    StepTrial,
    sizes,
    table_bytes,
)
from reslrb_cli.optimization.forecast import _with_learning
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.records.checkpoint import STATE_FILE, read_state
from reslrb_cli.records.decisions import GuidedRecord, PaidRecord, SequenceRecord
from reslrb_cli.records.manifest import read_manifest

# `guiding: auto` in whole runs of a small scene: the decision, the paths that are then traced, and what is kept.  Times
# are given, so that every machine decides alike. Variances come from the scene, whose lamp sends one path in twenty to
# a visible place.

AUTO = ["integrator.guiding=auto", *SMALL]
RUN = Path("runs/tiny")
#: Field of a problem that holds the decision on an option, and the option's words for off and on.
FIELD = {"guiding": "guided", "sequence": "sequence"}
WORDS = {"guiding": ("off", "on"), "sequence": ("independent", "low_discrepancy")}


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return begin(tmp_path, monkeypatch)


def take_times(monkeypatch: pytest.MonkeyPatch, guided_ms: float) -> None:
    fix_times(monkeypatch, {"guiding": guided_ms})


def decided(monkeypatch: pytest.MonkeyPatch, guided_ms: float, *settings: str, **options: Any) -> Problem:
    take_times(monkeypatch, guided_ms)
    return assemble(load("tiny.yaml", [*AUTO, *settings]), **options)


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    ("option", "adjoint"),
    [
        ("guiding", "batched"),
        ("sequence", "batched"),
        *(pytest.param("guiding", adjoint, marks=pytest.mark.long) for adjoint in ("correlated", "independent")),
    ],
)
def test_on_enables_guiding_and_off_removes_it(
    option: str, adjoint: str, experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the option off, a step's kernels equal those of a run without `auto`, operation by operation."""
    counts, name = [], FIELD[option]
    for other_ms, asked in ((0.1, True), (1000.0, True), (0.1, False)):
        fix_times(monkeypatch, {option: other_ms})
        settings = [*SMALL, f"integrator.{option}=auto"] if asked else SMALL
        problem = assemble(load("tiny.yaml", [*settings, f"run.adjoint={adjoint}"]))
        found, guiding = getattr(problem, name), problem.integrator.preparation.guiding
        print(found)
        assert [each for each in FIELD.values() if getattr(problem, each)] == ([name] if asked else [])
        is_on = asked and other_ms < 1
        if asked:
            assert (found.low or 0) > 1 if is_on else (found.high or 2) < 1
            assert found.setting == WORDS[option][is_on]
            assert getattr(found, "images", is_on) == is_on
        assert (guiding is not None) == (is_on and option == "guiding")
        assert guiding is None or guiding.learned == {}  # the run begins with an empty table
        assert is_even(problem) == (is_on and option == "sequence")
        assert not any(np.any(np.array(problem.optimizer.gradient(key))) for key in problem.selection.keys)
        counts.append(operations(problem))
        del problem, guiding
        gc.collect()  # scenes alive at the same time change each other's kernels
    on, off, plain = counts
    assert off == plain
    assert on != plain


@pytest.mark.usefixtures("llvm")
def test_the_sequence_is_independent_of_guiding(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for guided_ms in (1.0, 1000.0):
        problem = decided(monkeypatch, guided_ms, "integrator.sequence=low_discrepancy")
        plan = problem.integrator.plan(problem.scene, problem.scene.sensors()[0])
        assert (plan.grid is None) == (guided_ms > 1)
        assert plan.sequence is not None


@pytest.mark.usefixtures("llvm")
def test_images_are_not_guided_if_it_does_not_pay(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = StepTrial.take

    def slow(self: StepTrial, other: bool, round: int, spp: int) -> Step:
        taken = take(self, other, round, spp)
        taken.image_ms = 1000.0 if other else 1.0
        return taken

    take_times(monkeypatch, 0.5)
    monkeypatch.setattr(StepTrial, "take", slow)
    problem = assemble(load("tiny.yaml", [*AUTO, "run.adjoint=independent"]))
    assert problem.guided is not None
    assert problem.guided.guided
    assert not problem.guided.images
    guiding = problem.integrator.preparation.guiding
    assert [guiding.serves(purpose) for purpose in (Purpose.IMAGE, Purpose.GRADIENT, Purpose.BOTH)] == [
        False,
        True,
        True,
    ]
    plain = assemble(load("tiny.yaml", [*AUTO[1:], "run.adjoint=independent"]))
    images = [each.render(0, 4, 3, "test") for each in (problem, plain)]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-5)  # both use the same paths


def seeds_of_parts(monkeypatch: pytest.MonkeyPatch, experiment: Path) -> tuple[set[int], set[int]]:
    """Return the seeds of walks from which a table learned, and the seeds of steps. The function fails if the table
    learns during the steps.
    """
    drawn: dict[str, set[int]] = {"learn": set(), "take": set()}
    problem = assemble(load("tiny.yaml", AUTO[1:]))
    plain, guided = (problem.integrator.afresh(guided=on) for on in (False, True))
    trial, job = StepTrial(problem, "guiding", plain, guided), StepTrial._job
    part = "learn"

    def spy(self: StepTrial, view: Any, number: int, spp: int) -> Any:
        drawn[part].add(number)
        return job(self, view, number, spp)

    monkeypatch.setattr(StepTrial, "_job", spy)
    for round in range(2):
        trial.learn(round, 4)
    learned = trial._tracers[True].preparation.guiding.learned[0]
    before = learned.sums.copy(), learned.draws.copy()
    part = "take"
    for round in range(4):
        for guided in (False, True):
            trial.take(guided, round, 4)
    after = trial._tracers[True].preparation.guiding.learned[0]
    assert np.array_equal(before[0], after.sums)
    assert np.array_equal(before[1], after.draws)
    assert trial._tracers[False].preparation.guiding is None
    return drawn["learn"], drawn["take"]


@pytest.mark.usefixtures("llvm")
def test_learning_paths_are_not_used_for_the_decision(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learned, judged = seeds_of_parts(monkeypatch, experiment)
    assert len(learned) == 2
    assert len(judged) == 8
    assert not learned & judged


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("fault", ["seeds", "held"])
def test_faults_of_the_decision_are_found(fault: str, experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two faults are planted. Steps reuse the seeds of learning, or a table learns from the steps that judge it."""
    if fault == "seeds":
        monkeypatch.setattr(StepTrial, "_seed", lambda self, round, view, what: round)
        learned, judged = seeds_of_parts(monkeypatch, experiment)
        assert learned & judged
    else:
        from reslrb_cli.guiding.tables import Guiding

        monkeypatch.setattr(Guiding, "due", lambda self, number: True)
        with pytest.raises(AssertionError):
            seeds_of_parts(monkeypatch, experiment)


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(("option", "part"), [("guiding", "guided emission"), ("sequence", "low-discrepancy numbers")])
def test_a_run_reports_remembers_and_records_the_decision(
    option: str, part: str, experiment: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fix_times(monkeypatch, {option: 0.1})
    settings, name = [f"integrator.{option}=auto", *SMALL], FIELD[option]
    assert optimize("tiny.yaml", *(word for text in settings for word in ("--set", text))) == 0
    said = capsys.readouterr().err
    found = read_manifest(RUN)[name]
    assert found["guided" if option == "guiding" else "low_discrepancy"]
    assert not found["cached"]
    gain = f"{found['gain']:.2g} times the efficiency here ("
    line = f"{option} {WORDS[option][True]}: {gain}"
    chosen = f"{option} {WORDS[option][True]}"
    assert f"chosen by measurement: {chosen} (-v gives the reasons)" in said
    assert f"{option}: auto" in (RUN / "config.yaml").read_text()
    assert line in (RUN / "report.html").read_text()
    _, values = read_state(RUN / "checkpoint" / STATE_FILE)
    assert values[name] == found
    assert option != "guiding" or values["guiding"]["0"] > 0
    told: list[str] = []
    again = assemble(load("tiny.yaml", settings), told.append, PilotCache())
    record = getattr(again, name)
    assert record.to_json() == {**found, "cached": True}
    assert told[-1] == f"chosen by measurement: {chosen} (-v gives the reasons)"
    assert record.line() == f"{line}{found['low']:.2g} to {found['high']:.2g})"
    assert record.line(cost=True) == f"{record.line()} (as an earlier run measured)"
    assert is_even(again) == (option == "sequence")
    row = next(line for line in inspected(capsys, str(RUN)) if part in line)
    assert row.split()[0] == "needed"
    # At most as many cells as the 16,384 paths of a batch can distinguish.
    assert option != "guiding" or "65536 cells, 6.1 MiB" in row
    assert f"{option}: auto, {gain}" in row
    row = next(line for line in inspected(capsys, "tiny.yaml", "--set", settings[0]) if part in line)
    assert row.startswith("  left out")
    assert row.endswith(f"{option}: auto, which a run decides by measurement")


@pytest.mark.usefixtures("llvm")
def test_a_resumed_run_keeps_the_decision_bit_by_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Guiding and the sequence are decided once, and a resumed run restores both decisions."""
    begin_alone(tmp_path, monkeypatch)
    fix_times(monkeypatch, {"guiding": 0.2, "sequence": 0.1, "sequence alone": 1000.0})
    settings = [
        *AUTO[:3],
        "run.measuring=1000",
        "integrator.sequence=auto",
        "run.iterations=8",
        "run.checkpoint_every={iterations: 3}",
        "run.certainty=false",
    ]
    whole, left = run_and_kill(monkeypatch, 7, *(word for text in settings for word in ("--set", text)))
    monkeypatch.setattr(assembling, "settle", lambda *args: pytest.fail("measured again"))
    (tmp_path / "cache" / "pilot.json").unlink()
    assert optimize("--resume", str(left), "--quiet") == 0
    assert read_manifest(left)["guided"]["guided"]
    assert read_manifest(left)["sequence"]["low_discrepancy"]
    assert differences(whole, left) == []
    assert left_over(left) == []


@pytest.mark.usefixtures("llvm")
def test_a_memory_budget_too_small_for_tables_disables_guiding(
    experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    budget = "run.memory_budget={}"
    roomy = decided(monkeypatch, 1.0, budget.format(64))
    assert roomy.guided is not None
    assert roomy.guided.guided
    assert roomy.memory is not None
    plain = assemble(load("tiny.yaml", [*AUTO[1:], budget.format(64)]))
    assert plain.memory is not None
    more = roomy.memory.expected_bytes.total - plain.memory.expected_bytes.total
    assert more == pytest.approx(table_bytes(roomy), rel=0.05)
    tight = decided(monkeypatch, 1.0, budget.format(4))
    assert tight.guided is not None
    assert tight.guided.note.startswith("run.memory_budget has no room for tables of ")
    assert tight.integrator.preparation.guiding is None


@pytest.mark.usefixtures("llvm")
def test_a_damaged_record_is_measured_again(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Damaged(PilotCache):
        def get(self, key: str) -> dict[str, Any] | None:
            return {"guided": "maybe"}

    said: list[str] = []
    problem = decided(monkeypatch, 1.0, say=said.append, cache=Damaged())
    assert problem.guided is not None
    assert not problem.guided.cached
    assert any(line.startswith("measuring ") for line in said)


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("option", ["guiding", "sequence"])
def test_comparisons_and_scripts_need_an_explicit_choice(option: str) -> None:
    """In measurements, the experiment's `auto` counts as off. An `auto` in a list of methods or in a script is
    refused.
    """
    named = ("on", "off") if option == "guiding" else WORDS[option]
    config = load(Path(__file__).parents[2] / "configs" / "furnace.yaml")
    [plain, asked] = parse_cases(f"reslrb:stack,reslrb:gather({option}=auto)")
    assert plain.at(config, 4, known=True).integrator.options()[option] == WORDS[option][False]
    with pytest.raises(ConfigError, match=f"compare `{named[0]}` with `{named[1]}`"):
        asked.at(config, 4, known=True)
    with pytest.raises(ValueError, match=f"use {named[0]} or {named[1]}"):
        make_integrator("reslrb", **{option: "auto"})


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("option", ["guiding", "sequence"])
def test_an_explicit_choice_is_not_measured(option: str, experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StepTrial, "take", lambda *args: pytest.fail("measured"))
    for is_on, word in enumerate(WORDS[option]):
        problem = assemble(load("tiny.yaml", [f"integrator.{option}={word}", *SMALL]))
        assert problem.guided is problem.sequence is None
        assert (problem.integrator.preparation.guiding is not None) == (is_on and option == "guiding")
        assert is_even(problem) == (is_on and option == "sequence")


# Whether guided emission pays, decided on fabricated steps: what is on, what is off, at what cost, and with what
# confidence.


def gain(world: World, sizes: Sizes = SIZES) -> float:
    """Return the true gain of a world, computed by hand."""
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
        (World(0.1, 2.2, image=3.0), False),  # the image would lose efficiency
        (World(0.1, 2.2, image=0.4), True),
        (World(0.1, 2.2, sparse=True), True),
    ],
)
def test_it_is_on_if_it_pays(world: World, on: bool) -> None:
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
def test_the_interval_of_the_gain_has_its_coverage(entries: int, sparse: bool) -> None:
    """Without the allowance for timing errors, the interval has its nominal level. The gain includes the cost of
    learning.
    """
    inside = 0
    for seed in range(100):
        world = World(0.25, 2.0, walk=3.0, python=40.0, sparse=sparse, entries=entries, seed=seed)
        record = world.run()
        assert record.low is not None
        assert record.high is not None
        inside += record.low * TIMING_NOISE < gain(world) < record.high / TIMING_NOISE
    print(entries, sparse, inside)
    # Of 100 intervals, 95 are expected. A count below 86 has a probability of 1e-4.
    assert inside >= 86


def on_by_accident(**world: Any) -> int:
    """Count the worlds, out of 100, with guiding on."""
    return sum(World(**world, seed=seed).run().guided for seed in range(100))


def test_it_is_rarely_on_if_it_does_not_pay() -> None:
    # Learning costs as much as guiding gains: 0.8 * (1 + 0.1 + 0.15).
    world = {"variance": 0.8, "walk": 0.7, "python": 16.8}
    assert gain(World(**world)) == pytest.approx(1)
    # Without the allowance for times, 2.5 are expected on this side. The looks before the last add one more.
    assert on_by_accident(**world) <= 9
    assert on_by_accident(**world, entries=3) <= 9


def test_a_decision_without_the_cost_of_learning_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the cost of learning, guiding is enabled in most worlds where it gains nothing."""
    monkeypatch.setattr(GuidingPilot, "_more_ms", lambda self: 0.0)
    assert on_by_accident(variance=0.8, walk=0.7, python=16.8) > 50


def test_a_run_pays_for_its_amount_of_learning() -> None:
    """A world has no gain where a table learns from each seventh set of samples. The gain falls where the table learns
    from most sets, as in a short run, and rises where the table rarely learns.
    """
    world, gains = {"variance": 0.8, "walk": 0.7, "python": 16.8}, []
    for learned in (3 / 4, SIZES.lessons, 1 / 16):
        sizes = replace(SIZES, lessons=learned)
        by_hand = 1 / (0.8 * (1 + (0.7 * 16 + 16.8) * learned / 16))
        assert gain(World(**world), sizes) == pytest.approx(by_hand)
        record = World(**world).run(sizes)
        assert record.low < by_hand < record.high
        gains.append(record.gain)
    assert gains[0] < 0.6 * gains[1] < gains[1] < gains[2]


@pytest.mark.parametrize("spp", [1, 4, 16, 64, 1024])
@pytest.mark.parametrize(("overhead", "python"), [(0.0, 0.0), (0.1, 1.0), (1.0, 100.0), (1000.0, 1000.0)])
@pytest.mark.parametrize("time", [1.0, 3.0, 10.0])
def test_its_share_of_the_time_is_kept(spp: int, overhead: float, python: float, time: float) -> None:
    world = World(0.1, time, overhead=overhead, python=python, walk=1.5)
    record = world.run(Sizes(spp, spp, spp, False, 8, 1 / 7, GUIDING_LONGER), GUIDING_SHARE)
    taken = [call for call in world.calls if call[0] is not False]
    assert all(call[2] <= spp for call in world.calls)
    if record.gain is None:
        dear = re.fullmatch(r"measuring it would take more than [\d.e+-]+ iterations?", record.note)
        assert dear or "too few to decide" in record.note
        assert not record.guided
    else:
        assert record.rounds >= LEAST_ROUNDS
        assert 1 <= [call[0] for call in taken].count("learn") <= LEARNINGS
    # The last round may take longer than the earlier rounds.
    assert record.share <= GUIDING_SHARE * 1.05
    assert record.share * ITERATIONS * (spp + overhead) == pytest.approx(1e3 * record.measure_s, rel=1e-6)


def test_costs_outside_kernels_count_as_often_as_in_a_run() -> None:
    """Half the variance at three times the kernel time pays off where kernels are a small part of the elapsed time."""
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
def test_a_second_walk_is_left_out_without_time(python: float, walks: int) -> None:
    world = World(0.1, 1.0, overhead=1.0, python=python, walk=1.5)
    record = world.run(Sizes(16, 16, 16, False, 8, 1 / 7, GUIDING_LONGER), GUIDING_SHARE)
    assert [call[0] for call in world.calls].count("learn") == max(walks, 1)  # one walk, to measure its cost
    assert (record.rounds >= LEAST_ROUNDS) == (walks > 0)
    assert record.share <= GUIDING_SHARE * 1.05


def test_samples_fit_into_a_pass() -> None:
    world = World(0.1, 2.0)
    record = world.run(replace(SIZES, step=4096, call=1024, part=8))
    assert max(call[2] for call in world.calls) == 8
    assert record.guided


def test_few_entries_are_measured_more_often() -> None:
    assert World(0.02, 2.0, entries=3).run().guided
    assert World(0.02, 2.0, entries=3).run().rounds > World(0.02, 2.0).run().rounds


def test_images_with_their_own_samples_are_guided_if_it_pays() -> None:
    for image, image_time, guided in [(0.2, 2.0, True), (2.0, 1.0, False), (0.2, 10.0, False)]:
        record = World(0.05, 2.0, image=image, image_time=image_time, alone=True).run()
        assert record.guided
        assert record.images == guided
        assert record.line().startswith("guiding on: " if guided else "guiding on for gradients, off for images: ")
        # The time of the image is a part of the step time.
        own = image_time if guided else 1.0
        learning = (16 + 1) * SIZES.lessons / 16
        assert record.gain == pytest.approx((1 + 1) / (0.05 * (2 + own + learning)), rel=0.2)


def test_unclear_results_are_measured_longer() -> None:
    """Only close results are measured longer, and all stay within their share."""
    assert World(0.1, 2.2).run().rounds == SIZES.rounds
    assert World(3.0, 1.0).run().rounds == SIZES.rounds
    close = World(0.8, 1.0, walk=0.1)
    assert close.run().rounds == LOOKS * SIZES.rounds
    assert close.run(share=0.3 * GUIDING_SHARE).rounds < SIZES.rounds


@pytest.mark.parametrize("pilot", [GuidingPilot, SequencePilot])
def test_zero_noise_gives_no_gain(pilot: type[Turns[Any]], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(World, "_noisy", lambda self, random, variance: np.ones(4))
    record = World(pilot=pilot).run()
    assert record.setting in ("off", "independent")
    assert record.note == "gradients have no noise"


@pytest.mark.parametrize(("kind", "pilot"), [(GuidedRecord, GuidingPilot), (SequenceRecord, SequencePilot)])
def test_a_record_survives_json_and_other_data_is_refused(kind: type[PaidRecord], pilot: type[Turns[Any]]) -> None:
    record = World(0.1, 2.2, pilot=pilot).run()
    data = record.to_json()
    assert kind.from_json(data) == record
    assert kind.from_json(World(0.1, 2.2, overhead=1e4, python=1e6, pilot=pilot).run().to_json()).gain is None
    switch = "guided" if kind is GuidedRecord else "low_discrepancy"
    others = {"guided": True, "low_discrepancy": True, "rounds": 1.5, "more": 1, "gain": "2", switch: 1}
    for wrong in ({}, *({**data, key: value} for key, value in others.items())):
        with pytest.raises(TypeError):
            kind.from_json(wrong)


def test_learning_walks_come_before_all_guided_steps() -> None:
    world = World(0.1, 2.2)
    world.run()
    kinds = [call[0] for call in world.calls]
    assert kinds.index(True) > max(k for k, kind in enumerate(kinds) if kind == "learn")
    assert LEARNINGS == kinds.count("learn")


# Share of learning in a run: by the run's length, and in the forecast from steps that learned.


@pytest.mark.parametrize("iterations", [1, 3, 23])
@pytest.mark.parametrize("how", [["run.adjoint=correlated"], ["run.spp=8"]], ids=str)
def test_a_run_learns_as_often_as_planned(
    how: list[str], iterations: int, llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path, monkeypatch)
    settings = [*how, f"run.iterations={iterations}", "integrator.guiding=on", "integrator.estimator=stack"]
    problem, learned = assemble(load("tiny.yaml", ["run.adjoint=batched", *settings])), []
    right = Guiding.due

    def due(self: Guiding, number: int) -> bool:
        learned.append(right(self, number))
        return learned[-1]

    monkeypatch.setattr(Guiding, "due", due)
    for iteration in range(iterations):
        loop.gradient(problem, iteration)
    assert sum(learned) == pytest.approx(iterations * lessons(problem))
    size = sizes(problem, 1.0)
    few = sum(problem.selection.array(key).size for key in problem.selection.keys) < FEW_ENTRIES
    assert size.rounds == (ROUNDS_OF_FEW if few else ROUNDS)
    assert size.lessons * size.step / size.call == pytest.approx(lessons(problem))


@pytest.mark.parametrize("lesson", [0.0, 0.5, 3.0])
def test_the_cost_of_learning_counts_as_often_as_in_a_run(lesson: float) -> None:
    """Learning occurs in two of ten timed steps, or in two of three."""
    for learned in ([0, 0, 1, 0, 0, 0, 0, 0, 1, 0], [2, 0, 1]):
        times = [1.0 + lesson * count for count in learned]
        for mean in (0.0, 0.08, 2.0):
            assert _with_learning(times, learned, mean) == pytest.approx(1 + lesson * mean)


def test_without_variation_of_learning_only_the_mean_is_known() -> None:
    assert _with_learning([1.0, 3.0], [1, 2], 0.5) == 2
    assert _with_learning([1.0, 3.0], [0, 0], 0.5) == 2
