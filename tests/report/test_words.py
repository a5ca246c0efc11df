"""Numbers, times, keys and tables in words."""

from __future__ import annotations

import re

import numpy as np
import pytest
import yaml

from reslrb_cli.config.files import duration
from reslrb_cli.errors import printable
from reslrb_cli.records.measurements import MISFIT
from reslrb_cli.report.format import count, interval, number, rounded, shorten, with_error
from reslrb_cli.report.run_summary import advice, free_command, last_line, outcome_of, parameter_lines, warnings
from reslrb_cli.report.spread import misfit_lines

# Numbers, times, keys and results in words.


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.013123, 0.00041, "0.0131 +- 0.0004"),
        (123.4, 12.0, "123 +- 12"),
        (1.234e-7, 3.2e-9, "(1.23 +- 0.03)e-07"),
        (0.5, 0.0, "0.5"),
        (0.0, 0.02, "0.00 +- 0.02"),
        (1.0, float("nan"), "1"),
    ],
)
def test_a_value_with_its_error(value, error, text):
    assert with_error(value, error) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0123, "12.3 ms"),
        (4.56, "4.56 s"),
        (59.97, "1 min 0 s"),
        (7500, "2 h 5 min"),
        (2e6, "23.1 days"),
    ],
)
def test_times(seconds, text):
    assert duration(seconds) == text


def test_numbers():
    assert [count(amount, "iteration") for amount in (0, 1, 2)] == ["0 iterations", "1 iteration", "2 iterations"]
    assert (number(None), number(0.123456), number(1e6), number(0.5, 3)) == ("", "0.1235", "1e+06", "0.5")
    for size in 10.0 ** np.arange(-12, 12, 0.25):
        for digits in range(1, 6):
            for value in (size, -size):
                text = number(value, digits)
                assert float(text) == float(f"{value:.{digits}g}")
                assert ("e+" in text) == (abs(float(text)) >= 1e6)


@pytest.mark.parametrize(
    ("figures", "text"),
    [
        ((424.2, 151.7, 1234.5), "420 [150, 1200]"),
        ((0.58312, 0.5714, 0.5963), "0.583 [0.571, 0.596]"),  # half the width is 0.012: two digits
        ((4.0123, 3.95, 4.08), "4.01 [3.95, 4.08]"),  # 0.065: one digit
        ((1.234, 0.0031, 480.0), "1.2 [0.0031, 480]"),  # no end loses all its digits
        ((-0.5, -0.55, -0.45), "-0.50 [-0.55, -0.45]"),
        ((0.0, -0.2, 0.2), "0.00 [-0.20, 0.20]"),
        ((2.34567e7, 2.2e7, 2.5e7), "2.35e+07 [2.20e+07, 2.50e+07]"),
        ((3.2e-6, 3.1e-6, 3.4e-6), "3.20e-06 [3.10e-06, 3.40e-06]"),
        ((5.0, 5.0, 5.0), "5 [5, 5]"),
        ((2.5, 2.0, float("inf")), "2.5 [2, inf]"),
    ],
)
def test_intervals_have_the_digits_that_they_support(figures, text):
    assert interval(*figures) == text


def test_intervals_keep_their_meaning():
    """Rounding moves no number by more than a seventh of the interval's half width."""
    random = np.random.default_rng(0)
    for _ in range(2000):
        value = random.choice([-1, 1]) * 10 ** random.uniform(-8, 8)
        low, high = value - abs(value) * 10 ** random.uniform(-4, 1), value + abs(value) * 10 ** random.uniform(-4, 1)
        for exact, text in zip((value, low, high), rounded(value, low, high), strict=True):
            assert abs(float(text) - exact) <= (high - low) / 2 / 7


def test_keys_are_shortened_in_the_middle():
    assert shorten("floor.reflectance.data", 40) == "floor.reflectance.data"
    short = shorten("a_very_long_name.brdf_0.reflectance.data", 20)
    assert (len(short), short[:8], short[-8:]) == (20, "a_very_l", "nce.data")
    assert all(len(shorten("abcdefghij", width)) == min(width, 10) for width in range(1, 15))
    assert printable("a\x1b[31m\u202eb\ud800é") == "a\\x1b[31m\\u202eb\\ud800é"


