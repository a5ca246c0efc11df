"""Whole runs with several views, from the command line to the manifest and the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cli.calling import read_metrics
from cli.photographs import WALLS, cornell_box
from cli.tiny import write_experiment

from reslrb_cli.cli import main
from reslrb_cli.records.manifest import read_manifest

#: Where eight cameras stand before the Cornell box.
EYES = tuple(f"{x:.2f}, {y:.2f}, 3.6" for x, y in ((-0.8, 0), (0.8, 0), (0, 0.6), (0, -0.6), (-0.6, 0.5), (0.6, 0.5),
             (-0.6, -0.5), (0.6, -0.5)))  # fmt: skip


def optimize(config: str, *settings: str) -> dict:
    sets = [text for setting in settings for text in ("--set", setting)]
    with pytest.raises(SystemExit) as end:
        main(["optimize", config, "--force", *sets])
    assert end.value.code in (0, None)
    manifest = read_manifest(Path("runs") / Path(config).stem)
    assert manifest is not None
    return manifest


@pytest.mark.long
def test_eight_cameras_two_held_out(llvm, tmp_path, monkeypatch):
    """The walls from six of eight cameras, three of them an iteration: what the other two see comes closer as well."""
    (tmp_path / "scene.xml").write_text(cornell_box(24, eyes=EYES))
    true = ", ".join(f"{key}: {value}" for key, value in WALLS.items())
    (tmp_path / "box.yaml").write_text(
        f"""
variant: llvm_ad_rgb
scene: {{file: scene.xml}}
views: [{", ".join(f"{{sensor: {number}}}" for number in range(8))}]
target: {{render: {{spp: 512, parameters: {{{true}}}}}}}
parameters: [{", ".join(f"{{key: {key}, initial: 0.5, bounds: [0, 1]}}" for key in WALLS)}]
integrator: {{max_depth: 4, estimator: stack}}
run: {{iterations: 120, spp: 16, views_per_iteration: 3, held_out: [2, 5]}}
"""
    )
    monkeypatch.chdir(tmp_path)
    manifest = optimize("box.yaml")
    results = manifest["results"]
    assert [view["sensor"] for view in manifest["views"] if view["held_out"]] == [2, 5]
    assert results["held_out"]["final"] < 0.5 * results["held_out"]["initial"]
    seen = [record["held_out"] for record in read_metrics(Path("runs/box")) if record["held_out"] is not None]
    assert len(seen) == 12
    assert np.mean(seen[-3:]) < seen[0]
    assert results["rmse"]["final"] < 0.05 < results["rmse"]["initial"]


def test_a_run_tells_of_its_views(llvm, tmp_path, monkeypatch, capsys):
    """Mask, exposure and shares are in the manifest, in `images/` and on the page."""
    import mitsuba as mi

    write_experiment(tmp_path)
    pixels = np.random.default_rng(3).integers(20, 200, (8, 8, 3), dtype=np.uint8)
    pixels[2, 3] = 255
    mi.Bitmap(pixels).write(str(tmp_path / "photo.png"))
    monkeypatch.chdir(tmp_path)
    manifest = optimize("tiny.yaml", "target={file: photo.png, exposure: 0.8}", "run.iterations=1", "run.final_spp=4")
    [view] = manifest["views"]
    assert (view["kinds"], view["left_out"], view["exposure"]) == ({"clipped": 1}, 1, 0.8)
    assert "view 0: 1 of 64 pixels (1.6%) are left out: 1 are clipped" in capsys.readouterr().err
    weights = np.array(mi.Bitmap("runs/tiny/images/weights.exr"))
    assert np.argwhere(weights[:, :, 0] == 0).tolist() == [[2, 3]]
    page = Path("runs/tiny/report.html").read_text()
    assert "1 of 64" in page
    assert "black is left out of the loss" in page
    assert "0.8" in page[page.index("pixels left out") :]
