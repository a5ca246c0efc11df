"""Glass that rays jump over is warned of when a scene is loaded."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from reslrb_cli.scene.load import load_scene, warn_once

OFFSET = 8.94e-5 * (1 + 3)  # of a ray, where the slab is

SCENE = """\
<scene version="3.0.0">
  <sensor type="perspective"/>
  <emitter type="point"><point name="position" value="0, 6, 0"/></emitter>
  <bsdf type="dielectric" id="glass"/>
  <shape type="rectangle" id="floor">
    <transform name="to_world"><scale value="3"/><rotate x="1" angle="-90"/></transform></shape>
  <shape type="rectangle" id="top"><ref id="glass"/>
    <transform name="to_world"><scale value="2"/><rotate x="1" angle="-90"/><translate y="3"/></transform></shape>
  <shape type="rectangle" id="bottom"><ref id="glass"/>
    <transform name="to_world"><scale value="2"/><rotate x="1" angle="90"/><translate y="{bottom}"/></transform></shape>
  {more}
</scene>
"""


def warnings(tmp_path: Path, caplog: pytest.LogCaptureFixture, thickness: float, more: str = "") -> list[str]:
    file = tmp_path / "scene.xml"
    file.write_text(SCENE.format(bottom=3 - thickness, more=more))
    warn_once.cache_clear()
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        load_scene(file)
    return [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize("offsets", [0.5, 3, 8])
def test_thin(offsets: float, tmp_path: Path, caplog: pytest.LogCaptureFixture, llvm: str) -> None:
    [line] = warnings(tmp_path, caplog, offsets * OFFSET)
    assert "light passes through surfaces" in line
    assert "make the glass thicker" in line
    measured = float(line.partition(" that are ")[2].split()[0])
    assert 0.8 * offsets < measured < 1.4 * offsets  # obliquely it is thicker


@pytest.mark.parametrize("thickness", [15 * OFFSET, 0.2])
def test_thick(thickness: float, tmp_path: Path, caplog: pytest.LogCaptureFixture, llvm: str) -> None:
    assert warnings(tmp_path, caplog, thickness) == []


def test_a_ball_is_thin_at_its_rim_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture, llvm: str) -> None:
    place = '<float name="radius" value="0.5"/><point name="center" value="0, 1, 0"/>'
    assert warnings(tmp_path, caplog, 0.3, f'<shape type="sphere">{place}<ref id="glass"/></shape>') == []
