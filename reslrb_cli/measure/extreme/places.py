"""Where things stand: scale, distance from the origin, grazing views, sides and normals."""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.measure.analytic_scenes import camera as pinhole
from reslrb_cli.measure.extreme.case import Differences, ExtremeCase, Stock, Twin
from reslrb_cli.measure.small_scenes import bitmap, diffuse, rgb, room, transform

FLOOR = "floor.brdf_0.reflectance.value"
WALL = "wall.brdf_0.reflectance.value"
LAMP = "lamp.emitter.radiance.value"
AWAY = [60.0, 60.0, 52.9]  # 100 from the origin


def placed(scale: float = 1, offset: Any = (0, 0, 0)) -> dict:
    """The room, scaled about the origin and then moved; radiance makes its image the same."""
    import mitsuba as mi

    scene = room()
    move = transform(translate=list(offset), scale=scale)
    for name, item in scene.items():
        if isinstance(item, dict) and "to_world" in item:
            scene[name] = item | {"to_world": move @ item["to_world"]}
    view = np.array(room()["camera"]["to_world"].matrix)
    view[:3, 3] = scale * view[:3, 3] + np.asarray(offset)
    scene["camera"] |= {"to_world": mi.ScalarTransform4f(view), "near_clip": 1e-2 * scale, "far_clip": 1e4 * scale}
    return scene


def low_view() -> dict:
    """A camera close above the floor, which looks along it."""
    return room(camera=pinhole([0.9, -0.95, 0.9], [-0.9, -0.96, -0.2], [0, 1, 0], 25))


def turned_panes() -> dict:
    """Two sheets that scatter on one side: one turns its back on the camera, the other on the lamp."""

    def pane(tilt: float, **place: Any) -> dict:
        return {"type": "rectangle", "bsdf": diffuse(0.8, 0.6, 0.7),
                "to_world": transform(**place, rotate=([1, 0, 0], tilt), scale=0.35)}  # fmt: skip

    return room(first=pane(160, translate=[0.4, -0.2, 0.6]), second=pane(40, translate=[-0.4, -0.3, 0.5]))


def octahedron(*reflectance: float) -> dict:
    """A solid of eight flat faces that is shaded as a sphere."""
    import mitsuba as mi

    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(diffuse(*reflectance))
    mesh = mi.Mesh("solid", 6, 8, has_vertex_normals=True, props=properties)
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    faces = [(x, y, z) if (x + y + z) % 2 == 0 else (y, x, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    params = mi.traverse(mesh)
    params["vertex_positions"] = (0.5 * corners + [0.1, -0.3, 0.2]).ravel().tolist()
    params["vertex_normals"] = corners.ravel().tolist()
    params["faces"] = np.array(faces).ravel().tolist()
    params.update()
    return room(solid=mesh)


def normal_map() -> dict:
    """A floor whose normals lean by up to 60 degrees."""
    random = np.random.default_rng(5)
    lean = np.concatenate([random.uniform(0.2, 0.8, (4, 4, 2)), np.full((4, 4, 1), 0.75)], -1)
    return room(floor={"type": "normalmap", "normalmap": bitmap(lean, "bilinear"), "bsdf": diffuse(0.7, 0.5, 0.6)})


def vertical_light() -> dict:
    """A lamp that stands on the floor's edge: nearly all its light on the floor arrives at grazing angles."""
    side = {
        "type": "rectangle",
        "bsdf": diffuse(0, 0, 0),
        "emitter": {"type": "area", "radiance": rgb(9, 8, 7)},
        "to_world": transform(translate=[0, -0.99, 0.999], rotate=([0, 1, 0], 180), scale=[1, 0.01, 1]),
    }
    return room(lamp=side)


CASES = [
    ExtremeCase("scaled_1e-2", "the room a hundredth of its size", lambda: placed(1e-2), (FLOOR, WALL, LAMP),
                Twin(room)),
    ExtremeCase("scaled_1e+4", "the room ten thousand times its size", lambda: placed(1e4), (FLOOR, WALL, LAMP),
                Twin(room)),
    ExtremeCase("moved_100", "the room 100 from the origin, fifty times its own size", lambda: placed(1, AWAY),
                (FLOOR, WALL, LAMP), Twin(room)),
    ExtremeCase("grazing_sensor", "a camera that looks along the floor", low_view, (FLOOR, WALL, LAMP),
                Stock("ptracer"), spp=512),
    ExtremeCase("grazing_lamp", "a lamp on the floor's edge, at right angles to it", vertical_light,
                (FLOOR, WALL, LAMP), Stock("ptracer"), spp=128),
    ExtremeCase("back_facing", "sheets that turn their backs on camera and lamp", turned_panes,
                ("first.bsdf.reflectance.value", "second.bsdf.reflectance.value", FLOOR), Stock("ptracer"), spp=256),
    ExtremeCase("shading_normals", "eight flat faces shaded as a sphere", lambda: octahedron(0.7, 0.5, 0.8),
                ("solid.bsdf.reflectance.value", FLOOR), Stock("prb"), spp=256),
    ExtremeCase("shading_normals_albedo_0", "the same in black: the derivative alone shows how its normals are treated",
                lambda: octahedron(0, 0, 0), ("solid.bsdf.reflectance.value", FLOOR), Differences(0.05, "up"),
                spp=256),
    ExtremeCase("normal_map", "normals that lean by up to 60 degrees", normal_map,
                ("floor.nested_bsdf.reflectance.value", WALL), Stock("prb"), spp=512),
]  # fmt: skip
