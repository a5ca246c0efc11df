"""`guiding: auto`, tested with simulated steps and in whole runs of a small scene, and the rule of `sequence: auto`."""

from __future__ import annotations

import gc
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optimization.deciding import SIZES, SMALL, World, begin, decision, fix_times, inspected, is_even, operations
from runs.going_on import optimize
from turns import a_few, taking_turns

from reslrb_cli.config.loader import load
from reslrb_cli.errors import ConfigError
from reslrb_cli.guiding.tables import Guiding
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.measure.methods import parse_cases
from reslrb_cli.optimization import loop
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.race import (
    FEW_ENTRIES,
    LEAST_ROUNDS,
    ROUNDS,
    ROUNDS_OF_FEW,
    TIMING_NOISE,
    Finding,
    Sizes,
    Step,
    StepTrial,
    Turns,
    lessons,
    sizes,
)
from reslrb_cli.optimization.autotune.sampling import GUIDING_LONGER
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.checkpoint import STATE_FILE, read_state
from reslrb_cli.records.decisions import Decision, DecisionCache
from reslrb_cli.records.manifest import read_manifest

# `guiding: auto` in whole runs of a small scene: the decision, the paths that are then traced, and what is kept.  Times
# are given, so that every machine decides alike. Variances come from the scene, whose lamp sends one path in twenty to
# a visible place.

AUTO = ["integrator.guiding=auto", *SMALL]
RUN = Path("runs/tiny")
#: An option's words for off and on.
WORDS = {"guiding": ("off", "on"), "sequence": ("independent", "low_discrepancy")}


@pytest.fixture
def experiment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return begin(tmp_path, monkeypatch)


