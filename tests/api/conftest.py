"""Runs of these tests draw each diagram once, as those of the commands do."""

from __future__ import annotations

import pytest
from cli.conftest import drawn_once

from reslrb_cli.report.page import values


@pytest.fixture(autouse=True)
def _draw_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(values, "diagram", drawn_once)
