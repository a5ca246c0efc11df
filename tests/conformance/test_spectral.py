"""The spectral variant, in a process of its own: its own tests (`spectral.py`), and a part of the conformance tests."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
OWN = "tests/conformance/spectral.py"
QUICK = [
    f"{OWN}::test_coefficients_have_their_colour",
    f"{OWN}::test_coefficients_have_derivatives",
    f"{OWN}::test_the_condition_of_gradients_by_colours",
    f"{OWN}::test_the_coefficients_of_an_environment_map_are_no_zeros",
    f"{OWN}::test_the_furnace_has_its_colour[both-regular]",
    f"{OWN}::test_the_furnace_has_its_derivatives[light-stack-regular]",
    f"{OWN}::test_the_furnace_has_its_derivatives[light-reservoir-irregular]",
    "tests/conformance/test_gradients.py::test_exact_estimators_equal_naive_ad[roulette-correlated]",
]
#: Files whose default tests do not assume that a path's values are the channels of the film.
FILES = ["aim", "attached", "attached_camera", "attached_reservoir", "camera_paths", "edges", "freezing", "gradients",
         "guiding", "guiding_tables", "image_paths", "image_plugins", "kernels", "memory", "moving_emitters",
         "plan", "plugin", "replay", "sequences", "shuffled", "small_lamps", "survival", "weights"]  # fmt: skip


def run(*arguments: str) -> None:
    """Run tests in the spectral variant, and assert that they pass."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", *arguments]
    environment = os.environ | {"RESLRB_TEST_VARIANT": "llvm_ad_spectral"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]


def test_the_spectral_variant() -> None:
    run(*QUICK)


@pytest.mark.long
@pytest.mark.parametrize("file", [OWN, *(f"tests/conformance/test_{name}.py" for name in FILES)])
def test_the_conformance_of_the_spectral_variant(file: str) -> None:
    run(file)


@pytest.mark.long
def test_emitters_and_bsdfs_in_the_spectral_variant() -> None:
    run("tests/conformance/test_image_plugins.py", "-k", "not furnace")


@pytest.mark.long
def test_exact_estimators_in_the_spectral_variant() -> None:
    run("tests/conformance/test_gradients.py", "-k", "equal_naive_ad")
