"""Shared setup of the lens tests: fewer samples for quantities that no test measures."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from reslrb_cli.measure import tolerance
from reslrb_cli.runs import export


@pytest.fixture(autouse=True, scope="module")
def _few_samples() -> Iterator[None]:
    """Reduce the rays that measure where light goes, and the samples of the solid's picture. Otherwise, they take
    seconds in every run.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tolerance, "RAYS", 2**16)
        patch.setattr(export, "PICTURE_SPP", 4)
        yield
