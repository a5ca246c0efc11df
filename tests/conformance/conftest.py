"""The conformance tests run in one variant; scenes are in scenes.py and gradient_cases.py."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True, scope="session")
def _variant(llvm: str) -> None:
    """Sets the variant, and keeps Mitsuba from warning about what a test does on purpose."""
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)
