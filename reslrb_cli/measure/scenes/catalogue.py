"""The catalogue of scenes in which gradients of light paths often fail, each with its reference.

`TAGGED` has the cases by tag, and `CASES` by name. The extreme suite runs them all, and tests take scenes from here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from reslrb_cli.measure.scenes.analytic import (
    DOWN,
    FURNACE,
    POOL,
    RADIANCE,
    SLAB,
    UP,
    KnownScene,
    furnace_scene,
    refraction_scene,
    slab_scene,
    speck_in_view,
    texels_over_plane,
)
from reslrb_cli.measure.scenes.case import Differences, Moves, SceneCase, Stock, exact
from reslrb_cli.measure.scenes.moving import (
    FILTER,
    Move,
    displacement,
    grid,
    mesh,
    number,
    pose,
    smooth_fields,
    vertices,
    waves,
)
from reslrb_cli.measure.scenes.small import (
    bitmap,
    bright,
    camera,
    columns,
    dark,
    diffuse,
    glass,
    lamp,
    lit,
    lit_square,
    look_at,
    matte,
    normal_map,
    pinhole,
    placed,
    rectangle,
    rgb,
    room,
    skimming,
    small_lamp,
    sphere,
    sun,
    texture,
    transform,
    turned_panes,
    two_lamps,
    veiled,
    vertical_light,
)

FLOOR, TEXELS = "floor.brdf_0.reflectance.value", "floor.brdf_0.reflectance.data"
WALL, LAMP = "wall.brdf_0.reflectance.value", "lamp.emitter.radiance.value"
VEIL, OPACITY = "veil.bsdf.nested_bsdf.brdf_0.reflectance.value", "veil.bsdf.opacity.value"
PLATE = "floor.bsdf.reflectance.value"
#: The name of images in `SceneCase.open_ended`.
IMAGE = "image"

PTRACER, PRB, INTO_THE_DOMAIN = Stock("ptracer"), Stock("prb"), Differences(0.05, "up")
#: Roulette starts at the second vertex.
ROULETTE: dict[str, Any] = {"spp": 256, "seeds": 12, "options": {"max_depth": 5, "rr_depth": 2}}
#: Paths from the sensor hardly find this light, so the reference is an image of paths from the light.
TRACED: dict[str, Any] = {"image": "ptracer", "spp": 512}
NO_BLACK_LAMP = "Mitsuba loads no lamp without light"

# ---- Colours at the ends of their range ----


COLOURS = [
    SceneCase("albedo_0_in_one_channel", "texels that are exactly 0 in one channel, so ds/s is 0/0",
              lambda: room(floor=columns((0.5, 0.0, 0.4), (0.6, 0.3, 0.0))), (TEXELS, WALL), INTO_THE_DOMAIN),
    SceneCase("albedo_0", "texels that are exactly 0 in all channels: the throughput is 0, but its derivative is not",
              lambda: dark(0), (TEXELS, WALL), INTO_THE_DOMAIN),
    SceneCase("albedo_0_roulette", "texels that are exactly 0, with Russian roulette on throughput alone",
              lambda: dark(0), (TEXELS, WALL), INTO_THE_DOMAIN, **ROULETTE),
    SceneCase("albedo_1e-6", "texels of one millionth: the contribution behind them is tiny, but its derivative is not",
              lambda: dark(1e-6), (TEXELS, WALL)),
    SceneCase("albedo_1e-6_roulette", "texels of one millionth, with Russian roulette", lambda: dark(1e-6),
              (TEXELS, WALL), **ROULETTE),
    SceneCase("albedo_1", "a floor and a wall that are exactly white", lambda: bright(1), (TEXELS, WALL)),
    SceneCase("albedo_1-1e-6", "a floor and a wall that are one millionth below white", lambda: bright(1 - 1e-6),
              (TEXELS, WALL)),
    SceneCase("pure_colours", "red light on a green floor and a blue wall: the image is black, but its derivative is"
              " not", lambda: room(floor=columns((0, 0.8, 0), (0, 0.5, 0)), wall=matte(0, 0, 0.7),
                                   side=matte(0, 0.7, 0), lamp=lamp(radiance=rgb(5, 0, 0))), (TEXELS, WALL, LAMP),
              INTO_THE_DOMAIN, not_spectral="differences are too large beside colours without a spectrum"),
    SceneCase("pure_colours_roulette", "products that are zero in different channels, with Russian roulette",
              lambda: room(floor=columns((0.9, 0, 0), (0, 0.9, 0)), wall=matte(0, 0.8, 0.8), side=matte(0.8, 0, 0.8),
                           lamp=lamp(radiance=rgb(5, 5, 0))),
              (TEXELS, WALL, LAMP), INTO_THE_DOMAIN, **ROULETTE | {"seeds": 16}),
    SceneCase("lamp_0", "a lamp of radiance 0: the image is black, but its derivative equals that of a white lamp",
              lambda: room(lamp=lamp(radiance=rgb(0, 0, 0))), (LAMP,), Differences(0.5, "up"), seeds=8,
              not_spectral=NO_BLACK_LAMP),
]  # fmt: skip

# ---- Lamps, and boxes that light fills ----


def parallel(start: Sequence[float], end: Sequence[float], half: float, radiance: dict, up: Any = (0, 0, 1)) -> dict:
    """Parallel light from a square at `start` towards `end`."""
    return lit_square(radiance, look_at(start, end, up) @ transform(scale=half), "directionalarea")


def speck() -> dict:
    """A hall lit by a beam that hits a speck. The speck is close to the camera, at 1e-4 of the walls' distance."""
    at = [0.01, 0.0, -0.05]
    facing = look_at(at, [0.01, 0, 1], [0, 1, 0]) @ transform(scale=2e-3)
    return {
        "type": "scene",
        "camera": pinhole([0, 0, 0], [0, 0, -1], [0, 1, 0], 50),
        "box": {"type": "cube", "flip_normals": True, "to_world": transform(translate=[0, 0, -100], scale=500),
                "bsdf": diffuse(0.6, 0.7, 0.5)},
        "speck": rectangle(diffuse(0.5, 0.6, 0.8), facing),
        "lamp": parallel([20, 8, 15], at, 5e-4, rgb(3, 2, 4), [0, 1, 0]),
    }  # fmt: skip


