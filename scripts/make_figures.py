#!/usr/bin/env python3
"""Make the pictures in `docs/images/`.

    scripts/make_figures.py run RUN_FOLDER OUT.png    from a finished run: target, start, recovered and true texture
    scripts/make_figures.py scenes OUT.png            render the scenes in `scenes/`
    scripts/make_figures.py lens PICTURE RUN OUT.png  a picture, the glass face that a run found, and the face's light

All commands need the environment that `scripts/setup` makes. Run them with `.venv/bin/python`.
"""

from __future__ import annotations

import json
import sys
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
#: The experiments whose target is shown: samples per pixel, and exposure.
SCENES = {
    "cornell_floor": (1024, 1.0),
    "grey_room": (4096, 1.0),
    "caustic_slab": (1024, 1.0),
    "furnace": (64, 0.2),
    "lens_pose": (4096, 1.0),
    "caustic_heightmap": (4096, 0.6),
    "mixed_room": (0, 1.5),  # its target is a file, and is shown as it is
}
Image = np.ndarray[Any, Any]
Panel = tuple[str, Image]


def run_panels(folder: Path) -> list[Panel]:
    """Return the target, the initial image, and the first texture of the run. The texture is shown as recovered and, if
    known, as it truly is.
    """
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


def image_panels(folder: Path) -> list[Panel]:
    """Return the target, the initial image and the final image of a run."""
    names = {"target": "target", "start": "initial", "end": "final"}
    return [(title, imread(folder / "images" / f"{name}.png")) for title, name in names.items()]


def lens_panels(picture: Path, folder: Path) -> list[Panel]:
    """Return the picture, the glass face lit from its upper left, and the light that passes through the face. The face
    is shown without its mean curvature.
    """
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


def scene_panels() -> list[Panel]:
    """Return the targets of the experiments in `SCENES`."""
    from reslrb_cli.backend.variant import set_variant
    from reslrb_cli.config.loader import load
    from reslrb_cli.optimization.assemble import assemble

    set_variant("auto")
    panels = []
    for name, (spp, exposure) in SCENES.items():
        width = HEIGHT * 4 // 3 if name == "grey_room" else HEIGHT
        sets = [f"scene.options.resx={width}", f"scene.options.resy={HEIGHT}", f"target.render.spp={spp}"]
        problem = assemble(load(ROOT / "configs" / f"{name}.yaml", sets if spp else []))
        panels.append((name, encode(np.array(problem.views[0].target) * exposure)))
    return panels


def encode(image: Image) -> Image:
    """Return linear values (H, W, C) as sRGB in [0, 1]. Alpha is dropped."""
    from reslrb_cli.report import tonemap

    return tonemap.encode(np.clip(image[:, :, :3], 0, 1))


def write_panels(rows: Sequence[Sequence[Panel]], out: Path) -> None:
    """Write rows of panels with a title above each panel. All rows have the same width. The first row has the height
    `PANEL`.
    """
    aspects = [[image.shape[1] / image.shape[0] for _, image in panels] for panels in rows]
    gaps = [MARGIN * (len(panels) - 1) for panels in rows]
    whole = PANEL * sum(aspects[0]) + gaps[0]
    heights = [(whole - gap) / sum(of) for gap, of in zip(gaps, aspects, strict=True)]
    size = whole, sum(heights) + TITLE * len(rows)
    figure, bottom = Figure(figsize=size, dpi=DPI, facecolor="white"), size[1]
    for panels, of, height in zip(rows, aspects, heights, strict=True):
        bottom, left = bottom - TITLE - height, 0.0
        for (title, image), aspect in zip(panels, of, strict=True):
            axes = figure.add_axes((left / whole, bottom / size[1], aspect * height / whole, height / size[1]))
            fine = image.shape[0] >= height * DPI  # shrink with a filter, enlarge texel by texel
            axes.imshow(image, interpolation="antialiased" if fine else "nearest", aspect="auto")
            axes.set_axis_off()
            axes.set_title(title, fontsize=8, pad=3, parse_math=False)
            left += aspect * height + MARGIN
    out.parent.mkdir(parents=True, exist_ok=True)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Picture.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
    # Noise compresses badly, and the repository must stay small: 256 colours, or JPEG.
    (picture if out.suffix == ".jpg" else picture.quantize(256)).save(out, optimize=True)
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    kinds = {"run": run_panels, "scenes": scene_panels, "lens": lens_panels}
    if len(sys.argv) < 3 or sys.argv[1] not in kinds:
        sys.exit(__doc__)
    kind, *paths, out = sys.argv[1:]
    write_panels([kinds[kind](*map(Path, paths))], Path(out))
