"""Export of a run: the scene with the recovered values for plain Mitsuba, and the solid of a lens or a mirror."""

from __future__ import annotations

import importlib.util
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config.schema import Config, Fabrication
from reslrb_cli.errors import ConfigError
from reslrb_cli.lens.solid import (
    WRITERS,
    Sheet,
    Solid,
    as_sheet,
    make_solid,
    measured,
    ply_file,
    scaled,
    summary,
    within,
)
from reslrb_cli.measure.references import DEEPEST, Situation, camera_fault, ptracer_image
from reslrb_cli.optimization.loading import check_integrator, choose_sensors, load_configured, paths_of, what_moves
from reslrb_cli.records.atomic import write_atomically, writing
from reslrb_cli.records.images import luminance, write_bitmap, write_file, write_image
from reslrb_cli.records.metrics import finite
from reslrb_cli.records.run_folder import FABRICATION_FILE, exposures, workshop_file
from reslrb_cli.runs.workshop import OpticalBench, add_sheet, add_tolerances
from reslrb_cli.scene.export import export_scene
from reslrb_cli.scene.graph import interpolates_normals
from reslrb_cli.scene.images import read_photo
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.xml.read import Description

Array = np.ndarray[Any, Any]

#: Samples per pixel of pictures of the solid, and the direction and the upper side of each view.
PICTURE_SPP = 128
DIRECTIONS = {
    "solid": ((-0.5, -1.1, 1.5), [0, 0, 1]),
    "solid-front": ((0, 0, 1), [0, 1, 0]),
    "solid-side": ((-1, 0.02, 0.12), [0, 1, 0]),
}

#: Formats of solids, whose files must not be taken for the name of a folder.
_SOLIDS = (*WRITERS, ".ply", ".obj", ".step", ".stp", ".iges", ".igs", ".dxf", ".f3d", ".sldprt", ".glb", ".gltf",
           ".fbx", ".amf")  # fmt: skip

#: Called with a line about each thing written.
Say = Callable[[str], None]


def check_export(config: Config, output: Path, tolerances: bool) -> None:
    """Raise ConfigError if the export cannot be written to the folder `output`."""
    if tolerances and config.fabrication is None:
        raise ConfigError("--tolerances", "", "needs a configuration with a section `fabrication`")
    if output.suffix.lower() in _SOLIDS:
        reason = f"{output} is the name of a file; give a folder, into which the solid is written as .stl and .3mf"
        raise ConfigError("--output", "", reason)
    if os.path.lexists(output) and not (output.is_dir() and not output.is_symlink() and not any(output.iterdir())):
        raise ConfigError("--output", "", f"{output} exists; give a new or empty folder")


def write_export(config: Config, run: Path, output: Path, tolerances: bool, say: Say) -> None:
    """Export `config`, the experiment of `run` with its recovered values, to the folder `output`.

    A variant must be set. `say` is called with a line about each thing written. Raises ConfigError and
    UnsupportedScene.
    """
    plan = config.fabrication
    described: list[Description] = []
    scene = load_configured(config, described.append)
    selection, sensors = select_parameters(scene, config.parameters, config.source), choose_sensors(config, scene)
    beside: dict[str, Callable[[Path], object]] = {}
    if plan is not None:
        sheet, solid = read_solid(config, plan, selection.params)
    moves = what_moves(config, selection)
    check_integrator(config, config.integrator, scene, sensors, moves)
    paths = paths_of(config.integrator, scene, sensors, moves)
    integrator, why = choose_integrator(config, scene, selection.params, paths)
    numbers: dict[str, Any] = {}
    pictures: dict[str, Array] = {}
    if plan is not None:
        numbers = measured(solid, sheet, plan)
        target = read_target(config, scene.sensors()[sensors[0]], needed=tolerances)
        if target is not None:
            tracer, spp = mi.load_dict(dict(integrator)), config.run.final_spp
            image = luminance(np.array(mi.render(scene, integrator=tracer, sensor=sensors[0], spp=spp)))
            pictures = add_sheet(numbers, plan, scene, sensors[0], sheet, image, luminance(target))
            if tolerances:
                try:
                    bench = OpticalBench(scene, selection.params, plan, tracer, sensors[0])
                except ConfigError as error:
                    raise ConfigError(config.source, error.key, error.message) from None
                pictures |= add_tolerances(numbers, bench, image, luminance(target), spp, say)
        pictures |= pictures_of(solid)
        beside = solid_files(plan, sheet, solid, numbers, pictures)
    exposure = exposure_line(run)
    with writing("--output", output):
        export_scene(described[0], selection.params, selection.scene_keys, integrator, output, run, beside, exposure)
    say(f"{output / 'scene.xml'}: {', '.join(selection.keys)}; rendered by {integrator['type']}{why}")
    if exposure:
        say(exposure)
    faces = [spec.heightmap.mesh[0] for spec in config.parameters if spec.heightmap is not None]
    if plan is None and faces:
        how = "fabrication.thickness=25" if faces == ["face"] else f"'fabrication={{thickness: 25, face: {faces[0]}}}'"
        say(f"no solid was made of `{faces[0]}`: --set {how} makes one of that thickness if the scene is in mm")
    if plan is not None:
        tell_solid(output / f"{plan.kind}.stl", numbers, say)
        if light := numbers.get("light"):
            inside, aside, beyond = (100 * light[name] for name in ("inside", "beside", "beyond"))
            say(f"of the light that leaves it, {inside:.4g} % falls in the picture, {aside:.2g} % beside it on the "
                f"film, {beyond:.2g} % outside")  # fmt: skip
        if f"{plan.kind}.3mf" not in beside:
            say(f"{plan.kind}.3mf is not written: lib3mf is missing; pip install 'reslrb[fabrication]'")


