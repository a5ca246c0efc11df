"""The best parameters of a run: by the mean of some losses, or by views that are held out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from records.test_earlier_metrics import RECORD

from reslrb_cli.optimization.results import WINDOW, Best


def seen(losses, held_out=None):
    best = Best(held_out is not None)
    for number, loss in enumerate(losses):
        held = held_out[number] if held_out is not None else None
        best.see(replace(RECORD, iteration=number, loss=loss, held_out=held), {"a": number})
    return best


def test_noise_is_not_taken_for_the_best():
    """One lucky loss at the start, and less of it on the average later."""
    losses = [0.01] + [1.0] * 20 + [0.5] * 15 + [0.9] * 20
    best = seen(losses)
    means = [np.mean(losses[end - WINDOW : end]) for end in range(WINDOW, len(losses) + 1)]
    assert best.iteration == int(np.argmin(means)) + WINDOW - 1
    assert best.values == {"a": best.iteration}
    assert best.loss == pytest.approx(0.5)


def test_there_is_none_before_the_window_is_full():
    assert seen([1.0] * (WINDOW - 1)).to_json() is None
    assert seen([1.0] * WINDOW).to_json()["iteration"] == WINDOW - 1


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_is_never_the_best(bad):
    assert seen([bad] * 30).iteration is None
    assert seen([*[bad] * 5, *[2.0] * 30]).iteration == 5 + WINDOW - 1


def test_views_that_are_held_out_decide():
    held_out = [3.0, None, 1.0, None, 2.0]
    best = seen([5.0, 4.0, 3.0, 2.0, 1.0], held_out)
    assert (best.iteration, best.loss, best.values) == (2, 1.0, {"a": 2})


@pytest.mark.parametrize("at", [3, 12, 25])
def test_it_goes_on_from_what_it_was(at):
    losses = list(np.random.default_rng(3).uniform(size=40))
    whole, part = seen(losses), seen(losses[:at])
    again = Best(False)
    records = [replace(RECORD, iteration=number, loss=loss) for number, loss in enumerate(losses)]
    again.recall(records[:at])
    if part.iteration is not None:
        again.restore(part.iteration, part.loss, part.values)
    for record in records[at:]:
        again.see(record, {"a": record.iteration})
    assert again.to_json() == whole.to_json()
    assert again.values == whole.values