def grey(max_depth: int, size: int = 8) -> KnownScene:
    """A furnace whose radiance converges."""
    return furnace_scene((0.5, 0.8, 0.9), (1, 2, 0.5), max_depth, size)


def white_box() -> dict:
    """A closed white box with a white cube. The camera does not see behind the cube."""
    view = look_at([0.8, 0.7, 0.8], [-0.2, -0.2, -0.2], [0, 1, 0])
    return {
        "type": "scene",
        "camera": camera(size=8) | {"to_world": view, "fov": 80},
        "box": {"type": "cube", "flip_normals": True, "bsdf": diffuse(1, 0.99, 1)},
        "cube": {"type": "cube", "bsdf": diffuse(1, 1, 0.98),
                 "to_world": transform(rotate=([1, 2, 3], 40), scale=0.35)},
        "lamp": lit_square(rgb(3, 4, 5), translate=[0.2, 0.99, 0.2], rotate=DOWN, scale=0.3)
        | {"bsdf": diffuse(0.9, 0.9, 0.9)},
    }  # fmt: skip


LIGHTS = [
    SceneCase("emission_1e-25", "a lamp of radiance 1e-25 under a fixed adjoint image", lambda: lit(1e-25),
              (WALL, LAMP), Stock("ptracer", lambda: lit(1), {WALL: 1e-25})),
    SceneCase("emission_1e-25_roulette", "a lamp of radiance 1e-25, with Russian roulette on throughput",
              lambda: lit(1e-25), (WALL, LAMP), Stock("ptracer", lambda: lit(1), {WALL: 1e-25}), **ROULETTE),
    SceneCase("emission_1e+25", "a lamp of radiance 1e+25 under a fixed adjoint image", lambda: lit(1e25),
              (WALL, LAMP), Stock("ptracer", lambda: lit(1), {WALL: 1e25})),
    SceneCase("emission_1e-25_and_1e+25", "lamps of radiance 1e-25 and 1e+25 in one scene", two_lamps,
              (WALL, LAMP, "dim.emitter.radiance.value"), spp=128),
    SceneCase("lamp_of_area_1e-8", "a lamp of side 1e-4 and radiance 4e8", lambda: small_lamp(4e8), (WALL, LAMP)),
    SceneCase("lamp_of_area_1e-8_roulette", "a lamp of side 1e-4 and radiance 1, with Russian roulette",
              lambda: small_lamp(1), (WALL, LAMP), **ROULETTE),
    SceneCase("sun_1e6", "a sun of contrast 1e6 in an environment map", sun, ("sky.data", WALL), PRB, spp=256,
              seeds=12),
    SceneCase("grazing_light", "parallel light at half a degree over a floor", skimming,
              (FLOOR, "light.irradiance.value"), spp=256),
    SceneCase("connection_1e8", "the first connection has 1e8 times the weight of all other connections", speck,
              ("speck.bsdf.reflectance.value", "box.bsdf.reflectance.value", LAMP), image="ptracer", spp=256, seeds=24,
              options={"max_depth": 5}),
    SceneCase("no_connection", "no light path connects, because the sensor looks away",
              lambda: room(camera=camera() | {"to_world": look_at([1.2, 0.6, 4], [2.5, 1.4, 8], [0, 1, 0])}),
              (WALL, LAMP), open_ended=dict.fromkeys((WALL, LAMP), "no path reaches it")),
    exact("furnace", "a closed furnace, 16 bounces", lambda: grey(16), FURNACE, 16),
    exact("furnace_roulette", "a closed furnace without a depth limit: only Russian roulette ends the paths",
          lambda: grey(-1), FURNACE, -1, options={"max_depth": -1, "rr_depth": 5}, seeds=12),
    exact("furnace_1024", "a furnace of albedo 1, 1024 bounces",
          lambda: furnace_scene((1, 1, 1), (0.5, 1, 2), 1024, 4), FURNACE, 1024, spp=256, seeds=20, image="",
          naive=False),
    SceneCase("white_box_100", "a white box with an obstacle, and more bounces than bits for visibility", white_box,
              ("box.bsdf.reflectance.value", "cube.bsdf.reflectance.value"), seeds=12,
              options={"max_depth": 100, "hide_emitters": True},
              not_spectral="at equal seeds, a hundred bounces have a larger rounding error than gradients of few"
              " bounces"),
    exact("furnace_black", "a furnace of albedo 0: only the first bounce has a derivative",
          lambda: furnace_scene((0, 0, 0), (1, 2, 0.5), 8, 8), FURNACE, 8,
          open_ended={IMAGE: "a camera ray may slip between two triangles of a face"}),
]  # fmt: skip

