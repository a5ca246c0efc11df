"""The errors of a run as people see them, from the images and parameters in its folder."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from reslrb_cli.records.images import load_image
from reslrb_cli.records.parameters import read_mask, read_parameters
from reslrb_cli.report.seen import flip
from reslrb_cli.report.seen.colors import color_errors, is_color
from reslrb_cli.report.seen.images import image_errors
from reslrb_cli.report.tone import exposure_for, shown_exposures

_TARGET = re.compile(r"target(-\d+)?\.exr")
MOMENTS = ("initial", "final")


def seen_errors(
    folder: Path, results: Mapping[str, Any], views: Sequence[Mapping[str, Any]] | None = None
) -> dict[str, Any]:
    """What the manifest of the run in `folder` says of errors as people see them; empty where nothing can be compared.

    `images` has, by sensor (`""`, `"-0"`, ...), the `exposure` that the target is shown with, and `image_errors` of the
    `initial` and the `final` image. HDR-FLIP is of the final one, which takes seconds for a large image; where its
    package is missing, `note` says so. `colors` has, by key, `color_errors` of the colours whose true value is known;
    `results` is what the manifest says of them, and `views` of the views. What is missing in the folder or damaged is
    left out.
    """
    images, exposures = {}, shown_exposures(views)
    for path in sorted((folder / "images").glob("target*.exr")):
        match, target = _TARGET.fullmatch(path.name), load_image(path)
        if match is None or target is None:
            continue
        suffix = match[1] or ""
        exposure = exposures.get(suffix) or exposure_for(target)
        found: dict[str, Any] = {}
        for moment in MOMENTS:
            image = load_image(folder / "images" / f"{moment}{suffix}.exr")
            if image is not None and image.shape[:2] == target.shape[:2]:
                with_flip = moment == "final" and flip.is_installed()
                found[moment] = image_errors(image, target, exposure, with_flip)
        if found:
            images[suffix] = {"exposure": exposure} | found
    colors = _colors(folder / "parameters", results)
    if not images and not colors:
        return {}
    note = "" if flip.is_installed() or not any("final" in about for about in images.values()) else flip.MISSING
    return {"images": images, "colors": colors, "note": note}


def _colors(folder: Path, results: Mapping[str, Any]) -> dict[str, Any]:
    true = read_parameters(folder / "true")
    found: dict[str, Any] = {}
    moments = {"initial": read_parameters(folder / "initial"), "final": read_parameters(folder)}
    for key, about in (results.get("parameters") or {}).items():
        quantity = about.get("quantity") or ""
        if key in true and is_color(key, quantity):
            values = {moment: arrays[key] for moment, arrays in moments.items() if key in arrays}
            errors = color_errors(values, true[key], read_mask(folder, key), quantity)
            found |= {key: errors} if errors else {}
    return found
