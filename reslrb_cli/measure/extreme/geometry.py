"""Cases of the extreme suite: glass, motion, positions and roughness at the ends of their ranges."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.measure.extreme.suite import Differences, Extrapolated, ExtremeCase, Stock, exact
from reslrb_cli.measure.scenes.analytic import DOWN, POOL, SLAB, UP, refraction_scene, slab_scene
from reslrb_cli.measure.scenes.moving import (
    FILTER,
    Displacement,
    Move,
    Number,
    Pose,
    grid,
    mesh,
    smooth_fields,
    vertices,
    waves,
)
from reslrb_cli.measure.scenes.small import (
    bitmap,
    diffuse,
    glass,
    lit_square,
    look_at,
    pinhole,
    rectangle,
    rgb,
    room,
    transform,
)

FLOOR = "floor.brdf_0.reflectance.value"
WALL = "wall.brdf_0.reflectance.value"
LAMP = "lamp.emitter.radiance.value"
VEIL = "veil.bsdf.nested_bsdf.brdf_0.reflectance.value"
OPACITY = "veil.bsdf.opacity.value"


def veiled(opacity: Any, **changes: Any) -> dict:
    """A partly opaque sheet between lamp and floor, and one between camera and wall."""
    bsdf = {"type": "mask", "opacity": opacity, "id": "veil_bsdf",
            "bsdf": {"type": "twosided", "bsdf": diffuse(0.7, 0.6, 0.3)}}  # fmt: skip
    veil = rectangle(bsdf, translate=[0.1, 0.2, 0.2], rotate=([1, 0, 0], -80), scale=0.5)
    return room(veil=veil, **changes)


def nested() -> dict:
    """A glass ball inside a ball of water. The camera sees the floor below, but not the balls."""
    water = glass(1.33, specular_transmittance=rgb(0.9, 0.8, 0.7))
    inner = glass(1.5, 1.33, specular_transmittance=rgb(0.7, 0.8, 0.9), specular_reflectance=rgb(0.9, 0.6, 0.8))
    return {
        "type": "scene",
        "camera": pinhole([0, 0.3, 0], [0, 0, 0], [0, 0, -1], 80),
        "floor": rectangle(diffuse(0.7, 0.5, 0.6), rotate=UP, scale=2),
        "water": {"type": "sphere", "center": [0, 1, 0], "radius": 0.6, "bsdf": water},
        "glass": {"type": "sphere", "center": [0.1, 1, 0], "radius": 0.35, "bsdf": inner},
        "lamp": lit_square(rgb(9, 8, 7), translate=[0, 2.2, 0], rotate=DOWN, scale=0.5),
    }


def critical() -> dict:
    """A beam in a medium of index 1.5. The beam meets the medium's flat surface, y = 0, at the critical angle.

    The camera sees the bottom, which receives the totally reflected light.
    """
    theta = float(np.arcsin(1 / 1.5))
    start = [-float(np.sin(theta)), -float(np.cos(theta)), 0.0]
    below = [4 * float(np.tan(theta)), -4.0, 0.0]
    return {
        "type": "scene",
        "camera": pinhole([below[0], -3, 2], below, [0, 1, 0], 20),
        "surface": rectangle(glass(specular_reflectance=rgb(0.9, 0.7, 0.5)), rotate=UP, scale=3),
        "floor": rectangle(diffuse(0.7, 0.5, 0.6), translate=below, rotate=UP, scale=2),
        "lamp": _parallel(start, [0, 0, 0], 0.5, rgb(3, 2, 4)),
    }


def _parallel(start: list[float], end: list[float], half: float, radiance: dict) -> dict:
    """Parallel light from a square at `start` towards `end`."""
    return lit_square(radiance, look_at(start, end) @ transform(scale=half), "directionalarea")


#: Paths from the sensor hardly find this light, so the reference is an image of paths from the light.
TRACED: dict[str, Any] = {"image": "ptracer", "spp": 512}

GLASS_CASES = [
    ExtremeCase("opacity_0", "a transparent mask", lambda: veiled(0.0), (FLOOR, LAMP), Stock("prb"), spp=128),
    ExtremeCase("opacity_1", "an opaque mask", lambda: veiled(1.0), (FLOOR, LAMP, VEIL), Stock("prb"), spp=128),
    ExtremeCase("opacity_texture_0_and_1", "a mask with opaque and with transparent texels",
                lambda: veiled(bitmap(np.array([[[0.0], [1.0]], [[1.0], [0.0]]]))), (FLOOR, LAMP, VEIL), Stock("prb"),
                spp=128),
    ExtremeCase("opacity_0.4", "the opacity of a mask, at a depth where the image is quadratic in the opacity",
                lambda: veiled(0.4), (OPACITY,), Differences(0.3), spp=1024, options={"max_depth": 3}, signed=True),
    ExtremeCase("albedo_0_behind_mask", "a wall that is 0 in one channel, behind a mask",
                lambda: veiled(0.4, wall={"type": "twosided", "bsdf": diffuse(0, 0.7, 0.4)}), (WALL, VEIL),
                Differences(0.05, "up"), spp=128),
    ExtremeCase("nested_dielectrics", "a glass ball inside a water ball", nested,
                ("water.bsdf.specular_transmittance.value", "glass.bsdf.specular_transmittance.value",
                 "floor.bsdf.reflectance.value"), Stock("ptracer"), image="ptracer", spp=512,
                options={"max_depth": 8}),
    ExtremeCase("critical_angle", "a beam that is totally reflected at the critical angle", critical,
                ("surface.bsdf.specular_reflectance.value", "floor.bsdf.reflectance.value"), Stock("ptracer"),
                image="ptracer", spp=512, seeds=8),
    exact("refraction", "a point light over a pool", refraction_scene, POOL, 3, **TRACED),
    exact("index_1", "a point light over a pool of index 1", lambda: refraction_scene(1.0), POOL, 3, **TRACED),
    exact("index_3", "a point light over a pool of index 3", lambda: refraction_scene(3.0), POOL, 3, **TRACED),
    exact("slab", "a beam through a glass slab, with up to six reflections inside the slab",
          lambda: slab_scene(1.5, 40, 10), SLAB, 10, seeds=32, **TRACED),
    exact("slab_index_3_grazing", "a beam at 85 degrees on a slab of index 3: most of the light is reflected",
          lambda: slab_scene(3.0, 85, 10), SLAB, 10, **TRACED),
]  # fmt: skip

SIZE = 24
TOP = "top.vertex_positions"

#: Ten ray offsets at a thin slab: 8.9e-5 (1 + max |p|) each.
THIN = 10 * 8.9e-5 * (1 + 2.5)
Moves = Callable[[Any], Sequence[Move]]


def beam(origin: tuple[float, float], target: tuple[float, float], half: float, scale: float = 1) -> dict:
    """Parallel light in the plane z = 0 with a square cross-section. `origin` and `target` are (x, y)."""
    start, end = ([scale * x, scale * y, 0.0] for x, y in (origin, target))
    return _parallel(start, end, scale * half, rgb(9, 8, 7))


def steep(scale: float = 1) -> dict:
    """Light from above, at 20 degrees to the vertical."""
    return beam((0.5, 3), (0.05, 1.8), 0.25, scale)


def pool(
    bsdf: dict, light: dict, slope: float = 1, height: float = 1.8, thickness: float = 0, scale: float = 1,
    cells: int = 128,
) -> dict:  # fmt: skip
    """A receiver in glass with a wavy surface. With a `thickness`, the glass is a slab above the receiver.

    `slope` is the slope of the waves in units of 0.1, and `scale` the size of everything. The surface has `cells` flat
    faces per side. The error of the flat faces falls as the inverse square of `cells` (docs/method.md).
    """
    seen = pinhole([0, scale, 0], [0, 0, 0], [0, 0, -1], 90, SIZE, rfilter=FILTER)
    positions, faces, uv = grid(cells, lambda x, z: height + slope * waves(x, z), 2.5)
    scene = {
        "type": "scene",
        "camera": seen | {"near_clip": 1e-2 * scale, "far_clip": 1e3 * scale},
        "floor": rectangle(diffuse(0.8, 0.7, 0.6), rotate=UP, scale=20 * scale),
        "lamp": light,
        "top": mesh(scale * positions, faces, bsdf, uv),
    }
    if thickness:
        below = [0, scale * (height - thickness), 0]
        scene["bottom"] = rectangle(bsdf, translate=below, rotate=DOWN, scale=3 * scale)
    return scene


def bending(size: float = 1, scale: float = 1) -> Moves:
    """Three smooth displacements of the surface, multiplied by `size`."""

    def moves(scene: Any) -> Sequence[Move]:
        fields = size * scale * smooth_fields(vertices(scene, "top") / scale, 3, 1.0)
        return [Displacement(TOP, fields)]

    return moves


def sliding(scene: Any) -> Sequence[Move]:
    """Motion of the surface within itself."""
    return [Displacement(TOP, smooth_fields(vertices(scene, "top"), 3, 1.0) * np.array([1, 0, 1]))]


def with_lamp(scene: Any) -> Sequence[Move]:
    """Motion of the surface and of the lamp."""
    return [*bending()(scene), Pose("lamp.to_world", ("tx", "rz"), (0.5, 3, 0))]


def moving_slab(slope: float = 1, thickness: float = 0.2, scale: float = 1) -> Callable[[], dict]:
    return lambda: pool(glass(), steep(scale), slope, thickness=thickness, scale=scale)


def surface(ior: float = 1.5, slope: float = 1, **rough: Any) -> Callable[[], dict]:
    """A receiver in smooth or in rough glass."""
    return lambda: pool(glass(ior) | rough, steep(), slope)


def grazing(degrees: float) -> dict:
    """Light that meets the surface at `degrees` from its normal."""
    theta = float(np.deg2rad(degrees))
    at = -1.2 * float(np.tan(np.arcsin(np.sin(theta) / 1.5)))
    start = (at - 2 * float(np.sin(theta)), 1.2 + 2 * float(np.cos(theta)))
    return pool(glass(), beam(start, (at, 1.2), 0.02), slope=0.1, height=1.2)


def moved(name: str, about: str, scene: Callable[[], dict], step: float = 0.01, depth: int = 3,
          moves: Moves | None = None, left: float = 1e-3, **more: Any) -> ExtremeCase:  # fmt: skip
    fields: dict[str, Any] = {"image": "ptracer", "seeds": 8, "signed": True, "options": {"max_depth": depth}} | more
    return ExtremeCase(name, about, scene, (), Extrapolated(step, left), moves=moves or bending(), **fields)


ROUGH: dict[str, Any] = {"type": "roughdielectric", "alpha": 0.1}

MOTION_CASES = [
    moved("slope_0", "a flat glass surface that begins to bend", surface(slope=0)),
    moved("slope_1e-6", "a glass surface with slopes of one millionth", surface(slope=1e-5)),
    moved("slope_0.3", "a glass surface with slopes of a third", surface(slope=3), 0.005),
    moved("sliding_faces", "a surface whose faces slide through the light", surface(), moves=sliding),
    moved("total_reflection", "a surface with waves, beyond the critical angle",  # light from inside
          lambda: pool(glass(), beam((-1.87, 1.0), (-1.6, 1.2), 0.12), slope=0.1, height=1.2, cells=256), 0.0015),
    moved("grazing_85", "light at 85 degrees on glass", lambda: grazing(85), 0.005, moves=bending(0.1),
          seeds=12),
    moved("parallel_faces", "a slab with flat faces that begins to bend", moving_slab(0), depth=4),
    moved("thin_slab", "a slab whose thickness is ten ray offsets",
          moving_slab(0, THIN), 0.1, depth=4, moves=bending(THIN), spp=256),
    moved("moved_index_1", "moving glass of index 1, and the lamp above the glass", surface(1.0), moves=with_lamp),
    moved("moved_index_3", "moving glass of index 3", surface(3.0)),
    moved("moved_rough_1.001", "moving rough glass of index 1.001, and the lamp above the glass",
          surface(1.001, **ROUGH),
          moves=with_lamp, equal=1e-3),
    moved("moved_rough_3", "moving rough glass of index 3", surface(3.0, **ROUGH), equal=1e-3),
    moved("millimetres", "a slab at a thousand times its size", moving_slab(scale=1e3), depth=4, moves=bending(1, 1e3)),
    moved("shrunk_to_0.03", "a slab at three hundredths of its size", moving_slab(scale=0.03), depth=4,
          moves=bending(1, 0.03), left=5e-3),
]  # fmt: skip

AWAY = [60.0, 60.0, 52.9]  # 100 from the origin


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


def turned_panes() -> dict:
    """Two sheets that scatter on one side only. One sheet shows its back to the camera, the second sheet to the
    lamp.
    """

    def pane(tilt: float, **place: Any) -> dict:
        return rectangle(diffuse(0.8, 0.6, 0.7), **place, rotate=([1, 0, 0], tilt), scale=0.35)

    return room(first=pane(160, translate=[0.4, -0.2, 0.6]), second=pane(40, translate=[-0.4, -0.3, 0.5]))


def octahedron(*reflectance: float) -> dict:
    """A solid of eight flat faces, shaded as a sphere."""
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
    """A floor with a normal map whose normals lean by up to 60 degrees."""
    random = np.random.default_rng(5)
    lean = np.concatenate([random.uniform(0.2, 0.8, (4, 4, 2)), np.full((4, 4, 1), 0.75)], -1)
    return room(
        floor={
            "type": "normalmap",
            "normalmap": bitmap(lean, "bilinear") | {"raw": True},
            "bsdf": diffuse(0.7, 0.5, 0.6),
        }
    )


def vertical_light() -> dict:
    """A lamp that stands upright on the floor's edge. Nearly all of the lamp's light arrives on the floor at grazing
    angles.
    """
    place = transform(translate=[0, -0.99, 0.999], rotate=([0, 1, 0], 180), scale=[1, 0.01, 1])
    return room(lamp=lit_square(rgb(9, 8, 7), place))


PLACES_CASES = [
    ExtremeCase("scaled_1e-2", "the room at a hundredth of its size", lambda: placed(1e-2), (FLOOR, WALL, LAMP),
                Stock("ptracer", room)),
    ExtremeCase("scaled_1e+4", "the room at ten thousand times its size", lambda: placed(1e4), (FLOOR, WALL, LAMP),
                Stock("ptracer", room)),
    ExtremeCase("moved_100", "the room 100 units from the origin, which is fifty times its own size",
                lambda: placed(1, AWAY),
                (FLOOR, WALL, LAMP), Stock("ptracer", room)),
    ExtremeCase("grazing_sensor", "a camera that looks along the floor",
                lambda: room(camera=pinhole([0.9, -0.95, 0.9], [-0.9, -0.96, -0.2], [0, 1, 0], 25)),
                (FLOOR, WALL, LAMP), Stock("ptracer"), spp=512),
    ExtremeCase("grazing_lamp", "a lamp at the edge of the floor, at a right angle to the floor", vertical_light,
                (FLOOR, WALL, LAMP), Stock("ptracer"), spp=128, seeds=32),  # the image has skewed noise beside the lamp
    ExtremeCase("back_facing", "one-sided sheets that face away from the camera and the lamp", turned_panes,
                ("first.bsdf.reflectance.value", "second.bsdf.reflectance.value", FLOOR), Stock("ptracer"), spp=256),
    ExtremeCase("shading_normals", "eight flat faces with the shading normals of a sphere",
                lambda: octahedron(0.7, 0.5, 0.8),
                ("solid.bsdf.reflectance.value", FLOOR), Stock("prb"), spp=256),
    ExtremeCase("shading_normals_albedo_0", "eight black faces with the shading normals of a sphere",
                lambda: octahedron(0, 0, 0), ("solid.bsdf.reflectance.value", FLOOR), Differences(0.05, "up"),
                spp=256),
    ExtremeCase("normal_map", "shading normals that are tilted by up to 60 degrees", normal_map,
                ("floor.nested_bsdf.reflectance.value", WALL), Stock("prb"), spp=512),
]  # fmt: skip

RECEIVER = "floor.bsdf.reflectance.value"


def reflected(bsdf: dict) -> dict:
    """A lamp and an upright plate. The plate reflects the lamp's light to the floor."""
    return {
        "type": "scene",
        "camera": pinhole([0, 0.9, 0], [0, 0, 0], [0, 0, -1], 60),
        "floor": rectangle(diffuse(0.7, 0.5, 0.6), translate=[0, 0, 0], rotate=UP, scale=2),
        "plate": rectangle(bsdf, translate=[-1, 1, 0], rotate=([0, 1, 0], 90)),
        "lamp": lit_square(rgb(5, 6, 4), translate=[0.8, 1.3, 0], rotate=([0, 1, 0], -90), scale=0.4),
    }


