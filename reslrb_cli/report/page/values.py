"""Parameters on the page as numbers, swatches and pictures, and curves of loss and errors of one or several runs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from reslrb_cli.records.images import finite_range, in_range, read_mask, read_parameters
from reslrb_cli.report.format import number
from reslrb_cli.report.page.images import show
from reslrb_cli.report.page.layout import diagram, key, lay_out, soft
from reslrb_cli.report.plots import COLORS, MOST_POINTS, Curve, points_together
from reslrb_cli.report.run_summary import MOMENTS, is_settled, spread_words, units_differ, verdict_words
from reslrb_cli.report.sources import ShownRun
from reslrb_cli.report.tonemap import encode, exposure_for, exposure_words

Array = np.ndarray[Any, Any]

#: Subfolders of `parameters/` with the initial, final and true values.
_FOLDERS = {"initial": "initial", "final": "", "true": "true"}


#: Parameters of three numbers that are not visible colours.
NO_COLORS = ("eta", "k")

#: Quantities of geometry, which are neither light nor colour.
PLACES = ("length", "degrees", "scale")


def is_color(key: str, quantity: str) -> bool:
    """Whether the three channels of a parameter are a colour."""
    return quantity not in PLACES and not any(part in NO_COLORS for part in key.split(".")[-2:])


def parameter_table(results: Mapping[str, Any], end: str = "end", notes: bool = False) -> Markup:
    """Return a table with each parameter's value and error at start and end, and its true value if known.

    `notes` adds a remark on how errors are computed.
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
    noted = notes and bool(results.get("parameter_rmse"))
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
        shown = []
        for moment, array in arrays.items():
            value = [lay_out("run.value", about[moment])] if about.get(moment) else []
            size = lay_out("titled", titles[moment], f", {array.shape[1]}×{array.shape[0]}")
            shown.append(show(array, f"{titles[moment]}: {name}", size, *value))
        mask = read_mask(folder, name)
        if mask is not None and mask.ndim == 2 and not mask.all():
            share = lay_out("titled", "reached", f" by light and sensor (white): {100 * mask.mean():.3g} %")
            shown.append(show(mask[:, :, None].astype(np.float32), f"reached: {name}", share))
        parts += lay_out("gallery", shown, key(name), words)
    return parts


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

#: Maximum number of parameters of several runs with their own diagrams.
MOST_SHARED = 6
ABSCISSAE = (("iteration", "iteration"), ("elapsed_s", "time in steps and updates (s)"))
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
    curves = _both("loss", [(run, "loss", 0, run.column("loss"))])
    curves += _both(f"{what} by parameter", [(run, name, k, errors[name]) for k, name in enumerate(drawn)])
    curves += lay_out("legend", drawn)
    more, words = len(names) - len(drawn), f"The {MOST_CURVES} parameters that are the farthest off at the end; "
    return curves + soft(f"{words}{more} more are not drawn." if more else "") + _thinning([run])


def convergence_of_all(runs: Sequence[ShownRun]) -> Markup:
    """Return diagrams of the loss and the error of several runs. Add one diagram for each parameter that several runs
    share.
    """
    begun = [(place, run) for place, run in enumerate(runs) if run.records]
    if not begun:
        return lay_out("paragraph", "No iteration was completed.")
    parts = lay_out("legend", [run.name if run.records else "" for run in runs])
    parts += _both("loss", [(run, run.name, place, run.column("loss")) for place, run in begun])
    if any(units_differ(run.results) for run in runs):
        totals, label = [_total_relative(run) for _, run in begun], "relative error"
    else:
        totals, label = [run.column("parameter_rmse") for _, run in begun], "parameter RMSE"
    curves = [(run, run.name, place, total) for (place, run), total in zip(begun, totals, strict=True)]
    parts += _both(f"{label}, all parameters", curves)
    counts = Counter(name for _, run in begun for name in run.records[-1]["parameter_errors"])
    shared = [name for name, count in counts.items() if count > 1] if len(counts) > 1 else []
    for name in shared[:MOST_SHARED]:
        drawn = _both("RMSE", [(run, run.name, place, _errors(run, name, None)) for place, run in begun])
        parts += lay_out("heading", key(name)) + drawn if drawn else drawn
    if len(shared) > MOST_SHARED:
        parts += soft(f"{len(shared) - MOST_SHARED} more parameters that several runs have are not drawn.")
    missing = [run.name for run in runs if not run.records]
    parts += soft(f"No iteration was completed by: {', '.join(missing)}." if missing else "")
    return parts + _thinning(runs)


def _both(label: str, curves: Sequence[tuple[ShownRun, str, int, Figures]]) -> Markup:
    """Return the same curves in two diagrams side by side, over iterations and over time."""
    drawn = [
        ("", diagram([Curve(title, run.column(name), ys, k) for run, title, k, ys in curves], caption, label))
        for name, caption in ABSCISSAE
    ]
    return lay_out("diagrams", drawn)


def _thinning(runs: Sequence[ShownRun]) -> Markup:
    most = max((points_together(len(run.records)) for run in runs), default=1)
    if most <= 1:
        return Markup()
    if len(runs) == 1:
        return soft(f"Each point is the mean of {most} iterations.")
    return soft(f"Of runs with more than {MOST_POINTS} iterations each point is the mean of some, at most {most}.")


def _errors(run: ShownRun, name: str, scale: float | None) -> Figures:
    """Return the errors of one parameter, divided by `scale` if given."""
    errors = [record["parameter_errors"].get(name) for record in run.records]
    return [None if error is None else error / (scale or 1.0) for error in errors]


def _total_relative(run: ShownRun) -> Figures:
    """Return the root mean square of the relative errors of all parameters."""
    curves = [_errors(run, name, scale) for name, scale in run.scales.items() if scale]
    known = [[error for error in errors if error is not None] for errors in zip(*curves, strict=True)]
    return [math.sqrt(sum(error**2 for error in errors) / len(errors)) if errors else None for errors in known] or (
        [None] * len(run.records))  # fmt: skip
