"""Small scenes for the tests of `reslrb_cli.scene`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest


@pytest.fixture
def make_scene(llvm: str) -> Callable[..., Any]:
    """Function that makes a scene of a lit textured floor seen by a camera. Its arguments `changes` replace entries of
    the scene's dictionary.
    """
    import mitsuba as mi
    import numpy as np

    def make(**changes: Any) -> Any:
        texture = np.linspace(0.1, 0.9, 4 * 6 * 3, dtype=np.float32).reshape(4, 6, 3)
        scene = {
            "type": "scene",
            "camera": {
                "type": "perspective",
                "fov": 60,
                "to_world": mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}},
            },
            "floor": {"type": "diffuse", "reflectance": {"type": "bitmap", "raw": True, "data": mi.TensorXf(texture)}},
            "plane": {"type": "rectangle", "bsdf": {"type": "ref", "id": "floor"}},
            "lamp": {"type": "point", "position": [0, 0, 4], "intensity": {"type": "rgb", "value": [1.0, 2.0, 3.0]}},
        }
        scene.update(changes)
        return mi.load_dict({key: value for key, value in scene.items() if value is not None}, optimize=False)

    return make
