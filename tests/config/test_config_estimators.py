"""The options of `reslrb` in a configuration are those of its estimators."""

from __future__ import annotations

from typing import get_args

import pytest

from reslrb_cli.config import Reslrb
from reslrb_cli.config.choices import ESTIMATOR_OPTIONS
from reslrb_cli.estimators import ESTIMATORS


def test_the_table_names_every_estimator() -> None:
    names = list(ESTIMATORS)
    assert list(ESTIMATOR_OPTIONS) == names
    assert list(get_args(Reslrb.model_fields["estimator"].annotation)) == names


@pytest.mark.parametrize("name", ESTIMATOR_OPTIONS)
def test_options_and_defaults_are_the_estimators_own(name: str) -> None:
    options = Reslrb(estimator=name).options()  # type: ignore[arg-type]
    shared = {"max_depth", "rr_depth", "hide_emitters", "estimator"}
    assert {key: value for key, value in options.items() if key not in shared} == ESTIMATORS[name].OPTIONS
