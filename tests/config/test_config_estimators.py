"""The options of `reslrb` in a configuration are those of its estimators."""

from __future__ import annotations

from typing import Any, get_args

import pytest

from reslrb_cli.config.integrators import ESTIMATOR_OPTIONS, Reslrb
from reslrb_cli.config.schema import memory_bytes
from reslrb_cli.estimators import ESTIMATORS


def test_the_table_names_every_estimator() -> None:
    names = list(ESTIMATORS)
    assert list(ESTIMATOR_OPTIONS) == ["auto", *names]
    assert list(get_args(Reslrb.model_fields["estimator"].annotation)) == ["auto", *names]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_options_and_defaults_are_the_estimators_own(name: str) -> None:
    options = Reslrb(estimator=name).options()  # type: ignore[arg-type]
    shared = {"max_depth", "rr_depth", "hide_emitters", "estimator", "freeze"}
    shared |= {"attached", "filter_normalization", "attached_sampling", "guiding", "sequence"}
    assert {key: value for key, value in options.items() if key not in shared} == ESTIMATORS[name].OPTIONS


def test_a_chosen_estimator_keeps_the_shared_options_alone() -> None:
    own = Reslrb(estimator="reservoir", capacity=3, max_depth=4)
    assert own.chosen(estimator="stack") == Reslrb(estimator="stack", max_depth=4)


@pytest.mark.parametrize(
    ("written", "bytes_"),
    [(64, 64 * 2**20), (0.5, 2**19), ("512 MiB", 2**29), ("2GiB", 2**31), ("1.5 gb", 1_500_000_000), ("7 kB", 7000)],
)
def test_amounts_of_memory(written: int | float | str, bytes_: int) -> None:
    assert memory_bytes(written) == bytes_


@pytest.mark.parametrize("written", ["", "512", "-1 MiB", "1 XiB", "0 B", 0, -3, float("nan"), float("inf"), True])
def test_what_is_no_amount_of_memory(written: int | float | str) -> None:
    with pytest.raises(ValueError, match="no amount of memory"):
        memory_bytes(written)


@pytest.mark.parametrize(
    ("name", "off", "on"), [("guiding", "off", "on"), ("sequence", "independent", "low_discrepancy")]
)
def test_what_is_left_to_measurement_where_the_estimator_is(name: str, off: str, on: str) -> None:
    def given(**options: Any) -> str:
        return str(getattr(Reslrb(**options), name))

    assert given() == "auto"
    assert given(estimator="stack") == off
    assert given(estimator="stack", **{name: "auto"}) == "auto"
    assert given(**{name: off}) == off
    # What is made before anything is measured has nothing of it.
    for own in (Reslrb(), Reslrb(**{name: "auto", "estimator": "reservoir"})):
        assert getattr(own.chosen(estimator="stack"), name) == getattr(own.undecided_off(), name) == off
    asked = Reslrb(**{name: on})
    assert getattr(asked.chosen(estimator="stack"), name) == getattr(asked.undecided_off(), name) == on
