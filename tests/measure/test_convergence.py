"""Results of `convergence` for methods whose cost, noise and bias are known, with tests of references, curves and
scenes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli.tiny import KEY, write_experiment
from measure.pretended_steps import SHAPES, Pretence, Stage, of, plan, play
from scipy import stats
from turns import a_few

from reslrb_cli.config.loader import load
from reslrb_cli.measure import steps
from reslrb_cli.measure.judgement import HEAVY, Judgement, MethodSamples, ReferenceMean
from reslrb_cli.measure.methods import DEFAULTS, IMAGES, parse_cases
from reslrb_cli.measure.steps import Sampler, survey
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.records.measurements import BenchStatus, Method, MethodRecord, Range
from reslrb_cli.report.tables import closing_sentence, notes

# What `convergence` reports about methods of known cost, noise and bias. The processes only pretend to measure.


def test_cost_error_and_efficiency_match_the_methods() -> None:
    stage = Stage(case_ptracer=Pretence(0.4, 0.5), case_reslrb_stack=Pretence(0.1, 0.6),
                  case_reslrb_event=Pretence(0.05, 1.0))  # fmt: skip
    _, results, _ = play(stage, plan())
    for label, step_s, noise in (("ptracer", 0.4, 0.5), ("reslrb:stack", 0.1, 0.6), ("reslrb:event", 0.05, 1.0)):
        record = of(results, label)
        assert (record.status, record.biased, record.cold_s) == (BenchStatus.OK, False, 1.0)
        assert record.step_s == pytest.approx(step_s)
        assert record.relative_rmse == pytest.approx(noise, rel=0.1)
        assert record.efficiency.low < 1 / (noise**2 * step_s) < record.efficiency.high
        assert abs(record.bias_z) < record.bias_z_limit
        seconds = record.seconds_to["0.1"]
        assert seconds == pytest.approx(step_s * noise**2 / 0.01, rel=0.25)
        assert record.extrapolated == [name for name in ("0.1", "0.03", "0.01") if
                                       record.seconds_to[name] > record.repeats * step_s or float(name) < record.reference_rmse]  # fmt: skip # noqa: E501
    assert closing_sentence(results.methods).startswith("Best for this scene: reslrb:stack; ")


def test_a_planted_bias_of_three_percent_is_reported() -> None:
    slow = {name: Pretence(0.2, 0.1) for name in ("case_ptracer", "case_reslrb_stack", "reference_reslrb_stack")}
    stage = Stage(case_reslrb_event=Pretence(0.05, 0.1, bias=0.03), **slow)
    _, results, _ = play(stage, plan())
    sound, biased = of(results, "reslrb:stack"), of(results, "reslrb:event")
    assert [r.biased for r in (sound, biased, of(results, "ptracer"))] == [False, True, False]
    assert biased.bias == pytest.approx(0.03, rel=0.2)
    assert biased.bias_z > biased.bias_z_limit
    assert biased.bias_reference == "ptracer"
    # Squared bias counts like variance, and keeps the error above 1 %. Without bias, this method would be the most
    # efficient.
    assert biased.efficiency.low < 1 / (0.05 * (0.1**2 + 0.03**2)) < biased.efficiency.high
    assert biased.efficiency.value > 2 * sound.efficiency.value
    assert (biased.seconds_to["0.01"], sound.seconds_to["0.01"] is not None) == (None, True)
    sentence = closing_sentence(results.methods)
    assert sentence.startswith(("Best for this scene: ptracer", "Best for this scene: reslrb:stack"))
    assert "The biased reslrb:event has" in sentence
    assert f"but its error stays above {biased.bias:.2g}." in sentence
    assert any(
        note.startswith(f"reslrb:event, all: biased by {biased.bias:.2g} of the whole")
        for note in notes(results.methods)
    )


def test_too_heavy_tails_for_intervals_are_reported() -> None:
    """One step in 64 is a hundred times as noisy as the others, and causes nearly all of the variance.

    A sample without this step has less than a hundredth of the variance, and its interval does not include the
    outlier's effect.
    """
    heavy = Pretence(0.1, 0.1, outliers=(30,))
    session, results, _ = play(Stage(case_reslrb_stack=heavy, case_reslrb_event=Pretence(0.1, 0.1)), plan())
    for key in (*SHAPES, "all"):
        flagged, sound = of(results, "reslrb:stack", key), of(results, "reslrb:event", key)
        assert "dominate the variance" in flagged.message, key
        assert flagged.biased is None  # heavy tails also make z scores unreliable
        assert (sound.message, sound.biased) == ("", False)
    [member] = [member for member in session.of("case") if member.label == "reslrb:stack"]
    assert Judgement(session).overall(member).message == HEAVY  # also in the lines printed during the measurement
    lucky = play(Stage(case_reslrb_stack=Pretence(0.1, 0.1)), plan())[1]
    assert of(lucky, "reslrb:stack").efficiency.low > 10 * of(results, "reslrb:stack").efficiency.value
    assert any(note.startswith("reslrb:stack, all: single") for note in notes(results.methods))
    assert closing_sentence(results.methods).startswith("Best for this scene: reslrb:event")


def test_ordinary_tails_are_not_reported() -> None:
    """Every fourth step is ten times as noisy as the others. Many steps dominate the variance, and the intervals are
    valid.
    """
    stage = Stage(case_reslrb_stack=Pretence(0.1, 0.05, outliers=tuple(range(0, 200, 4)), outlier=10.0))
    _, results, _ = play(stage, plan())
    record = of(results, "reslrb:stack")
    assert (record.message, record.biased) == ("", False)
    truth = 1 / (0.1 * 0.05**2 * (3 + 10**2) / 4)
    assert record.efficiency.low < truth < record.efficiency.high


def test_references_of_errors_are_checked_too() -> None:
    """With a biased reference, the errors of unbiased methods are wrong. The reference is reported as biased, and the
    unbiased methods are not.
    """
    stage = Stage(reference_reslrb_stack=Pretence(0.1, 0.1, bias=0.1), case_reslrb_stack=Pretence(0.1, 0.1),
                  case_ptracer=Pretence(0.1, 0.1), case_reslrb_event=Pretence(0.1, 0.1, bias=0.1))  # fmt: skip
    _, results, _ = play(stage, plan())
    reference = next(r for r in results.references if r.parameter == "a")
    assert (reference.biased, reference.bias_reference) == (True, "ptracer")
    assert of(results, "reslrb:stack").biased is False
    event = of(results, "reslrb:event", "a")
    assert event.biased is True
    assert event.bias == pytest.approx(0.1, rel=0.2)  # against ptracer, not against the biased reference
    words = " differ, so either of them may be biased"
    assert words in closing_sentence(results.methods, results.references)
    agreed = [replace(record, biased=False) for record in results.references]
    assert words not in closing_sentence(results.methods, agreed)


def test_a_missing_independent_reference_is_reported() -> None:
    facts = {"independent": {"a": "ptracer", "b": None}, "why": {"a": "", "b": "not ptracer: it differs"}}
    stage = Stage(facts, case_reslrb_event=Pretence(0.1, 0.1, bias=0.1), reference_reslrb_stack=Pretence(noise=0.1))
    _, results, said = play(stage, plan())
    assert "b: no independent reference (not ptracer: it differs); biases are judged by reslrb:stack" in said
    event = of(results, "reslrb:event", "b")
    assert (event.biased, event.bias_reference) == (True, "reslrb:stack")
    assert of(results, "reslrb:event", "a").bias_reference == "ptracer"
    reference = next(r for r in results.references if r.parameter == "b")
    assert (reference.biased, reference.bias_z, reference.message) == (None, None, "there is no independent reference")


def test_the_noise_of_one_image_is_not_a_bias() -> None:
    """With the configuration's loss, dL/dI is fixed at several images, and the reference's error includes the noise of
    these images.
    """
    quiet = Pretence(0.1, 0.02, image_noise=0.05)
    stage = Stage(reference_reslrb_stack=quiet, independent_ptracer=Pretence(0.1, 0.02, image_noise=0.05),
                  case_reslrb_stack_adjoint_batched_=Pretence(0.1, 0.05),
                  case_reslrb_stack_adjoint_correlated_=Pretence(0.1, 0.05, bias=0.5))  # fmt: skip
    cases = "reslrb:stack(adjoint=batched),reslrb:stack(adjoint=correlated)"
    session, results, _ = play(stage, plan(cases, quantity="loss", rounds=32))
    assert [m.method.adjoint for m in session.members] == ["batched", "correlated", None, None]
    assert [r.biased for r in results.methods if r.parameter == "all"] == [False, True]
    reference = next(r for r in results.references if r.parameter == "all")
    assert reference.reference_rmse == pytest.approx(0.05 / np.sqrt(8), rel=0.3)
    assert of(results, "reslrb:stack(adjoint=batched)").method.options["estimator"] == "stack"


def test_a_sweep_of_samples() -> None:
    """Each sample count is a separate method. The reference has the sample count of the configuration."""
    four, sixteen = Pretence(0.1, 1.0), Pretence(0.3, 0.5)
    stage = Stage(case_reslrb_stack__4_spp=four, case_reslrb_stack__16_spp=sixteen)
    session, results, _ = play(stage, plan("reslrb:stack", values=(4, 16)))
    assert [(m.label, m.spp, m.config.run.spp) for m in session.members] == [
        ("reslrb:stack, 4 spp", 4, 4), ("reslrb:stack, 16 spp", 16, 16), ("reslrb:stack", 4, 4), ("ptracer", 4, 4)
    ]  # fmt: skip
    assert of(results, "reslrb:stack, 16 spp").relative_rmse == pytest.approx(0.5, rel=0.1)
    assert of(results, "reslrb:stack, 16 spp").method.spp == 16
    assert closing_sentence(results.methods).startswith("Best for this scene: reslrb:stack, 16 spp; 1.34 [")
    spps = {question["of"]: question["spp"] for question in stage.asked if question["of"]}
    assert spps["case reslrb:stack, 16 spp"] == 16


# Errors, efficiencies and times from samples of a known distribution.

REPETITIONS = 200
#: Least and most repetitions that may cover the truth if each does with a probability of 95 %. One test in 1000 exceeds
#: these limits by chance.
LEAST, MOST = (int(stats.binom.ppf(p, REPETITIONS, 0.95)) for p in (0.0005, 0.9995))
TRUTH = np.random.default_rng(2).uniform(0.5, 2.0, 40)
SIGNAL = float(TRUTH @ TRUTH)
SECONDS = 0.2
METHOD = Method("ptracer", {"type": "ptracer"}, 4)


def noise(random: np.random.Generator, count: int) -> np.ndarray:
    """Return noise of shape (count, 40). Each entry has a variance of 3 from factors that entries share, and 0.2 of its
    own.
    """
    common = np.random.default_rng(1).standard_normal((4, 40))
    common *= np.sqrt(3.0 / np.square(common).sum(0))
    return random.standard_normal((count, 4)) @ common + np.sqrt(0.2) * random.standard_normal((count, 40))


VARIANCE = 3.2 * 40


def make(
    seed: int, steps: int = 48, rows: int = 24, per_row: int = 6, per_turn: int = 2, bias: float = 0.0
) -> MethodSamples:
    random = np.random.default_rng(1000 + seed)
    means = TRUTH + noise(random, rows * per_row).reshape(rows, per_row, -1).mean(1)
    values, turns = TRUTH * (1 + bias) + noise(random, steps), np.arange(steps) // per_turn
    seconds = SECONDS * random.gamma(40, 1 / 40, steps // per_turn)
    return MethodSamples(values, turns, seconds, ReferenceMean(means))


def test_errors_are_those_of_averages_without_that_of_the_reference() -> None:
    """The reference is as noisy as averages of 6 steps. Unless this noise is subtracted, averages of 32 steps look at
    least twice as bad.
    """
    made = [make(seed, steps=64, rows=6, per_row=1) for seed in range(REPETITIONS)]
    for level in range(6):
        found = [samples.points(METHOD, KEY)[level] for samples in made]
        assert {point.steps for point in found} == {2**level}
        assert {point.repeats for point in found} == {64 // 2**level}
        assert found[0].elapsed_s == pytest.approx(2**level * made[0].step_s)
        # A point drowns in noise and is None if the estimate of its square is negative. The squares are the unbiased
        # estimates.
        squares = [
            float(np.square(s.deviations[: 64 // 2**level * 2**level].reshape(-1, 2**level, 40).mean(1)).sum(1).mean())
            - s.reference.noise
            for s in made
        ]
        told = [0.0 if p.relative_rmse is None else p.relative_rmse**2 * s.reference.signal
                for p, s in zip(found, made, strict=True)]  # fmt: skip
        np.testing.assert_allclose(told, np.maximum(squares, 0), rtol=1e-9, atol=1e-9)
        error = stats.sem(squares)
        assert abs(np.mean(squares) - VARIANCE / 2**level) < 4 * error
    assert VARIANCE / 32 + np.mean([s.reference.noise for s in made]) > 4 * VARIANCE / 32


@pytest.mark.parametrize("rows", [8, 24])
def test_the_intervals_of_errors_have_their_coverage(rows: int) -> None:
    """Errors from fewer than four averages have no interval. The true errors are VARIANCE / n, relative to SIGNAL."""
    made = [make(seed, steps=64, rows=rows) for seed in range(REPETITIONS)]
    found = [samples.points(METHOD, KEY) for samples in made]
    for level, point in enumerate(found[0]):
        known = [points[level] for points in found if points[level].low is not None]
        if point.repeats < 4:
            assert not known
            continue
        assert all(each.low < each.relative_rmse < each.high for each in known)
        truth = np.sqrt(VARIANCE / point.steps / SIGNAL)
        covered = sum(each.low < truth < each.high for each in known)
        assert len(known) >= REPETITIONS - 1
        assert LEAST <= covered <= MOST
    assert all(p.low is None for points in found for p in points if p.relative_rmse is None)


def test_the_floor_and_the_signal() -> None:
    made = [make(seed).reference for seed in range(REPETITIONS)]
    for values, truth in (([r.noise for r in made], VARIANCE / 144), ([r.signal for r in made], SIGNAL)):
        assert abs(np.mean(values) - truth) < 4 * stats.sem(values)
    assert made[0].floor == pytest.approx(np.sqrt(made[0].noise / made[0].signal))
    assert ReferenceMean(np.random.default_rng(1).standard_normal((8, 5)) * 0.0).floor is None


def test_omissions_of_a_reference() -> None:
    reference = make(1, rows=5).reference
    for k in range(-1, 5):
        rest = ReferenceMean(np.delete(reference.rows, k, axis=0)) if k >= 0 else reference
        np.testing.assert_allclose(reference.mean + reference.moved[1 + k], rest.mean)
        assert (reference.noises[1 + k], reference.signals[1 + k]) == pytest.approx((rest.noise, rest.signal))


@pytest.mark.parametrize(("steps", "rows"), [(48, 24), (16, 8), (192, 48)])
def test_the_intervals_have_their_coverage(steps: int, rows: int) -> None:
    """200 repetitions check the intervals of the efficiency, 1 / (relative variance * seconds)."""
    truth, covered = SIGNAL / VARIANCE / SECONDS, 0
    for seed in range(REPETITIONS):
        estimate = make(seed, steps, rows).efficiency()
        assert estimate is not None
        interval = estimate.exponential()
        covered += interval.low <= truth <= interval.high
    assert LEAST <= covered <= MOST


@pytest.mark.parametrize("steps", [16, 32, 64])
def test_the_intervals_of_a_single_colour_have_their_coverage(steps: int) -> None:
    """The three channels of the colour deviate together, so that every error is the square of one normal number."""
    covered = 0
    for seed in range(REPETITIONS):
        random = np.random.default_rng(seed)
        own, others = (1 + 0.1 * random.standard_normal((count, 1)) * np.ones(3) for count in (steps, 400))
        samples = MethodSamples(
            own, np.arange(steps) // 2, np.ones(steps // 2), ReferenceMean(others.reshape(40, 10, 3).mean(1))
        )
        efficiency = samples.efficiency()
        assert efficiency is not None
        covered += efficiency.exponential().low <= 100 <= efficiency.exponential().high
    assert LEAST <= covered <= MOST


def test_the_interval_of_a_biased_method_has_its_coverage() -> None:
    bias = 0.6
    truth, covered = SIGNAL / (VARIANCE + bias**2 * SIGNAL) / SECONDS, 0
    for seed in range(REPETITIONS):
        estimate = make(seed, bias=bias).efficiency()
        assert estimate is not None
        covered += estimate.exponential().low <= truth <= estimate.exponential().high
    assert LEAST <= covered <= MOST


def test_a_method_with_a_flat_error_is_biased_and_its_efficiency_says_so() -> None:
    """The method has hardly any noise, and an error that no number of steps lowers: more than a reference's rounding,
    and less than three times that.
    """
    flat = Pretence(0.1, 1e-5, bias=0.0024)
    sound = {name: Pretence(0.1, 1e-4) for name in ("case_ptracer", "case_reslrb_stack", "reference_reslrb_stack")}
    _, results, _ = play(Stage(case_reslrb_event=flat, **sound), plan())
    record = of(results, "reslrb:event")
    assert record.biased is True
    assert record.efficiency.value == pytest.approx(1 / (0.1 * 0.0024**2), rel=0.2)


def test_equal_methods_seldom_have_a_best() -> None:
    """Of 400 sessions with equal methods, a lead is claimed in at most 5 %. A real lead of 3 is claimed in most."""
    random, claimed, found = np.random.default_rng(9), 0, 0
    for methods in [2, 5, 9, 12] * 100:
        records = []
        for number in range(methods):
            reference = ReferenceMean(1 + 0.05 * random.standard_normal((8, 20)))
            values, seconds = 1 + random.standard_normal((32, 20)), random.gamma(40, SECONDS / 40, 16)
            estimate = MethodSamples(values, np.arange(32) // 2, seconds, reference).efficiency()
            assert estimate is not None
            records.append(MethodRecord(
                method=replace(METHOD, label=str(number)), parameter=KEY, status=BenchStatus.OK, biased=False,
                efficiency=estimate.exponential(), efficiency_freedom=estimate.freedom,
            ))  # fmt: skip
        claimed += "times as efficient" in closing_sentence(records)
        first, own = records[0], records[0].efficiency
        better = replace(first, efficiency=Range(*(3 * value for value in (own.value, own.low, own.high))))
        found += "times as efficient" in closing_sentence([better, *records[1:]])
    assert claimed <= 20
    assert found >= 360


def test_the_size_of_a_bias() -> None:
    assert np.sqrt(make(3, steps=256, bias=0.5).squared_bias) == pytest.approx(0.5, rel=0.2)


def test_times() -> None:
    """Times follow sqrt(variance / steps), and are at least one step. Times beyond the measured steps or below the
    floor are extrapolated.
    """
    samples = make(5, steps=64, rows=200)
    relative = samples.variance
    for target in (0.5, 0.2, 0.01):
        seconds, beyond = samples.seconds_to(target, biased=False)
        steps = max(relative / target**2, 1.0)
        assert seconds == pytest.approx(steps * samples.step_s)
        assert beyond is (steps > 64 or target < samples.reference.floor)
    assert [samples.seconds_to(target, False)[1] for target in (0.5, 0.01)] == [False, True]
    assert samples.seconds_to(100.0, False) == (samples.step_s, False)
    rough = make(5, steps=64, rows=3, per_row=1)
    assert rough.reference.floor > 0.3
    assert rough.seconds_to(0.3, False)[1]  # within the steps, but below the noise floor


def test_times_prevented_by_a_bias() -> None:
    samples = make(6, steps=256, rows=100, bias=0.2)
    size = float(np.sqrt(samples.squared_bias))
    assert samples.seconds_to(0.9 * size, biased=True) == (None, False)
    assert samples.seconds_to(0.9 * size, biased=False)[0] is not None
    seconds, _ = samples.seconds_to(2 * size, biased=True)
    assert seconds == pytest.approx(samples.variance / (3 * size**2) * samples.step_s)


def test_too_few_steps_have_no_intervals() -> None:
    assert make(7, steps=4, per_turn=2).efficiency() is None
    assert make(7, steps=6, per_turn=2).efficiency() is not None


# `convergence` on the scenes of the shipped configurations, with fixed seeds and a step count that does not depend on
# time.

# Facts that are found before any measurement: references, dL/dI, and the border of the film.

GAUSSIAN = ('<rfilter type="box"/>', '<rfilter type="gaussian"/>')


def problem(folder: Path, *changes: tuple[str, str], overrides: tuple[str, ...] = ()) -> Any:
    write_experiment(folder)
    text = (folder / "scene.xml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "scene.xml").write_text(text)
    return assemble_scene(load(folder / "tiny.yaml", list(overrides)))


@pytest.fixture(autouse=True)
def _few_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steps, "PATHS", dict.fromkeys(steps.PATHS, 2**16))


def test_facts(tmp_path: Path) -> None:
    facts, arrays = survey(problem(tmp_path), "fixed")
    assert facts["shapes"] == {KEY: [4, 4, 3]}
    assert (facts["independent"], facts["why"], facts["without"]) == ({KEY: "ptracer"}, {KEY: ""}, {})
    assert (facts["pixels"], facts["masked"]) == (64, False)
    assert (arrays["adjoints"].shape, arrays["target-0"].shape) == ((1, 8, 8, 3), (8, 8, 3))
    assert arrays["mask"].all()


def test_the_loss_has_several_images(tmp_path: Path) -> None:
    _, arrays = survey(problem(tmp_path), "loss")
    assert arrays["adjoints"].shape == (IMAGES, 8, 8, 3)
    assert len({adjoint.tobytes() for adjoint in arrays["adjoints"]}) == IMAGES


@pytest.mark.parametrize(
    ("change", "masked"), [(GAUSSIAN, True), pytest.param(("box", "box"), False, marks=pytest.mark.long)]
)
def test_the_border_is_left_out(tmp_path: Path, change: tuple[str, str], masked: bool) -> None:
    facts, arrays = survey(problem(tmp_path, change), "fixed")
    assert facts["masked"] is masked
    inside = arrays["mask"][:, :, 0] == 1
    assert inside.all() is not masked
    assert bool(inside[4, 4])
    adjoint = np.abs(arrays["adjoints"][0]).sum(2)
    assert (adjoint[~inside] == 0).all()
    assert adjoint[4, 4] > 0
    facts, arrays = survey(problem(tmp_path, change), "image")
    assert (facts["shapes"], set(arrays)) == ({"image": [8, 8, 3]}, {"mask"})


def test_a_method_that_is_never_right_is_reported(tmp_path: Path) -> None:
    facts, _ = survey(problem(tmp_path, ("area", "directionalarea"), GAUSSIAN), "fixed")
    assert list(facts["without"]) == ["prb"]
    assert "directionalarea" in facts["without"]["prb"]
    assert facts["independent"] == {KEY: "ptracer"}


@pytest.mark.parametrize("mode", a_few(["fixed", "loss", "image"], ["fixed"]))
def test_steps_are_repeatable_and_the_border_does_not_count(tmp_path: Path, mode: str) -> None:
    what = problem(tmp_path, GAUSSIAN, overrides=("run.adjoint=independent",))
    _, arrays = survey(what, "image" if mode == "image" else "loss")
    sampler = Sampler(what.config, mode, arrays)
    row, times = sampler.step(3, 4, 0)
    assert row.shape == ((192,) if mode == "image" else (48,))
    assert row.any()
    assert times.wall_ms > 0
    again = sampler.step(3, 4, 0)[0]
    np.testing.assert_allclose(again, row, rtol=1e-4, atol=1e-6)
    assert not np.allclose(sampler.step(4, 4, 0)[0], row)
    if mode == "image":
        assert (row.reshape(8, 8, 3)[arrays["mask"][:, :, 0] == 0] == 0).all()
    if mode == "fixed":
        assert not np.allclose(sampler.step(3, 4, 1)[0], row, rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", a_few([case.label for case in parse_cases(DEFAULTS["fixed"])],
                                       ["ptracer", "prb", "reslrb:stack(paths=both)"]))  # fmt: skip
def test_a_fixed_gradient_is_not_charged_for_an_image(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No method renders an image that nobody uses, beside the paths of its gradient."""
    what = problem(tmp_path)
    [case] = parse_cases(name)
    sampler = Sampler(case.at(what.config, 3, known=True), "fixed", survey(what, "fixed")[1])
    tracer = type(sampler.problem.integrator)

    def image(self: Any, *job: Any) -> None:
        raise AssertionError("an image is rendered")

    monkeypatch.setattr(tracer, "image", image)
    monkeypatch.setattr(tracer, "known", image)
    assert sampler.step(3, 4, 0)[0].any()
