"""The conformance tests run in one variant; scenes are in scenes.py and gradient_cases.py."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True, scope="session")
def _variant(llvm: str) -> None:
    """Sets the variant, and keeps Mitsuba from warning about what a test does on purpose."""
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)


@pytest.fixture(params=["quarter", pytest.param("all", marks=pytest.mark.long)])
def samples(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """How many of its samples `scenes.agreement` takes: a quarter shows the faults that were planted, in seconds.

    All of them, which halve the noise, are for `-m long`.
    """
    from conformance import scenes

    monkeypatch.setattr(scenes, "SHARE", {"quarter": 0.25, "all": 1.0}[request.param])