def transmitted(bsdf: dict) -> dict:
    """A lamp that shines through a horizontal plate on the floor. The camera is between plate and floor."""
    return reflected(bsdf) | {
        "plate": rectangle(bsdf, translate=[0, 1, 0], rotate=UP, scale=2),
        "lamp": lit_square(rgb(5, 6, 4), translate=[0, 1.8, 0], rotate=DOWN, scale=0.5),
    }


def close() -> dict:
    """A narrow beam that falls on the floor, and a camera that sees only its spot."""
    return {
        "camera": pinhole([0, 0.9, 0], [0, 0, 0], [0, 0, -1], 4),
        "lamp": lit_square(rgb(5, 6, 4), None, "directionalarea", translate=[0, 1.8, 0], rotate=DOWN, scale=0.01),
    }


#: For each kind of BSDF: its surroundings, its options, the names of the colour of its lobe and of its roughness, and
#: whether the roughness is a parameter.
KINDS: dict[str, tuple[Callable[[dict], dict], dict, str, str, bool]] = {
    "roughconductor": (reflected, {}, "specular_reflectance", "alpha", True),
    "roughdielectric": (transmitted, {}, "specular_transmittance", "alpha", True),
    "roughplastic": (reflected, {"diffuse_reflectance": rgb(0.1, 0.2, 0.3)}, "specular_reflectance", "alpha", False),
    "principled": (reflected, {"metallic": 0.9}, "base_color", "roughness", True),
}


