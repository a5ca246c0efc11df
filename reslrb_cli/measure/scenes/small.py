"""Small scenes to measure in, and to check gradients in: a Cornell box, and a corner of a room.

The Cornell box, with a texture on its white surfaces, is measured where no configuration is given (`build`). The corner
of a room, and what to put into it, as `mi.load_dict` takes them, are to check gradients in (`room`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.errors import ConfigError

#: What errors name in place of a file.
CORNELL_BOX_SOURCE = "the built-in Cornell box"


#: What stands for the scene in `scene.file`.
FILE = Path("/cornell-box")


#: No roulette, no directly visible emitters; `size` is the film's, `texture` the texture's, both squares.
CORNELL_BOX = f"""\
scene:
  file: {FILE}
  options: {{size: 128, texture: 16}}
target: {{render: {{}}}}
parameters:
  - key: white.reflectance.data
integrator: {{rr_depth: 1000000, hide_emitters: true}}
run: {{spp: 16}}
"""


def build(options: dict[str, Any]) -> Any:
    """The scene, with the options of CONFIG; its texels are random, between 0.2 and 0.9, its filter is a box.

    Raises ConfigError where an option is unknown or no count.
    """
    values = {"size": 128, "texture": 16} | options
    for name, value in values.items():
        if name not in ("size", "texture") or type(value) is not int or value < 1:
            raise ConfigError(
                CORNELL_BOX_SOURCE, f"scene.options.{name}", "the options are size and texture, both at least 1"
            )
    size, texture = values["size"], values["texture"]
    scene = mi.cornell_box()
    texels = np.random.default_rng(0).uniform(0.2, 0.9, (texture, texture, 3))
    scene["white"] = {
        "type": "diffuse",
        "reflectance": {
            "type": "bitmap",
            "bitmap": mi.Bitmap(texels.astype(np.float32)),
            "raw": True,
            "filter_type": "bilinear",
            "format": "variant",
        },
    }
    scene["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    return mi.load_dict(scene, optimize=False)


SIZE = 16


def texture(height: int, width: int, low: float = 0.2, high: float = 0.8, seed: int = 1, channels: int = 3) -> dict:
    """A bitmap of random texels, by nearest neighbour so that each texel is a parameter of its own."""
    data = np.random.default_rng(seed).uniform(low, high, (height, width, channels)).astype(np.float32)
    return bitmap(data)


def bitmap(data: np.ndarray, filter_type: str = "nearest") -> dict:
    """A bitmap texture that holds `data` (H, W, C) as it is."""
    import mitsuba as mi

    return {"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(data, np.float32)), "raw": True,
            "filter_type": filter_type, "wrap_mode": "clamp"}  # fmt: skip


def rgb(*value: float) -> dict:
    """A colour."""
    return {"type": "rgb", "value": list(value)}


def diffuse(*value: float) -> dict:
    """A diffuse BSDF of this colour."""
    return {"type": "diffuse", "reflectance": rgb(*value)}


def transform(**steps: Any) -> Any:
    """A transform of `translate`, `rotate` (axis, angle) and `scale`, applied in reverse order of naming."""
    import mitsuba as mi

    result = mi.ScalarTransform4f()
    for name, value in steps.items():
        if name == "rotate":
            axis, angle = value
            result = result @ mi.ScalarTransform4f().rotate(np.divide(axis, np.linalg.norm(axis)).tolist(), angle)
        else:
            result = result @ getattr(mi.ScalarTransform4f(), name)(value)
    return result


def camera(rfilter: str = "box", size: int = SIZE, sensor: str = "perspective", **film: Any) -> dict:
    """A camera that looks at the corner of the room."""
    import mitsuba as mi

    lens = {"aperture_radius": 0.1, "focus_distance": 4.0} if sensor == "thinlens" else {}
    return {
        "type": sensor,
        "fov": 45,
        **lens,
        "to_world": mi.ScalarTransform4f().look_at(origin=[1.2, 0.6, 4], target=[-0.1, -0.2, 0], up=[0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb",
                 "rfilter": {"type": rfilter}, **film},
        "sampler": {"type": "independent"},
    }  # fmt: skip


def room(**changes: Any) -> dict:
    """A corner of a room, floor and two walls, under an area light that the camera does not see.

    `changes` replace or add objects; None takes one away.
    """
    scene = {
        "type": "scene",
        "camera": camera(),
        "floor": {"type": "twosided", "bsdf": diffuse(0.7, 0.5, 0.6)},
        "wall": {"type": "twosided", "bsdf": diffuse(0.5, 0.7, 0.4)},
        "side": {"type": "twosided", "bsdf": diffuse(0.6, 0.4, 0.7)},
        "floor_shape": {"type": "rectangle", "to_world": transform(translate=[0, -1, 0], rotate=([1, 0, 0], -90)),
                        "bsdf": {"type": "ref", "id": "floor"}},
        "wall_shape": {"type": "rectangle", "to_world": transform(translate=[0, 0, -1]),
                       "bsdf": {"type": "ref", "id": "wall"}},
        "side_shape": {"type": "rectangle", "to_world": transform(translate=[-1, 0, 0], rotate=([0, 1, 0], 90)),
                       "bsdf": {"type": "ref", "id": "side"}},
        "lamp": lamp(radiance=rgb(3.0, 4.0, 5.0)),
    }  # fmt: skip
    scene.update(changes)
    return {key: value for key, value in scene.items() if value is not None}


def lamp(**emitter: Any) -> dict:
    """A square area light above the room that shines down into it; `emitter` are options of its `area` emitter."""
    return {
        "type": "rectangle",
        "to_world": transform(translate=[0.2, 1.6, 0.2], rotate=([1, 0, 0], 90), scale=0.6),
        "bsdf": diffuse(0.0, 0.0, 0.0),
        "emitter": {"type": "area", **emitter},
    }


def load(scene: dict) -> Any:
    """The scene, its objects as they stand."""
    import mitsuba as mi

    return mi.load_dict(scene, optimize=False)
