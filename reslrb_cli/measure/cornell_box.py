"""The scene that is measured where no configuration is given: a Cornell box with a texture on its white surfaces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.errors import ConfigError

#: What errors name in place of a file.
SOURCE = "the built-in Cornell box"
#: What stands for the scene in `scene.file`.
FILE = Path("/cornell-box")

#: No roulette, no directly visible emitters; `size` is the film's, `texture` the texture's, both squares.
CONFIG = f"""\
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
            raise ConfigError(SOURCE, f"scene.options.{name}", "the options are size and texture, both at least 1")
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