def exposure_line(run: Path) -> str:
    """Return a line with the factor by which renderings match the run's photographs. The result is empty if it is 1."""
    found = {sensor: " ".join(f"{value:.4g}" for value in np.ravel(each)) for sensor, each in exposures(run).items()}
    if set(found.values()) <= {"1"}:
        return ""
    same = len(set(found.values())) == 1
    words = [each if same else f"{each} (sensor {sensor})" for sensor, each in found.items()]
    return f"multiply renderings by the exposure, {words[0] if same else ', '.join(words)}, to match the photographs"


# --- the solid in the run folder --------------------------------------------------------------------------------------


def keep_solid(
    config: Config, scene: mi.Scene, params: mi.SceneParameters, sensor: int, run: Path, image: Array, target: Array
) -> None:
    """Write the fabrication data (`fabrication.json`) and the pictures of a run's solid into the run folder.

    `params` are the current scene parameters. `image` and `target` (H, W, C) are the image and the target of sensor
    number `sensor`. Raises ConfigError if there is no solid between the faces.
    """
    assert config.fabrication is not None
    sheet, solid = read_solid(config, config.fabrication, params)
    numbers = measured(solid, sheet, config.fabrication)
    pictures = add_sheet(
        numbers, config.fabrication, scene, sensor, sheet, luminance(image), luminance(target)
    ) | pictures_of(solid)
    for name, image in pictures.items():
        write_image(run / "images" / workshop_file(name), image)
    content = json.dumps(finite(numbers), indent=2).encode() + b"\n"
    write_atomically(run / FABRICATION_FILE, lambda file: file.write(content))