def plate(kind: str, roughness: str) -> dict:
    """A plate with a BSDF of this `kind`. The plate reflects or transmits a lamp's light."""
    around, options, colour, own, _ = KINDS[kind]
    return around({"type": kind, own: float(roughness), colour: rgb(0.9, 0.7, 0.5), **options})


ROUGHNESS = ("1", "0.1", "1e-2", "1e-4")

#: Roughnesses whose derivative is checked on followed paths. `principled` chooses a lobe and has no such derivative.
#: The values are the numbers of seeds. With fewer seeds, the noise hides the derivative, or single seeds dominate it.
FOLLOWED = {("roughconductor", "0.1"): 16, ("roughconductor", "1e-2"): 16,
            ("roughdielectric", "0.1"): 64, ("roughdielectric", "1e-2"): 32}  # fmt: skip
#: Numbers of seeds that decide noisy derivatives by roughness.
SEEDS = {("principled", "1e-2"): 40, ("principled", "1e-4"): 40}
NOISE = "the noise of a roughness's derivative grows as 1 / roughness: equal seeds decide"


def _case(kind: str, roughness: str) -> ExtremeCase:
    _, _, colour, own, is_parameter = KINDS[kind]
    key, differentiated = f"plate.bsdf.{own}.value", is_parameter and (kind, roughness) not in FOLLOWED
    is_noisy = differentiated and float(roughness) <= 0.1
    return ExtremeCase(
        f"{kind}_{roughness}", f"light that a {kind} of roughness {roughness} reflects or transmits",
        lambda: plate(kind, roughness),
        (f"plate.bsdf.{colour}.value", RECEIVER, *([key] if differentiated else [])), Stock("prb"), spp=256,
        signed=differentiated, open_ended={key: NOISE} if is_noisy else {}, seeds=SEEDS.get((kind, roughness), 16),
    )  # fmt: skip


