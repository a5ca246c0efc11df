"""`reslrb export`: a run's scene with the values that it recovered, for Mitsuba alone, and the solid that it shapes."""

from __future__ import annotations

import importlib.util
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from reslrb_cli.cli.options import FOLDER, overrides_option, read_recovered, start_variant, writing
from reslrb_cli.cli.terminal import echo
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import write_atomically

if TYPE_CHECKING:
    import mitsuba as mi

    from reslrb_cli.config.schema import Config, Fabrication
    from reslrb_cli.lens.solid import Sheet, Solid
    from reslrb_cli.scene.xml.read import Description


@click.command("export")
@click.argument("run", metavar="RUN", type=FOLDER)
@overrides_option
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path),
    help="Folder to make, which must not exist yet; or a file, .stl, .3mf, .obj or .ply, of the solid alone.",
)  # fmt: skip
@click.option("--tolerances", is_flag=True, help="Of a lens or a mirror also render what it throws where light, "
              "distance, index and tool are not as planned; takes about 15 images of run.final_spp.")  # fmt: skip
def command(run: Path, overrides: tuple[str, ...], output: Path, tolerances: bool) -> None:
    """Write the scene of the run in the folder RUN with the values that it recovered.

    FOLDER/scene.xml and what lies beside it are all that Mitsuba needs: `mi.load_file("FOLDER/scene.xml")`. Variables
    and includes are put in, what was mended is written as Mitsuba 3 has it, textures and meshes are copied, those that
    were recovered are in FOLDER/recovered.

    Where the configuration has a section `fabrication`, as that of `reslrb lens`, the folder also holds the closed
    solid in millimetres (lens.stl, .3mf, .obj, .ply), its heights (heights.png, .exr) and fabrication.json.
    """
    from reslrb_cli.lens.solid import WRITERS

    config = read_recovered(run, overrides)
    if tolerances and (config.fabrication is None or output.suffix.lower() in WRITERS):
        raise ConfigError("--tolerances", "", "goes with a folder, and a run whose configuration has a section "
                          "`fabrication`")  # fmt: skip
    plan, writer = config.fabrication, WRITERS.get(output.suffix.lower())
    if writer is None:
        check_folder(output)
    else:
        check_file(output, config)
    start_variant(config)

    from reslrb_cli.optimization.loading import check_integrator, choose_sensors, load_configured, paths_of
    from reslrb_cli.optimization.moving import moves_anything
    from reslrb_cli.scene.export import export_scene
    from reslrb_cli.scene.parameters import select_parameters

    described: list[Description] = []
    scene = load_configured(config, described.append)
    selection, sensors = select_parameters(scene, config.parameters, config.source), choose_sensors(config, scene)
    beside: dict[str, Callable[[Path], object]] = {}
    if plan is not None:
        sheets, solid = read_solid(config, plan, selection.params)
        if writer is not None:
            with writing("--output", output):
                output.parent.mkdir(parents=True, exist_ok=True)
                content = writer(solid)
                write_atomically(output, lambda file: file.write(content))
            tell_solid(output, plan, sheets, solid)
            return
    moves = moves_anything(config, selection)
    check_integrator(config, config.integrator, scene, sensors, moves)
    paths = paths_of(config.integrator, scene, sensors, moves)
    integrator, why = choose_integrator(config, scene, selection.params, paths)
    if plan is not None:
        off = measure_tolerances(config, scene, selection.params, sheets, integrator) if tolerances else {}
        beside = solid_files(plan, sheets, solid, off)
    with writing("--output", output):
        export_scene(described[0], selection.params, selection.scene_keys, integrator, output, run, beside)
    echo(f"{output / 'scene.xml'}: {', '.join(selection.keys)}; rendered by {integrator['type']}{why}")
    if plan is not None:
        tell_solid(output / f"{plan.kind}.stl", plan, sheets, solid)
        if f"{plan.kind}.3mf" not in beside:
            echo(f"{plan.kind}.3mf is left out, since lib3mf is missing: pip install 'reslrb[fabrication]'")


def check_folder(path: Path) -> None:
    """Raise ConfigError where there is something at `path` already that is no empty folder."""
    if os.path.lexists(path) and not (path.is_dir() and not path.is_symlink() and not any(path.iterdir())):
        raise ConfigError("--output", "", f"{path} exists; name a folder that does not exist yet, or is empty")


def check_file(path: Path, config: Config) -> None:
    """Raise ConfigError where no solid can be written to the file `path`."""
    if config.fabrication is None:
        raise ConfigError("--output", "", f"{path}: name a folder; of a scene a solid is made where the configuration "
                          "has a section `fabrication`, which `reslrb lens` writes")  # fmt: skip
    if os.path.lexists(path):
        raise ConfigError("--output", "", f"{path} exists; name a file that does not exist yet")
    if path.suffix.lower() == ".3mf" and not _writes_3mf():
        raise ConfigError("--output", "", f"{path}: 3MF needs lib3mf, which is missing: "
                          "pip install 'reslrb[fabrication]'; .stl, .obj and .ply need nothing")  # fmt: skip


def _writes_3mf() -> bool:
    return importlib.util.find_spec("lib3mf") is not None


