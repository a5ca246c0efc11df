"""The conformance tests run in one variant. Their scenes are in scenes.py and gradient_cases.py."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True, scope="session")
def _variant(llvm: str) -> None:
    """Set the variant, and stop Mitsuba's warnings about deliberate actions of the tests."""
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)


@pytest.fixture(params=["quarter", pytest.param("all", marks=pytest.mark.long)])
def samples(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Share of its samples that `scenes.agreement` uses. A quarter of the samples shows the planted faults within
    seconds.

    All samples, which halve the noise, are for `-m long`.
    """
    from conformance import scenes

    monkeypatch.setattr(scenes, "SHARE", {"quarter": 0.25, "all": 1.0}[request.param])
