"""Photographs as targets: clipped, with unknown exposure, and with what light tracing cannot see in them."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli import tiny
from cli.calling import reslrb, settings
from cli.photographs import WALLS, write_photograph

from reslrb_cli.cli import main
from reslrb_cli.records.manifest import read_manifest


def optimize(*given: str) -> tuple[dict[str, np.ndarray], dict]:
    """Recovered values, and the manifest."""
    sets = settings(*given)
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


@pytest.mark.usefixtures("llvm")
def test_texels_that_no_view_shows_are_told_from_settled_ones(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a truth, too. They light the lamp's face, and by it what is seen: a gradient, and no colour of theirs."""
    monkeypatch.chdir(tmp_path)
    tiny.write_experiment(tmp_path)
    scene = tiny.SCENE.replace('name="fov" value="50"', 'name="fov" value="14.25"')  # the middle 2 x 2 of 4 x 4 texels
    (tmp_path / "scene.xml").write_text(scene)
    image = mi.render(mi.load_file("scene.xml"), spp=1024, integrator=mi.load_dict({"type": "path", "max_depth": 3}))
    mi.Bitmap(image).write("photo.exr")
    sets = ("target={file: photo.exr}", "run.iterations=80", "run.spp=512", "loss.type=relative_l2",
            "optimizer={learning_rate: 0.05, schedule: cosine}")  # fmt: skip
    done = reslrb("optimize", "tiny.yaml", *settings(*sets))
    assert done.exit_code == 0, done.output
    about = read_manifest(Path("runs/tiny"))["results"]["certainty"]["parameters"][tiny.KEY]
    assert (about["seen"], about["shares"]["not seen"]) == (0.25, 0.75)
    assert about["verdict"] == "settled"
    assert about["shares"]["settled"] > 0.2
    values, true = np.load("runs/tiny/parameters/parameters.npz")[tiny.KEY], np.array(mi.Bitmap("poster.exr"))
    errors = np.sqrt(np.mean(np.square(values - true), axis=2))
    shown = np.zeros((4, 4), dtype=bool)
    shown[1:3, 1:3] = True
    assert errors[shown].max() < 4 * about["spread"][0] < errors[~shown].mean()
    assert "settled (" in done.output
    assert ", 75 % not seen" in done.output
    np.testing.assert_array_equal(np.load(f"runs/tiny/parameters/{tiny.KEY}.mask.npy"), shown)
    page = Path("runs/tiny/report.html").read_text()
    assert "75 % not seen" in page
    assert "<b>reached</b> by light and sensor (white): 25 %" in page
    assert "noise of the target is not in it" in page
