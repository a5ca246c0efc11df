"""The Cornell box as a camera would see it: rendered by `path`, and written as an 8-bit file that clips."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

#: Reflectances of the coloured walls, to be recovered.
WALLS = {
    "red.reflectance.value": [0.570068, 0.0430135, 0.0443706],
    "green.reflectance.value": [0.105421, 0.37798, 0.076425],
}
CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {file: photo.png}
parameters:
  - {key: red.reflectance.value, initial: 0.5, bounds: [0, 1]}
  - {key: green.reflectance.value, initial: 0.5, bounds: [0, 1]}
"""


def write_photograph(folder: Path, size: int, spp: int, exposure: float = 1.0, **changes: Any) -> None:
    """Put scene, photograph and `photo.yaml` into `folder`; a variant must be set.

    `changes` are objects of the scene by id, in place of its own.
    """
    import mitsuba as mi

    box = mi.cornell_box() | changes
    del box["integrator"]
    box["sensor"]["film"] |= {"width": size, "height": size}
    mi.xml.dict_to_xml(box, str(folder / "scene.xml"))
    image = mi.render(mi.load_dict(box), integrator=mi.load_dict({"type": "path", "max_depth": -1}), spp=spp)
    bitmap = mi.Bitmap(np.array(image) * exposure)
    bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(str(folder / "photo.png"))
    (folder / "photo.yaml").write_text(CONFIG)
