"""Random corners of rooms, with photographs of 8 bits by `path`, for rates over many runs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np
from cli import tiny
from kit import area, diffuse, scene, sensor, shape

COLOURED, GLOSSY = ("floor", "wall", "left", "ball"), ("floor", "ball")
BUILT = (0.1, 0.2, 0.3, 0.4)


def write_corner(
    folder: Path,
    seed: int,
    size: tuple[int, int],
    is_right: bool,
    curve: Callable[[np.ndarray], np.ndarray] | None = None,
) -> None:
    """Write `corner.xml`, in which all colours are grey, and `photo.png` with random colours, lamp and exposure. If
    not `is_right`, the roughnesses in the photograph differ from those in the file by a factor of at least 1.35. A
    `curve` makes linear values of a film curve from light.
    """
    random = np.random.default_rng(seed)
    colours = {name: ",".join(f"{each:.3f}" for each in random.uniform(0.08, 0.85, 3)) for name in COLOURED}
    alphas = {name: float(random.choice(BUILT)) for name in GLOSSY}
    factors = {name: np.exp(random.choice([-1, 1]) * random.uniform(0.3, 1.2)) for name in GLOSSY}
    right = {name: alpha if is_right else float(np.clip(alpha * factors[name], 0.05, 0.9))
             for name, alpha in alphas.items()}  # fmt: skip
    x, y, z = random.uniform(-0.8, 0.8), random.uniform(0.9, 2.2), random.uniform(-1, 0.3)
    exposure = random.uniform(0.3, 1.2)
    places = {
        "floor": ("rectangle", '<rotate x="1" angle="-90"/><scale value="2"/>'),
        "wall": ("rectangle", '<scale value="2"/><translate y="1" z="-1.5"/>'),
        "left": ("rectangle", '<rotate y="1" angle="90"/><scale value="2"/><translate x="-1.6"/>'),
        "ball": ("sphere", '<scale value="0.4"/><translate x="0.5" y="0.4" z="0.2"/>'),
    }
    lamp = f'<rotate x="1" angle="90"/><scale value="0.3"/><translate x="{x}" y="{y}" z="{z}"/>'
    for name, own in (("corner", alphas), ("true", right)):
        parts = [sensor("0, 1, 3", "0, 0.5, 0", size=size, fov=60, rfilter="gaussian")]
        for key, (kind, place) in places.items():
            colour = colours[key] if name == "true" else "0.5"
            bsdf = diffuse(colour)
            if key in GLOSSY:
                bsdf = (f'<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="{colour}"/>'
                        f'<float name="alpha" value="{own[key]}"/></bsdf>')  # fmt: skip
            parts.append(shape(kind, key, f'<bsdf type="twosided">{bsdf}</bsdf>', place=place))
        parts.append(shape("rectangle", "lamp", diffuse("0"), area("20, 18, 15"), place=lamp))
        (folder / f"{name}.xml").write_text(scene(*parts))
    path = mi.load_dict({"type": "path", "max_depth": 16})
    image = np.array(mi.render(mi.load_file(str(folder / "true.xml")), integrator=path, spp=2048))[:, :, :3]
    tiny.write_photo(folder / "photo.png", exposure * image if curve is None else curve(exposure * image))
