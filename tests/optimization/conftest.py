"""The variant of these tests."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _variant(llvm):
    """LLVM: these tests are about arithmetic, not about a device."""
