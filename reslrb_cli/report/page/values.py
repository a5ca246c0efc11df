"""The parameters on the page, with their errors, and curves of loss and errors.

Parameters are numbers with swatches, and textures as pictures (`parameter_table`, `texture_pictures`). Curves are loss
and errors of one run, or of several in one picture, against iterations and time (`convergence`, `convergence_of_all`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from reslrb_cli.records.images import finite_range, read_mask, read_parameters
from reslrb_cli.report.format import number
from reslrb_cli.report.page.images import Picture, gallery, show, titled
from reslrb_cli.report.page.layout import (
    COLORS,
    MOST_POINTS,
    Curve,
    diagram,
    diagrams,
    key,
    lay_out,
    legend,
    points_together,
    soft,
)
from reslrb_cli.report.perceptual import PLACES, is_color
from reslrb_cli.report.run_summary import is_settled, spread_words, units_differ, verdict_words
from reslrb_cli.report.sources import Run
from reslrb_cli.report.tonemap import encode, exposure_for, exposure_words

Array = np.ndarray[Any, Any]

#: Where a run folder has the values of a moment, below `parameters/`.
MOMENTS = (("start", "initial"), ("end", "final"), ("true", "true"))
_FOLDERS = {"initial": "initial", "final": "", "true": "true"}


def parameter_table(results: Mapping[str, Any], end: str = "end") -> Markup:
    """Value and error of each parameter at the start and at the end, and the true value where it is known."""
    parameters = results.get("parameters") or {}
    has_truth = any(about.get("true") for about in parameters.values())
    kinds = {"RMSE": "parameter_rmse"} | ({"relative error": "relative_error"} if units_differ(results) else {})
    errors = kinds if has_truth else {}
    rows = [
        {
            "name": name, "about": about, "notes": _notes(about), "swatches": _swatches(name, about),
            "errors": [(results.get(kind) or {}).get(name) for kind in errors.values()],
            "worse": name in (results.get("worse") or ()), "spread": spread_words(results, name, "±"),
            "verdict": verdict_words(results, name), "settled": is_settled(results, name),
        }
        for name, about in parameters.items()
    ]  # fmt: skip
    moments = {"initial": "start", "final": end} | ({"true": "true"} if has_truth else {})
    return lay_out("run.parameters", rows, moments, list(errors))


def texture_pictures(
    folder: Path, results: Mapping[str, Any], current: Mapping[str, Array] | None = None
) -> Markup:  # fmt: skip
    """Each texture at the start and at the end, the true one where it is known, and what of it light and sensor reach.

    `folder` is a run's `parameters/`; `current` are the values now, by key, of a run that has no end yet.
    """
    parts = Markup()
    archives = {moment: read_parameters(folder / sub) for moment, sub in _FOLDERS.items()}
    if current is not None:
        archives["final"] = dict(current)
    titles = {moment: "now" if moment == "final" and current is not None else title for title, moment in MOMENTS}
    for name, about in (results.get("parameters") or {}).items():
        arrays = {moment: _texture(archive, name) for moment, archive in archives.items()}
        exposure, words = _exposure(arrays), ""
        if about.get("quantity") in PLACES:
            arrays, words = _as_relief(arrays)
            exposure = 1.0
        shown = [
            _picture(titles[moment], name, array, about.get(moment), exposure)
            for _, moment in MOMENTS
            if (array := arrays[moment]) is not None
        ]
        mask = _texture_mask(folder, name)
        if shown and mask is not None and not mask.all():
            share = titled("reached", f" by light and sensor (white): {100 * mask.mean():.3g} %")
            shown.append(show(mask[:, :, None].astype(np.float32), f"reached: {name}", share))
        if shown:
            parts += gallery(shown, key(name), words or exposure_words(exposure))
    return parts


def _as_relief(arrays: Mapping[str, Array | None]) -> tuple[dict[str, Array | None], str]:
    """Heights, which may be negative, from black to white, at all moments alike; and words that say so."""
    low, high = finite_range(array for array in arrays.values() if array is not None)
    span = (high - low) or 1.0
    shown = {moment: None if array is None else (array - low) / span for moment, array in arrays.items()}
    return shown, f"black is {number(low, 3)}, white is {number(high, 3)}"


def _exposure(arrays: Mapping[str, Array | None]) -> float:
    """What is emitted may be far beyond 1, and has one exposure at all moments: by the truth, where that is known."""
    true, final = arrays["true"], arrays["final"]
    known = true if true is not None else final
    return exposure_for(known) if known is not None and float(np.nanmax(known)) > 1 else 1.0


def _picture(title: str, name: str, array: Array, about: Mapping[str, Any] | None, exposure: float) -> Picture:
    value = [lay_out("run.value", about)] if about else []
    return show(array * exposure, f"{title}: {name}", titled(title, f", {array.shape[1]}×{array.shape[0]}"), *value)


def _notes(about: Mapping[str, Any]) -> list[str]:
    shape, reached = "×".join(str(size) for size in about.get("shape") or ()), about.get("reached")
    share = f"{100 * reached:.3g} % reached" if reached is not None and reached < 1 else ""
    return [about.get("quantity") or "", shape if shape != "3" else "", share]


def _swatches(key: str, about: Mapping[str, Any]) -> dict[str, str]:
    """The colours of a parameter in CSS, by moment, with one exposure: what is emitted, or beyond 1, is at most 1."""
    colors = {}
    for _, moment in MOMENTS:
        found = about.get(moment) or {}
        values = found.get("mean", found.get("value"))
        if isinstance(values, list) and len(values) == 3 and None not in values:
            colors[moment] = np.array(values, dtype=np.float64)
    if not is_color(key, about.get("quantity") or "") or not colors:
        return {}
    brightest = max(float(color.max()) for color in colors.values())
    unit = brightest if brightest > 1 or (about.get("quantity") and brightest > 0) else 1.0
    shown = {moment: encode(np.clip(color / unit, 0, 1)) for moment, color in colors.items()}
    return {moment: f"rgb({','.join(f'{255 * c:.0f}' for c in color)})" for moment, color in shown.items()}


def _texture(archive: Mapping[str, Array], key: str) -> Array | None:
    array = archive.get(key)
    return array if array is not None and array.ndim == 3 and array.size else None


def _texture_mask(folder: Path, key: str) -> Array | None:
    mask = read_mask(folder, key)
    return mask if mask is not None and mask.ndim == 2 else None


#: Curves in one diagram of one run, at most: those of the parameters that are the farthest off at the end.
MOST_CURVES = len(COLORS)

#: Parameters of several runs that have diagrams of their own, at most.
MOST_SHARED = 6
ABSCISSAE = (("iteration", "iteration"), ("elapsed_s", "time in steps and updates (s)"))
Record = Mapping[str, Any]


def convergence(run: Run) -> Markup:
    """Loss, and errors by parameter where they are known, against iterations and against time."""
    if not run.records:
        when = (
            "has been completed yet; the first one also compiles what the others use"
            if run.at_work
            else "was completed"
        )
        return lay_out("paragraph", f"No iteration {when}.")
    scales, relative = run.scales, units_differ(run.results)
    last = run.records[-1]["parameter_errors"]
    ends = {
        name: error / (scales.get(name) or 1.0 if relative else 1.0)
        for name, error in last.items()
        if error is not None
    }
    names = [name for name in sorted(ends, key=lambda name: -ends[name]) if not relative or scales.get(name)]
    drawn = names[:MOST_CURVES]
    errors = [(run, name, place, _error_curve(name, scales.get(name) if relative else None))
              for place, name in enumerate(drawn)]  # fmt: skip
    what = "relative error" if relative else "RMSE"
    curves = _both([(run, "loss", 0, _loss)], "loss") + _both(errors, f"{what} by parameter") + legend(drawn)
    more, words = len(names) - len(drawn), f"The {MOST_CURVES} parameters that are the farthest off at the end; "
    return curves + soft(f"{words}{more} more are not drawn." if more else "") + _thinning([run])


def convergence_of_all(runs: Sequence[Run]) -> Markup:
    """Loss and error of several runs in one picture; of parameters that several have, each in a picture of its own."""
    begun = [(place, run) for place, run in enumerate(runs) if run.records]
    if not begun:
        return lay_out("paragraph", "No iteration was completed.")
    parts = legend([run.name if run.records else "" for run in runs])
    parts += _both([(run, run.name, place, _loss) for place, run in begun], "loss")
    absolute = not any(units_differ(run.results) for run in runs)
    total = _total_rmse if absolute else _total_relative
    label = "parameter RMSE" if absolute else "relative error"
    parts += _both([(run, run.name, place, total(run)) for place, run in begun], f"{label}, all parameters")
    counts = Counter(name for _, run in begun for name in run.records[-1]["parameter_errors"])
    shared = [name for name, count in counts.items() if count > 1] if len(counts) > 1 else []
    for name in shared[:MOST_SHARED]:
        drawn = _both([(run, run.name, place, _error_curve(name, None)) for place, run in begun], "RMSE")
        parts += lay_out("heading", key(name)) + drawn if drawn else drawn
    if len(shared) > MOST_SHARED:
        parts += soft(f"{len(shared) - MOST_SHARED} more parameters that several runs have are not drawn.")
    missing = [run.name for run in runs if not run.records]
    parts += soft(f"No iteration was completed by: {', '.join(missing)}." if missing else "")
    return parts + _thinning(runs)


def _both(curves: Sequence[tuple[Run, str, int, Callable[[Record], float | None]]], label: str) -> Markup:
    """The same curves in two diagrams beside each other, against iterations and against time."""
    drawn = []
    for name, caption in ABSCISSAE:
        made = [
            Curve(title, [record[name] for record in run.records], [value(record) for record in run.records], place)
            for run, title, place, value in curves
        ]
        drawn.append(("", diagram(made, caption, label)))
    return diagrams(*drawn)


def _thinning(runs: Sequence[Run]) -> Markup:
    most = max((points_together(len(run.records)) for run in runs), default=1)
    if most <= 1:
        return Markup()
    if len(runs) == 1:
        return soft(f"Each point is the mean of {most} iterations.")
    return soft(f"Of runs with more than {MOST_POINTS} iterations each point is the mean of some, at most {most}.")


def _loss(record: Record) -> float | None:
    return record["loss"]


def _error_curve(key: str, scale: float | None) -> Callable[[Record], float | None]:
    """The error of one parameter, over `scale` where that is given."""

    def error(record: Record) -> float | None:
        value = record["parameter_errors"].get(key)
        return None if value is None else value / (scale or 1.0)

    return error


def _total_rmse(run: Run) -> Callable[[Record], float | None]:
    return lambda record: record["parameter_rmse"]


def _total_relative(run: Run) -> Callable[[Record], float | None]:
    """The root mean square over the parameters of their errors as shares of the truth."""
    scales = run.scales

    def total(record: Record) -> float | None:
        errors = record["parameter_errors"].items()
        shares = [value / scale for key, value in errors if value is not None and (scale := scales.get(key))]
        return math.sqrt(sum(share**2 for share in shares) / len(shares)) if shares else None

    return total