# ---- Sizes, places, and normals ----


def octahedron(*reflectance: float) -> dict:
    """A solid of eight flat faces, shaded as a sphere."""
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    faces = [(x, y, z) if (x + y + z) % 2 == 0 else (y, x, z) for x in (0, 1) for y in (2, 3) for z in (4, 5)]
    positions = 0.5 * corners + [0.1, -0.3, 0.2]
    return room(solid=mesh(positions, np.array(faces), diffuse(*reflectance), normals=corners, name="solid"))


ALL = (FLOOR, WALL, LAMP)
PLACES = [
    SceneCase("scaled_1e-2", "the room at a hundredth of its size", lambda: placed(1e-2), ALL, Stock("ptracer", room)),
    SceneCase("scaled_1e+4", "the room at ten thousand times its size", lambda: placed(1e4), ALL,
              Stock("ptracer", room)),
    SceneCase("moved_100", "the room 100 units from the origin, which is fifty times its own size",
              lambda: placed(1, [60.0, 60.0, 52.9]), ALL, Stock("ptracer", room)),
    SceneCase("grazing_sensor", "a camera that looks along the floor",
              lambda: room(camera=pinhole([0.9, -0.95, 0.9], [-0.9, -0.96, -0.2], [0, 1, 0], 25)), ALL, spp=512),
    # The image has skewed noise beside the lamp.
    SceneCase("grazing_lamp", "a lamp at the edge of the floor, at a right angle to the floor", vertical_light, ALL,
              spp=128, seeds=32),
    SceneCase("back_facing", "one-sided sheets that face away from the camera and the lamp", turned_panes,
              ("first.bsdf.reflectance.value", "second.bsdf.reflectance.value", FLOOR), spp=256),
    SceneCase("shading_normals", "eight flat faces with the shading normals of a sphere",
              lambda: octahedron(0.7, 0.5, 0.8), ("solid.bsdf.reflectance.value", FLOOR), PRB, spp=256),
    SceneCase("shading_normals_albedo_0", "eight black faces with the shading normals of a sphere",
              lambda: octahedron(0, 0, 0), ("solid.bsdf.reflectance.value", FLOOR), INTO_THE_DOMAIN, spp=256),
    SceneCase("normal_map", "shading normals that are tilted by up to 60 degrees", normal_map,
              ("floor.nested_bsdf.reflectance.value", WALL), PRB, spp=512),
]  # fmt: skip

