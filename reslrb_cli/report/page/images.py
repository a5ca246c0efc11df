"""Images on the page: start, end, target and maps of every sensor, and tables of views and perceptual errors."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from reslrb_cli.optimization.targets import WORDS
from reslrb_cli.records.images import load_image
from reslrb_cli.report.format import number
from reslrb_cli.report.page.layout import lay_out
from reslrb_cli.report.sources import ShownRun
from reslrb_cli.report.spread import misfit_words
from reslrb_cli.report.tonemap import (
    as_png,
    color_stops,
    colored,
    encode,
    exposure_words,
    read_comparison,
    shown_exposures,
    signed_end,
)

Array = np.ndarray[Any, Any]

#: Maximum length of a picture's longer side in pixels, to keep the page small.
MOST_PIXELS = 640

#: Smaller pictures are shown with square pixels instead of smooth interpolation.
FEW_PIXELS = 256


@dataclass(frozen=True)
class Picture:
    """Picture as a `data:` address, with its size (width, height) in pixels and the lines of its caption.

    A map also has a colour scale: some of its colours (`stops`), and labels from its start to its end (`ends`). The
    page compares pictures that have a `moment`, such as the start of the run, with each other.
    """

    uri: str
    size: tuple[int, int]
    alt: str
    caption: Sequence[str]
    stops: Sequence[str] = ()
    ends: Sequence[str] = ()
    moment: str = ""

    @property
    def smooth(self) -> bool:
        """Whether the picture has enough pixels for smooth enlargement."""
        return max(self.size) >= FEW_PIXELS


def show(values: Array, alt: str, *caption: str) -> Picture:
    """Return linear values (H, W, C) as an sRGB picture. Fewer than three channels are shown as grey."""
    values = fit(np.nan_to_num(values[:, :, :3] if values.shape[2] >= 3 else values[:, :, :1], posinf=1e30))
    encoded = np.round(255 * encode(np.clip(values, 0.0, 1.0))).astype(np.uint8)
    return _embed(as_png(np.broadcast_to(encoded, (*encoded.shape[:2], 3))), encoded.shape, alt, caption)


def show_map(values: Array, end: float, alt: str, *caption: str, signed: bool = False) -> Picture:
    """Return values (H, W, 1) as a picture in colours, with a scale below the caption.

    The scale runs from 0 to `end`. With `signed`, the scale starts at -`end` instead.
    """
    grey = fit(values)[:, :, 0]
    last = number(end)
    ends = [f"−{last}", "0", f"{last} or more"] if signed else ["0", f"{last} or more"]
    about = f"{alt}, from {ends[0]} to {last}"
    return _embed(colored(grey / end, signed), grey.shape, about, caption, color_stops(9, signed), ends)


def _embed(png: bytes, shape: tuple[int, ...], *about: Any) -> Picture:
    """Return a picture with an embedded PNG, made from an array of `shape` (H, W, ...)."""
    return Picture(f"data:image/png;base64,{base64.b64encode(png).decode()}", (shape[1], shape[0]), *about)


def fit(values: Array) -> Array:
    """Return `values` (H, W, C), shrunk to a longer side of at most `MOST_PIXELS`."""
    longest = max(values.shape[:2])
    if longest <= MOST_PIXELS:
        return values
    from reslrb_cli.scene.values import resample

    height, width = (max(round(size * MOST_PIXELS / longest), 1) for size in values.shape[:2])
    return resample(values, (width, height))


def view_table(views: Sequence[Mapping[str, Any]] | None, results: Mapping[str, Any]) -> Markup:
    """Return a table of the views, and the loss of the held-out views.

    The result is empty for a single view with default settings. All pixels of such a view have equal weights.
    """
    special = [view for view in views or () if view["left_out"] or view["kinds"]]
    if not views or (len(views) == 1 and not special and views[0]["exposure"] == 1):
        return Markup()
    exposures = {view["exposure"]: _recovered(view["exposure"], results) for view in views}
    held_out = results.get("held_out") or {}
    losses = [held_out[moment] for moment in ("initial", "final") if moment in held_out]
    return lay_out("run.views", views, WORDS, exposures, losses)


def _recovered(exposure: object, results: Mapping[str, Any]) -> list[float]:
    """Return the known values of a recovered exposure."""
    final = ((results.get("parameters") or {}).get(exposure) or {}).get("final") or {}
    value = final.get("value")
    return value if isinstance(value, list) else [] if value is None else [value]


def seen_table(results: Mapping[str, Any]) -> Markup:
    """Return a table of the perceptual errors of a run's images at start and end."""
    rows: list[dict[str, Any]] = []
    for suffix, about in (results.get("seen") or {}).items():
        sensor = f"sensor {suffix[1:]}, " if suffix else ""
        rows += [
            {"name": sensor + title, "errors": about[moment]}
            for title, moment in (("start", "initial"), ("end", "final"))
            if moment in about
        ]
    return lay_out("run.seen", rows) if rows else Markup()