def results(**changes):
    values = {"initial": {"value": [0.5, 0.5, 0.5]}, "final": {"value": [0.123456, 0.2, 0.3]}, "true": None}
    return {
        "iterations": 30, "loss": 0.5, "rmse": {"initial": None, "final": None}, "parameter_rmse": {},
        "relative_error": {}, "parameters": {"wall.reflectance.value": values}, "loss_trend": None, "worse": [],
    } | changes  # fmt: skip


def test_without_a_truth_the_table_has_only_values():
    assert parameter_lines(results(), 80) == [
        "parameter               start        end",
        "wall.reflectance.value  0.5 0.5 0.5  0.123 0.2 0.3",
    ]


@pytest.mark.parametrize("width", [40, 80, 160])
def test_no_line_is_wider_than_the_terminal_and_no_number_is_cut(width):
    key = "a_very_long_name_of_a_wall_that_goes_on_and_on.brdf_0.reflectance.data"
    texture = {"mean": [0.123, 0.456, 0.789], "min": -0.00123, "max": 1.23e5}
    about = {"initial": texture, "final": texture, "true": texture}
    pair = {key: {"initial": 0.123, "final": 0.456}}
    found = results(parameters={key: about}, parameter_rmse=pair, relative_error=pair, worse=[key])
    lines = parameter_lines(found, width)
    assert max(map(len, lines)) <= width
    words = " ".join(" ".join(lines).split())
    assert len(re.findall(r"0\.123 0\.456 0\.789 \(-0\.00123 to 123000\)", words)) == 3
    assert re.search(r"0\.123 to 0\.456, worse", words)


def test_many_parameters_are_a_few_lines():
    assert parameter_lines({}, 80) == parameter_lines(results(parameters={"a": {"initial": None}}), 80) == []
    values = {"initial": {"value": 0.5}, "final": {"value": 0.1}}
    found = results(parameters={f"part{number}.alpha.value": values for number in range(40)})
    lines = parameter_lines(found, 80)
    assert len(lines) == 14
    assert lines[-1] == "and 28 more parameters, on the page"


def test_the_last_line():
    assert last_line("finished", results(loss=None), [], "runs/a/report.html") == (
        "finished after 30 iterations; look at runs/a/report.html"
    )
    line = last_line("interrupted", results(rmse={"initial": 0.3, "final": 0.05}), ["2 values not finite"], "r.html")
    assert line == (
        "interrupted after 30 iterations, loss 0.5, parameter RMSE 0.3 to 0.05, 2 values not finite; look at r.html"
    )


def trend(change, start=0.0131, end=0.0133):
    return {"start": {"mean": start, "error": 0.0004}, "end": {"mean": end, "error": 0.0004}, "change": change}


def test_statements_about_the_loss():
    assert warnings(results(loss_trend=trend("fell"))) == warnings(results(loss_trend=trend("unclear"))) == []
    flat = "the loss did not fall (0.0131 +- 0.0004 at the start, 0.0133 +- 0.0004 at the end)"
    assert warnings(results(loss_trend=trend("flat"))) == [flat]
    assert warnings(results(loss_trend=trend("rose"))) == [flat.replace("did not fall", "rose")]
    lower = warnings(results(loss_trend=trend("flat", end=0.0129)))[0]
    assert lower.startswith("the loss fell by no more than its noise (")
    images = {"initial": 0.01, "final": 0.008}
    assert warnings(results(loss_trend=trend("flat"), image_loss=images)) == []
    assert warnings(results(image_loss={"initial": -20.0, "final": -30.0})) == []  # a ratio of 1.5 of a negative loss
    assert warnings(results(loss_trend=trend("flat"), image_loss={"initial": 0.01, "final": None})) == [flat]


def test_the_worst_parameters_are_named():
    pairs = {f"part{n}": {"initial": 0.1, "final": 0.1 + 0.1 * n} for n in range(1, 7)}
    lines = warnings(results(worse=list(pairs), parameter_rmse=pairs))
    assert lines[0] == "part6 got worse (RMSE 0.1 to 0.7)"
    assert lines[-1] == "and so did 3 more parameters"
    assert len(lines) == 4


