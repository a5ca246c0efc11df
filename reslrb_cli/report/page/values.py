"""Parameters on the page as numbers, swatches and pictures, and curves of loss and errors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from reslrb_cli.records.images import finite_range, in_range, read_mask, read_parameters
from reslrb_cli.report.format import number
from reslrb_cli.report.page.images import show
from reslrb_cli.report.page.layout import diagram, key, lay_out, soft
from reslrb_cli.report.panels import ITERATION, TIME
from reslrb_cli.report.plots import COLORS, Curve, Panel, points_together
from reslrb_cli.report.run_summary import MOMENTS, is_settled, units_differ, verdict_words
from reslrb_cli.report.sources import ShownRun
from reslrb_cli.report.spread import spread_words
from reslrb_cli.report.tonemap import encode, exposure_for, exposure_words

Array = np.ndarray[Any, Any]

#: Subfolders of `parameters/` with the initial, final and true values.
_FOLDERS = {"initial": "initial", "final": "", "true": "true"}


#: Parameters of three numbers that are not visible colours. `values` are those of a spectrum at its wavelengths.
NO_COLORS = ("eta", "k", "values")

#: Quantities of geometry, which are neither light nor colour.
PLACES = ("length", "degrees", "scale")


def is_color(key: str, quantity: str) -> bool:
    """Whether the three channels of a parameter are a colour."""
    return quantity not in PLACES and not any(part in NO_COLORS for part in key.split(".")[-2:])


def parameter_table(results: Mapping[str, Any], end: str) -> Markup:
    """Return a table with each parameter's value and error at start and end, and its true value if known. `end` is the
    title of the column of final values.
    """
    parameters = results.get("parameters") or {}
    has_truth = any(about.get("true") for about in parameters.values())
    relative = units_differ(results)
    kinds = {"RMSE": "parameter_rmse"} | ({"relative error": "relative_error"} if relative else {})
    errors = kinds if has_truth else {}
    rows = [
        {
            "name": name, "about": about, "swatches": _swatches(name, about),
            "errors": [(results.get(kind) or {}).get(name) for kind in errors.values()],
            "worse": name in (results.get("worse") or ()), "spread": spread_words(results, name, "±"),
            "verdict": verdict_words(results, name), "settled": is_settled(results, name),
        }
        for name, about in parameters.items()
    ]  # fmt: skip
    moments = {"initial": "start", "final": end} | ({"true": "true"} if has_truth else {})
    noted = bool(results.get("parameter_rmse"))
    return lay_out("run.parameters", rows, moments, list(errors), noted, relative)


def texture_pictures(run: ShownRun) -> Markup:
    """Return each texture at start and end (or now), the true texture if known, and the mask of reached texels."""
    folder = run.path / "parameters"
    archives = {moment: read_parameters(folder / sub) for moment, sub in _FOLDERS.items()}
    titles = {moment: title for title, moment in MOMENTS}
    if run.current is not None:
        archives["final"], titles["final"] = dict(run.current), "now"
    parts = Markup()
    for name, about in (run.results.get("parameters") or {}).items():
        found = {moment: archive[name] for moment, archive in archives.items() if name in archive}
        arrays = {moment: array for moment, array in found.items() if array.ndim == 3 and array.size}
        if not arrays:
            continue
        arrays, words = visible(arrays, about.get("quantity") in PLACES)
        mask = read_mask(folder, name)
        if mask is not None and "final" in arrays and mask.shape == arrays["final"].shape[:2]:
            arrays["final"] = hatched(arrays["final"], ~mask)
        shown = []
        for moment, array in arrays.items():
            value = [lay_out("run.value", about[moment])] if about.get(moment) else []
            size = lay_out("titled", titles[moment], f", {array.shape[1]}×{array.shape[0]}")
            shown.append(show(array, f"{titles[moment]}: {name}", size, *value))
        if mask is not None and mask.ndim == 2 and not mask.all():
            share = lay_out("titled", "reached", f" by light and sensor (white): {number(100 * mask.mean(), 3)} %; the "
                            f"other texels are not recovered, and hatched at the {titles['final']}")  # fmt: skip
            shown.append(show(mask[:, :, None].astype(np.float32), f"reached: {name}", share))
        parts += lay_out("gallery", shown, key(name), words)
    return parts


def hatched(array: Array, where: Array) -> Array:
    """Return an image (H, W, C) in which the pixels `where` (H, W) alternate between two greys."""
    y, x = np.indices(where.shape)
    grey = np.where((x + y) % 2, 0.5, 0.15).astype(array.dtype)
    return np.where(where[:, :, None], grey[:, :, None], array)


def visible(arrays: Mapping[str, Array], heights: bool) -> tuple[dict[str, Array], str]:
    """Return the arrays, all scaled in the same way for viewing, and a remark on the scaling.

    Heights, which may be negative, are mapped to the range from black to white. Other textures may be far above 1. The
    exposure suits the true texture or, if it is unknown, the final texture.
    """
    if heights:
        low, high = finite_range(arrays.values())
        words = f"black is {number(low, 3)}, white is {number(high, 3)}"
        return {moment: in_range(array, low, high) for moment, array in arrays.items()}, words
    known = arrays.get("true", arrays.get("final"))
    exposure = exposure_for(known) if known is not None and float(np.nanmax(known)) > 1 else 1.0
    return {moment: array * exposure for moment, array in arrays.items()}, exposure_words(exposure)


def _swatches(key: str, about: Mapping[str, Any]) -> dict[str, str]:
    """Return a parameter's CSS colours by moment. All moments share one scale. For emission and values above 1, the
    scale maps the brightest value to 1.
    """
    moments = {moment: about.get(moment) or {} for _, moment in MOMENTS}
    values = {moment: found.get("mean", found.get("value")) for moment, found in moments.items()}
    colors = {
        moment: np.array(color, dtype=np.float64)
        for moment, color in values.items()
        if isinstance(color, list) and len(color) == 3 and None not in color
    }
    if not is_color(key, about.get("quantity") or "") or not colors:
        return {}
    brightest = max(float(color.max()) for color in colors.values())
    unit = brightest if brightest > 1 or (about.get("quantity") and brightest > 0) else 1.0
    shown = {moment: 255 * encode(np.clip(color / unit, 0, 1)) for moment, color in colors.items()}
    return {moment: f"rgb({','.join(f'{channel:.0f}' for channel in color)})" for moment, color in shown.items()}


#: Maximum number of curves in a diagram of one run, for the parameters with the largest final errors.
MOST_CURVES = len(COLORS)

ABSCISSAE = (("iteration", ITERATION), ("elapsed_s", TIME))
Figures = list[float | None]


def convergence(run: ShownRun) -> Markup:
    """Return diagrams of the loss and the known parameter errors over iterations and over time."""
    if not run.records:
        yet = "has been completed yet; the first one also compiles what the others use"
        return lay_out("paragraph", f"No iteration {yet if run.at_work else 'was completed'}.")
    relative = units_differ(run.results)
    scales = run.scales if relative else {}
    errors = {name: _errors(run, name, scales.get(name)) for name in run.records[-1]["parameter_errors"]}
    ends = {name: curve[-1] for name, curve in errors.items() if not relative or scales.get(name)}
    known = {name: end for name, end in ends.items() if end is not None}
    names = sorted(known, key=lambda name: -known[name])
    drawn = names[:MOST_CURVES]
    what = "relative error" if relative else "RMSE"
    curves = _losses(run)
    curves += _both(run, f"{what} by parameter", {name: errors[name] for name in drawn})
    curves += lay_out("legend", drawn)
    more, together = len(names) - len(drawn), points_together(len(run.records))
    words = f"The {MOST_CURVES} parameters that are the farthest off at the end; {more} more are not drawn."
    return curves + soft(words if more else "") + soft(
        f"Each point is the mean of {together} iterations." if together > 1 else "")  # fmt: skip


def _losses(run: ShownRun) -> Markup:
    """Return diagrams of the loss of the iterations. The noise of their images can hide that it falls, so the losses of
    the saved images, which have more samples, are drawn, too, if they are known.
    """
    saved = run.results.get("image_loss") or {}
    ends: Figures = [saved.get("initial"), saved.get("final")]
    if len(run.records) < 2 or None in ends:
        return _both(run, "loss", {"loss": run.column("loss")})
    drawn = []
    for name, caption in ABSCISSAE:
        xs = run.column(name)
        iterations = Curve("iterations", xs, run.column("loss"), 0)
        curves = [iterations, Curve("saved images", [xs[0], xs[-1]], ends, 1, points=True)]
        drawn.append(("", diagram(Panel("", caption, "loss", curves))))
    return lay_out("diagrams", drawn) + lay_out("legend", ["iterations", "saved images, with less noise"])


def _both(run: ShownRun, label: str, curves: Mapping[str, Figures]) -> Markup:
    """Return the same curves in two diagrams side by side, over iterations and over time."""
    drawn = [
        ("", diagram(Panel("", caption, label, [
            Curve(title, run.column(name), ys, k) for k, (title, ys) in enumerate(curves.items())])))
        for name, caption in ABSCISSAE
    ]  # fmt: skip
    return lay_out("diagrams", drawn)


def _errors(run: ShownRun, name: str, scale: float | None) -> Figures:
    """Return the errors of one parameter, divided by `scale` if given."""
    errors = [record["parameter_errors"].get(name) for record in run.records]
    return [None if error is None else error / (scale or 1.0) for error in errors]
