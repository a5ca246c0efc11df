"""Families of small scenes whose parameters have random true values, for the calibration of verdicts over whole runs.

Each family has a scene and parameters of one kind. A seed determines the true values and the settings of the run.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import yaml
from kit import TEXTURE, area, diffuse, scene, sensor, shape
from optimization.judged import LEFT, POSTER, RIGHT, WALL, iterate_to_the_end, write_scene
from optimization.judged import SCENE as LIGHTS

from reslrb_cli.config.loader import load
from reslrb_cli.measure.missing import check_missing
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.optimizers import SMALL
from reslrb_cli.optimization.uncertainty.posterior import LEAST_VALUE, TOLERANCE
from reslrb_cli.statistics import rms

Random = np.random.Generator
ROOT = Path(__file__).parents[2]
#: Parameters, true values by key, and further settings of a run.
Draw = tuple[list[dict[str, Any]], dict[str, Any], dict[str, Any]]


@dataclass(frozen=True)
class Recovered:
    """Verdict on a parameter, and the errors, spreads and tolerances of its entries. A texture has one number each."""

    key: str
    verdict: str
    errors: np.ndarray
    spreads: np.ndarray
    tolerances: np.ndarray

    @property
    def is_within(self) -> bool:
        """True if four fifths of the entries are within their tolerances."""
        return bool(np.mean(self.errors <= self.tolerances) >= 0.8)


@dataclass(frozen=True)
class Family:
    """Scenes of one kind: the text of the scene file, and a function that draws the parameters of one run."""

    name: str
    kind: str
    scene: str
    draw: Callable[[Random, Path], Draw]


def color(random: Random, low: float = 0.1, high: float = 0.85) -> list[float]:
    return [float(each) for each in random.uniform(low, high, 3)]


def recolored(random: Random, keys: Sequence[str]) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the parameters of these colours, and their true values."""
    return [entry(key, 0.5) for key in keys], {key: color(random) for key in keys}


def mirrored(random: Random, folder: Path, sizes: Sequence[int], key: str
             ) -> tuple[list[dict[str, Any]], dict[str, Any]]:  # fmt: skip
    """Return the parameters of a rug of one of these sizes and of the mirror's colour `key`, and their true values."""
    size = int(random.choice(sizes))
    texture(random, folder, "rug0", size)
    truth = {RUG: texture(random, folder, "rug", size), key: color(random, 0.4, 0.95)}
    return [entry(RUG, 0.5), entry(key, 0.5)], truth


def under_l1(draw: Callable[[Random, Path], Draw]) -> Callable[[Random, Path], Draw]:
    """Return a function that draws the same runs with the loss `l1`."""

    def drawn(random: Random, folder: Path) -> Draw:
        parameters, truth, settings = draw(random, folder)
        return parameters, truth, settings | {"loss.type": "l1"}

    return drawn