MOVING = {"verdict": "still moving", "shares": {"still moving": 1.0}, "spread": [3.0], "to_go": [7.0], "moved": 2.9,
          "reach": 3.0, "rate": 0.03}  # fmt: skip


def judged(about, **measured):
    """Return results of a lamp with the verdict of `MOVING | about`."""
    lamp = {"quantity": "radiance", "shape": [3], "initial": {"value": [5.0]}, "final": {"value": [7.9]}, "true": None}
    common = {"measure_s": 1.0, "share": 0.1, "iterations": 200,
              "learning_rate": 0.03, "target_noise": "measured", "target_spp": 64}  # fmt: skip
    certainty = common | {"parameters": {"lamp.radiance.value": MOVING | about}} | measured
    trend = measured.pop("trend", None)
    return results(parameters={"lamp.radiance.value": lamp}, certainty=certainty, loss_trend=trend)


@pytest.mark.parametrize(("found", "words", "setting"), [
    # The steps moved the lamp in one direction all the time, but not far enough.
    (judged({}), "a higher rate", "--set optimizer.learning_rate=0.2"),
    (judged({"rate": 0.5}), "a higher rate", "its own learning_rate: 3"),
    # The steps were long enough in total, but the lamp did not arrive. It oscillates, or moves along a valley.
    (judged({"reach": 60.0}), "more iterations", "--set run.iterations=680"),
    (judged({"reach": 60.0, "moved": 0.0}), "more iterations", "--set run.iterations=1000"),
    (judged({}, trend={"change": "rose", "start": {"mean": 1, "error": 0.1}, "end": {"mean": 2, "error": 0.1}}),
     "a lower rate", "--set optimizer.learning_rate=0.01"),
    # The loss fell at first and is flat since then, so more of the same steps do not help.
    (judged({"reach": 60.0}, trend=trend("fell", 26.0, 0.3) | {"late": "flat"}),
     "a new run from here", "initial: {run: RUN} for each parameter"),
    (judged({"reach": 60.0}, trend=trend("fell", 26.0, 0.3) | {"late": "fell"}),
     "more iterations", "--set run.iterations=680"),
    (judged({}, trend=trend("fell", 26.0, 0.3) | {"late": "flat"}),
     "a higher rate", "--set optimizer.learning_rate=0.2"),
])  # fmt: skip
def test_a_moving_value_gets_a_remedy(found, words, setting):
    assert parameter_lines(found, 120)[1].endswith(f"still moving: {words}")
    assert f"not converged, still moving: lamp.radiance.value ({words}: {setting})" in warnings(found)


def test_noise_of_the_target_is_told_from_noise_of_the_run():
    noisy = {"verdict": "below the noise", "shares": {"below the noise": 1.0}, "spread": [3.0], "of_target": [2.9]}
    found = judged(noisy)
    assert parameter_lines(found, 120)[1].endswith("below the noise of the target: a cleaner target")
    assert warnings(found) == [
        "below the noise of the target: lamp.radiance.value (a cleaner target: --set target.render.spp=1024)"
    ]
    found["certainty"]["is_biased"] = True  # of a loss like `l1`, whatever the target is
    assert parameter_lines(found, 120)[1].endswith("below the noise of the images: a loss without bias")
    assert warnings(found) == [
        "below the noise of the images: lamp.radiance.value (a loss without bias: --set loss.type=l2)"
    ]
    found = judged(noisy | {"of_target": [1.0]})
    assert parameter_lines(found, 120)[1].endswith("below the noise")
    assert len(parameter_lines(found, 120)) == 2


def test_a_spread_without_the_noise_of_the_target_is_marked():
    found = judged({}, target_noise="left out")
    assert parameter_lines(found, 120)[-1] == (
        "spread: by the noise of the run; noise and errors of targets are not in it"
    )


def test_invisible_parts_are_reported_beside_settled_ones():
    shares = {"settled": 0.58, "still moving": 0.02, "not seen": 0.4}
    found = judged({"verdict": "settled", "shares": shares})
    assert parameter_lines(found, 120)[1].endswith("settled (58 %), 40 % not seen")
    assert warnings(found) == []
    found = judged({"verdict": "not seen", "shares": {"not seen": 1.0}, "spread": None})
    assert parameter_lines(found, 120)[1].endswith("not seen")
    assert warnings(found) == ["not seen: lamp.radiance.value"]


