"""Tests compute with one thread, and files are read and written all the same."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from compilation import search_path

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = """
import sys
from pathlib import Path
from reslrb_cli.backend.variant import set_variant
set_variant("llvm_ad_rgb")
from threads import compute_alone
import drjit as dr, mitsuba as mi, numpy as np
from reslrb_cli.scene.load import load_scene
print(compute_alone(), dr.thread_count(), flush=True)
image = np.random.default_rng(1).uniform(size=(40, 30, 3)).astype(np.float32)
file = sys.argv[1] + "/image.exr"
mi.Bitmap(image).write(file)
assert (np.array(mi.Bitmap(file)) == image).all()
load_scene(Path(sys.argv[2]), {"resx": 16, "resy": 16})
dr.set_thread_count(2)
mi.Bitmap(image[:20]).write(file)
assert (np.array(mi.Bitmap(file)) == image[:20]).all()
"""


@pytest.mark.usefixtures("llvm")
def test_one_thread_reads_and_writes_images(tmp_path: Path) -> None:
    """And several, if a test has them."""
    scene = ROOT / "scenes" / "grey_room" / "scene.xml"
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path), str(scene)], capture_output=True, text=True, check=False,
        timeout=120, env={"PYTHONPATH": search_path(ROOT, ROOT / "tests"), "HOME": str(tmp_path)},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "True 1\n"), done.stderr


ONE_CORE = """
import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from reslrb_cli.backend.variant import set_variant
set_variant("llvm_ad_rgb")
import mitsuba as mi, numpy as np
file = sys.argv[1] + "/image.exr"
mi.Bitmap(np.ones((8, 8, 3), np.float32)).write(file)
print(np.array(mi.Bitmap(file)).sum())
"""


@pytest.mark.usefixtures("llvm")
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs to choose the cores of a process")
def test_a_machine_of_one_core_reads_and_writes_images(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", ONE_CORE, str(tmp_path)], capture_output=True, text=True, check=False, timeout=60,
        env={"PYTHONPATH": search_path(ROOT), "HOME": str(tmp_path)},
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "192.0\n"), done.stderr


def test_tests_have_one(llvm: str, pytestconfig: pytest.Config) -> None:
    import drjit as dr

    if os.environ.get("RESLRB_TEST_OPTIMISED") or "not long" not in pytestconfig.option.markexpr:
        pytest.skip("these tests run as users do")
    if hasattr(os, "sched_getaffinity") and len(os.sched_getaffinity(0)) == 1:
        pytest.skip("where there is one core, whatever sets a variant sets two threads")
    assert not llvm.startswith("llvm") or dr.thread_count() == 1
