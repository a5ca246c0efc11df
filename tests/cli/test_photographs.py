"""Photographs as targets: clipped, with unknown exposure, and with what light tracing cannot see in them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cli.photographs import WALLS, write_photograph

from reslrb_cli.cli import main
from reslrb_cli.records.manifest import read_manifest


def optimize(*settings: str) -> tuple[dict[str, np.ndarray], dict]:
    """Recovered values, and the manifest."""
    sets = [text for setting in settings for text in ("--set", setting)]
    with pytest.raises(SystemExit) as end:
        main(["optimize", "photo.yaml", "--force", *sets])
    assert end.value.code in (0, None)
    values = json.loads(Path("runs/photo/parameters/parameters.json").read_text())
    manifest = read_manifest(Path("runs/photo"))
    assert manifest is not None
    return {key: np.array(entry["value"]) for key, entry in values.items()}, manifest


def errors(values: dict[str, np.ndarray]) -> dict[str, float]:
    """The greatest error of any channel, by wall."""
    return {key: float(np.abs(values[key] - true).max()) for key, true in WALLS.items()}


@pytest.mark.long
def test_walls_beside_a_lamp_that_clips(llvm, tmp_path, monkeypatch):
    """At exposure 1, by `l2`, with the lamp in view: the mask makes the difference between right and black walls."""
    write_photograph(tmp_path, 64, 1024)
    monkeypatch.chdir(tmp_path)
    values, manifest = optimize()
    [view] = manifest["views"]
    assert view["kinds"]["clipped"] > 0.01 * view["pixels"]
    assert max(errors(values).values()) < 0.05, values
    unmasked, manifest = optimize("target.mask=none")
    assert manifest["views"][0]["left_out"] == 0
    assert max(errors(unmasked).values()) > 0.05, unmasked


@pytest.mark.long
def test_walls_of_a_photograph_whose_exposure_is_unknown(llvm, tmp_path, monkeypatch):
    """At an exposure of 0.8 that is recovered with the walls; taken for 1, the same photograph makes them darker."""
    write_photograph(tmp_path, 32, 1024, exposure=0.8)
    monkeypatch.chdir(tmp_path)
    values, manifest = optimize("target.exposure=auto", "integrator.estimator=stack")
    assert manifest["views"][0]["exposure"] == "exposure"
    assert values["exposure"] == pytest.approx(0.8, rel=0.05)
    bright = {key: np.array(true) > 0.1 for key, true in WALLS.items()}
    for key, true in WALLS.items():
        np.testing.assert_allclose(values[key][bright[key]], np.array(true)[bright[key]], rtol=0.1)
    given, _ = optimize("integrator.estimator=stack")
    assert any(np.any(given[key][bright[key]] < 0.9 * np.array(WALLS[key])[bright[key]]) for key in WALLS), given
