"""The spectral variant: its own tests (`spectral.py`), and a part of the conformance tests.

The default suite changes the variant of its process. `-m long` has a process for each file.
"""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from conformance import spectral as own
from conformance import test_gradients
from conformance.gradient_cases import CASES

ROOT = Path(__file__).resolve().parents[2]
OWN = "tests/conformance/spectral.py"
ROULETTE = next(case for case in CASES if case.name == "roulette")
QUICK: dict[str, Callable[..., None]] = {
    "colours": own.test_coefficients_have_their_colour,
    "derivatives of colours": own.test_coefficients_have_derivatives,
    "condition of gradients by colours": own.test_the_condition_of_gradients_by_colours,
    "condition of zero gradients": own.test_the_condition_of_gradients_that_are_zero,
    "furnace": lambda: own.test_the_furnace_has_its_colour("both", "regular"),
    "derivatives by stack": lambda: own.test_the_furnace_has_its_derivatives("light", "stack", "regular"),
    "bump map": own.test_a_bump_map_is_no_colour,
    "black body": own.test_a_black_body_becomes_a_regular_spectrum,
    "proposals": own.test_spectra_get_bounds_and_black_lamps_are_not_proposed,
    "export of a lamp": own.test_a_recovered_colour_of_a_lamp_is_exported,
    "export of every form": own.test_every_form_of_a_spectrum_is_exported,
    "raw photograph": own.test_a_raw_photograph_gets_the_colours_of_the_lamps,
    "missing channel": own.test_a_photograph_lacks_a_channel_of_the_film,
    "coefficients are no zeros": own.test_the_coefficients_of_an_environment_map_are_no_zeros,
    "naive AD": lambda: test_gradients.test_exact_estimators_equal_naive_ad(ROULETTE, "correlated"),
}
#: Files whose default tests do not assume that a path's values are the channels of the film.
FILES = ["aim", "attached", "attached_camera", "attached_reservoir", "camera_paths", "drawing", "edges", "freezing",
         "gradients", "guiding", "guiding_tables", "image_paths", "image_plugins", "kernels", "memory",
         "moving_emitters", "plan", "plugin", "replay", "sequences", "shuffled", "small_lamps",
         "weights"]  # fmt: skip


def run(*arguments: str) -> None:
    """Run tests in the spectral variant, and assert that they pass."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", *arguments]
    environment = os.environ | {"RESLRB_TEST_VARIANT": "llvm_ad_spectral"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]


@pytest.mark.parametrize("check", QUICK)
def test_the_spectral_variant(check: str, spectral: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = {"tmp_path": tmp_path, "monkeypatch": monkeypatch}
    names = inspect.signature(QUICK[check]).parameters
    QUICK[check](**{name: given[name] for name in names})


@pytest.mark.long
@pytest.mark.parametrize("file", [OWN, *(f"tests/conformance/test_{name}.py" for name in FILES)])
def test_the_conformance_of_the_spectral_variant(file: str) -> None:
    run(file)
