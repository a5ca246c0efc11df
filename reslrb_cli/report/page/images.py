"""The images on the page: start, end, target and maps of every sensor."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.records.images import load_image
from reslrb_cli.report.error_map import color_stops, colored, read_comparison, signed_end
from reslrb_cli.report.page.markup import figure, figures, text
from reslrb_cli.report.page.pictures import Array, embed, fit, show
from reslrb_cli.report.sources import Run
from reslrb_cli.report.tone import exposure_for, exposure_words, shown_exposures
from reslrb_cli.report.words import number

#: Images between the first and the last that are shown of a sensor, at most.
MOST_BETWEEN = 12
_OF_A_SENSOR = re.compile(r"(?:initial|final|target)(-\d+)?\.exr")


def image_rows(run: Run) -> str:
    """Of every sensor a row: the initial image, the final one, the target, and maps of error and dL/dI.

    A sensor's images have one exposure, that of the run's manifest, or else what suits the target. What is missing is
    left out.
    """
    folder, exposures = run.path / "images", shown_exposures(run.manifest.get("views"))
    suffixes = {match[1] or "" for path in folder.glob("*.exr") if (match := _OF_A_SENSOR.fullmatch(path.name))}
    ordered = sorted(suffixes, key=lambda suffix: int(suffix[1:] or 0))
    return "".join(_row(folder, suffix, run.results, exposures.get(suffix)) for suffix in ordered)


def _row(folder: Path, suffix: str, results: Mapping[str, Any], exposure: float | None) -> str:
    names = {"start": "initial", "end": "final", "target": "target"}
    loaded = {title: load_image(folder / f"{name}{suffix}.exr") for title, name in names.items()}
    exposure = exposure_for(loaded["target"]) if exposure is None else exposure
    sensor = f" of sensor {suffix[1:]}" if suffix else ""
    shown = [
        _figure(image * exposure, f"{title}{sensor}", f"<b>{text(title)}</b>, {image.shape[1]}×{image.shape[0]}")
        for title, image in loaded.items()
        if image is not None
    ]
    shown += _weight_figure(folder, suffix, sensor) + _error_figures(folder, suffix, results)
    title = f"<h3>Sensor {text(suffix[1:])}</h3>" if suffix else ""
    words = exposure_words(exposure, loaded["target"])
    title += f'<p class="soft small">{text(words)}</p>' if words else ""
    return title + figures(shown) + _between(folder, suffix, exposure)


def _figure(image: Array, alt: str, markup: str) -> str:
    picture = show(image)
    return figure(picture.uri, picture.size, alt, markup, picture.smooth)


def _weight_figure(folder: Path, suffix: str, sensor: str) -> list[str]:
    """What pixels weigh, where not all count alike: black is left out."""
    weights = load_image(folder / f"weights{suffix}.exr")
    if weights is None:
        return []
    share = weights[:, :, :1] / max(float(weights.max()), 1e-30)
    return [_figure(share, f"mask{sensor}", "<b>mask</b>: black is left out of the loss")]


def _error_figures(folder: Path, suffix: str, results: Mapping[str, Any]) -> list[str]:
    """The maps of |I - T| and of dL/dI, with their scales; without the first where it, or its scale, is missing."""
    about = (results.get("error_maps") or {}).get(f"error{suffix}")
    layers = read_comparison(folder, suffix)
    shown = []
    if about is not None and about.get("end") and "difference" in layers:
        grey = np.abs(layers["difference"].astype(np.float64)).mean(axis=2, keepdims=True)
        caption = f"<b>|image − target|</b> at the end, mean {text(number(about['mean'], 3))}"
        shown.append(map_figure(grey, about["end"], "error map", caption))
    if "gradient" in layers:
        total = np.nan_to_num(layers["gradient"].astype(np.float64)).sum(axis=2, keepdims=True)
        caption = "<b>∂loss/∂image</b> at the end, sum over channels"
        shown.append(map_figure(total, signed_end(total), "derivative of the loss", caption, signed=True))
    return shown


def map_figure(values: Array, end: float, alt: str, markup: str, signed: bool = False) -> str:
    """Values (H, W, 1) in colours, from 0 to `end`, or if `signed` from -`end`, with the scale below the caption."""
    grey = fit(values)[:, :, 0]
    picture = embed(colored(grey / end, signed), grey.shape)
    last = text(number(end))
    low, middle = (f"−{last}", "<span>0</span>") if signed else ("0", "")
    stops = ",".join(color_stops(9, signed))
    scale = (
        f'<div class="scale" style="background:linear-gradient(to right,{stops})"></div>'
        f'<div class="ends"><span>{low}</span>{middle}<span>{last} or more</span></div>'
    )
    return figure(picture.uri, picture.size, f"{alt}, from {low} to {last}", markup + scale, picture.smooth)


def _between(folder: Path, suffix: str, exposure: float) -> str:
    """Images that were saved on the way, evenly chosen where they are many."""
    pattern = re.compile(rf"iteration-(\d+){suffix}\.exr")
    found = sorted((int(match[1]), path) for path in folder.iterdir() if (match := pattern.fullmatch(path.name)))
    if len(found) > MOST_BETWEEN:
        found = [found[round(place)] for place in np.linspace(0, len(found) - 1, MOST_BETWEEN)]
    loaded = [(iteration, load_image(path)) for iteration, path in found]
    shown = [
        _figure(image * exposure, f"after {iteration} iterations", f"after {iteration} iterations")
        for iteration, image in loaded
        if image is not None
    ]
    return f'<p class="soft small">on the way:</p>{figures(shown)}' if shown else ""