def texture(random: Random, folder: Path, name: str, size: int, channels: int = 3, low: float = 0.1) -> dict[str, str]:
    """Write a texture with details of one texel and larger ones. Return the entry that names its file."""
    coarse = random.uniform(0, 1, (max(size // 4, 2), max(size // 4, 2), channels))
    coarse = np.kron(coarse, np.ones((size // len(coarse), size // len(coarse), 1)))
    share = random.uniform(0.2, 0.8)
    values = low + (0.9 - low) * (share * coarse + (1 - share) * random.uniform(0, 1, (size, size, channels)))
    mi.Bitmap(values.astype(np.float32)).write(str(folder / f"{name}.exr"))
    return {"file": f"{name}.exr"}


def entry(key: str, initial: float, low: float = 0.0, high: float = 1.0) -> dict[str, Any]:
    return {"key": key, "initial": initial, "bounds": [low, high]}


def bitmap(name: str, file: str, filter_type: str = "bilinear") -> str:
    text = TEXTURE.format(file).replace('name="reflectance"', f'name="{name}"')
    return text.replace('value="nearest"', f'value="{filter_type}"')


def point(position: str, intensity: str) -> str:
    x, y, z = position.split(", ")
    place = f'<point name="position" x="{x}" y="{y}" z="{z}"/>'
    return f'<emitter type="point">{place}<rgb name="intensity" value="{intensity}"/></emitter>'


FLAT = '<rotate x="1" angle="-90"/>'
CORNER = scene(
    sensor("0.5, 1.6, 3", "0, 0.6, 0", size=20, fov=48),
    shape("rectangle", "floor", diffuse("0.5"), place=f'{FLAT}<scale value="2"/>'),
    shape("rectangle", "back", diffuse("0.5"), place='<scale value="2"/><translate y="1" z="-1"/>'),
    shape("sphere", "ball", '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.5"/>'
          '<float name="alpha" value="0.2"/></bsdf>', place='<scale value="0.5"/><translate x="0.5" y="0.5"/>'),
    shape("rectangle", "panel", diffuse("0"), area("8"),
          place='<rotate x="1" angle="90"/><scale value="0.5"/><translate x="-0.6" y="2.4" z="0.6"/>'),
)  # fmt: skip


SURFACES = ["floor.bsdf.reflectance.value", "back.bsdf.reflectance.value", "ball.bsdf.diffuse_reflectance.value"]


def lit_wall(random: Random, folder: Path) -> Draw:
    keys = [WALL, LEFT] if random.random() < 0.5 else [WALL]
    parameters = [entry(WALL, 0.5)]
    truth: dict[str, Any] = {WALL: color(random)}
    if LEFT in keys:
        parameters.append(entry(LEFT, 3.0, 0.0, 100.0))
        truth[LEFT] = color(random, 3, 12)
    return parameters, truth, {"integrator.max_depth": 3}


def corner(random: Random, folder: Path) -> Draw:
    chosen = random.permutation(SURFACES).tolist()[: int(random.integers(1, 4))]
    parameters, truth = recolored(random, chosen)
    if random.random() < 0.5:
        parameters.append(entry("panel.emitter.radiance.value", 4.0, 0.0, 100.0))
        truth["panel.emitter.radiance.value"] = color(random, 4, 14)
    return parameters, truth, {"integrator.max_depth": 4}


def poster(random: Random, folder: Path) -> Draw:
    parameters, truth = [entry(POSTER, 0.5)], {POSTER: texture(random, folder, "print", 4)}
    if random.random() < 0.5:
        parameters.append(entry(RIGHT, 2.0, 0.0, 100.0))
        truth[RIGHT] = color(random, 3, 12)
    return parameters, truth, {"integrator.max_depth": 3}


RUG = "rug.bsdf.reflectance.data"
ROOM = scene(
    sensor("0, 2.2, 2.4", "0, 0, 0", size=28, fov=46),
    shape("rectangle", "rug", f'<bsdf type="diffuse">{bitmap("reflectance", "rug0.exr")}</bsdf>', place=FLAT),
    shape("rectangle", "side", diffuse("0.5"),
          place='<rotate y="1" angle="90"/><translate x="-1" y="1"/>'),
    point("0.6, 1.8, 0.8", "9, 8, 7"),
)  # fmt: skip


def rug(random: Random, folder: Path) -> Draw:
    size = int(random.choice([8, 16, 32]))
    parameters, truth = [entry(RUG, 0.5)], {RUG: texture(random, folder, "rug", size)}
    texture(random, folder, "rug0", size)
    if random.random() < 0.5:
        key = "side.bsdf.reflectance.value"
        parameters.append(entry(key, 0.5))
        truth[key] = color(random)
    return parameters, truth, {"integrator.max_depth": 4}


COAT = "sample.bsdf"
MAPS = scene(
    sensor("0, 3, 2.5", "0, 0, 0", size=32, fov=40),
    shape("rectangle", "sample", '<bsdf type="principled">', bitmap("base_color", "color0.exr"),
          bitmap("roughness", "rough0.exr"), bitmap("metallic", "metal0.exr"), "</bsdf>", place=FLAT),
    shape("rectangle", "panel", area("12"),
          place='<rotate x="1" angle="90"/><scale value="0.6"/><translate x="1" y="3"/>'),
    '<emitter type="constant"><rgb name="radiance" value="0.3"/></emitter>',
)  # fmt: skip


def maps(random: Random, folder: Path) -> Draw:
    size = int(random.choice([4, 8]))
    for name, channels in (("color0", 3), ("rough0", 1), ("metal0", 1)):
        texture(random, folder, name, size, channels)
    parameters = [entry(f"{COAT}.base_color.data", 0.5), entry(f"{COAT}.roughness.data", 0.5, 0.05)]
    truth = {f"{COAT}.base_color.data": texture(random, folder, "color", size),
             f"{COAT}.roughness.data": texture(random, folder, "rough", size, 1, 0.3)}  # fmt: skip
    if random.random() < 0.6:
        parameters.append(entry(f"{COAT}.metallic.data", 0.5))
        truth[f"{COAT}.metallic.data"] = texture(random, folder, "metal", size, 1)
    return parameters, truth, {"integrator.max_depth": 2}


VARNISH = scene(
    sensor("-1.2, 2.4, 2.2", "0, 0, 0", size=24, fov=44),
    shape("rectangle", "sample", '<bsdf type="blendbsdf">', bitmap("weight", "weight0.exr"),
          '<bsdf type="diffuse">', bitmap("reflectance", "wood0.exr"), "</bsdf>",
          '<bsdf type="roughconductor"><float name="alpha" value="0.3"/>',
          bitmap("specular_reflectance", "metal0.exr"), "</bsdf></bsdf>", place=FLAT),
    point("1, 2, -0.5", "14, 14, 14"),
    '<emitter type="constant"><rgb name="radiance" value="0.4"/></emitter>',
)  # fmt: skip


def varnish(random: Random, folder: Path) -> Draw:
    size = int(random.choice([4, 8]))
    for name, channels in (("weight0", 1), ("wood0", 3), ("metal0", 3)):
        texture(random, folder, name, size, channels)
    keys = ("sample.bsdf.weight.data", "sample.bsdf.bsdf_0.reflectance.data",
            "sample.bsdf.bsdf_1.specular_reflectance.data")  # fmt: skip
    chosen = [keys[place] for place in ((0, 1), (1, 2), (0, 1, 2))[int(random.integers(3))]]
    truth = {key: texture(random, folder, f"true{place}", size, 1 if key == keys[0] else 3)
             for place, key in enumerate(chosen)}  # fmt: skip
    return [entry(key, 0.5) for key in chosen], truth, {"integrator.max_depth": 2}


TINTED = scene(
    sensor("0, 1, 3", "0, 0.5, 0", size=28, fov=40),
    shape("rectangle", "mirror", '<bsdf type="principled"><rgb name="base_color" value="0.5"/>'
          '<float name="metallic" value="1"/><float name="roughness" value="0.05"/></bsdf>',
          place='<scale value="0.6"/><translate y="0.6" z="-0.8"/>'),
    shape("rectangle", "rug", f'<bsdf type="diffuse">{bitmap("reflectance", "rug0.exr")}</bsdf>',
          place=f'{FLAT}<scale value="4"/>'),
    point("0, 2, 1.5", "12, 12, 12"),
)  # fmt: skip


def tinted(random: Random, folder: Path) -> Draw:
    parameters, truth = mirrored(random, folder, (8, 16, 32), "mirror.bsdf.base_color.value")
    return parameters, truth, {"integrator.max_depth": 4}


PLATE = scene(
    sensor("0, 1.4, 2.6", "0, 0.1, 0", size=24, fov=42),
    shape("rectangle", "plate", '<bsdf type="roughconductor"><string name="material" value="none"/>'
          '<float name="alpha" value="0.1"/><rgb name="specular_reflectance" value="0.5"/></bsdf>', place=FLAT),
    shape("rectangle", "rug", f'<bsdf type="diffuse">{bitmap("reflectance", "rug0.exr")}</bsdf>',
          place='<scale value="1.2"/><translate y="1.3" z="-1.2"/>'),
    shape("rectangle", "stripe", diffuse("0.6"),
          place='<scale x="1.2" y="0.12"/><translate y="0.2" z="-1.1"/>'),
    point("0, 2.5, 1.5", "16, 16, 16"),
)  # fmt: skip


def plate(random: Random, folder: Path) -> Draw:
    parameters, truth = mirrored(random, folder, (4, 8, 16), "plate.bsdf.specular_reflectance.value")
    if random.random() < 0.4:
        parameters.append(entry("plate.bsdf.alpha.value", 0.25, 0.03, 0.6))
        truth["plate.bsdf.alpha.value"] = float(random.uniform(0.06, 0.3))
    return parameters, truth, {"integrator.max_depth": 4}


def exposed_wall(random: Random, folder: Path) -> Draw:
    _, truth, settings = lit_wall(random, folder)
    return [entry(WALL, 0.5)], {WALL: truth[WALL]}, settings | {"target.exposure": "auto"}


def exposed_corner(random: Random, folder: Path) -> Draw:
    chosen = random.permutation(SURFACES).tolist()[: int(random.integers(1, 3))]
    exposure = str(random.choice(["auto", "per_channel"]))
    return *recolored(random, chosen), {"integrator.max_depth": 4, "target.exposure": exposure}


BALL = scene(
    sensor("0.4, 2, 3", "0, 0.3, 0", size=28, fov=40, rfilter="gaussian"),
    shape("rectangle", "floor", diffuse("0.6"), place=f'{FLAT}<scale value="3"/>'),
    shape("cube", "box", diffuse("0.5, 0.3, 0.2"), place='<scale value="0.3"/><translate y="0.3"/>'),
    shape("rectangle", "panel", area("14"),
          place='<rotate x="1" angle="90"/><scale value="0.4"/><translate x="0.8" y="2.4" z="0.6"/>'),
)  # fmt: skip


def moved_box(random: Random, folder: Path) -> Draw:
    move = [float(each) for each in random.uniform(-0.15, 0.15, 3) * [1, 0, 1]]
    parameters: list[dict[str, Any]] = [{"motion": {"of": "box", "free": ["x", "z"]}}]
    truth: dict[str, Any] = {"box.x": move[0], "box.z": move[2]}
    if random.random() < 0.5:
        parameters.append(entry("box.bsdf.reflectance.value", 0.5))
        truth["box.bsdf.reflectance.value"] = color(random)
    return parameters, truth, {"integrator.max_depth": 2}


def moved_lamp(random: Random, folder: Path) -> Draw:
    move = [float(each) for each in random.uniform(-0.4, 0.4, 3)]
    return [{"motion": {"of": "panel", "free": ["translation"]}}], {"panel.translation": move}, {
        "integrator.max_depth": 2}  # fmt: skip


GLASS = (ROOT / "scenes/caustic_heightmap/scene.xml").read_text().replace('value="128"', 'value="32"')
RELIEF = scene(
    sensor("0, 1.9, 1.2", "0, 0, 0", size=24, fov=60, rfilter="gaussian"),
    shape("rectangle", "screen", diffuse("0.8"), place=f'{FLAT}<scale value="1.4"/>'),
    shape("ply", "face", '<string name="filename" value="face.ply"/>',
          '<bsdf type="roughconductor"><float name="alpha" value="0.1"/></bsdf>',
          place='<rotate x="1" angle="-60"/><translate y="0.9" z="-1.3"/>'),
    '<emitter type="directional"><vector name="direction" x="0" y="-0.5" z="-1"/>'
    '<rgb name="irradiance" value="4"/></emitter>',
)  # fmt: skip


def relief(random: Random, folder: Path) -> Draw:
    shutil.copy(ROOT / "scenes/caustic_heightmap/face.ply", folder)
    size = int(random.choice([3, 5, 8]))
    places = np.linspace(0, np.pi, size)
    waves = [np.cos(random.integers(0, 4) * places + random.uniform(0, 3)) for _ in range(4)]
    heights = 0.01 * (np.outer(waves[0], waves[1]) + np.outer(waves[2], waves[3]))
    mi.Bitmap(heights[:, :, None].astype(np.float32)).write(str(folder / "heights.exr"))
    rates = {"type": "sgd", "momentum": 0.9, "learning_rate": 6e-4, "schedule": "cosine"}
    optimizer = {"type": "auto"} if size < 8 else rates
    return ([{"heightmap": {"mesh": "face", "resolution": [size, size]}}], {"face.heightmap": {"file": "heights.exr"}},
            {"integrator.max_depth": 4, "optimizer": optimizer})  # fmt: skip


def recover(family: Family, seed: int, folder: Path) -> list[Recovered]:
    """Make the run of a family with this seed, from the check of missing derivatives to the verdicts."""
    random = np.random.default_rng([FAMILIES.index(family), seed])
    write_scene(folder)
    (folder / "scene.xml").write_text(family.scene)
    parameters, truth, settings = family.draw(random, folder)
    by_auto = random.random() < 2 / 3
    config: dict[str, Any] = {
        "variant": "llvm_ad_rgb", "scene": {"file": "scene.xml"}, "parameters": parameters,
        "target": {"render": {"spp": int(random.choice([128, 512, 2048])), "parameters": truth}},
        "integrator": {"type": "reslrb"}, "loss": {"type": "l2"}, "optimizer": {"type": "auto"} if by_auto else ADAM,
        "run": {"iterations": int(random.choice([30, 60, 120])), "spp": int(random.choice([8, 16, 32])), "seed": seed},
    }  # fmt: skip
    for name, value in settings.items():
        section, _, entry = name.partition(".")
        config[section] = config[section] | {entry: value} if entry else value
    (folder / "family.yaml").write_text(yaml.safe_dump(config))
    problem = assemble(load(folder / "family.yaml"), to_run=True)
    problem, missing = check_missing(problem, lambda line: None, lambda line: None)
    problem = problem.afresh(problem.values()) if missing else problem
    true = {key: np.asarray(value, dtype=np.float64) for key, value in problem.truth.items()}
    problem.truth.clear()
    certainty, last = iterate_to_the_end(problem)
    found = certainty.measure(last.iteration + 1, last.elapsed_s, lambda: False)
    assert found is not None
    found = found.without_derivatives([record.parameter for record in missing if record.is_incomplete])
    result = []
    for key, about in found.parameters.items():
        value = problem.values()[key].astype(np.float64)
        error, scale = value - true[key].reshape(value.shape), certainty.scale(key)
        if key in certainty.shown:
            value, error = value[certainty.shown[key]], error[certainty.shown[key]]
        one = np.abs(value.ravel()) if value.size <= SMALL else np.array([rms(value)])
        errors = np.abs(error.ravel()) if value.size <= SMALL else np.array([rms(error)])
        spreads = np.full(1, np.nan) if about.spread is None else np.array(about.spread, dtype=np.float64)
        tolerances = TOLERANCE * np.maximum(one, LEAST_VALUE * scale)
        result.append(Recovered(key, about.verdict, errors, np.resize(spreads, errors.shape), tolerances))
    return result


ADAM = {"type": "adam", "learning_rate": 0.02, "schedule": "cosine"}
FAMILIES = [
    Family("lit wall", "colours", LIGHTS, lit_wall), Family("corner", "colours", CORNER, corner),
    Family("poster", "textures", LIGHTS, poster), Family("rug", "textures", ROOM, rug),
    Family("sheet", "maps", MAPS, maps), Family("varnish", "maps", VARNISH, varnish),
    Family("tinted mirror", "mirrors", TINTED, tinted), Family("plate", "mirrors", PLATE, plate),
    Family("exposed wall", "exposures", LIGHTS, exposed_wall),
    Family("exposed corner", "exposures", CORNER, exposed_corner),
    Family("moved box", "motions", BALL, moved_box), Family("moved lamp", "motions", BALL, moved_lamp),
    Family("slab", "heightmaps", GLASS, relief), Family("relief", "heightmaps", RELIEF, relief),
    Family("l1 wall", "l1", LIGHTS, under_l1(lit_wall)), Family("l1 rug", "l1", ROOM, under_l1(rug)),
]  # fmt: skip
