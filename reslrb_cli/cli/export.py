"""`reslrb export`: a run's scene with the values that it recovered, for Mitsuba alone."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from reslrb_cli.cli.options import overrides_option, read_recovered, start_variant, writing
from reslrb_cli.cli.terminal import echo
from reslrb_cli.errors import ConfigError

if TYPE_CHECKING:
    import mitsuba as mi

    from reslrb_cli.config.schema import Config
    from reslrb_cli.scene.xml.read import Description


@click.command("export")
@click.argument("run", metavar="RUN", type=click.Path(path_type=Path))
@overrides_option
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), help="Folder to make; it must not exist yet."
)
def command(run: Path, overrides: tuple[str, ...], output: Path) -> None:
    """Write the scene of the run in the folder RUN with the values that it recovered.

    FOLDER/scene.xml and what lies beside it are all that Mitsuba needs: `mi.load_file("FOLDER/scene.xml")`. Variables
    and includes are put in, what was mended is written as Mitsuba 3 has it, textures and meshes are copied, those that
    were recovered are in FOLDER/recovered.
    """
    config = read_recovered(run, overrides)
    check_folder(output)
    start_variant(config)

    from reslrb_cli.optimization.loading import check_integrator, choose_sensors, load_configured, paths_of
    from reslrb_cli.optimization.moving import moves_anything
    from reslrb_cli.scene.export import export_scene
    from reslrb_cli.scene.parameters import select_parameters

    described: list[Description] = []
    scene = load_configured(config, described.append)
    selection, sensors = select_parameters(scene, config.parameters, config.source), choose_sensors(config, scene)
    moves = moves_anything(config, selection)
    check_integrator(config, config.integrator, scene, sensors, moves)
    paths = paths_of(config.integrator, scene, sensors, moves)
    integrator, why = choose_integrator(config, scene, selection.params, paths)
    with writing("--output", output):
        export_scene(described[0], selection.params, selection.scene_keys, integrator, output, run)
    echo(f"{output / 'scene.xml'}: {', '.join(selection.keys)}; rendered by {integrator['type']}{why}")


def check_folder(path: Path) -> None:
    """Raise ConfigError where there is something at `path` already that is no empty folder."""
    if os.path.lexists(path) and not (path.is_dir() and not path.is_symlink() and not any(path.iterdir())):
        raise ConfigError("--output", "", f"{path} exists; name a folder that does not exist yet, or is empty")


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
