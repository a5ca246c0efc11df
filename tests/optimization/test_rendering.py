"""Images that are saved: which of them are recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reslrb_cli.config.loader import load, loads
from reslrb_cli.optimization import loading
from reslrb_cli.optimization.assemble import assemble_scene

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "stiff" / "lamp.yaml"
TINY = ["scene.options={resx: 12, resy: 12}", "integrator.max_depth=2", "integrator.freeze=true"]


@pytest.mark.parametrize(("most", "recorded"), [(12 * 12 * 8, True), (12 * 12 * 8 - 1, False)])
def test_only_small_images_are_recorded(monkeypatch, most, recorded):
    """The trials of a recording render an image three times more: no gain where that takes long, and it comes once."""
    monkeypatch.setattr(loading, "MOST_PATHS_APART", most)
    problem = assemble_scene(load(CONFIG, TINY))
    image = problem.render(0, 8, 0, "saved image")
    assert bool(problem.integrator.preparation.recordings.counts()) == recorded
    problem = replace(problem, integrator=problem.integrator.with_options(samples_per_pass=None, freeze=False))
    assert np.array_equal(image, problem.render(0, 8, 0, "saved image"))


def test_passes_of_a_large_image_are_not_recorded(monkeypatch):
    """However small the last of them is."""
    monkeypatch.setattr(loading, "PATHS_PER_PASS", 12 * 12 * 4)
    monkeypatch.setattr(loading, "MOST_PATHS_APART", 12 * 12 * 3)
    problem = assemble_scene(load(CONFIG, TINY))
    problem.render(0, 5, 0, "saved image")
    assert not problem.integrator.preparation.recordings.counts()


def test_a_run_with_ptracer_says_where_a_lens_is_not_clipped(tmp_path, caplog):
    lens = '<float name="aperture_radius" value="0.1"/><float name="focus_distance" value="3"/>'
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0"><sensor type="thinlens" id="eye"><float name="far_clip" value="4"/>{lens}</sensor>'
        '<emitter type="point"/><shape type="rectangle" id="floor">'
        '<transform name="to_world"><translate z="5"/></transform></shape></scene>'
    )

    def lines(integrator: str) -> list[str]:
        own = "parameters: [{key: floor.bsdf.reflectance.value}]"
        text = f"scene: {{file: scene.xml}}\ntarget: {{render: {{}}}}\n{own}\nintegrator: {{type: {integrator}}}\n"
        caplog.clear()
        assemble_scene(loads(text, tmp_path / "c.yaml", []))
        return [record.getMessage() for record in caplog.records]

    assert lines("reslrb") == []
    [line] = lines("ptracer")
    assert "sensor eye: ptracer does not clip what a `thinlens` sees" in line
