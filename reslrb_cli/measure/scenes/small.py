"""Small scenes for measurements and gradient checks: a Cornell box, and a corner of a room.

`build` returns the Cornell box with a texture on its white surfaces. Measurements without a configuration use the
Cornell box. `room` returns the corner of a room as a dictionary for `mi.load_dict`. Gradient checks add objects to it.
Functions such as `dark` and `veiled` return variations of the room.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.errors import ConfigError

#: Name in errors in place of a file.
CORNELL_BOX_SOURCE = "the built-in Cornell box"

#: Placeholder of the scene in `scene.file`.
FILE = Path("/cornell-box")

#: No roulette and no directly visible emitters; `size` of the square film, `texture` of the square texture.
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
    """Return the scene with the options of CONFIG. The scene has random texels from 0.2 to 0.9, and a box filter.

    Raises ConfigError if an option is unknown or is not a positive integer.
    """
    values = {"size": 128, "texture": 16} | options
    for name, value in values.items():
        if name not in ("size", "texture") or type(value) is not int or value < 1:
            reason = "the options are size and texture, both at least 1"
            raise ConfigError(CORNELL_BOX_SOURCE, f"scene.options.{name}", reason)
    size, texture = values["size"], values["texture"]
    scene = mi.cornell_box()
    texels = np.random.default_rng(0).uniform(0.2, 0.9, (texture, texture, 3))
    scene["white"] = {"type": "diffuse", "reflectance": {
        "type": "bitmap", "bitmap": mi.Bitmap(texels.astype(np.float32)), "raw": not mi.is_spectral,
        "filter_type": "bilinear", "format": "variant"}}  # fmt: skip
    scene["sensor"]["film"] |= {"width": size, "height": size, "rfilter": {"type": "box"}}
    return mi.load_dict(scene, optimize=False)


SIZE = 16


def texture(height: int, width: int, low: float = 0.2, high: float = 0.8, seed: int = 1, channels: int = 3) -> dict:
    """A bitmap of random texels with nearest-neighbour filtering, so that texels are independent parameters."""
    data = np.random.default_rng(seed).uniform(low, high, (height, width, channels)).astype(np.float32)
    return bitmap(data)


def bitmap(data: np.ndarray, filter_type: str = "nearest") -> dict:
    """A bitmap texture with unchanged `data` (H, W, C)."""
    return {"type": "bitmap", **texels(data), "filter_type": filter_type, "wrap_mode": "clamp"}


def texels(data: np.ndarray) -> dict:
    """The texels (H, W, C) of a bitmap texture. In a spectral variant, three channels are a colour."""
    data = np.ascontiguousarray(data, np.float32)
    if mi.is_spectral and data.shape[2] == 3:
        return {"bitmap": mi.Bitmap(data)}  # Mitsuba would take `data` for coefficients
    return {"data": mi.TensorXf(data), "raw": True}


def rgb(*value: float) -> dict:
    """A colour."""
    return {"type": "rgb", "value": list(value)}


def diffuse(*reflectance: Any) -> dict:
    """A diffuse BSDF of this colour, or with this texture."""
    textured = len(reflectance) == 1
    return {"type": "diffuse", "reflectance": reflectance[0] if textured else rgb(*reflectance)}


def matte(*reflectance: Any) -> dict:
    """A `diffuse` BSDF on both sides."""
    return {"type": "twosided", "bsdf": diffuse(*reflectance)}


def glass(ior: float = 1.5, outside: float = 1.0, **options: Any) -> dict:
    """A smooth dielectric with this index."""
    return {"type": "dielectric", "int_ior": ior, "ext_ior": outside, **options}


def transform(**steps: Any) -> Any:
    """A transform of `translate`, `rotate` (axis, angle) and `scale`. The last one given applies first."""
    result = mi.ScalarTransform4f()
    for name, value in steps.items():
        if name == "rotate":
            axis, angle = value
            result = result.rotate(np.divide(axis, np.linalg.norm(axis)).tolist(), angle)
        else:
            result = getattr(result, name)(value)
    return result


def look_at(origin: Sequence[float], target: Sequence[float], up: Sequence[float] = (0, 0, 1)) -> Any:
    """A transform that points the z axis from `origin` to `target`."""
    return mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=list(up))


def rectangle(bsdf: dict, to_world: Any = None, **place: Any) -> dict:
    """A square of side 2 that faces along z, transformed by `to_world` or by the arguments of `transform`."""
    return {"type": "rectangle", "bsdf": bsdf, "to_world": transform(**place) if to_world is None else to_world}


def sphere(bsdf: dict, center: Sequence[float], radius: float) -> dict:
    """A sphere."""
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf}


def lit_square(radiance: dict, to_world: Any = None, kind: str = "area", **place: Any) -> dict:
    """A black `rectangle` with an emitter of the type `area` or `directionalarea`."""
    return rectangle(diffuse(0, 0, 0), to_world, **place) | {"emitter": {"type": kind, "radiance": radiance}}


def pinhole(origin: Sequence[float], target: Sequence[float], up: Sequence[float], fov: float, size: int = SIZE,
            **film: Any) -> dict:  # fmt: skip
    """A camera for short distances, with a box filter unless `film` has another `rfilter`."""
    return _camera("perspective", fov, look_at(origin, target, up), size, film) | {"near_clip": 1e-3}


def camera(rfilter: str = "box", size: int = SIZE, sensor: str = "perspective", **film: Any) -> dict:
    """A camera that looks at the corner of the room."""
    lens = {"aperture_radius": 0.1, "focus_distance": 4.0} if sensor == "thinlens" else {}
    view = look_at([1.2, 0.6, 4], [-0.1, -0.2, 0], [0, 1, 0])
    return _camera(sensor, 45, view, size, {"rfilter": {"type": rfilter}} | film) | lens


def _camera(sensor: str, fov: float, to_world: Any, size: int, film: dict) -> dict:
    shape = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    return {"type": sensor, "fov": fov, "to_world": to_world, "film": shape | film, "sampler": {"type": "independent"}}


def room(**changes: Any) -> dict:
    """A corner of a room: floor and two walls, under an area light that the camera does not see.

    `changes` replace or add objects. The value None removes an object.
    """
    scene = {
        "type": "scene",
        "camera": camera(),
        "floor": matte(0.7, 0.5, 0.6),
        "wall": matte(0.5, 0.7, 0.4),
        "side": matte(0.6, 0.4, 0.7),
        "floor_shape": rectangle({"type": "ref", "id": "floor"}, translate=[0, -1, 0], rotate=([1, 0, 0], -90)),
        "wall_shape": rectangle({"type": "ref", "id": "wall"}, translate=[0, 0, -1]),
        "side_shape": rectangle({"type": "ref", "id": "side"}, translate=[-1, 0, 0], rotate=([0, 1, 0], 90)),
        "lamp": lamp(radiance=rgb(3.0, 4.0, 5.0)),
    }
    scene.update(changes)
    return {key: value for key, value in scene.items() if value is not None}


def lamp(**emitter: Any) -> dict:
    """A square area light above the room that shines down. `emitter` has options of the `area` emitter."""
    place = transform(translate=[0.2, 1.6, 0.2], rotate=([1, 0, 0], 90), scale=0.6)
    return rectangle(diffuse(0.0, 0.0, 0.0), place) | {"emitter": {"type": "area", **emitter}}


def columns(*texels: tuple[float, ...]) -> dict:
    """A matte surface whose texture has these columns and two rows. Mitsuba needs at least two rows."""
    row = np.array(texels, float).reshape(1, len(texels), -1)
    return matte(bitmap(np.repeat(row, 2, 0)))


def dark(value: float) -> dict:
    """The room, with one black or nearly black texel on the floor."""
    return room(floor=columns((value, value, value), (0.6, 0.3, 0.5)))


def bright(value: float) -> dict:
    """The room, with a white or nearly white floor and wall."""
    return room(floor=columns((value, value, value), (value, 0.3, value)), wall=matte(value, value, value))


def lit(scale: float) -> dict:
    """The room with the lamp's radiance multiplied by `scale`."""
    return room(lamp=lamp(radiance=rgb(3 * scale, 4 * scale, 5 * scale)))


