"""Common setup for the tests of commands: each test has its own log handlers and its own cache."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest
from cli.tiny import write_experiment

from reslrb_cli.cli import main
from reslrb_cli.cli.optimize import Progress
from reslrb_cli.runs import recorder as recording


@pytest.fixture(autouse=True)
def _own_log_and_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Clear the log handlers and set a separate cache. The handler would keep the standard error that the next test
    closes.
    """
    monkeypatch.setenv("RESLRB_CACHE", str(tmp_path_factory.mktemp("cache")))
    logger = logging.getLogger("reslrb_cli")
    logger.handlers.clear()
    yield
    logger.handlers.clear()
    logger.setLevel(logging.NOTSET)


@pytest.fixture
def optimize(llvm, tmp_path, monkeypatch, capsys, request):
    """Function that runs `reslrb optimize tiny.yaml` and returns the exit code, standard output and standard error."""
    write_experiment(tmp_path)
    monkeypatch.chdir(tmp_path)
    if getattr(request, "param", None) != "real page":  # the real page takes longer than the run
        monkeypatch.setattr(
            recording, "write_report", lambda folder, *now: (folder / "report.html").write_text("<html>")
        )

    def call(*args):
        with pytest.raises(SystemExit) as end:
            main.main(["optimize", "tiny.yaml", *args])
        out, err = capsys.readouterr()
        return int(end.value.code or 0), out, err

    return call


@pytest.fixture
def during(monkeypatch):
    """Function that installs `act`, so that the command calls `act(record)` after each iteration."""

    def install(act):
        show = Progress.show

        def acting(self, record):
            show(self, record)
            act(record)

        monkeypatch.setattr(Progress, "show", acting)

    return install
