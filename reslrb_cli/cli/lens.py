"""`reslrb lens`: write an experiment that shapes a lens or a mirror whose caustic shows a picture."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from reslrb_cli.cli.terminal import echo, has_room
from reslrb_cli.errors import ConfigError
from reslrb_cli.glasses import find_glass
from reslrb_cli.records.atomic import write_atomically, writing

if TYPE_CHECKING:
    import numpy as np

#: Texels and pixels along the longer side.
PIXELS = 256
ITERATIONS = 100
#: Vertices of the face per cell of the initial face, along each side, and the maximum along one side.
FINER, MOST_VERTICES = 3, 1024
#: Stages until a face is found, about: trials of the floor, grids, the solid.
STAGES = 9
#: Options whose names differ from those of the face's settings.
_OPTIONS = {"picture_size": "--picture-size", "light_distance": "--light-distance", "incidence": "--mirror"}


def read_luminance(path: Path) -> np.ndarray:
    """Return the linear luminance (H, W) of an image file, upright. Print its conversions. Raises ConfigError.

    Transparent parts are white, as in image viewers. If the whole image would then be white, transparent parts are
    black.
    """
    from reslrb_cli.lens.surface import is_even
    from reslrb_cli.records.images import luminance
    from reslrb_cli.scene.images import photo_lines, read_photo

    photo = read_photo(path)
    image, alpha = luminance(photo.image), photo.alpha
    for line in photo_lines(path):
        echo(line)
    if alpha is not None:
        image = alpha * image if photo.is_integer else image
        image = image if is_even(image + 1 - alpha) else image + 1 - alpha
    return image


class Index(click.ParamType):
    """An index of refraction, or the name of a material of the catalogue."""

    name = "index"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        try:
            return float(value)
        except ValueError:
            pass
        try:
            find_glass(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)
        return str(value)


@dataclass(frozen=True)
class LensOptions:
    """The options of the command, by the names of its parameters."""

    picture: Path
    output: Path
    size: float
    distance: float
    picture_size: float | None
    ior: float | str
    thickness: float | None
    mirror: float | None
    outline: Literal["rectangle", "round"]
    tilt: tuple[float, float]
    light_distance: float | None
    sun: float
    floor: float | None
    pixels: int

    def check(self) -> None:
        """Raise ConfigError if an option contradicts another, or names files that exist."""
        if self.sun and self.light_distance is not None:
            raise ConfigError("--sun", "", "needs parallel light, --light-distance a point light; remove one")
        if self.output.exists() and not self.output.is_dir():
            raise ConfigError("--output", "", f"{self.output} is a file; name a folder")
        names = ("lens.yaml", "scene.xml", "face.ply", "target.exr", "picture.exr", "start.exr", "preview.png")
        taken = next((path for name in names if (path := self.output / name).exists()), None)
        if taken is not None:
            raise ConfigError("--output", "", f"{taken} exists; give another folder, or remove it")


#: Seconds from the start, and from line to line, without a terminal.
SECONDS_PER_LINE = 5.0


@contextmanager
def show_stages(count: int) -> Iterator[Callable[[str], None]]:
    """Show on standard error which of about `count` stages runs: by a bar on a terminal that has a width,
    otherwise by lines. Yields a
    function that takes the name of the stage that begins.
    """
    stream, begun, last = sys.stderr, 0, time.monotonic()
    bar: Any = None
    if stream is not None and has_room(stream):
        from tqdm import tqdm

        form = "{percentage:3.0f}%|{bar}| {desc}, {elapsed}"
        bar = tqdm(total=count, file=stream, leave=False, dynamic_ncols=True, bar_format=form)

    def tell(stage: str) -> None:
        nonlocal begun, last
        begun += 1
        if bar is not None:
            bar.set_description_str(stage, refresh=False)
            bar.update(min(1, begun - 1, count - bar.n))
            bar.refresh()
        elif stream is not None and time.monotonic() - last > SECONDS_PER_LINE:
            last = time.monotonic()
            click.echo(f"{stage} ...", file=stream)

    try:
        yield tell
    finally:
        if bar is not None:
            bar.close()


@click.command("lens")
@click.argument("picture", metavar="PICTURE", type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", type=click.Path(path_type=Path), default=Path("lens"), show_default=True, help="Folder to write."
)
@click.option("--size", type=float, default=100.0, show_default=True, help="Longer side of the face, in mm.")
@click.option(
    "--distance", type=float, default=200.0, show_default=True, help="Distance from the face to the receiver, in mm."
)
@click.option("--picture-size", type=float, help="Longer side of the picture on the receiver, in mm. Default: --size.")
@click.option("--ior", type=Index(), default=1.49, show_default=True,
              help="Index of refraction, or the name of a material, such as PMMA.")  # fmt: skip
@click.option(
    "--thickness", type=float, help="Thickness of the lens at its flat face, in mm. Default: a quarter of --size."
)
@click.option("--mirror", type=float, metavar="DEGREES",
              help="Make a mirror instead of a lens, with this angle between the light and the mirror's normal, "
                   "e.g. 30.")  # fmt: skip
@click.option("--outline", type=click.Choice(["rectangle", "round"]), default="rectangle", show_default=True,
              help="Outline of the face; round is the ellipse inside the rectangle.")  # fmt: skip
@click.option("--tilt", type=float, nargs=2, default=(0.0, 0.0), metavar="NOD TURN",
              help="Rotation of the receiver about its horizontal and its vertical axis, in degrees.")  # fmt: skip
@click.option(
    "--light-distance", type=float, help="Distance of a point light from the face, in mm. Default: parallel light."
)
@click.option(
    "--sun",
    type=click.FloatRange(0, 10, max_open=True),
    default=0.0,
    metavar="DEGREES",
    help="Angular diameter of parallel light; that of the sun is 0.53.",
)
@click.option(
    "--floor",
    type=click.FloatRange(0, 1, max_open=True),
    help="Minimum brightness, as a fraction of the maximum, to which darker parts are raised. Default: chosen.",
)
@click.option("--pixels", type=click.IntRange(16, 1024), default=PIXELS, show_default=True,
              help="Pixels of the picture's longer side. The face has three vertices per pixel along each side, but at "
                   "most 1024 along its longer side.")  # fmt: skip
def command(**given: Any) -> None:
    """Write an experiment that shapes a lens, or a mirror, whose caustic shows PICTURE in parallel light.

    Run it with `reslrb optimize FOLDER/lens.yaml`. The initial face of the lens or mirror already casts the picture:
    `preview.png` shows the caustic that it is computed to cast. The command prints the depth of the relief, the size of
    the solid and the cutter that fits into it. At twice the distance, the relief is about half as deep.
    """
    import numpy as np

    from reslrb_cli.backend.variant import set_variant
    from reslrb_cli.lens import experiment
    from reslrb_cli.lens.surface import Setting, contrast_line, is_even, shape_surface, similarity
    from reslrb_cli.lens.transport import lifted, resized

    options = LensOptions(**given)
    options.check()
    picture, output, pixels, size, sun = options.picture, options.output, options.pixels, options.size, options.sun
    set_variant("auto")

    from reslrb_cli.records.images import write_file

    image = whole = read_luminance(picture)
    longer = max(image.shape)
    if longer > pixels:
        image = resized(image, (max(1, round(image.shape[0] * pixels / longer)),
                                max(1, round(image.shape[1] * pixels / longer))))  # fmt: skip
    if is_even(image) and not is_even(whole):
        raise ConfigError("--pixels", "", f"is {pixels}, too few for the fine pattern of {picture}, which has "
                          f"{longer} pixels")  # fmt: skip
    rows, columns = image.shape
    at, is_mirror = options.light_distance, options.mirror is not None
    if options.outline == "round" and at is not None and (is_mirror or rows != columns):
        raise ConfigError("--outline", "", "round needs parallel light, or a point light, a lens and a square picture: "
                          "the cone of a point light fits no other face")  # fmt: skip
    share = np.array([columns, rows]) / max(rows, columns)
    setting = Setting(
        kind="mirror" if is_mirror else "lens",
        size=tuple(size * share),
        distance=options.distance,
        picture_size=tuple((size if options.picture_size is None else options.picture_size) * share),
        ior=find_glass(options.ior).nd if isinstance(options.ior, str) else options.ior,
        thickness=size / 4 if options.thickness is None else options.thickness,
        outline=options.outline,
        light_distance=np.inf if at is None else at,
        tilt=options.tilt,
        incidence=options.mirror or 0.0,
    )
    finer = min(FINER, max(1, MOST_VERTICES // pixels))
    try:
        with show_stages(STAGES) as tell:
            surface = shape_surface(image, setting, pixels, "auto" if options.floor is None else options.floor, tell)
            tell("solid")
            ny, nx = (finer * cells for cells in surface.heights.shape)
            heights = experiment.at_vertices(surface, nx, ny).astype(np.float32)
            solid = experiment.solid_lines(setting, heights)
    except ConfigError as error:
        key = error.key.removeprefix("fabrication.")
        source = picture if key == "picture" else _OPTIONS.get(key, f"--{key}")
        raise ConfigError(source, "", error.message) from None
    echo(surface.summary())
    if line := contrast_line(image, surface.floor):
        echo(line)
    target, power = experiment.target_image(image, surface)
    film = target.shape[1], target.shape[0]
    preview, original = surface.forecast, resized(image, surface.forecast.shape)
    # Brighter spots than the brightest part of the picture are white.
    shown = preview * (original.mean() / original.max())
    with writing("--output", output):
        output.mkdir(parents=True, exist_ok=True)
        write_file(output / "preview.png", shown.astype(np.float32)[:, :, None], linear=False)
        write_file(output / "start.exr", heights[:, :, None], linear=True)
        for name, seen in (("target.exr", target), ("picture.exr", experiment.on_film(image))):
            write_file(output / name, np.repeat(seen.astype(np.float32)[:, :, None], 3, 2), linear=True)
        texts = {
            "face.ply": experiment.face_ply(setting, nx, ny),
            "scene.xml": experiment.scene_xml(surface, film, columns, power, sun).encode(),
            "lens.yaml": experiment.lens_yaml(surface, heights, picture.name, ITERATIONS, sun, options.ior).encode(),
        }
        for name, content in texts.items():
            write_atomically(output / name, lambda file, content=content: file.write(content))  # type: ignore[misc]
    for line in solid:
        echo(line)
    wanted = resized(lifted(image, surface.floor), preview.shape)
    alike = f"; SSIM with the target {similarity(preview, wanted):.2f}" if min(preview.shape) >= 7 else ""
    echo(f"{output / 'preview.png'}: the caustic at the start{alike}")
    echo(f"{output / 'lens.yaml'}: {nx}x{ny} heights, a picture of {columns}x{rows} pixels")
    echo(f"next: `reslrb optimize {output / 'lens.yaml'}`")
