"""What all tests share: libLLVM chosen before Mitsuba is imported, the variant, a clean allocator between modules."""

from __future__ import annotations

import gc
import importlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from compilation import compute_alone, leave_out_optimisations
from report.chromium import Chromium, find_chromium

import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before any test imports Mitsuba
from reslrb_cli.backend.variant import set_variant
from reslrb_cli.errors import BackendError

#: What most tests come to import.
HEAVY = ("colour", "matplotlib.pyplot", "reslrb_cli.cli.optimize", "reslrb_cli.report.page", "reslrb_cli.runs.recorder")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests that need a browser, if there is none."""
    if find_chromium() is None:
        left_out = [item for item in items if "chromium" in getattr(item, "fixturenames", ())]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    executable = find_chromium()
    assert executable is not None, "pytest_collection_modifyitems leaves these tests out"
    browser = Chromium(executable, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say in one line that they were left out."""
    if find_chromium() is None:
        terminalreporter.write_line(
            "no Chromium: tests that look at pages in a browser are left out (scripts/setup --test brings one)"
        )


def pytest_collection_finish() -> None:
    """What is there until the last test is not looked through again and again for what has become free: each recording
    of a step has Python do that."""
    if "PYTEST_XDIST_WORKER" in os.environ:  # which has many tests before it
        for name in HEAVY:
            importlib.import_module(name)
    gc.collect()
    gc.freeze()


def is_quick(config: pytest.Config) -> bool:
    """Whether it is not the long runs that are asked for; RESLRB_TEST_OPTIMISED=1 has all tests run as users do."""
    is_long = "long" in config.option.markexpr and "not long" not in config.option.markexpr
    return not is_long and not os.environ.get("RESLRB_TEST_OPTIMISED")


def pytest_configure(config: pytest.Config) -> None:
    """Compiles quickly, where that is worth it, and heeds signals."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # Shells start what is in the background with SIGINT ignored, and nohup without SIGHUP: so would be all runs
        # that tests start, some of which are to be interrupted.
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    if is_quick(config):
        leave_out_optimisations()


@pytest.fixture(scope="session")
def llvm(pytestconfig: pytest.Config) -> str:
    """Sets the variant, once, and returns its name.

    It is `llvm_ad_rgb`, and tests are skipped if the machine has no backend for it. If RESLRB_TEST_VARIANT names a
    variant, a missing backend fails the tests: whoever names one wants it tested.
    """
    named = os.environ.get("RESLRB_TEST_VARIANT")
    try:
        variant = set_variant(named or "llvm_ad_rgb")
    except BackendError as error:
        (pytest.fail if named else pytest.skip)(str(error))
    if variant.startswith("llvm") and is_quick(pytestconfig):
        compute_alone()
    return variant


@pytest.fixture(autouse=True, scope="module")
def _release_jit_memory() -> Iterator[None]:
    """Gives the JIT's cached memory back after each module, so that peaks measured in one do not show in the next."""
    yield
    if "drjit" in sys.modules:
        gc.collect()
        sys.modules["drjit"].flush_malloc_cache()


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A place for a disk, which is taken away at the end."""
    place = tmp_path / "disk"
    place.mkdir()
    yield place
    while os.path.ismount(place):
        subprocess.run(["umount", str(place)], check=True)