def pictures_of(solid: Solid) -> dict[str, Array]:
    """Render views of the solid in grazing light, as if it were plaster. Returns images (H, W, 3). The keys are the
    images' names on the workshop sheet.
    """
    low, high = solid.points.min(axis=0), solid.points.max(axis=0)
    middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    found = {}
    with tempfile.TemporaryDirectory(prefix="reslrb-") as folder:
        file = Path(folder) / "solid.ply"
        file.write_bytes(ply_file(solid.points, solid.triangles))
        for name, (away, up) in DIRECTIONS.items():
            origin = middle + 4.2 * radius * np.array(away) / np.linalg.norm(away)
            scene = mi.load_dict({
                "type": "scene",
                "solid": {"type": "ply", "filename": str(file), "face_normals": True,
                          "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 0.7}}},
                "lamp": {"type": "directional", "direction": [0.92, -0.3, -0.2], "irradiance": 6},
                "sky": {"type": "constant", "radiance": 0.15},
                "camera": {"type": "perspective", "fov": 28, "fov_axis": "smaller",
                           "to_world": mi.ScalarTransform4f().look_at(origin.tolist(), middle.tolist(), up),
                           "film": {"type": "hdrfilm", "width": 480, "height": 360, "pixel_format": "rgba",
                                    "rfilter": {"type": "box"}}},
            })  # fmt: skip
            integrator = mi.load_dict({"type": "direct", "hide_emitters": True})
            image = np.array(mi.render(scene, integrator=integrator, spp=PICTURE_SPP))
            found[name] = np.asarray(image[:, :, :3] + (1 - image[:, :, 3:4]) * 0.9, dtype=np.float32)
    return found


def _writes_3mf() -> bool:
    return importlib.util.find_spec("lib3mf") is not None


def read_solid(config: Config, plan: Fabrication, params: mi.SceneParameters) -> tuple[Sheet, Solid]:
    """Return the face in the scene and the solid below it. Raises ConfigError."""
    keys = [f"{plan.face}.vertex_positions", f"{plan.face}.faces"]
    if any(key not in params.properties for key in keys):
        raise ConfigError(config.source, "fabrication.face", f"there is no mesh `{plan.face}` in the scene")
    points, triangles = (np.array(params[key]).reshape(-1, 3) for key in keys)
    try:
        sheet = as_sheet(plan.face, points, triangles, interpolates_normals(params.properties[keys[0]][2]))
        return sheet, make_solid(sheet, plan)
    except ConfigError as error:
        raise ConfigError(config.source, error.key, error.message) from None


def read_target(config: Config, sensor: mi.Sensor, needed: bool) -> Array | None:
    """Return the target image (H, W, C) of a sensor. Return None if `target.file` is not set, or does not have the size
    of the film.

    Raises ConfigError instead of returning None if the target is `needed` for tolerances.
    """
    file = config.target.file
    if file is None:
        reason = "the caustic is compared with target.file, which is missing"
    else:
        target = read_photo(file).image[:, :, :3]
        width, height = (int(n) for n in sensor.film().crop_size())
        if target.shape[:2] == (height, width):
            return target
        reason = f"target.file has {target.shape[1]}x{target.shape[0]} pixels, the film {width}x{height}"
    if needed:
        raise ConfigError("--tolerances", "", reason)
    return None


def solid_files(
    plan: Fabrication,
    sheet: Sheet,
    solid: Solid,
    numbers: dict[str, Any],
    pictures: dict[str, Array],
) -> dict[str, Callable[[Path], object]]:
    """Return a writer for each file of a solid. The keys are the file names in the exported folder. If lib3mf is
    missing, there is no 3MF file.

    `numbers` and `pictures` are the content of the sheet for the workshop.
    """
    from reslrb_cli.report.page.workshop import sheet as sheet_page

    files: dict[str, Callable[[Path], object]] = {}
    for suffix, made in WRITERS.items():
        if suffix != ".3mf" or _writes_3mf():
            files[plan.kind + suffix] = lambda path, made=made: path.write_bytes(made(solid))  # type: ignore[misc]
    heights = sheet.z[::-1]
    image, offset, step = scaled(heights, within(sheet, plan)[::-1])
    files["heights.exr"] = lambda path: write_file(path, heights.astype(np.float32)[:, :, None], linear=True)
    files["heights.png"] = lambda path: write_bitmap(path, mi.Bitmap(image[:, :, None]))
    numbers["faces"][sheet.name]["heights"] = {
        "files": ["heights.png", "heights.exr"],
        "png": {"offset": offset, "step": step},
        "rows": "from the greatest y to the least; columns from the least x",
        "pitch": [float(np.diff(line).mean()) for line in (sheet.x, sheet.y)],
    }
    files["fabrication.json"] = lambda path: path.write_text(json.dumps(finite(numbers), indent=2) + "\n")
    page = sheet_page(numbers, pictures, f"{plan.kind.capitalize()} for the workshop")
    files["sheet.html"] = lambda path: path.write_text(page, encoding="utf-8")
    return files


def tell_solid(path: Path, numbers: dict[str, Any], say: Say) -> None:
    """Report the fabrication data of the solid in the file `path`."""
    first, *others = summary(numbers)
    say(f"{path}: {first}")
    for line in others:
        say(line)


def choose_integrator(
    config: Config, scene: mi.Scene, params: mi.SceneParameters, paths: str
) -> tuple[dict[str, object], str]:
    """Choose the Mitsuba integrator that best reproduces the image of the run's `paths` (`loading.paths_of`).

    If the choice is not the usual one, or `path` is wrong in this scene, the function also returns the reason.
    `ptracer` traces light paths. Where `ptracer` is wrong, the function chooses `path`. The integrator `path` also sees
    glass and mirrors.
    """
    own = config.integrator.options()
    options: dict[str, object] = {name: own[name] for name in ("max_depth", "rr_depth", "hide_emitters") if name in own}
    sensor = scene.sensors()[choose_sensors(config, scene)[0]]
    # DEEPEST passes the depth check, which is about roulette: roulette does not change the mean image.
    at = Situation.of(scene, sensor, params, DEEPEST, config.integrator.hide_emitters)
    why = ""
    if paths == "light":
        reason = ptracer_image(at)
        if reason is None or config.integrator.type == "ptracer":
            return {"type": "ptracer", **options}, ""
        why = f", since {reason.replace('it ', 'ptracer ', 1)}"
    fault = camera_fault(at)
    return {"type": "path", **options}, why + (f", but {fault.replace('it ', 'path ', 1)}" if fault else "")
