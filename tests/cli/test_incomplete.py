"""Messages and behaviour of a run that moves a parameter whose derivative lacks silhouettes and shadow edges."""

from __future__ import annotations

import os
import signal
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cli.tiny import done, reslrb, settings
from kit import area, diffuse, scene, sensor, shape
from optimization import glass
from scipy import stats

import reslrb_cli as rl
from reslrb_cli.config.loader import load
from reslrb_cli.measure import missing
from reslrb_cli.measure.gradients import Case, Direction
from reslrb_cli.measure.missing import LineSegment, MissingCheck, Tracing, measure_missing, missing_record, share_of
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.manifest import read_manifest
from reslrb_cli.records.measurements import ALARM, MissingRecord, incomplete_records, student
from reslrb_cli.report.run_summary import find_remedy, warnings
from reslrb_cli.scene.parameters import Selection

#: A box on a floor under an area lamp, seen from above. Runs recover the box's place from an image that `path`
#: rendered.
SCENE = scene(
    sensor("0, 3.2, 4.2", "0, 0.2, 0", size=20, fov=45, rfilter="gaussian"),
    shape("rectangle", "floor", diffuse("0.5, 0.5, 0.5"), place='<rotate x="1" angle="-90"/><scale value="3"/>'),
    shape("cube", "box", diffuse("0.7, 0.3, 0.2"), place='<scale value="0.4"/><translate value="0, 0.4, 0"/>'),
    shape("rectangle", "lamp", area("12, 12, 12"),
          place='<rotate x="1" angle="90"/><scale value="0.7"/><translate value="0.8, 3.5, 0.5"/>'),
)  # fmt: skip
CONFIG = """
variant: llvm_ad_rgb
scene: {file: box.xml}
target: {file: target.exr}
parameters:
  - {motion: {of: box, free: [x, z]}, learning_rate: 0.01}
integrator: {max_depth: 2, estimator: stack, guiding: off, sequence: independent}
loss: {type: l2}
run: {iterations: 60, spp: 16, final_spp: 16, measuring: 0.9}
"""
ACCEPT = "run.accept_incomplete=true"