def decided(monkeypatch: pytest.MonkeyPatch, guided_ms: float, *settings: str, **options: Any) -> Problem:
    fix_times(monkeypatch, {"guiding": guided_ms})
    return assemble(load("tiny.yaml", [*AUTO, *settings]), **options)


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    "adjoint",
    ["batched", *(pytest.param(adjoint, marks=pytest.mark.long) for adjoint in ("correlated", "independent"))],
)
def test_on_enables_guiding_and_off_removes_it(adjoint: str, experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With guiding off, a step's kernels equal those of a run without `auto`, operation by operation."""
    counts = []
    for guided_ms, asked in ((0.1, True), (1000.0, True), (0.1, False)):
        fix_times(monkeypatch, {"guiding": guided_ms})
        settings = AUTO if asked else AUTO[1:]
        problem = assemble(load("tiny.yaml", [*settings, f"run.adjoint={adjoint}"]))
        guiding, is_on = problem.integrator.preparation.guiding, asked and guided_ms < 1
        assert [each.setting for each in problem.decisions] == (["guiding"] if asked else [])
        for found in problem.decisions:
            assert (found.low or 0) > 1 if is_on else (found.high or 2) < 1
            assert found.value == WORDS["guiding"][is_on]
        assert (guiding is not None) == is_on
        assert guiding is None or guiding.learned == {}  # the run begins with an empty table
        assert not any(np.any(np.array(problem.optimizer.gradient(key))) for key in problem.selection.keys)
        counts.append(operations(problem))
        del problem, guiding
        gc.collect()  # scenes alive at the same time change each other's kernels
    on, off, plain = counts
    assert off == plain
    assert on != plain


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("sequence", a_few(["low_discrepancy", "auto"], ()))
def test_a_named_sequence_stays_and_auto_depends_on_guiding(
    sequence: str, experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Guiding competes with low-discrepancy numbers, which the run uses without guiding."""
    take, raced = StepTrial.take, set()

    def spy(self: StepTrial, other: bool, round: int, spp: int) -> Step:
        plan = self._tracers[other].plan(self._problem.scene, self._problem.scene.sensors()[0])
        raced.add((other, plan.grid is not None, plan.sequence is not None))
        return take(self, other, round, spp)

    monkeypatch.setattr(StepTrial, "take", spy)
    for guided_ms in (0.1, 1000.0):
        problem = decided(monkeypatch, guided_ms, f"integrator.sequence={sequence}")
        on = guided_ms < 1
        assert (problem.integrator.preparation.guiding is not None) == on
        assert is_even(problem) == (sequence != "auto" or not on)
        found = decision(problem, "sequence")
        assert (None if found is None else found.value) == (WORDS["sequence"][not on] if sequence == "auto" else None)
    assert raced == {(False, False, True), (True, True, sequence != "auto")}


@pytest.mark.usefixtures("llvm")
def test_the_sequence_follows_a_rule(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StepTrial, "take", lambda *args: pytest.fail("measured"))
    for guiding, value in (("off", "low_discrepancy"), ("on", "independent")):
        settings = [f"integrator.guiding={guiding}", "integrator.sequence=auto", *SMALL]
        problem = assemble(load("tiny.yaml", settings))
        assert [(each.setting, each.value) for each in problem.decisions] == [("sequence", value)]
        assert is_even(problem) == (value == "low_discrepancy")


@pytest.mark.usefixtures("llvm")
def test_guiding_is_off_if_images_would_lose(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    take = StepTrial.take

    def slow(self: StepTrial, other: bool, round: int, spp: int) -> Step:
        taken = take(self, other, round, spp)
        taken.image_ms = 1000.0 if other else 1.0
        return taken

    fix_times(monkeypatch, {"guiding": 0.5})
    monkeypatch.setattr(StepTrial, "take", slow)
    problem = assemble(load("tiny.yaml", [*AUTO, "run.adjoint=independent"]))
    [found] = problem.decisions
    assert (found.value, problem.integrator.preparation.guiding) == ("off", None)
    assert found.high is not None
    assert found.high < 1


@pytest.mark.usefixtures("llvm")
def test_runs_that_move_light_are_not_guided(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Turns, "run", lambda self: pytest.fail("measured"))
    settings = ["target.render.spp=4", "scene.size=[16, 16]", "run.measuring=1000"]
    problem = assemble(load(Path(__file__).parents[2] / "configs" / "lens_pose.yaml", settings))
    values = {each.setting: each.value for each in problem.decisions}
    assert values == {"sequence": "low_discrepancy", "guiding": "off", "blur": "1 px"}


def seeds_of_parts(monkeypatch: pytest.MonkeyPatch, experiment: Path) -> tuple[set[int], set[int]]:
    """Return the seeds of walks from which a table learned, and the seeds of steps. The function fails if the table
    learns during the steps.
    """
    drawn: dict[str, set[int]] = {"learn": set(), "take": set()}
    problem = assemble(load("tiny.yaml", AUTO[1:]))
    plain, guided = (problem.integrator.afresh(guiding=value) for value in ("off", "on"))
    trial, job = StepTrial(problem, "guiding", plain, guided), StepTrial._job
    part = "learn"

    def spy(self: StepTrial, view: Any, number: int, spp: int) -> Any:
        drawn[part].add(number)
        return job(self, view, number, spp)

    monkeypatch.setattr(StepTrial, "_job", spy)
    trial.learn(4)
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
    assert len(learned) == 1
    assert len(judged) == 8
    assert not learned & judged


@pytest.mark.long
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
def test_a_run_reports_remembers_and_records_the_decision(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fix_times(monkeypatch, {"guiding": 0.1})
    part = "guided emission"
    assert optimize("tiny.yaml", *(word for text in AUTO for word in ("--set", text))) == 0
    said = capsys.readouterr().err
    [found] = read_manifest(RUN)["decisions"]
    assert (found["setting"], found["value"], found["cached"]) == ("guiding", "on", False)
    gain = f"{found['gain']:.2g} times the efficiency here ("
    line = f"guiding on: {gain}"
    chosen = "chosen by measurement: guiding on (`reslrb --debug` gives the reasons)"
    assert chosen in said
    assert "guiding: auto" in (RUN / "config.yaml").read_text()
    assert line in (RUN / "report.html").read_text()
    _, values = read_state(RUN / "checkpoint" / STATE_FILE)
    assert values["decisions"] == [found]
    assert values["guiding"]["0"] > 0
    told: list[str] = []
    [record] = assemble(load("tiny.yaml", AUTO), told.append, DecisionCache()).decisions
    assert record.to_json() == {**found, "cached": True}
    assert told[-1] == chosen
    assert record.line() == f"{line}{found['low']:.2g} to {found['high']:.2g})"
    assert record.line(cost=True) == f"{record.line()} (as an earlier run measured)"
    row = next(line for line in inspected(capsys, str(RUN)) if part in line)
    assert row.split()[0] == "needed"
    # At most as many cells as the 16,384 paths of a batch can distinguish.
    assert "65536 cells, 5.2 MiB" in row
    assert f"guiding: auto, {gain}" in row
    row = next(line for line in inspected(capsys, "tiny.yaml", "--set", AUTO[0]) if part in line)
    assert row.startswith("  left out")
    assert row.endswith("guiding: auto, which a run decides")


@pytest.mark.usefixtures("llvm")
def test_a_damaged_decision_is_measured_again(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """This also holds for a file that a person has edited."""
    cache = DecisionCache()
    decided(monkeypatch, 1.0, cache=cache)
    file = experiment / "cache" / "decisions.json"
    whole = json.loads(file.read_text())
    for damage in ({"setting": "guiding"}, Decision(setting="guiding", value="perhaps", why="").to_json()):
        file.write_text(json.dumps(dict.fromkeys(whole, damage)))
        said = list[str]()
        [found] = decided(monkeypatch, 1.0, say=said.append, cache=cache).decisions
        assert not found.cached
        assert any(line.startswith("measuring ") for line in said)


@pytest.mark.usefixtures("llvm")
@taking_turns("setting", ["guiding", "paths"], "is_open", [True, False])
def test_only_a_decided_race_is_kept(
    setting: str, is_open: bool, experiment: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A race whose time was up may find another result in the next run."""
    cache, gain = DecisionCache(), (1.5, 0.8, 2.8)
    results = iter([Finding(False, gain, "", is_open), Finding(True, (1.6, 1.2, 2.1), "")])
    monkeypatch.setattr(StepTrial, "race", lambda self, *given, **options: next(results))
    settings = [f"integrator.{setting}=auto", "integrator.estimator=stack", *SMALL]
    first, second = (decision(assemble(load("tiny.yaml", settings), cache=cache), setting) for _ in range(2))
    assert first is not None
    assert second is not None
    assert (first.gain, first.low, first.high, first.cached) == (*gain, False)
    assert second.cached == (not is_open)
    assert (second.value == first.value) == (not is_open)


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("option", ["guiding", "sequence"])
def test_comparisons_need_an_explicit_choice_and_scripts_measure_nothing(option: str) -> None:
    """In measurements, the experiment's `auto` counts as off. An `auto` in a list of methods is refused. In a script,
    nothing is measured.
    """
    config = load(Path(__file__).parents[2] / "configs" / "furnace.yaml")
    [plain, asked] = parse_cases(f"reslrb:stack,reslrb:gather({option}=auto)")
    assert plain.at(config, 4, known=True).integrator.options()[option] == WORDS[option][False]
    with pytest.raises(ConfigError, match=f"`auto` is for whole runs; use `{WORDS[option][False]}`"):
        asked.at(config, 4, known=True)
    chosen = make_integrator("reslrb", **{option: "auto"}).preparation.sampling.chosen
    assert chosen[option] == {"guiding": "off", "sequence": "low_discrepancy"}[option]


@pytest.mark.usefixtures("llvm")
def test_compared_options_may_be_automatic() -> None:
    config = load(Path(__file__).parents[2] / "configs" / "furnace.yaml")
    [even, left] = parse_cases("reslrb:stack(sequence=low_discrepancy),reslrb:auto(sequence=auto)")
    assert even.at(config, 4, known=False).integrator.options()["sequence"] == "low_discrepancy"
    assert left.at(config, 4, known=False, auto=True).integrator.options()["sequence"] == "auto"


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("option", ["guiding", "sequence"])
def test_an_explicit_choice_is_not_measured(option: str, experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StepTrial, "take", lambda *args: pytest.fail("measured"))
    for is_on, word in enumerate(WORDS[option]):
        problem = assemble(load("tiny.yaml", [f"integrator.{option}={word}", *SMALL]))
        assert problem.decisions == []
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
    found = world.race()
    assert found.other == on
    assert found.gain is not None
    gained, low, high = found.gain
    assert low < gain(world) < high
    assert found.why().startswith(f"{gained:.2g} times the efficiency here (")
    assert ("the image, of the same samples" in found.why()) == (not on and low > 1)


@pytest.mark.long
@taking_turns("entries", [3, 200], "sparse", [False, True])
def test_the_interval_of_the_gain_has_its_coverage(entries: int, sparse: bool) -> None:
    """Without the allowance for timing errors, the interval has its nominal level. The gain includes the cost of
    learning.
    """
    inside = 0
    for seed in range(100):
        world = World(0.25, 2.0, walk=3.0, python=40.0, sparse=sparse, entries=entries, seed=seed)
        found = world.race().gain
        assert found is not None
        _, low, high = found
        inside += low * TIMING_NOISE < gain(world) < high / TIMING_NOISE
    print(entries, sparse, inside)
    # Of 100 intervals, 95 are expected. A count below 86 has a probability of 1e-4.
    assert inside >= 86


def on_by_accident(**world: Any) -> int:
    """Count the worlds, out of 100, with guiding on."""
    return sum(World(**world, seed=seed).race().other for seed in range(100))


@pytest.mark.long
def test_it_is_rarely_on_if_it_does_not_pay() -> None:
    # Learning costs as much as guiding gains: 0.8 * (1 + 0.1 + 0.15).
    world = {"variance": 0.8, "walk": 0.7, "python": 16.8}
    assert gain(World(**world)) == pytest.approx(1)
    # Without the allowance for times, 2.5 are expected on this side.
    assert on_by_accident(**world) <= 9
    assert on_by_accident(**world, entries=3) <= 9


@pytest.mark.long
def test_a_decision_by_the_gain_alone_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lower end of the interval is replaced by the gain itself."""
    right = Turns._gain

    def gain_alone(self: Turns) -> Any:
        gain, _, high = right(self) or pytest.fail("no gain")
        return gain, gain, high

    monkeypatch.setattr(Turns, "_gain", gain_alone)
    assert on_by_accident(variance=0.8, walk=0.7, python=16.8) > 30


@pytest.mark.long
def test_a_decision_without_the_cost_of_learning_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the cost of learning, guiding is enabled in most worlds where it gains nothing."""
    monkeypatch.setattr(Turns, "_learning_ms", lambda self: 0.0)
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
        gained, low, high = World(**world).race(sizes).gain or pytest.fail("no gain")
        assert low < by_hand < high
        gains.append(gained)
    assert gains[0] < 0.6 * gains[1] < gains[1] < gains[2]


@pytest.mark.parametrize("spp", [1, 4, 16, 64, 1024])
@pytest.mark.parametrize(("overhead", "python"), [(0.0, 0.0), (0.1, 1.0), (1.0, 100.0), (1000.0, 1000.0)])
@pytest.mark.parametrize("time", [1.0, 3.0, 10.0])
def test_the_time_limit_is_kept(spp: int, overhead: float, python: float, time: float) -> None:
    """The limit is the time of ten iterations. It includes the compilation of kernels."""
    world, limit_s = World(0.1, time, overhead=overhead, python=python, walk=1.5), 1e-2 * (spp + overhead)
    found = world.race(Sizes(spp, spp, spp, False, 8, 1 / 7, GUIDING_LONGER), limit_s)
    taken = [call for call in world.calls if call[0] is not False]
    assert all(call[2] <= spp for call in world.calls)
    learned = [call[0] for call in taken].count("learn")
    if found.gain is None:
        assert found.note.startswith("measuring it would take more than ") or "too few to decide" in found.note
        assert not found.other
        # One step and one walk show the time of the others.
        most = limit_s + 1e-3 * (4 * (spp * max(time, 1.5) + overhead) + python + 5.0)
    else:
        assert world.rounds >= LEAST_ROUNDS
        assert learned == 1
        most = 1.3 * limit_s  # the last round may take longer than the earlier rounds
    assert world.spent_s <= most


def test_costs_outside_kernels_count_as_often_as_in_a_run() -> None:
    """Half the variance at three times the kernel time pays off where kernels are a small part of the elapsed time."""
    world = World(0.5, 3.0, overhead=160.0)
    found, trial = world.race(), SIZES.trial
    python = world.overhead * trial / SIZES.call
    learning = (world.walk * SIZES.part + world.python) * SIZES.lessons * trial / SIZES.call
    assert found.gain is not None
    _, low, high = found.gain
    assert low < (trial + python) / (0.5 * (3 * trial + python + learning)) < high
    assert found.other
    assert not World(0.5, 3.0).race().other


def test_samples_fit_into_a_pass() -> None:
    world = World(0.1, 2.0)
    assert world.race(replace(SIZES, step=4096, call=1024, part=8)).other
    assert max(call[2] for call in world.calls) == 8


def test_few_entries_are_measured_more_often() -> None:
    few, many = World(0.02, 2.0, entries=3), World(0.02, 2.0)
    assert few.race().other
    assert many.race().other
    assert few.rounds > many.rounds


@pytest.mark.parametrize(
    ("world", "on"),
    [
        (World(0.05, 1.1, image=3.0), False),
        (World(0.05, 1.1, image=0.9), True),
        (World(0.05, 1.1, image=3.0, alone=True), False),
        (World(0.05, 1.1, image=0.9, alone=True), True),
        (World(0.05, 0.2, image=1.0, image_time=1.5, alone=True), False),  # less time in all, and more for the image
    ],
)
def test_the_image_must_not_lose_efficiency(world: World, on: bool) -> None:
    """This holds for images of the gradient's samples, and for images with their own samples."""
    found = world.race(guides=False)
    assert found.other == on
    assert found.gain is not None
    assert found.gain[1] > 1
    assert bool(found.note) == (not on)


def test_learning_costs_nothing_if_the_run_learns_either_way() -> None:
    world = World(0.1, 1.1, walk=5.0, python=100.0)
    for guides, expected in ((False, 1 / (0.1 * 1.1)), (True, gain(world))):
        found = world.race(guides=guides).gain
        assert found is not None
        assert found[0] == pytest.approx(expected, rel=0.2)


def test_the_number_of_rounds_is_fixed() -> None:
    """Only the limit ends a race earlier."""
    for world in (World(0.1, 2.2), World(3.0, 1.0), World(0.8, 1.0, walk=0.1)):
        world.race()
        assert world.rounds == SIZES.rounds
    part = World(0.8, 1.0, walk=0.1)
    part.race(limit_s=0.3 * world.spent_s)
    assert part.rounds < SIZES.rounds


@pytest.mark.parametrize("world", [World(0.7, 1.0, walk=0.1), World(1.0, 1.0), World(0.1, 1.0), World(0.1, 10.0)])
def test_a_race_that_its_limit_ended_is_open_unless_it_is_clear(world: World) -> None:
    """More time may decide it otherwise. A race that ends by itself is decided."""
    whole = replace(world, calls=[], spent_s=0.0)
    assert not whole.race().is_open
    kinds = set()
    for share in np.linspace(0.01, 0.99, 25):
        part = replace(world, calls=[], spent_s=0.0)
        found = part.race(limit_s=share * whole.spent_s)
        if part.rounds == SIZES.rounds:
            continue
        is_clear = found.gain is not None and not found.gain[1] <= 1 <= found.gain[2]
        assert found.is_open == (not is_clear)
        assert found.note or is_clear
        assert not (found.is_open and found.other)
        kinds.add(found.is_open)
    assert True in kinds


def test_zero_noise_gives_no_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(World, "_noisy", lambda self, random, variance: np.ones(4))
    found = World().race()
    assert (found.other, found.note) == (False, "gradients have no noise")


def test_a_decision_survives_json_and_other_data_is_refused() -> None:
    data = Decision(setting="guiding", value="on", why="it pays", gain=2.0, low=1.5, high=2.5).to_json()
    assert Decision.from_json(data).to_json() == data
    assert Decision.from_json({**data, "more": 1}).to_json() == data  # by a later version
    others: dict[str, Any] = {"setting": 1, "value": True, "gain": "2"}
    for wrong in ({}, *({**data, key: value} for key, value in others.items())):
        with pytest.raises(TypeError):
            Decision.from_json(wrong)


def test_learning_walks_come_before_all_guided_steps() -> None:
    world = World(0.1, 2.2)
    world.race()
    kinds = [call[0] for call in world.calls]
    assert kinds.index(True) > max(k for k, kind in enumerate(kinds) if kind == "learn")
    assert kinds.count("learn") == 1


# Share of learning in a run, by the run's length.


@taking_turns("iterations", [1, 3, 23], "how", ["run.adjoint=correlated", "run.spp=8"])
def test_a_run_learns_as_often_as_planned(
    how: str, iterations: int, llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin(tmp_path, monkeypatch)
    settings = [how, f"run.iterations={iterations}", "integrator.guiding=on", "integrator.estimator=stack"]
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
