"""What tests of lenses share: fewer samples of what no test measures."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from reslrb_cli.measure import tolerance
from reslrb_cli.runs import export


@pytest.fixture(autouse=True, scope="module")
def _few_samples() -> Iterator[None]:
    """Of the rays that tell where light goes, and of the solid's picture, which take seconds of every run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tolerance, "RAYS", 2**16)
        patch.setattr(export, "PICTURE_SPP", 4)
        yield
