"""The spectral variant, in a process of its own: its own tests, and a part of the conformance tests."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
#: Tests of other files that also run in the spectral variant.
QUICK = [
    "test_gradients.py::test_exact_estimators_equal_naive_ad[texture-correlated]",
]
LONG = ["test_gradients.py", "test_image_paths.py", "test_image_plugins.py", "test_camera_paths.py", "test_edges.py",
        "test_attached.py", "test_attached_camera.py", "test_moving_emitters.py", "test_guiding.py"]  # fmt: skip


def run(*arguments: str) -> None:
    """Run tests in the spectral variant, and assert that they pass."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-p", "no:cacheprovider", *arguments]
    environment = os.environ | {"RESLRB_TEST_VARIANT": "llvm_ad_spectral"}
    done = subprocess.run(command, capture_output=True, text=True, cwd=HERE.parents[1], env=environment)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    print(done.stdout[-3000:])


def test_the_spectral_variant() -> None:
    run(str(HERE / "spectral.py"), *(str(HERE / one) for one in QUICK))


@pytest.mark.long
@pytest.mark.parametrize("file", LONG)
def test_the_conformance_of_the_spectral_variant(file: str) -> None:
    run(str(HERE / file))