def _followed(kind: str, roughness: str) -> ExtremeCase:
    """Return the case of the derivative with respect to a roughness that moves light.

    The derivative has little noise, and finite differences give the reference. In two cases, the usual scene leaves
    almost no derivative: nearly smooth glass blurs by less than a pixel, and the mirror spreads the lamp's light over
    more than the view. A narrow beam replaces the lamp there, and the camera of the glass is closer.
    """

    def scene() -> dict:
        made = plate(kind, roughness)
        if (kind, roughness) == ("roughdielectric", "1e-2"):
            made |= close()
        if (kind, roughness) == ("roughconductor", "0.1"):
            made["lamp"] = _parallel([0, 2, 0], [-1, 1, 0], 0.05, rgb(500, 600, 400))
        made["camera"]["film"]["rfilter"] = FILTER  # a box filter has no derivative by film position
        return made

    return ExtremeCase(
        f"{kind}_{roughness}_followed", f"light whose direction follows the roughness {roughness} of a {kind}",
        scene, (), Extrapolated(0.05 * float(roughness), 2e-3), image="", spp=256, signed=True,
        seeds=FOLLOWED[kind, roughness],
        options={"max_depth": 3},  # from the plate to the floor: the edges beyond do not move
        ours={"attached": True}, equal=5e-4, moves=lambda scene: [Number("plate.bsdf.alpha.value")],
    )  # fmt: skip


#: A plate throws light on a floor, and the camera sees only the floor. The plate stays out of view: connections of a
#: nearly smooth lobe to the sensor have a variance that no sample count resolves.
ROUGHNESS_CASES = [_case(kind, roughness) for kind in KINDS for roughness in ROUGHNESS]
ROUGHNESS_CASES += [_followed(kind, roughness) for kind, roughness in FOLLOWED]