# ---- Roughness. A plate throws light on a floor, and the camera sees only the floor. The plate stays out of view:
# connections of a nearly smooth lobe to the sensor have a variance that no sample count resolves. ----


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


#: For each kind of BSDF: its surroundings, its options, the names of the colour of its lobe and of its roughness, and
#: whether the roughness is a parameter.
KINDS: dict[str, tuple[Callable[[dict], dict], dict, str, str, bool]] = {
    "roughconductor": (reflected, {}, "specular_reflectance", "alpha", True),
    "roughdielectric": (transmitted, {}, "specular_transmittance", "alpha", True),
    "roughplastic": (reflected, {"diffuse_reflectance": rgb(0.1, 0.2, 0.3)}, "specular_reflectance", "alpha", False),
    "principled": (reflected, {"metallic": 0.9}, "base_color", "roughness", True),
}
#: Roughnesses whose derivative is checked on followed paths. `principled` chooses a lobe and has no such derivative.
#: The values are the numbers of seeds. With fewer seeds, the noise hides the derivative, or single seeds dominate it.
FOLLOWED = {("roughconductor", "0.1"): 16, ("roughconductor", "1e-2"): 16,
            ("roughdielectric", "0.1"): 64, ("roughdielectric", "1e-2"): 32}  # fmt: skip
#: Numbers of seeds that decide noisy derivatives by roughness.
SEEDS = {("principled", "1e-2"): 40, ("principled", "1e-4"): 40}
NOISE = "the noise of a roughness's derivative grows as 1 / roughness: equal seeds decide"


def plate(kind: str, roughness: str) -> dict:
    """A plate with a BSDF of this `kind`. The plate reflects or transmits a lamp's light."""
    around, options, colour, own, _ = KINDS[kind]
    return around({"type": kind, own: float(roughness), colour: rgb(0.9, 0.7, 0.5), **options})


def _rough(kind: str, roughness: str) -> SceneCase:
    _, _, colour, own, is_parameter = KINDS[kind]
    key, differentiated = f"plate.bsdf.{own}.value", is_parameter and (kind, roughness) not in FOLLOWED
    is_noisy = differentiated and float(roughness) <= 0.1
    return SceneCase(
        f"{kind}_{roughness}", f"light that a {kind} of roughness {roughness} reflects or transmits",
        lambda: plate(kind, roughness), (f"plate.bsdf.{colour}.value", PLATE, *([key] if differentiated else [])), PRB,
        spp=256, signed=differentiated, open_ended={key: NOISE} if is_noisy else {},
        seeds=SEEDS.get((kind, roughness), 16),
    )  # fmt: skip


