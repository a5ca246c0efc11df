"""The Cornell box as a camera would see it: rendered by `path`, and written as an 8-bit file that clips."""

from __future__ import annotations

from pathlib import Path

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
SENSOR = """<sensor type="perspective">
        <string name="fov_axis" value="smaller"/> <float name="fov" value="39.3077"/>
        <transform name="to_world"><lookat origin="{}" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="{size}"/> <integer name="height" value="{size}"/>
            <string name="pixel_format" value="rgb"/> <rfilter type="gaussian"/>
        </film>
    </sensor>"""


def cornell_box(size: int, extra: str = "", eyes: tuple[str, ...] = ("0, 0, 3.9",)) -> str:
    """Mitsuba's Cornell box as XML, with a film of `size` squared for each eye, and `extra` elements."""
    import mitsuba as mi

    lines = [SENSOR.format(eye, size=size) for eye in eyes]
    shapes = []
    for key, item in mi.cornell_box().items():
        if not isinstance(item, dict) or item["type"] not in ("diffuse", "rectangle", "cube"):
            continue
        if item["type"] == "diffuse":
            color = ", ".join(map(str, item["reflectance"]["value"]))
            lines.append(f'<bsdf type="diffuse" id="{key}"><rgb name="reflectance" value="{color}"/></bsdf>')
            continue
        matrix = " ".join(map(str, np.array(item["to_world"].matrix).reshape(4, 4).ravel()))
        emitter = ""
        if "emitter" in item:
            color = ", ".join(map(str, item["emitter"]["radiance"]["value"]))
            emitter = f'<emitter type="area"><rgb name="radiance" value="{color}"/></emitter>'
        shapes.append(
            f'<shape type="{item["type"]}" id="{key}"><transform name="to_world"><matrix value="{matrix}"/></transform>'
            f'<ref id="{item["bsdf"]["id"]}"/>{emitter}</shape>'
        )
    return "\n".join(['<scene version="3.0.0">', *lines, *shapes, extra, "</scene>"])


def write_noise(path: Path, width: int, height: int) -> Path:
    """8 bits of nothing in particular; a variant must be set."""
    import mitsuba as mi

    image = np.random.default_rng(3).uniform(0, 0.9, (height, width, 3)).astype(np.float32)
    mi.Bitmap(image).convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(str(path))
    return path


def write_photograph(folder: Path, size: int, spp: int, exposure: float = 1.0, extra: str = "") -> None:
    """Put scene, photograph and `photo.yaml` into `folder`; a variant must be set."""
    import mitsuba as mi

    (folder / "scene.xml").write_text(cornell_box(size, extra))
    scene = mi.load_file(str(folder / "scene.xml"))
    image = mi.render(scene, integrator=mi.load_dict({"type": "path", "max_depth": -1}), spp=spp)
    bitmap = mi.Bitmap(np.array(image) * exposure)
    bitmap.convert(component_format=mi.Struct.Type.UInt8, srgb_gamma=True).write(str(folder / "photo.png"))
    (folder / "photo.yaml").write_text(CONFIG)