def read_solid(config: Config, plan: Fabrication, params: mi.SceneParameters) -> tuple[list[Sheet], Solid]:
    """The faces in a scene with these `params`, and the solid between them. Raises ConfigError."""
    import numpy as np

    from reslrb_cli.lens.solid import as_sheet, make_solid
    from reslrb_cli.scene.graph import interpolates_normals

    sheets = []
    try:
        for i, name in enumerate(plan.faces):
            keys = [f"{name}.vertex_positions", f"{name}.faces"]
            if any(key not in params.properties for key in keys):
                raise ConfigError("", f"fabrication.faces[{i}]", f"there is no mesh `{name}` in the scene")
            points, triangles = (np.array(params[key]).reshape(-1, 3) for key in keys)
            smooth = interpolates_normals(params.properties[keys[0]][2])
            sheets.append(as_sheet(name, points, triangles, smooth))
        return sheets, make_solid(sheets, plan)
    except ConfigError as error:
        raise ConfigError(config.source, error.key, error.message) from None


def measure_tolerances(
    config: Config, scene: mi.Scene, params: mi.SceneParameters, sheets: Sequence[Sheet], integrator: dict[str, object]
) -> dict[str, dict[str, Any]]:
    """What the scene throws where something is not as planned, line by line (`measure/tolerance.py`). Raises
    ConfigError."""
    import mitsuba as mi
    import numpy as np

    from reslrb_cli.measure.tolerance import Bench
    from reslrb_cli.measure.tolerance import tolerances as measure
    from reslrb_cli.optimization.loading import choose_sensors
    from reslrb_cli.scene.images import read_photo

    assert config.fabrication is not None
    sensor = choose_sensors(config, scene)[0]
    files = config.target.file
    if files is None or len(files) != 1:
        raise ConfigError("--tolerances", "", "what is thrown is compared with target.file, which has to be one image")
    target = read_photo(files[0]).image.astype(np.float64) @ np.array([0.2126, 0.7152, 0.0722])
    width, height = (int(n) for n in scene.sensors()[sensor].film().crop_size())
    if target.shape != (height, width):
        raise ConfigError("--tolerances", "", f"target.file has {target.shape[1]}x{target.shape[0]} pixels, the film "
                          f"{width}x{height}")  # fmt: skip
    try:
        bench = Bench(scene, params, config.fabrication, mi.load_dict(dict(integrator)), sensor)
    except ConfigError as error:
        raise ConfigError(config.source, error.key, error.message) from None
    return measure(bench, sheets, target, config.run.final_spp, echo)


def solid_files(
    plan: Fabrication, sheets: Sequence[Sheet], solid: Solid, off: dict[str, dict[str, Any]]
) -> dict[str, Callable[[Path], object]]:
    """Who writes what an exported folder holds of a solid, by the file's name; without 3MF where lib3mf is missing.

    `off`: what was measured of tolerances.
    """
    import mitsuba as mi
    import numpy as np

    from reslrb_cli.lens.solid import WRITERS, measured, outwards, scaled, within
    from reslrb_cli.records.images import write_bitmap, write_file

    files: dict[str, Callable[[Path], object]] = {}
    for suffix, made in WRITERS.items():
        if suffix != ".3mf" or _writes_3mf():
            files[plan.kind + suffix] = lambda path, made=made: path.write_bytes(made(solid))  # type: ignore[misc]
    numbers = measured(solid, sheets, plan)
    for i, sheet in enumerate(sheets):
        stem = "heights" if i == 0 else "heights-back"
        heights = outwards(sheet, plan, 1 - 2 * i)
        image, offset, step = scaled(heights, within(sheet, plan)[::-1])
        files[f"{stem}.exr"] = lambda path, heights=heights: write_file(  # type: ignore[misc]
            path, heights.astype(np.float32)[:, :, None], linear=True
        )
        files[f"{stem}.png"] = lambda path, image=image: write_bitmap(  # type: ignore[misc]
            path, mi.Bitmap(image[:, :, None])
        )
        numbers["faces"][sheet.name]["heights"] = {
            "files": [f"{stem}.png", f"{stem}.exr"],
            "png": {"offset": offset, "step": step},
            "rows": "from the greatest y to the least; columns from the least x",
            "pitch": [float(np.diff(line).mean()) for line in (sheet.x, sheet.y)],
        }
    if off:
        numbers["tolerances"] = off
    files["fabrication.json"] = lambda path: path.write_text(json.dumps(numbers, indent=2) + "\n")
    return files


def tell_solid(path: Path, plan: Fabrication, sheets: Sequence[Sheet], solid: Solid) -> None:
    """Say what a maker wants to know of the solid in the file `path`."""
    from reslrb_cli.lens.solid import measured, summary

    first, *others = summary(measured(solid, sheets, plan))
    echo(f"{path}: {first}")
    for line in others:
        echo(line)


def choose_integrator(
    config: Config, scene: mi.Scene, params: mi.SceneParameters, paths: str
) -> tuple[dict[str, object], str]:
    """Mitsuba's integrator whose image is that of the run's `paths` (`loading.paths_of`), as far as there is one; and
    why it is not the usual one.

    Light paths are traced by `ptracer`, and where that is wrong by `path`, which also sees glass and mirrors.
    """
    from reslrb_cli.measure.references import DEEPEST, Situation, ptracer_image
    from reslrb_cli.optimization.loading import choose_sensors

    own = config.integrator.options()
    options: dict[str, object] = {name: own[name] for name in ("max_depth", "rr_depth", "hide_emitters") if name in own}
    if paths != "light":
        return {"type": "path", **options}, ""
    sensor = scene.sensors()[choose_sensors(config, scene)[0]]
    # Roulette, which that asks about, changes no image.
    why = ptracer_image(Situation.of(scene, sensor, params, DEEPEST, config.integrator.hide_emitters))
    if why is None or config.integrator.type == "ptracer":
        return {"type": "ptracer", **options}, ""
    return {"type": "path", **options}, f", since {why.replace('it ', 'ptracer ', 1)}"