def _followed(kind: str, roughness: str) -> SceneCase:
    """Return the case of the derivative with respect to a roughness that moves light.

    The derivative has little noise, and finite differences give the reference. In two cases, the usual scene leaves
    almost no derivative: nearly smooth glass blurs by less than a pixel, and the mirror spreads the lamp's light over
    more than the view. A narrow beam replaces the lamp there, and the camera of the glass is closer.
    """

    def scene() -> dict:
        made = plate(kind, roughness)
        if (kind, roughness) == ("roughdielectric", "1e-2"):
            made["camera"] = pinhole([0, 0.9, 0], [0, 0, 0], [0, 0, -1], 4)
            made["lamp"] = lit_square(rgb(5, 6, 4), None, "directionalarea", translate=[0, 1.8, 0], rotate=DOWN,
                                      scale=0.01)  # fmt: skip
        if (kind, roughness) == ("roughconductor", "0.1"):
            made["lamp"] = parallel([0, 2, 0], [-1, 1, 0], 0.05, rgb(500, 600, 400))
        made["camera"]["film"]["rfilter"] = FILTER  # a box filter has no derivative by film position
        return made

    return SceneCase(
        f"{kind}_{roughness}_followed", f"light whose direction follows the roughness {roughness} of a {kind}",
        scene, (), Differences(0.05 * float(roughness), left=2e-3), image="", spp=256, signed=True,
        seeds=FOLLOWED[kind, roughness],
        options={"max_depth": 3},  # from the plate to the floor: the edges beyond do not move
        ours={"attached": True}, equal=5e-4, moves=lambda scene: [number("plate.bsdf.alpha.value")],
    )  # fmt: skip


ROUGHNESS = [_rough(kind, roughness) for kind in KINDS for roughness in ("1", "0.1", "1e-2", "1e-4")]
ROUGHNESS += [_followed(*which) for which in FOLLOWED]

# ---- Films ----


def seen(camera: dict, **change: Any) -> dict:
    """The room with a floor texture of 2 x 2 texels, the minimum size in Mitsuba."""
    return room(camera=camera, floor=matte(texture(2, 2) | change))


def strip() -> dict:
    """A film of one column of 4096 pixels."""
    film = camera()["film"] | {"width": 1, "height": 4096}
    return seen(camera() | {"film": film, "fov": 0.2})


FILMS = [
    SceneCase("one_pixel", "a film of one pixel", lambda: seen(camera(size=1)), (TEXELS, LAMP), spp=8192),
    SceneCase("one_sample", "one light path for each of 256 pixels", lambda: seen(camera()), (TEXELS, LAMP), spp=1,
              seeds=64),
    SceneCase("one_texel", "one texel that covers all of the floor",
              lambda: seen(camera(), to_uv=transform(scale=0.4)), (TEXELS, LAMP)),
    SceneCase("film_1x4096", "a film of one column of 4096 pixels", strip, (TEXELS, LAMP), spp=64),
    SceneCase("film_border", "a filter that reaches beyond the film's border, where samples are lost",
              lambda: seen(camera("gaussian", size=4)), (TEXELS, LAMP), image="ptracer", spp=1024),
    SceneCase("film_crop", "a crop window of 3 x 2 pixels, and a filter that reaches beyond its border",
              lambda: seen(camera("tent", crop_offset_x=6, crop_offset_y=12, crop_width=3, crop_height=2)),
              (TEXELS, LAMP), **TRACED),
]  # fmt: skip

# ---- Masks and glass ----


def nested() -> dict:
    """A glass ball inside a ball of water. The camera sees the floor below, but not the balls."""
    water = glass(1.33, specular_transmittance=rgb(0.9, 0.8, 0.7))
    inner = glass(1.5, 1.33, specular_transmittance=rgb(0.7, 0.8, 0.9), specular_reflectance=rgb(0.9, 0.6, 0.8))
    return {
        "type": "scene",
        "camera": pinhole([0, 0.3, 0], [0, 0, 0], [0, 0, -1], 80),
        "floor": rectangle(diffuse(0.7, 0.5, 0.6), rotate=UP, scale=2),
        "water": sphere(water, [0, 1, 0], 0.6),
        "glass": sphere(inner, [0.1, 1, 0], 0.35),
        "lamp": lit_square(rgb(9, 8, 7), translate=[0, 2.2, 0], rotate=DOWN, scale=0.5),
    }