def two_lamps() -> dict:
    place = transform(translate=[0.9, 0.8, 1.6], rotate=([1, 0.5, 0], 120), scale=0.4)
    return room(lamp=lamp(radiance=rgb(1e25, 2e25, 3e25)),
                dim=lamp(radiance=rgb(3e-25, 2e-25, 1e-25)) | {"to_world": place})  # fmt: skip


def small_lamp(radiance: float) -> dict:
    """A lamp with sides of length 1e-4."""
    tiny = transform(translate=[0.2, 1.6, 0.2], rotate=([1, 0, 0], 90), scale=0.5e-4)
    return room(lamp=lamp(radiance=rgb(radiance, 2 * radiance, radiance)) | {"to_world": tiny})


def sun() -> dict:
    """A sky of 8 x 16 texels, one of which is a million times brighter than the others."""
    sky = np.random.default_rng(2).uniform(0.5, 1.5, (8, 16, 3)).astype(np.float32)
    sky[2, 5] = 1e6
    return room(lamp=None, sky={"type": "envmap", "bitmap": mi.Bitmap(sky)})


def skimming() -> dict:
    """Parallel light that meets the floor at half a degree from the floor's plane."""
    height = float(np.tan(np.deg2rad(0.5)))
    light = {"type": "directional", "direction": [-0.9, -height, -0.43], "irradiance": rgb(90, 80, 70)}
    return room(lamp=None, wall_shape=None, side_shape=None, light=light)


