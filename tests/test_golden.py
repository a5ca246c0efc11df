"""Golden values (tests/golden/golden.py). A change without intended effects must change no bit, no text and no
format.
"""

from __future__ import annotations

import json

import pytest
from golden import golden

CONTENT = json.loads(golden.VALUES.read_text())
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def values() -> dict[str, object]:
    """Golden values of this machine."""
    known = CONTENT["machines"].get(golden.machine())
    if known is None:
        pytest.skip("no values of this processor and libLLVM: tests/golden/golden.py makes them, on the commit before")
    return known


@pytest.mark.parametrize("other_seed", [False, True], ids=["", "another seed"])
@pytest.mark.parametrize("name", golden.RUNS)
def test_bits(values: dict[str, object], name: str, other_seed: bool) -> None:
    assert golden.values_of(name, other_seed) == values[f"{name}{', another seed' * other_seed}"]


def test_texts() -> None:
    assert golden.texts() == CONTENT["texts"]


@pytest.mark.parametrize("name", golden.MEASUREMENTS)
def test_formats(name: str) -> None:
    assert golden.form_of(name) == CONTENT["forms"][name]
