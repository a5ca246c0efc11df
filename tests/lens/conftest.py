"""Shared setup of the lens tests: fewer samples for quantities that no test measures."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from reslrb_cli.runs import export, workshop


@pytest.fixture(autouse=True, scope="module")
def _few_samples() -> Iterator[None]:
    """Reduce the rays that measure where light goes, and the samples of the solid's picture. Otherwise, they take
    seconds in every run.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workshop, "SHARE_RAYS", 2**16)  # the error of a share is at most 2e-3
        patch.setattr(export, "PICTURE_SPP", 4)
        yield
