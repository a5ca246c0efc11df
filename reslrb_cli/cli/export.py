"""`reslrb export`: write a run's scene with recovered values for plain Mitsuba, and the solid of a lens or mirror."""

from __future__ import annotations

from pathlib import Path

import click

from reslrb_cli.cli.options import FOLDER, overrides_option, start_variant
from reslrb_cli.cli.terminal import echo


@click.command("export")
@click.argument("run", metavar="RUN", type=FOLDER)
@overrides_option
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path),
    help="Folder to create, which must not exist yet.",
)  # fmt: skip
@click.option("--tolerances", is_flag=True, help=
        "For a lens or a mirror, also render its image with errors of light, distance and index; takes "
        "about 15 images of run.final_spp.")  # fmt: skip
def command(run: Path, overrides: tuple[str, ...], output: Path, tolerances: bool) -> None:
    """Write the scene of a run with the recovered values. RUN is the run folder.

    Mitsuba needs only FOLDER/scene.xml and the files beside it: `mi.load_file("FOLDER/scene.xml")`. Variables and
    includes are resolved, and outdated elements are written for Mitsuba 3. Textures and meshes are copied. Recovered
    textures and meshes are in FOLDER/recovered.

    If the configuration has a section `fabrication`, for example from `reslrb lens`, FOLDER also contains the closed
    solid in millimetres (lens.stl and lens.3mf). FOLDER then also contains the solid's heights (heights.png, .exr)
    and fabrication.json.
    """
    from reslrb_cli.records.run_folder import recovered
    from reslrb_cli.runs.export import check_export, write_export

    config = recovered(run, overrides)
    check_export(config, output, tolerances)
    start_variant(config)
    write_export(config, run, output, tolerances, echo)
