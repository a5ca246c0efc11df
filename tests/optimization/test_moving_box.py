"""A box on a floor is found from eight places around its own, under five lights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from kit import area, scene, sensor, shape
from optimization.test_projective import BOX, FLOOR, LAMP, write_mesh

import reslrb_cli as rl

SIZE, AWAY = 0.6, 0.25
LIGHTS = {
    "area": LAMP,
    "sphere": shape(
        "sphere", "lamp", '<float name="radius" value="0.3"/> <point name="center" x="-1" y="0.5" z="3"/>',
        area("12, 11, 10")),
    "point": '<emitter type="point"><point name="position" x="-1" y="0.5" z="3"/>'
             '<rgb name="intensity" value="7 6.5 6"/></emitter>',
    "directional": '<emitter type="directional"><vector name="direction" x="0.4" y="-0.2" z="-1"/>'
                   '<rgb name="irradiance" value="2 1.9 1.8"/></emitter>',
    "constant": '<emitter type="constant"><rgb name="radiance" value="0.6 0.7 0.8"/></emitter>',
}  # fmt: skip
CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {render: {spp: 4096, integrator: {type: prb, max_depth: 4}, parameters: {box.translation: [0, 0, 0]}}}
parameters:
  - motion: {of: box, free: [translation]}
    learning_rate: 0.02
integrator: {type: reslrb, max_depth: 4}
loss: {type: l2}
optimizer: {type: adam, schedule: cosine}
run: {iterations: 80, spp: 16, certainty: false}
"""


def write_experiment(folder: Path, light: str) -> Path:
    camera = sensor("0, -2.6, 2.6", "0, 0, 0.1", up="0, 0, 1", size=96, fov=45, id="camera", rfilter="gaussian")
    (folder / "scene.xml").write_text(scene(camera, FLOOR, BOX, LIGHTS[light]))
    write_mesh(folder)
    (folder / "box.yaml").write_text(CONFIG)
    return folder / "box.yaml"


@pytest.mark.long
@pytest.mark.parametrize("light", LIGHTS)
def test_a_box_is_found_from_eight_directions(llvm: str, tmp_path: Path, light: str) -> None:
    path, far = write_experiment(tmp_path, light), []
    for angle in 2 * np.pi * np.arange(8) / 8:
        start = [round(AWAY * float(np.cos(angle)), 6), round(AWAY * float(np.sin(angle)), 6), 0]
        run = rl.optimize(path, overrides={"parameters[0].initial": start, "run.output": str(tmp_path / "runs")})
        for _ in run:
            pass
        far.append(float(np.linalg.norm(run.parameters["box.translation"])) / SIZE)
    print(f"{light}: distance from the true place over the size of the box:", " ".join(f"{each:.4f}" for each in far))
    assert np.sum(np.array(far) < 0.01) >= 7