BALL = {"key": "ball.alpha", "p": 1e-9, "explained": 0.98, "value": [0.2], "proposed": [0.4912], "bounds": "[0.02, 1]"}
TINT = {"key": "rug.data", "p": 1e-5, "explained": 0.31, "value": [1, 1, 1], "proposed": [], "bounds": ""}
FIT = {"p": 0.002, "misfit": 0.0614, "energy": 1e-4, "is_significant": True, "candidates": [BALL, TINT]}


def test_a_model_that_does_not_fit_names_what_would():
    """The entries of `parameters` can be copied. The values that the misfit may have moved are not settled."""
    found = judged({"verdict": MISFIT, "shares": {MISFIT: 1.0}}, fit=FIT)
    lines = parameter_lines(found, 120)
    assert lines[1].endswith(f"{MISFIT}: another parameter")
    assert lines[2:] == [
        "misfit: images and targets differ by 6.1 % more than noise explains; the spreads allow for a hidden misfit of "
        "the same size",
        "these entries of `parameters` would reduce it:",
        "  - {key: ball.alpha, bounds: [0.02, 1]}  # 98 % of the misfit; 0.2 would become about 0.491",
        "  - {key: rug.data}  # 31 % of the misfit",
    ]
    assert warnings(found) == [
        f"{MISFIT}: lamp.radiance.value (images and targets differ by 6.1 % more than noise explains) "
        "(another parameter: --free ball.alpha)"
    ]
    assert yaml.safe_load(lines[4]) == [{"key": "ball.alpha", "bounds": [0.02, 1]}]


@pytest.mark.parametrize(
    ("shares", "named"), [((0.98, 0.31), 1), ((0.6, 0.31), 2), ((0.6, 0.2, 0.2), 3), ((0.4, 0.2, 0.1, 0.1), 3)]
)
def test_a_command_recovers_what_explains_the_misfit(shares, named):
    """A value that gets worse or is still moving comes first, because it may cause the misfit."""
    causes = [BALL | {"key": f"a {number}", "explained": share} for number, share in enumerate(shares)]
    command = "reslrb optimize 'runs/a b' " + " ".join(f"--free 'a {number}'" for number in range(named))
    rose = {"change": "rose", "start": {"mean": 1, "error": 0.1}, "end": {"mean": 2, "error": 0.1}}
    below = {"verdict": "below the noise of the target"}
    for about, loss, expected in (
        ({"verdict": MISFIT}, None, command),
        (below, None, command),
        ({}, None, ""),
        ({}, rose, ""),
    ):
        found = judged(about, fit=FIT | {"candidates": causes}, trend=loss)
        manifest = {"results": found, "status": "finished"}
        assert free_command(manifest, "runs/a b") == expected
        fell = found | {"loss_trend": {"change": "fell"}}
        assert (outcome_of(manifest, fell, "runs/a b").command == command) == bool(about)
    settled = judged({"verdict": MISFIT}, fit=FIT)
    allowed = {"results": settled, "command_line": ["reslrb", "optimize", "--allow-code"]}
    assert free_command(allowed, "a") == "reslrb optimize a --allow-code --free ball.alpha"
    assert free_command({"results": judged({})}, "a") == free_command({}, "a") == ""


def test_values_on_their_way_may_cause_a_misfit():
    about = {"verdict": "still moving", "spread": [0.1]}
    [first, *_] = misfit_lines({"certainty": {"fit": FIT, "parameters": {"ball.alpha": about}}})
    assert first.endswith("differ by 6.1 % more than noise explains; values that are still moving may be the cause")


def test_a_misfit_without_a_cause_has_no_remedy():
    found = judged({"verdict": MISFIT, "shares": {MISFIT: 1.0}}, fit=FIT | {"candidates": []})
    assert advice(found) is None
    assert len(parameter_lines(found, 120)) == 3
    settled = judged({"verdict": "settled", "shares": {"settled": 1.0}}, fit=FIT | {"is_significant": False})
    assert len(parameter_lines(settled, 120)) == 2