def critical() -> dict:
    """A beam in a medium of index 1.5. The beam meets the medium's flat surface, y = 0, at the critical angle.

    The camera sees the bottom, which receives the totally reflected light.
    """
    theta = float(np.arcsin(1 / 1.5))
    below = [4 * float(np.tan(theta)), -4.0, 0.0]
    return {
        "type": "scene",
        "camera": pinhole([below[0], -3, 2], below, [0, 1, 0], 20),
        "surface": rectangle(glass(specular_reflectance=rgb(0.9, 0.7, 0.5)), rotate=UP, scale=3),
        "floor": rectangle(diffuse(0.7, 0.5, 0.6), translate=below, rotate=UP, scale=2),
        "lamp": parallel([-float(np.sin(theta)), -float(np.cos(theta)), 0.0], [0, 0, 0], 0.5, rgb(3, 2, 4)),
    }


GLASS = [
    SceneCase("opacity_0", "a transparent mask", lambda: veiled(0.0), (FLOOR, LAMP), PRB, spp=128),
    SceneCase("opacity_1", "an opaque mask", lambda: veiled(1.0), (FLOOR, LAMP, VEIL), PRB, spp=128),
    SceneCase("opacity_texture_0_and_1", "a mask with opaque and with transparent texels",
              lambda: veiled(bitmap(np.array([[[0.0], [1.0]], [[1.0], [0.0]]]))), (FLOOR, LAMP, VEIL), PRB, spp=128),
    SceneCase("opacity_0.4", "the opacity of a mask, at a depth where the image is quadratic in the opacity",
              lambda: veiled(0.4), (OPACITY,), Differences(0.3), spp=1024, options={"max_depth": 3}, signed=True),
    SceneCase("albedo_0_behind_mask", "a wall that is 0 in one channel, behind a mask",
              lambda: veiled(0.4, wall=matte(0, 0.7, 0.4)), (WALL, VEIL), INTO_THE_DOMAIN, spp=128),
    SceneCase("nested_dielectrics", "a glass ball inside a water ball", nested,
              ("water.bsdf.specular_transmittance.value", "glass.bsdf.specular_transmittance.value", PLATE),
              options={"max_depth": 8}, **TRACED),
    SceneCase("critical_angle", "a beam that is totally reflected at the critical angle", critical,
              ("surface.bsdf.specular_reflectance.value", PLATE), seeds=8, **TRACED),
    exact("refraction", "a point light over a pool", refraction_scene, POOL, 3, **TRACED),
    exact("index_1", "a point light over a pool of index 1", lambda: refraction_scene(1.0), POOL, 3, **TRACED),
    exact("index_3", "a point light over a pool of index 3", lambda: refraction_scene(3.0), POOL, 3, **TRACED),
    exact("slab", "a beam through a glass slab, with up to six reflections inside the slab",
          lambda: slab_scene(1.5, 40, 10), SLAB, 10, seeds=32, **TRACED),
    exact("slab_index_3_grazing", "a beam at 85 degrees on a slab of index 3: most of the light is reflected",
          lambda: slab_scene(3.0, 85, 10), SLAB, 10, **TRACED),
]  # fmt: skip

# ---- Losses and sums ----


def mixed(weights: np.ndarray) -> np.ndarray:
    """Weights for each channel and pixel, with either sign. The mean weight is not zero."""
    return weights * np.random.default_rng(4).choice([-1.0, 1.0], weights.shape, p=[0.35, 0.65]).astype(np.float32)


def spoilt(value: float) -> Callable[[np.ndarray], np.ndarray]:
    """Weights with `value` in one channel of each of three pixels."""

    def spoil(weights: np.ndarray) -> np.ndarray:
        weights = weights.copy()
        weights[(5, 8, 11), (9, 8, 3), (0, 1, 2)] = value
        return weights

    return spoil


