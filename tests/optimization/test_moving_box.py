"""A box on a floor is found by `optimizer: auto`, under five lights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli import tiny
from kit import area, scene, sensor, shape
from optimization.test_projective import BOX, FLOOR, LAMP, write_mesh

import reslrb_cli as rl
from reslrb_cli.optimization.block import Block

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
integrator: {type: reslrb, max_depth: 4}
loss: {type: l2}
optimizer: {type: auto}
run: {iterations: 80, spp: 16, certainty: false}
"""


def write_experiment(folder: Path, light: str) -> Path:
    camera = sensor("0, -2.6, 2.6", "0, 0, 0.1", up="0, 0, 1", size=96, fov=45, id="camera", rfilter="gaussian")
    (folder / "scene.xml").write_text(scene(camera, FLOOR, BOX, LIGHTS[light]))
    write_mesh(folder)
    (folder / "box.yaml").write_text(CONFIG)
    return folder / "box.yaml"


def find_box(path: Path, *sets: tuple[str, Any]) -> list[float]:
    """Recover the box, and return its distance from its place after each iteration, as a share of its size."""
    run = rl.optimize(path, overrides={"run.output": str(path.parent / "runs"), **dict(sets)})
    return [record.parameter_errors["box.translation"] * 3**0.5 / SIZE for record in run]


def test_auto_finds_a_box_within_a_few_steps(llvm: str, tmp_path: Path) -> None:
    """The box is AWAY from its place, and 7 pixels wide."""
    path = write_experiment(tmp_path, "area")
    sets = [("parameters[0].initial", [AWAY, 0, 0]), ("scene.size", [32, 32]), ("run.spp", 32)]
    far = find_box(path, *sets, ("target.render.spp", 256))
    assert far[0] == pytest.approx(AWAY / SIZE)
    # A single step may be noisy. With six seeds, the largest of these numbers were 0.013, 0.0085, and 0.021.
    assert np.median(far[6:12]) < 0.02
    assert np.median(far[10:]) < 0.01
    assert max(far[10:]) < 0.03
    assert len(far) < 80


def test_steps_are_halved_until_the_loss_does_not_rise(
    llvm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps are four times too long. They would move the box away from its place."""
    steps = Block.steps
    monkeypatch.setattr(Block, "steps", lambda block, now: 4 * steps(block, now))
    path = write_experiment(tmp_path, "area")
    sets = [("parameters[0].initial", [AWAY / 4, 0, 0]), ("scene.size", [32, 32]), ("run.spp", 32)]
    assert find_box(path, *sets, ("run.iterations", 12), ("target.render.spp", 512))[-1] < 0.02


def test_init_offers_to_move_the_box(llvm: str, tmp_path: Path) -> None:
    write_experiment(tmp_path, "area")
    tiny.done("init", tmp_path / "scene.xml", "-o", tmp_path / "first.yaml")
    text = (tmp_path / "first.yaml").read_text()
    assert "  # - motion: {of: box, free: [translation, rotation]}  # 7 % of the picture, box.obj\n" in text
    assert "of: floor" not in text


@pytest.mark.long
@pytest.mark.parametrize("light", LIGHTS)
def test_a_box_is_found_from_eight_directions(llvm: str, tmp_path: Path, light: str) -> None:
    path, far = write_experiment(tmp_path, light), []
    for angle in 2 * np.pi * np.arange(8) / 8:
        start = [round(AWAY * float(np.cos(angle)), 6), round(AWAY * float(np.sin(angle)), 6), 0]
        found = find_box(path, ("parameters[0].initial", start))
        print(f"{light}: within 1 % after {1 + max(np.flatnonzero(np.array(found) > 0.01))} of {len(found)} iterations")
        far.append(found[-1])
    print(f"{light}: distance from the true place over the size of the box:", " ".join(f"{each:.4f}" for each in far))
    assert np.sum(np.array(far) < 0.01) >= 7
