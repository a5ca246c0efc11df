"""The three commands on somebody else's room, from 8 bits of what a camera would see there.

Most of its light comes through windows, which clip; a mirror and clear glass are in view; no exposure is given.
"""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from cli.calling import done, settings
from cli.test_three_commands import COLOUR, EXPOSURE, check_mask, keep, misses
from rooms import real_room

from reslrb_cli.scene.load import load_scene

pytestmark = [pytest.mark.usefixtures("llvm"), pytest.mark.long]

#: What the photograph shows of what the scene file has as 0.1 and 1.
TRUE = {"Walls.brdf_0.reflectance.value": [0.45, 0.35, 0.25], "Sofa.brdf_0.reflectance.value": [0.6, 0.3, 0.2]}
WIDTH, HEIGHT, SPP, PARTS = 320, 180, 128, 4


def write_photograph(scene_file: Path, path: Path) -> None:
    """The room in its true colours, by camera paths of any length."""
    scene = load_scene(scene_file, size=(WIDTH, HEIGHT))
    params = mi.traverse(scene)
    for key, true in TRUE.items():
        params[key] = mi.Color3f(true)
    params.update()
    integrator = mi.load_dict({"type": "path", "max_depth": -1})
    image = sum(np.array(mi.render(scene, integrator=integrator, spp=SPP, seed=part)) for part in range(PARTS)) / PARTS
    bitmap = mi.Bitmap((EXPOSURE * image[:, :, :3]).astype(np.float32))
    bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(str(path))


def test_colours_of_a_real_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene_file = real_room()
    write_photograph(scene_file, tmp_path / "photo.png")
    monkeypatch.chdir(tmp_path)
    done("init", scene_file, "--target", "photo.png", "-o", "room.yaml")
    keep(Path("room.yaml"), list(TRUE))
    done("optimize", "room.yaml")
    check_mask(Path("runs/room"))
    assert misses(Path("runs/room"), COLOUR, TRUE) == []
    without = settings("target.mask=none", "target.exposure=1", "integrator.estimator=stack")
    done("optimize", "room.yaml", "--force", *without)
    assert misses(Path("runs/room"), COLOUR, TRUE) == [*TRUE, "exposure"]
