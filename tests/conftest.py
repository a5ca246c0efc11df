"""Shared setup of all tests: the choice of libLLVM before Mitsuba is imported, the variant, and a clean allocator
between modules.
"""

from __future__ import annotations

import gc
import importlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from compilation import (
    allocate_registers,
    combine,
    compute_alone,
    gather_at_once,
    leave_out_optimisations,
    show_fatal_errors,
)
from golden import said
from kit import with_wavelengths, work_in
from report.chromium import Chromium, find_chromium
from turns import in_part, read_part

import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before any test imports Mitsuba
from reslrb_cli.backend.variant import set_variant
from reslrb_cli.errors import BackendError

#: Modules that most tests import sooner or later.
HEAVY = ("colour", "matplotlib.pyplot", "reslrb_cli.cli.optimize", "reslrb_cli.report.page", "reslrb_cli.runs.recorder")


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "Run the K-th of N parts of the chosen tests. Each part has a share of each file."
    parser.addoption("--part", type=read_part, metavar="K/N", default=(1, 1), help=text)


class FromTheEnd(pytest.Dir):
    """Folder whose files are collected from the last to the first."""

    def collect(self) -> Iterable[pytest.Item | pytest.Collector]:
        return reversed([*super().collect()])


def pytest_collect_directory(path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Let every other worker collect from the end. Workers store the files that pytest has rewritten for them, which
    takes as long as the import of everything else. They meet in the middle, and none rewrites the files of another.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0")
    return FromTheEnd.from_parent(parent, path=path) if int(worker.removeprefix("gw")) % 2 else None


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Give all workers the same order. Leave out the tests of other parts, and tests that need a browser if there is no
    browser.
    """
    if "PYTEST_XDIST_WORKER" in os.environ:
        items.sort(key=lambda item: item.path.parts)
    chosen = in_part(items, *config.getoption("part"))
    if len(chosen) < len(items):
        config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
        items[:] = chosen
    if find_chromium() is None:
        left_out = [item for item in items if "chromium" in getattr(item, "fixturenames", ())]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in left_out]


#: Diagrams that earlier tests drew, by the labels of their axes and the kinds of their curves.
DRAWN: dict[tuple[Any, ...], str] = {}


def drawn_once(panel: Any) -> str:
    """Return the first diagram that was drawn with these labels and curves of these kinds. Drawing takes longer than
    most runs of tests.
    """
    from reslrb_cli.report.page.layout import diagram

    curves = [(curve.place, len(curve.xs), curve.known()) for curve in panel.shown()]
    kinds = [(place, len(known) > 1, len(known) < count, known.min() > 0) for place, count, known in curves]
    if (kind := (panel.x, panel.y, *kinds)) not in DRAWN:
        DRAWN[kind] = diagram(panel)
    return DRAWN[kind]


@pytest.fixture(autouse=True)
def _draw_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw each kind of a run's diagrams once."""
    if "reslrb_cli.report" in sys.modules:
        monkeypatch.setattr("reslrb_cli.report.page.values.diagram", drawn_once)


@pytest.fixture(scope="session")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    executable = find_chromium()
    assert executable is not None, "pytest_collection_modifyitems leaves these tests out"
    browser = Chromium(executable, tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print one line if tests that need a browser are left out."""
    if find_chromium() is None:
        terminalreporter.write_line(
            "no Chromium: tests that look at pages in a browser are left out (scripts/setup --test brings one)"
        )


def pytest_collection_finish() -> None:
    """Exclude all existing objects from later garbage collections. Python collects garbage for each recording of a
    step, and the objects exist until the last test anyway.
    """
    if "PYTEST_XDIST_WORKER" in os.environ:  # a worker has many tests before this one
        for name in HEAVY:
            importlib.import_module(name)
    gc.collect()
    gc.freeze()


def is_quick(config: pytest.Config) -> bool:
    """Return True unless the long tests are requested. With RESLRB_TEST_OPTIMISED=1, return False, so that all tests
    run as for users.
    """
    is_long = "long" in config.option.markexpr and "not long" not in config.option.markexpr
    return not is_long and not os.environ.get("RESLRB_TEST_OPTIMISED")


def pytest_configure(config: pytest.Config) -> None:
    """Leave out compiler optimisations in quick runs, and handle ignored signals by default."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # Shells start background jobs with SIGINT ignored, and nohup starts jobs with SIGHUP ignored. All runs that
        # tests start would inherit this, but some of these runs must be interrupted.
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    # Otherwise every process that tests start would compile the package anew, which takes half a second.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
    if is_quick(config):
        os.fsync = lambda descriptor: None  # files of tests need not survive a loss of power
        if leave_out_optimisations():
            show_fatal_errors(os.dup(2))  # before pytest captures it


def tested_variant() -> str:
    """Set the variant of the tests, and return its name."""
    named = os.environ.get("RESLRB_TEST_VARIANT")
    try:
        return set_variant(named or "llvm_ad_rgb")
    except BackendError as error:
        (pytest.fail if named else pytest.skip)(str(error))


@pytest.fixture(scope="session")
def llvm(pytestconfig: pytest.Config) -> str:
    """Set the variant once, and return its name.

    The variant is `llvm_ad_rgb`. Tests are skipped if the machine has no backend for it. If RESLRB_TEST_VARIANT names a
    variant, a missing backend fails the tests, because the user wants to test this variant.
    """
    variant = tested_variant()
    if variant.startswith("llvm") and is_quick(pytestconfig):
        compute_alone()
        gather_at_once()
    return variant


@pytest.fixture
def spectral(llvm: str) -> Iterator[None]:
    """The spectral variant of the tests' backend, with the plugins."""
    import mitsuba as mi

    from reslrb_cli.integrators.plugin import register

    mi.set_variant(with_wavelengths(llvm))
    register()
    yield
    mi.set_variant(llvm)


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of the test as the working directory, with a cache of its own."""
    work_in(tmp_path, monkeypatch)
    return tmp_path


@pytest.fixture
def compared(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Compare the outputs of all commands that a test calls, and the configurations and scenes that they write, with
    the stored ones. Long tests compute with other samples, so they are left out.
    """
    if not is_quick(request.config):
        yield
        return
    from reslrb_cli.scene.load import warn_once

    calls: list[Any] = []
    invoke = CliRunner.invoke
    warn_once.cache_clear()  # the output must not depend on earlier tests
    monkeypatch.setenv("RESLRB_CACHE", str(tmp_path / "cache"))

    def remember(*given: Any, **options: Any) -> Any:
        result = invoke(*given, **options)
        lines = said.lines_of(result.stdout, result.stderr)
        calls.append(said.masked([*map(str, given[2]), result.exit_code, *lines], tmp_path))
        return result

    monkeypatch.setattr(CliRunner, "invoke", remember)
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*") if file.is_file()}
    yield
    written = [
        file for file in sorted(tmp_path.rglob("*")) if file.suffix in (".yaml", ".xml") and "runs" not in file.parts
    ]
    texts = {str(file.relative_to(tmp_path)): said.content(file, tmp_path) for file in written
             if file.is_file() and not file.is_symlink() and before.get(file) != file.stat().st_mtime_ns}  # fmt: skip
    said.check(f"{request.node.nodeid.removeprefix('tests/')}", {"calls": calls, **texts})


def switched_on(switch: Callable[[bool], None], config: pytest.Config) -> Iterator[None]:
    """Turn an option of LLVM on during a test, if tests compile without LLVM's optimisations."""
    if is_quick(config):
        switch(True)
    yield
    if is_quick(config):
        switch(False)


@pytest.fixture
def combined(llvm: str, pytestconfig: pytest.Config) -> Iterator[None]:
    """Compile the kernels of a test with LLVM's combiner, which comparisons of two masks need (compilation.py)."""
    yield from switched_on(combine, pytestconfig)


@pytest.fixture
def registers(llvm: str, pytestconfig: pytest.Config) -> Iterator[None]:
    """Compile the kernels of a test with LLVM's allocation of registers, for kernels that run for seconds."""
    yield from switched_on(allocate_registers, pytestconfig)


@pytest.fixture(autouse=True, scope="module")
def _release_jit_memory() -> Iterator[None]:
    """Free the JIT's cached memory after each module, so that the memory peaks of one module do not affect the next
    module. Exclude what is left from later garbage collections, as `pytest_collection_finish` does.
    """
    yield
    gc.collect()
    gc.freeze()
    if "drjit" in sys.modules:
        sys.modules["drjit"].flush_malloc_cache()


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Folder where a test may mount a disk. The disk is unmounted at the end."""
    place = tmp_path / "disk"
    place.mkdir()
    yield place
    while os.path.ismount(place):
        subprocess.run(["umount", str(place)], check=True)
