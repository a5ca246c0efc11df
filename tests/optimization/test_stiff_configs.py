"""The stiff experiments in `configs/stiff/`: they load, and are as stiff as they say."""

from __future__ import annotations

from pathlib import Path

import pytest

from reslrb_cli.config.loader import load
from reslrb_cli.measure.conditioning import measure_conditioning
from reslrb_cli.optimization.assemble import assemble

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "stiff"
SMALL = ["scene.options={resx: 16, resy: 16}", "target.render.spp=16"]


def test_each_is_known_here():
    assert {path.stem for path in CONFIGS.iterdir()} == {"lamp", "plate", "wall"}


MORE = [("plate", "change"), ("wall", "gradient")]


@pytest.mark.parametrize(
    ("name", "quantity"),
    [("lamp", "change"), *(pytest.param(*each, marks=pytest.mark.long) for each in MORE)],
)
def test_sensitivities_differ_by_a_million(name, quantity):
    """By the parameters' units, or, of single entries, by how many they are."""
    spp = "run.spp=1024" if name == "wall" else "run.spp=64"
    measured = measure_conditioning(assemble(load(CONFIGS / f"{name}.yaml", [*SMALL, spp])), samples=4)
    assert measured.spread(quantity) > 1e6
    assert measured.spread("length") is not None
