"""What tests of commands share: a log that ends with each test, and a cache of their own."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from reslrb_cli.report.seen import flip


@pytest.fixture(autouse=True)
def _own_log_and_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A command logs to the standard error that it finds first, which the next test closes."""
    monkeypatch.setenv("RESLRB_CACHE", str(tmp_path_factory.mktemp("cache")))
    # HDR-FLIP takes longer than all else that these runs do at their end; tests/report looks at it.
    monkeypatch.setattr(flip, "is_installed", lambda: False)
    logger = logging.getLogger("reslrb_cli")
    logger.handlers.clear()
    yield
    logger.handlers.clear()