@pytest.fixture(scope="module")
def experiment(llvm: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Path of the configuration. In the target, the box is 0.25 further along x."""
    import mitsuba as mi

    folder = tmp_path_factory.mktemp("box")
    (folder / "box.xml").write_text(SCENE)
    (folder / "box.yaml").write_text(CONFIG)
    (folder / "there.xml").write_text(SCENE.replace("0, 0.4, 0", "0.25, 0.4, 0"))
    image = mi.render(mi.load_file(str(folder / "there.xml")), spp=512, integrator=mi.load_dict({"type": "path"}))
    mi.Bitmap(image).write(str(folder / "target.exr"))
    return folder / "box.yaml"


@pytest.fixture(scope="module")
def run(experiment: Path) -> tuple[str, Path]:
    """Output and folder of a run that accepts an incomplete derivative."""
    folder = experiment.parent / "runs"
    return done("optimize", experiment, *settings(f"run.output={folder}", ACCEPT)).output, folder / "box"


def test_a_derivative_that_lacks_more_than_half_is_refused(experiment: Path):
    result = reslrb("optimize", experiment)
    assert result.exit_code == 2
    *_, line = result.output.splitlines()
    assert line.startswith(f"{experiment}: integrator.type: box.x: ")
    assert "of the derivative is missing (silhouettes, shadow edges" in line
    assert "--set integrator.edges=on includes silhouettes and shadow edges" in line
    assert f"--set {ACCEPT} runs it anyway" in line


def test_a_missing_derivative_is_also_refused_at_the_optimum(experiment: Path):
    """At the optimum, the derivative of the loss vanishes. The check measures it at displaced values."""
    words = settings("target={render: {spp: 64}}", "run.spp=64")
    result = reslrb("optimize", experiment, *words)
    assert result.exit_code == 2
    assert "of the derivative is missing (silhouettes, shadow edges" in result.output.splitlines()[-1]


def test_a_value_with_an_incomplete_derivative_is_never_settled(run: tuple[str, Path]):
    output, folder = run
    manifest: dict[str, Any] = read_manifest(folder) or {}
    judged = manifest["results"]["certainty"]["parameters"]
    assert {key: about["verdict"] for key, about in judged.items()} == {
        "box.x": "derivative incomplete", "box.z": "derivative incomplete",
    }  # fmt: skip
    [told] = [line for line in output.splitlines() if line.startswith("box.x: ")]
    assert "of the derivative is missing" in told
    assert [entry["parameter"] for entry in manifest["incomplete"]] == ["box.x", "box.z"]
    assert manifest["incomplete"][0]["share"] > 0.5
    assert "derivative incomplete: box.x" in output
    page = (folder / "report.html").read_text()
    assert "of the derivative is missing (silhouettes" in page
    assert "settled" not in output


def test_a_continued_run_remembers_the_missing_share(run: tuple[str, Path]):
    before: dict[str, Any] = read_manifest(run[1]) or {}
    done("optimize", "--resume", run[1], *settings("run.iterations=62"))
    after: dict[str, Any] = read_manifest(run[1]) or {}
    assert after["incomplete"] == before["incomplete"]
    assert after["results"]["certainty"]["parameters"]["box.x"]["verdict"] == "derivative incomplete"


def test_a_run_with_derivatives_of_edges_finds_the_place(experiment: Path):
    """The run measures that edges matter. It then needs no permission for an incomplete derivative."""
    moving = "parameters=[{motion: {of: box, free: [x, z]}, learning_rate: 0.03}]"
    choices = settings(
        "integrator.edges=auto",
        moving,
        "run.iterations=24",
        "run.certainty=false",
        f"run.output={experiment.parent / 'on'}",
    )
    output, folder = done("optimize", experiment, *choices).output, experiment.parent / "on/box"
    assert "chosen by measurement: edges on: without them, the derivative of box.x lacks" in output
    first: dict[str, Any] = read_manifest(folder) or {}
    [decision] = [each for each in first["decisions"] if each["setting"] == "edges"]
    assert decision["value"] == "on"
    values = np.load(folder / "parameters/parameters.npz")
    assert np.hypot(values["box.x"] - 0.25, values["box.z"]).item() < 0.25 / 3
    resumed = done("optimize", "--resume", folder, *settings("run.iterations=26"))
    again: dict[str, Any] = read_manifest(folder) or {}
    assert again["decisions"] == first["decisions"]
    assert "chosen by measurement" not in resumed.output


def test_an_unmeasured_share_is_reported(experiment: Path):
    """A dry run reports an unmeasured share."""
    result = done("optimize", experiment, "--dry-run", *settings("run.measuring=0"))
    assert "box.x: the derivative may lack silhouettes and shadow edges; the missing share" in result.output
    assert "--set integrator.edges=on includes silhouettes and shadow edges" in result.output


@pytest.mark.parametrize("measuring", [0.12, 0.3, 0.9])
def test_the_measurement_stays_within_its_samples(experiment: Path, monkeypatch: pytest.MonkeyPatch, measuring: float):
    """Noise leaves the share unknown, so the measurement asks for as many samples as it may take."""
    problem, taken = assemble(load(experiment, [f"run.measuring={measuring}"])), []
    random = np.random.default_rng(1)

    def gradient(case: Case, leaves: Any, tracer: Any, seed: int, spp: int, step: Any) -> np.ndarray:
        taken.append(spp)
        return random.normal(size=case.size)

    def see(case: Case, tracer: Any, seed: int, spp: int) -> np.ndarray:
        taken.append(spp)
        return random.normal(size=case.weights.shape)

    render = Problem.render

    def image(problem: Problem, sensor: int, spp: int, iteration: int, purpose: str) -> np.ndarray:
        taken.append(spp)
        return render(problem, sensor, spp, iteration, purpose)

    monkeypatch.setattr(Case, "gradient_of", gradient)
    monkeypatch.setattr(Case, "image", see)
    monkeypatch.setattr(Problem, "render", image)
    assert not any(record.is_decided for record in measure_missing(problem))
    allowed = measuring * problem.config.run.iterations * problem.config.run.spp
    assert 0.7 * allowed < sum(taken) <= allowed


def test_the_scene_moves_once_for_each_place(experiment: Path, monkeypatch: pytest.MonkeyPatch):
    """A move of a large mesh takes longer than an image. Gradients of several views need only one move."""
    problem = assemble(load(experiment, ["parameters=[{motion: {of: box, free: [x, z]}}]"]))
    check, moves = MissingCheck.of_run(problem, ["box.x", "box.z"]), list[Any]()
    [case] = check.tracing.cases
    expected = case.gradient(check.tracing.gradients, 3, 4, step=case.known_step)
    check.tracing.cases = [case, Case(problem.scene, check.keys, 0, problem.selection)]
    hand_over = Selection.hand_over

    def counted(selection: Selection, values: Any) -> None:
        moves.append(values)
        hand_over(selection, values)

    monkeypatch.setattr(Selection, "hand_over", counted)
    leaves = case.leaves(case.initial)
    for _ in range(2):
        found = case.gradient_of(leaves, check.tracing.gradients, 3, 4, step=case.known_step)
        np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert len(moves) == 1
    segments = [LineSegment(np.eye(2)[k], -0.1, 0.1, [np.array(case.weights)] * 2) for k in (0, 1)]
    check.tracing.samples(segments, range(3))
    assert len(moves) == 1 + 2 * (2 + 3)


@pytest.mark.parametrize("count", [0, 5, 9])
def test_an_interrupt_stops_the_measurement_at_once(experiment: Path, monkeypatch: pytest.MonkeyPatch, count: int):
    """The interrupt comes after `count` images and gradients."""
    problem, taken = assemble(load(experiment, [])), list[Any]()
    before = {key: value.copy() for key, value in problem.values().items()}

    def seen(case: Case, *_: Any, **__: Any) -> np.ndarray:
        taken.append(case)
        return np.ones(case.weights.shape)

    monkeypatch.setattr(Case, "image", seen)
    monkeypatch.setattr(Case, "gradient_of", lambda *_, **__: seen(*_)[0, 0, :2])
    with pytest.raises(KeyboardInterrupt):
        measure_missing(replace(problem, interrupted=lambda: len(taken) >= count))
    assert len(taken) == count
    assert {key: value.tolist() for key, value in problem.values().items()} == {
        key: value.tolist() for key, value in before.items()
    }


def test_an_interrupt_stops_a_script_during_the_measurement(experiment: Path, monkeypatch: pytest.MonkeyPatch):
    image, taken = Case.image, list[Case]()

    def seen(case: Case, *given: Any) -> np.ndarray:
        taken.append(case)
        os.kill(os.getpid(), signal.SIGINT)
        return image(case, *given)

    monkeypatch.setattr(Case, "image", seen)
    with pytest.raises(KeyboardInterrupt):
        rl.optimize(experiment, folder=experiment.parent / "stopped")
    assert len(taken) == 1
    assert not (experiment.parent / "stopped").exists()


@pytest.mark.long
def test_light_without_edges_has_a_complete_derivative(llvm: str, tmp_path: Path):
    """The light of a spot lamp falls off smoothly and passes through glass. The derivative contains the whole
    caustic.
    """
    heights = "parameters=[{motion: {of: lamp, free: [translation]}}, {heightmap: {mesh: slab, resolution: [5, 4]}}, "
    heights += "{key: floor.bsdf.reflectance.value}]"
    path = glass.write_experiment(tmp_path)
    problem = assemble(load(path, [heights, "run.iterations=100", "run.measuring=1"]))
    values = {key: value.copy() for key, value in problem.values().items()}
    found = measure_missing(problem)
    assert [record.parameter for record in found] == ["lamp.translation", "slab.heightmap"]
    assert not any(record.is_incomplete for record in found), [record.line() for record in found]
    assert all(np.array_equal(value, values[key]) for key, value in problem.values().items())
    assert not any(np.any(np.array(gradient)) for gradient in problem.gradients().values())


def test_a_short_measurement_finds_the_derivative_of_a_lens_complete(llvm: str):
    """The light of the lens has no edges, and its caustic bends within the longest step."""
    path, sets = Path(__file__).parents[2] / "configs/lens_pose.yaml", ["target.render.spp=64", "scene.size=[32, 32]"]
    problem = assemble(load(path, sets))
    values = {key: value.copy() for key, value in problem.values().items()}
    found = measure_missing(problem)
    assert len(found) == 2
    assert not any(each.is_incomplete for each in found), [each.line() for each in found]
    assert all(np.array_equal(value, values[key]) for key, value in problem.values().items())
    assert not any(np.any(np.array(gradient)) for gradient in problem.gradients().values())


def test_shares_have_standard_errors():
    """Samples with known means give the right share on average. The scatter of the share matches its standard error."""
    random, found = np.random.default_rng(1), []
    for _ in range(400):
        whole = np.array([8.0, 0.0]) + random.normal(size=(8, 2))
        found.append(share_of(whole, np.array([0.0, 4.8]) + 0.5 * random.normal(size=(8, 2))))
    share, error = np.array(found).T
    assert share.mean() == pytest.approx(0.6, abs=4 * share.std() / np.sqrt(400))
    assert np.sqrt(np.mean(error**2)) == pytest.approx(share.std(), rel=0.15)
    assert share_of(random.normal(size=(8, 2)), np.ones((8, 2))) is None


def simulated(
    directions: int, share: float, whole: float, noise: float, count: int, samples: int = 480
) -> list[MissingRecord]:
    """Return records of measurements with known shares, of at most `samples` samples for each direction. The
    differences have the means `whole`. The missing parts have the standard deviation `noise`, and the differences have
    twice as much.
    """
    random = np.random.default_rng(5)

    class Simulated(Tracing):
        def segment(self, direction: Direction, trials: int = 4, step: float = 1.0) -> LineSegment:
            return LineSegment(direction.vector, -1, 1)

        def weigh(self, segment: LineSegment, *_: Any) -> LineSegment:
            return replace(segment, weights=[np.ones(1)])

        def sample(self, segment: LineSegment, seeds: Sequence[int]) -> np.ndarray:
            self.spent += 3 * self.spp * len(seeds)
            a, b = random.normal(size=(2, len(seeds)))
            differences = whole + 1.7 * noise * a + noise * b
            return np.transpose([differences, differences - share * whole - noise * b])

    check: Any = object.__new__(MissingCheck)
    check.problem, check.views, check.source, check.image_spp = None, [], "a.yaml", 4
    check.directions = lambda key: [Direction(np.ones(1), "both")] * directions
    found = []
    for _ in range(count):
        check.tracing = tracing = Simulated([], None, None, 1)
        found.append(check.measured("x", lambda more, own=tracing: own.spent + more <= samples * directions))
    return found


@pytest.mark.parametrize(("samples", "seeds"), [(35, 0), (36, missing.FEWEST)])
def test_a_measurement_begins_only_if_it_can_end(samples: int, seeds: int) -> None:
    """A trial takes 4 samples, both images for dL/dI take 8, and the fewest seeds take 24."""
    [record] = simulated(1, 0.0, 1.0, 0.1, 1, samples)
    assert record.seeds == seeds


def test_all_looks_together_keep_the_probability_of_a_false_alarm():
    """The samples have a mean of 0. Each look at growing numbers of them may find them significant."""
    sums = np.random.default_rng(3).normal(size=(4000, missing.MOST_SEEDS)).cumsum(1)
    squares = np.square(np.diff(sums, axis=1, prepend=0)).cumsum(1)
    alarms, look = np.zeros(len(sums), bool), missing.FEWEST
    while look <= missing.MOST_SEEDS:
        mean = sums[:, look - 1] / look
        error = np.sqrt((squares[:, look - 1] / look - mean**2) / (look - 1))
        alarms |= np.abs(mean) > student(look, 1) * error
        look *= missing.GROWTH
    assert 0.2 * ALARM < alarms.mean() <= stats.binom.ppf(0.99, len(sums), ALARM) / len(sums)


def test_the_length_of_a_segment_starts_from_that_of_the_last_one():
    """A trial moves a mesh twice. Lengths shrink and grow until the image changes by about `AIM`."""
    lengths: list[float] = []

    class Along(Tracing):
        def _change(self, vector: np.ndarray, low: float, high: float) -> float:
            lengths.append(high)
            return float(vector[0]) * (high - low)

        def weigh(self, segment: LineSegment, *_: Any) -> LineSegment:
            return replace(segment, weights=[np.zeros(1)])

    check: Any = object.__new__(MissingCheck)
    check.problem, check.views, check.source, check.image_spp = None, [], "a.yaml", 4
    check.tracing = Along([], None, None, 1)
    check.directions = lambda key: [Direction(np.array([size]), "both") for size in (3.0, 4.0, 0.5, 0.01, 0.0)]
    check.measured("x", lambda more: True)
    assert lengths == pytest.approx([0.1, 0.005, 0.005, 0.005, 0.03, 0.03, 0.1, 0.1])


def test_weights_belong_to_the_end_with_the_higher_loss(llvm: str):
    """There, the derivative of the loss does not vanish, whichever end is nearer to the target at -1."""

    class Along(Tracing):
        def values(self, vector: np.ndarray, s: float) -> dict[str, np.ndarray]:
            self.at = s
            return {}

    case: Any = SimpleNamespace(weights=np.zeros((1, 1, 1)), set=lambda values: None)
    view: Any = SimpleNamespace(
        sensor=0, share=1.0, follow=lambda scene: None, compare=lambda image: [np.square(np.array(image) + 1).sum()]
    )
    along = Along([case], None, None, 1)
    problem: Any = SimpleNamespace(
        scene=None, render=lambda *_: np.full((1, 1, 1), along.at), image_gradient=lambda _, image: 2 * (image + 1)
    )
    segment = LineSegment(np.ones(1), -1, 0.5)
    assert along.weigh(segment, problem, [view], 1).weights == [np.ones((1, 1, 1))]


@pytest.mark.parametrize(("directions", "noise"), [(1, 0.25), (3, 0.2)])
def test_false_alarms_are_rare(directions: int, noise: float):
    """At most 0.5 % of the measurements of a complete derivative find it incomplete at any look at the samples."""
    found = simulated(directions, 0.0, 1.0, noise, 500)
    assert len({each.seeds for each in found}) > 1, "no second look"
    alarms = sum(each.is_incomplete and not each.is_unknown for each in found)
    assert alarms <= stats.binom.ppf(0.99, len(found), ALARM)
    assert not any(each.is_for_the_most_part for each in found)


@pytest.mark.parametrize(("share", "least"), [(1.0, 0.99), (0.8, 0.95), (0.5, 0.0)])
def test_large_missing_shares_are_refused(share: float, least: float):
    """The noise of a single seed is half of the derivative. A share of one half is the limit of what may start."""
    found = simulated(1, share, 1.0, 0.5, 200)
    refused = np.mean([each.is_for_the_most_part for each in found])
    assert refused >= least
    assert least or refused <= 0.02
    assert np.mean([each.is_incomplete and not each.is_unknown for each in found]) >= 0.95


def test_long_segments_have_no_truncation_error():
    """The loss bends within the segment. The gradient is complete, so nothing is missing, whatever the length."""

    class Bent(Tracing):
        def values(self, vector: np.ndarray, s: float) -> dict[str, np.ndarray]:
            self.at = s
            return {}

        def _see(self, vector: np.ndarray, s: float, seeds: Sequence[int]) -> list[list[np.ndarray]]:
            return [[np.array([np.sin(3 * s)])]] * len(seeds)

    case: Any = SimpleNamespace(
        weigh=lambda weights: None, known_step=None, leaves=lambda values: values,
        gradient_of=lambda *_, **__: np.array([3 * np.cos(3 * bent.at)]),
    )  # fmt: skip
    bent = Bent([case], None, None, 1)
    found = bent.samples([LineSegment(np.ones(1), -0.1, 0.5, [np.ones(1)])], range(400))
    record = missing_record("a.yaml", "x", found)
    assert not record.is_incomplete, record
    middle = 3 * np.cos(0.6) / found[0, 0, 0] - 1
    assert middle > 2 * record.margin, "the derivative in the middle would look incomplete"


@pytest.mark.parametrize(
    ("before", "after", "value"),
    [((0.094, 0.01), (0.094, 0.01), "off"), ((0.9, 0.02), (0.1, 0.05), "on"), ((0.9, 0.02), None, "on"),
     ((0.3, 0.02), (0.29, 0.02), "off"), (None, (0.2, 0.01), "on")],
)  # fmt: skip
def test_edges_that_do_not_help_are_turned_off(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, before: Any, after: Any, value: str
):
    """`edges: auto` compares the shares without and with edges."""
    problem = assemble(load(experiment, ["integrator.edges=auto", ACCEPT]))
    results = iter([before, after])
    monkeypatch.setattr(missing, "measure_missing", lambda _: [record(*(next(results) or (None, None)))])
    said: list[str] = []
    decided, found = missing.check_missing(problem, said.append, lambda line: None)
    assert said[0].startswith(f"chosen by measurement: edges {value}: ")
    assert len(said) == 1
    assert ("edges" in decided.integrator.preparation.sampling.on) is (value == "on")
    shares = [] if after is None else [before and before[0] if value == "off" else after[0]]
    assert [each.share for each in found] == shares


def record(share: float | None, error: float | None, seeds: int = 8, key: str = "box.x") -> MissingRecord:
    return MissingRecord("a.yaml", key, share, error, 1, seeds)


@pytest.mark.parametrize(
    ("found", "incomplete", "refused"),
    [
        (record(0.02, 0.001), False, False),  # from the finite step, for an interior derivative
        (record(0.1, 0.04), False, False),
        (record(0.3, 0.04), True, False),
        (record(0.45, 0.2), True, False),
        (record(0.9, 0.1), True, False),  # with 8 seeds, five standard errors are needed
        (record(0.9, 0.1, 32), True, True),
        (record(None, None), True, False),
        (record(None, None, 0), True, False),
    ],
)
def test_consequences_of_a_share(found: MissingRecord, incomplete: bool, refused: bool):
    assert (found.is_incomplete, found.is_for_the_most_part) == (incomplete, refused)
    assert ("detect no missing part" in found.line()) is (found.share == 0.1)


@pytest.mark.parametrize(
    ("share", "margin", "unknown", "decided", "words"),
    [
        (None, 0.1, True, False, "seeds cannot distinguish the derivative from 0"),
        (0.3, 0.3, True, False, "seeds cannot determine the missing share of the derivative (30% +- "),
        (0.3, 0.29, False, False, ": 30% +- "),
        (0.3, 0.2, False, True, ": 30% +- "),  # at most one half is missing
        (0.3, 0.201, False, False, ": 30% +- "),
        (0.7, 0.2, False, False, ": 70% +- "),  # perhaps one half
        (0.7, 0.199, False, True, ": 70% +- "),
        (0.25, 0.25, False, False, "seeds detect no missing part of the derivative (25% +- "),
        (0.06, 0.05, False, True, ": 6.0% +- "),  # above `NOTICED`
        (0.02, 0.01, False, True, ": 2.0% +- "),
        (0.0001, 0.00001, False, True, "seeds detect no missing part of the derivative (0.0% +- "),
        (0.09949, 0.01, False, True, ": 9.9% +- "),
        (0.0996, 0.01, False, True, ": 10% +- "),
    ],
)
def test_a_share_and_the_bounds_of_its_interval(
    share: float | None, margin: float, unknown: bool, decided: bool, words: str
):
    found = record(share, margin / student(8, 1))
    assert (found.is_unknown, found.is_decided) == (unknown, decided)
    assert words in found.line()
    assert (incomplete_records([vars(found)]) == [found]) is found.is_incomplete
    assert replace(found, standard_error=None).percent() == replace(found, share=None).percent() == "an unknown share"


@pytest.mark.parametrize(
    ("without", "with_edges", "reduced"),
    [
        (record(0.3, 0.03), record(0.24, 0.03), False),  # twice the error of a difference is 0.085
        (record(0.3, 0.03), record(0.26, 0.001), False),
        (record(0.3, 0.03), record(0.2, 0.03), True),
        (record(0.2, 0.03), record(0.3, 0.03), False),
        (record(0.3, 0.03), record(None, None), True),
        (record(None, None), record(0.2, 0.03), True),
        (record(0.3, 0.03), None, True),
    ],
)
def test_edges_stay_on_if_they_may_reduce_the_share(
    without: MissingRecord, with_edges: MissingRecord | None, reduced: bool
):
    assert without.is_reduced_to(with_edges) is reduced


def test_a_rising_loss_is_explained_by_the_missing_part():
    """The program then proposes no lower rate, not even for other parameters that still move."""
    level = {"start": {"mean": 1.0, "error": 0.01}, "end": {"mean": 2.0, "error": 0.01}, "change": "rose"}
    moving = {"verdict": "still moving", "shares": {"still moving": 1.0}, "moved": 0.1, "rate": 0.01, "reach": 10.0}
    lacking = {"verdict": "derivative incomplete", "shares": {"derivative incomplete": 1.0}}
    about = {"parameters": {"box.x": lacking, "box.color": moving}, "iterations": 100, "learning_rate": 0.01}
    results = {"loss_trend": level, "certainty": about, "iterations": 100}
    remedy = find_remedy(results, "box.color")
    assert remedy is not None
    assert remedy.words == "a lower rate"
    results["incomplete"] = [vars(record(0.47, 0.02))]
    assert find_remedy(results, "box.color") is None
    told = warnings(results)
    assert "incomplete derivative (47% +- 2.0% of the derivative of box.x is missing), and a lower rate" in told[1]
    assert "derivative incomplete: box.x (47% +- 2.0% of it is missing)" in told
