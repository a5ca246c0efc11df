"""The tests of measurements run in one variant, without Mitsuba's warnings about deliberate actions of the tests."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True, scope="session")
def _quiet(llvm: str) -> None:
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)