def placed(scale: float = 1, offset: Any = (0, 0, 0)) -> dict:
    """The room, scaled about the origin and then moved. The radiance is scaled so that the image stays the same."""
    scene = room()
    move = transform(translate=list(offset), scale=scale)
    for name, item in scene.items():
        if isinstance(item, dict) and "to_world" in item:
            scene[name] = item | {"to_world": move @ item["to_world"]}
    view = np.array(room()["camera"]["to_world"].matrix)
    view[:3, 3] = scale * view[:3, 3] + np.asarray(offset)
    scene["camera"] |= {"to_world": mi.ScalarTransform4f(view), "near_clip": 1e-2 * scale, "far_clip": 1e4 * scale}
    return scene


def vertical_light() -> dict:
    """A lamp that stands upright on the floor's edge. Nearly all of the lamp's light arrives on the floor at grazing
    angles.
    """
    place = transform(translate=[0, -0.99, 0.999], rotate=([0, 1, 0], 180), scale=[1, 0.01, 1])
    return room(lamp=lit_square(rgb(9, 8, 7), place))


def turned_panes() -> dict:
    """Two sheets that scatter on one side only. One sheet shows its back to the camera, the second sheet to the
    lamp.
    """

    def pane(tilt: float, **place: Any) -> dict:
        return rectangle(diffuse(0.8, 0.6, 0.7), **place, rotate=([1, 0, 0], tilt), scale=0.35)

    return room(first=pane(160, translate=[0.4, -0.2, 0.6]), second=pane(40, translate=[-0.4, -0.3, 0.5]))


def normal_map() -> dict:
    """A floor with a normal map whose normals lean by up to 60 degrees."""
    lean = np.random.default_rng(5).uniform(0.2, 0.8, (4, 4, 2))
    normals = bitmap(np.concatenate([lean, np.full((4, 4, 1), 0.75)], -1), "bilinear") | {"raw": True}
    return room(floor={"type": "normalmap", "normalmap": normals, "bsdf": diffuse(0.7, 0.5, 0.6)})


def veiled(opacity: Any, place: dict[str, Any] | None = None, **changes: Any) -> dict:
    """The room with a partly opaque sheet. By default, it hangs between lamp and floor."""
    bsdf = {"type": "mask", "opacity": opacity, "id": "veil_bsdf", "bsdf": matte(0.7, 0.6, 0.3)}
    place = place or {"translate": [0.1, 0.2, 0.2], "rotate": ([1, 0, 0], -80), "scale": 0.5}
    return room(veil=rectangle(bsdf, **place), **changes)


def load(scene: dict) -> Any:
    """Load the scene without merging objects."""
    return mi.load_dict(scene, optimize=False)