LOSSES = [
    SceneCase("negative_loss", "a loss with negative derivatives", room, (FLOOR, LAMP), weights=np.negative,
              signed=True),
    SceneCase("mixed_loss", "a loss whose derivatives have both signs, by channel and pixel", room, (FLOOR, LAMP),
              weights=mixed, signed=True, spp=256),
    SceneCase("nan_loss", "NaN in the loss's derivative is refused and counted", room, (FLOOR, LAMP),
              weights=spoilt(np.nan)),
    SceneCase("infinite_loss", "infinity in the loss's derivative is refused and counted", room, (FLOOR, LAMP),
              weights=spoilt(-np.inf)),
    # A film of one pixel, so that all samples are added to the same few sums.
    *(exact(name, f"{spp:.0e} samples in one pixel, in single precision", lambda: grey(2, 1), FURNACE, 2, image="",
            spp=spp, seeds=1, naive=False, equal=5e-3)
      for name, spp in (("sums_1e7", 10**7), ("sums_1e8", 10**8))),
]  # fmt: skip

# ---- Motion: light from above falls on a glass surface with waves that moves ----

SIZE = 24
#: Ten ray offsets at a thin slab: 8.9e-5 (1 + max |p|) each.
THIN = 10 * 8.9e-5 * (1 + 2.5)


def beam(origin: tuple[float, float], target: tuple[float, float], half: float, scale: float = 1) -> dict:
    """Parallel light in the plane z = 0 with a square cross-section. `origin` and `target` are (x, y)."""
    start, end = ([scale * x, scale * y, 0.0] for x, y in (origin, target))
    return parallel(start, end, scale * half, rgb(9, 8, 7))


def pool(
    bsdf: dict | None = None, light: dict | None = None, slope: float = 1, height: float = 1.8, thickness: float = 0,
    scale: float = 1, cells: int = 128,
) -> dict:  # fmt: skip
    """A receiver in glass with a wavy surface. With a `thickness`, the glass is a slab above the receiver.

    By default, the light is at 20 degrees to the vertical. `slope` is the slope of the waves in units of 0.1, and
    `scale` the size of everything. The surface has `cells` flat faces per side. The error of the flat faces falls as
    the inverse square of `cells` (docs/method.md).
    """
    bsdf = bsdf or glass()
    seen = pinhole([0, scale, 0], [0, 0, 0], [0, 0, -1], 90, SIZE, rfilter=FILTER)
    positions, faces, uv = grid(cells, lambda x, z: height + slope * waves(x, z), 2.5)
    scene = {
        "type": "scene",
        "camera": seen | {"near_clip": 1e-2 * scale, "far_clip": 1e3 * scale},
        "floor": rectangle(diffuse(0.8, 0.7, 0.6), rotate=UP, scale=20 * scale),
        "lamp": light or beam((0.5, 3), (0.05, 1.8), 0.25, scale),
        "top": mesh(scale * positions, faces, bsdf, uv, True),
    }
    if thickness:
        below = [0, scale * (height - thickness), 0]
        scene["bottom"] = rectangle(bsdf, translate=below, rotate=DOWN, scale=3 * scale)
    return scene


def bending(size: float = 1, scale: float = 1, axes: Any = (1, 1, 1), lamp: bool = False) -> Moves:
    """Three smooth displacements of the surface along `axes`, multiplied by `size`. The `lamp` may move, too."""

    def moves(scene: Any) -> Sequence[Move]:
        fields = size * scale * smooth_fields(vertices(scene, "top") / scale, 3, 1.0) * np.array(axes)
        beside = [pose("lamp.to_world", ("tx", "rz"), (0.5, 3, 0))] if lamp else []
        return [displacement("top.vertex_positions", fields), *beside]

    return moves


def grazing(degrees: float) -> dict:
    """Light that meets the surface at `degrees` from its normal."""
    theta = float(np.deg2rad(degrees))
    at = -1.2 * float(np.tan(np.arcsin(np.sin(theta) / 1.5)))
    start = (at - 2 * float(np.sin(theta)), 1.2 + 2 * float(np.cos(theta)))
    return pool(light=beam(start, (at, 1.2), 0.02), slope=0.1, height=1.2)


def moved(name: str, about: str, scene: Callable[[], dict], step: float = 0.01, moves: Moves | None = None,
          depth: int = 3, left: float = 1e-3, **more: Any) -> SceneCase:  # fmt: skip
    """Return a case of motion, whose differences have this `step` in the amplitudes."""
    fields: dict[str, Any] = {"image": "ptracer", "seeds": 8, "signed": True, "options": {"max_depth": depth}} | more
    return SceneCase(name, about, scene, (), Differences(step, left=left), moves=moves or bending(), **fields)