def image_rows(run: ShownRun) -> Markup:
    """Return a row per sensor: the initial image, the final image, the target, and maps of the error and dL/dI.

    All images of a sensor have the exposure in the manifest. Missing images are left out.
    """
    exposures = shown_exposures(run.manifest.get("views"))
    return Markup().join(_row(run.path / "images", suffix, run.results, exposures[suffix]) for suffix in exposures)


def _row(folder: Path, suffix: str, results: Mapping[str, Any], exposure: float) -> Markup:
    names = {"start": "initial", "end": "final", "target": "target"}
    loaded = {title: load_image(folder / f"{name}{suffix}.exr") for title, name in names.items()}
    sensor = f" of sensor {suffix[1:]}" if suffix else ""
    shown = []
    for title, image in loaded.items():
        if image is not None:
            caption = lay_out("titled", title, f", {image.shape[1]}×{image.shape[0]}")
            shown.append(replace(show(image * exposure, f"{title}{sensor}", caption), moment=title))
    weights = load_image(folder / f"weights{suffix}.exr")
    if weights is not None:  # the weights of pixels differ
        share = weights[:, :, :1] / max(float(weights.max()), 1e-30)
        shown.append(show(share, f"mask{sensor}", lay_out("titled", "mask", ": black is left out of the loss")))
    shown += _error_maps(folder, suffix, results)
    if not shown:
        return Markup()
    title = f"Sensor {suffix[1:]}" if suffix else ""
    return lay_out("gallery", shown, title, exposure_words(exposure, loaded["target"]))


def _error_maps(folder: Path, suffix: str, results: Mapping[str, Any]) -> list[Picture]:
    """Return the maps of |I - T|, of dL/dI and of the misfit with their scales. Missing maps, and maps without a scale,
    are left out.
    """
    about = (results.get("error_maps") or {}).get(f"error{suffix}")
    layers = read_comparison(folder, suffix)
    shown = []
    if about is not None and about.get("end") and "difference" in layers:
        grey = np.abs(layers["difference"].astype(np.float64)).mean(axis=2, keepdims=True)
        caption = lay_out("titled", "|image − target|", f" at the end, mean {number(about['mean'], 3)}")
        shown.append(show_map(grey, about["end"], "error map", caption))
    if "gradient" in layers:
        total = np.nan_to_num(layers["gradient"].astype(np.float64)).sum(axis=2, keepdims=True)
        caption = lay_out("titled", "∂loss/∂image", " at the end, sum over channels")
        shown.append(show_map(total, signed_end(total), "derivative of the loss", caption, signed=True))
    misfit = load_image(folder / f"misfit{suffix}.exr") if misfit_words(results) else None
    if misfit is not None:
        caption = lay_out("titled", "misfit", ", as a share of the target: red is too bright, grey is noise")
        shown.append(show_map(misfit, signed_end(misfit), "misfit", caption, signed=True))
    return shown
