"""Runs whose model is right seldom say that it is not."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli import corners, tiny
from cli.tiny import settings

pytestmark = [pytest.mark.usefixtures("llvm"), pytest.mark.long]

#: Settings that need no measurements.
QUICK = ("integrator.paths=both", "integrator.guiding=off", "integrator.pixels=even", "run.final_spp=16")


def test_a_right_model_explains_its_photograph(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 40 corners with photographs of 8 bits by `path`, at most 2 have a misfit."""
    ps = []
    for seed in range(40):
        (folder := tmp_path / str(seed)).mkdir()
        monkeypatch.chdir(folder)
        corners.write_corner(folder, 200 + seed, (32, 20), is_right=True)
        tiny.done("init", "corner.xml", "--target", "photo.png", "--fit", 0)
        tiny.done("optimize", "corner.yaml", *settings(*QUICK))
        fit = tiny.manifest("runs/corner")["results"]["certainty"]["fit"]
        ps.append(fit["p"])
        print(seed, fit["p"], fit["is_significant"], [each["key"] for each in fit["candidates"]], flush=True)
    assert sum(p <= 0.01 for p in ps) <= 2, ps