ROUGH: dict[str, Any] = {"type": "roughdielectric", "alpha": 0.1}
MOTION = [
    moved("slope_0", "a flat glass surface that begins to bend", lambda: pool(slope=0)),
    moved("slope_1e-6", "a glass surface with slopes of one millionth", lambda: pool(slope=1e-5)),
    moved("slope_0.3", "a glass surface with slopes of a third", lambda: pool(slope=3), 0.005),
    moved("sliding_faces", "a surface whose faces slide through the light", pool, moves=bending(axes=(1, 0, 1))),
    moved("total_reflection", "a surface with waves, beyond the critical angle",  # light from inside
          lambda: pool(light=beam((-1.87, 1.0), (-1.6, 1.2), 0.12), slope=0.1, height=1.2, cells=256), 0.0015),
    moved("grazing_85", "light at 85 degrees on glass", lambda: grazing(85), 0.005, bending(0.1), seeds=12),
    moved("parallel_faces", "a slab with flat faces that begins to bend", lambda: pool(slope=0, thickness=0.2),
          depth=4),
    moved("thin_slab", "a slab whose thickness is ten ray offsets", lambda: pool(slope=0, thickness=THIN), 0.1,
          bending(THIN), 4, spp=256),
    moved("moved_index_1", "moving glass of index 1, and the lamp above the glass", lambda: pool(glass(1.0)),
          moves=bending(lamp=True)),
    moved("moved_index_3", "moving glass of index 3", lambda: pool(glass(3.0))),
    moved("moved_rough_1.001", "moving rough glass of index 1.001, and the lamp above the glass",
          lambda: pool(glass(1.001) | ROUGH), moves=bending(lamp=True), equal=1e-3),
    moved("moved_rough_3", "moving rough glass of index 3", lambda: pool(glass(3.0) | ROUGH), equal=1e-3),
    moved("millimetres", "a slab at a thousand times its size", lambda: pool(thickness=0.2, scale=1e3),
          moves=bending(scale=1e3), depth=4),
    moved("shrunk_to_0.03", "a slab at three hundredths of its size", lambda: pool(thickness=0.2, scale=0.03),
          moves=bending(scale=0.03), depth=4, left=5e-3),
]  # fmt: skip

# ---- Lamps that no sample finds, or one sample in a thousand ----

#: The parameters of `texels_over_plane`.
PLANE = "plane.bsdf.reflectance.value"
LAMP_TEXELS = {"albedo": PLANE, "texels": f"{RADIANCE}.data"}


def spots() -> KnownScene:
    """A lamp with three bright texels and thirteen black ones."""
    texels = np.zeros((4, 4, 3))
    texels[0, 0], texels[1, 2], texels[2, 2] = (9, 8, 7), (3, 4, 5), (30, 20, 10)
    return texels_over_plane(texels)


UNFOUND = [
    exact("lamp_of_a_thousandth_of_a_pixel", "a visible lamp that one in a thousand primary rays hits",
          lambda: speck_in_view(side=0.0037, radiance=(300, 200, 400)), {"radiance": LAMP}, 1, image="ptracer",
          seeds=8),
    exact("black_texels", "a lamp with black texels, which are never sampled in proportion to radiance", spots,
          LAMP_TEXELS, 2, spp=256),
    exact("black_lamp", "a lamp with only black texels, so no density is proportional to radiance",
          lambda: texels_over_plane(np.zeros((2, 2, 3))), LAMP_TEXELS, 2, spp=256,
          open_ended={PLANE: "there is no light that it could reflect"}),
]  # fmt: skip

TAGGED: dict[str, list[SceneCase]] = {
    "colours": COLOURS, "lights": LIGHTS, "places": PLACES, "roughness": ROUGHNESS, "films": FILMS, "glass": GLASS,
    "losses": LOSSES, "motion": MOTION, "unfound": UNFOUND,
}  # fmt: skip
#: By name; no two cases have the same name.
CASES = {case.name: case for cases in TAGGED.values() for case in cases}
