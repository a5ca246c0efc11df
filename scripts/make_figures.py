#!/usr/bin/env python3
"""Make the pictures in `docs/images/`.

    scripts/make_figures.py run RUN_FOLDER OUT.png    from a finished run: target, start, recovered and true texture
    scripts/make_figures.py scenes OUT.png            render the scenes in `scenes/`
    scripts/make_figures.py lens PICTURE RUN OUT.png  a picture, the face that a run found for it, and what it throws

All need the environment that `scripts/setup` makes: run them with `.venv/bin/python`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from PIL import Image as Picture

import reslrb_cli  # noqa: F401  # chooses libLLVM, so it comes before Mitsuba

ROOT = Path(__file__).resolve().parent.parent
PANEL, MARGIN, TITLE = 1.9, 0.06, 0.24  # inches
DPI = 100
HEIGHT = 180  # pixels of a scene's picture
#: Samples per pixel, the longest path, and the exposure of each scene's picture.
SCENES = {
    "cornell_floor": (1024, 8, 1.0),
    "grey_room": (4096, 16, 1.0),
    "caustic_slab": (1024, 5, 1.0),
    "furnace": (64, 8, 0.2),
}

#: Of the experiments that move light, or show it in a mirror, samples per pixel and exposure of the target's picture.
EXPERIMENTS = {"lens_pose": (4096, 1.0), "caustic_heightmap": (4096, 0.6), "mixed_room": (4096, 1.5)}
Image = np.ndarray[Any, Any]


def main() -> None:
    """Parse the command line and write one picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="kind", required=True)
    run = kinds.add_parser("run", help="strip from a run folder")
    run.add_argument("folder", type=Path)
    run.add_argument("out", type=Path)
    scenes = kinds.add_parser("scenes", help="strip of the shipped scenes")
    scenes.add_argument("out", type=Path)
    lens = kinds.add_parser("lens", help="strip from the run of a lens")
    lens.add_argument("picture", type=Path)
    lens.add_argument("folder", type=Path)
    lens.add_argument("out", type=Path)
    arguments = parser.parse_args()
    if arguments.kind == "lens":
        panels = lens_panels(arguments.picture, arguments.folder)
    else:
        panels = run_panels(arguments.folder) if arguments.kind == "run" else scene_panels()
    write_strip(panels, arguments.out)


def run_panels(folder: Path) -> list[tuple[str, Image]]:
    """Target, initial image, and the first texture of the run: recovered, and true where it is known."""
    summary = json.loads((folder / "parameters" / "parameters.json").read_text())
    texture = next((entry["file"] for entry in summary.values() if "file" in entry), None)
    if texture is None:
        raise SystemExit(f"{folder}: the run recovered no texture")
    files = {
        "target": folder / "images" / "target.png",
        "start": folder / "images" / "initial.png",
        "recovered texture": folder / "parameters" / texture,
        "true texture": folder / "parameters" / "true" / texture,
    }
    return [(title, imread(file.with_suffix(".png"))) for title, file in files.items() if file.exists()]


def lens_panels(picture: Path, folder: Path) -> list[tuple[str, Image]]:
    """The picture, the face lit from its upper left (without its mean curvature), and the light it throws."""
    from reslrb_cli.backend.variant import set_variant

    set_variant("auto")
    from reslrb_cli.cli.lens import read_luminance
    from reslrb_cli.scene.images import read_image

    target, final = (read_image(folder / "images" / f"{name}.exr") for name in ("target", "final"))
    rows, columns = (np.flatnonzero(target[:, :, 1].any(axis=axis)) for axis in (1, 0))
    thrown = final[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    heights = read_image(folder / "parameters" / "face.heightmap.exr", "linear", signed=True)[::-1, ::-1, 0]
    y, x = np.mgrid[-1 : 1 : 1j * heights.shape[0], -1 : 1 : 1j * heights.shape[1]]
    dome = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    relief = heights.ravel() - dome @ np.linalg.lstsq(dome, heights.ravel(), rcond=None)[0]
    slope_y, slope_x = np.gradient(relief.reshape(heights.shape))
    lit = slope_x + slope_y
    lit = 0.5 + lit / (6 * lit.std())
    shown = read_luminance(picture)[:, :, None]
    panels = [("picture", encode(np.repeat(shown, 3, 2)))]
    panels += [("face, lit from above", np.repeat(np.clip(lit, 0, 1)[:, :, None], 3, 2))]
    return [*panels, ("the light that it throws", encode(thrown * shown.mean()))]


def scene_panels() -> list[tuple[str, Image]]:
    """The scenes in `scenes/`, light-traced by `reslrb`; of `EXPERIMENTS` the target."""
    from reslrb_cli.backend.variant import set_variant
    from reslrb_cli.config.loader import load
    from reslrb_cli.integrators.step import make_integrator
    from reslrb_cli.optimization.assemble import assemble
    from reslrb_cli.optimization.loading import render_in_passes
    from reslrb_cli.scene.load import load_scene

    set_variant("auto")
    panels = []
    for name, (spp, max_depth, exposure) in SCENES.items():
        width = HEIGHT * 4 // 3 if name == "grey_room" else HEIGHT
        scene = load_scene(ROOT / "scenes" / name / "scene.xml", {"resx": width, "resy": HEIGHT})
        integrator = make_integrator("reslrb", max_depth=max_depth)
        image = render_in_passes(integrator, scene, 0, spp, 0, 0, "figure", None)
        panels.append((name, encode(image * exposure)))
    for name, (spp, exposure) in EXPERIMENTS.items():
        size = [f"scene.options.{side}={HEIGHT}" for side in ("resx", "resy")]
        problem = assemble(load(ROOT / "configs" / f"{name}.yaml", [*size, f"target.render.spp={spp}"]))
        panels.append((name, encode(np.array(problem.views[0].target) * exposure)))
    return panels


def encode(image: Image) -> Image:
    """Return linear values (H, W, C) as sRGB in [0, 1], without alpha."""
    from reslrb_cli.report import tonemap

    return tonemap.encode(np.clip(image[:, :, :3], 0, 1))


def write_strip(panels: Sequence[tuple[str, Image]], out: Path) -> None:
    """Write panels of equal height beside each other, a title above each."""
    widths = [PANEL * image.shape[1] / image.shape[0] for _, image in panels]
    size = sum(widths) + MARGIN * (len(panels) - 1), PANEL + TITLE
    figure = Figure(figsize=size, dpi=DPI, facecolor="white")
    left = 0.0
    for (title, image), width in zip(panels, widths, strict=True):
        axes = figure.add_axes((left / size[0], 0, width / size[0], PANEL / size[1]))
        fine = image.shape[0] >= PANEL * DPI  # shrink with a filter, enlarge texel by texel
        axes.imshow(image, interpolation="antialiased" if fine else "nearest", aspect="auto")
        axes.set_axis_off()
        axes.set_title(title, fontsize=8, pad=3)
        left += width + MARGIN
    out.parent.mkdir(parents=True, exist_ok=True)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    # 256 colours: noise compresses badly, and the repository is to stay small.
    Picture.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy()).quantize(256).save(out, optimize=True)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
