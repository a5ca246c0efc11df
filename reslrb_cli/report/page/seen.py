"""Errors as people see them, as tables: of images, and of recovered colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from reslrb_cli.report.page.markup import breakable, soft, table, text
from reslrb_cli.report.sources import Run
from reslrb_cli.report.words import number

_HEAD = ("image", "PSNR", "SSIM", "CIEDE2000", "ΔE ITP", "HDR-FLIP", "|image − target|")
_TOLD = "Each line: mean; median, 95 %, 99 % of the pixels or texels are below; the greatest."
_MEASURES = {"ciede2000": "CIEDE2000", "itp": "ΔE ITP"}


def seen_tables(runs: Sequence[Run]) -> str:
    """The errors of the images and colours of runs, a line for each at the start and at the end."""
    rows: list[list[str]] = []
    colors: list[list[str]] = []
    notes, several = [], len(runs) > 1
    for run in runs:
        seen = run.results.get("seen") or {}
        before = f"{breakable(run.name)} " if several else ""
        for suffix, about in (seen.get("images") or {}).items():
            sensor = f"sensor {suffix[1:]}, " if suffix else ""
            rows += [_image_row(f"{before}{text(sensor)}{title}", about[moment]) for title, moment in _moments(about)]
        for key, about in (seen.get("colors") or {}).items():
            measure = _MEASURES.get(about.get("measure"), "")
            pair = [_spread(about.get(moment)) for moment in ("initial", "final")]
            colors.append([f"{before}{breakable(key)}", text(measure), *pair])
        notes += [seen["note"]] if seen.get("note") and seen["note"] not in notes else []
    if not rows and not colors:
        return ""
    drop = 5 if rows and not any(row[5] for row in rows) else None  # no column for what nobody measured
    head = [title for place, title in enumerate(_HEAD) if place != drop]
    shown = [[cell for place, cell in enumerate(row) if place != drop] for row in rows]
    parts = [table(head, shown, "spreads"), table(("colour", "in", "start", "end"), colors, "spreads")]
    return "".join(parts) + soft(_TOLD) + "".join(map(soft, notes))


def _moments(about: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(title, moment) for title, moment in (("start", "initial"), ("end", "final")) if moment in about]


def _image_row(markup: str, errors: Mapping[str, Any]) -> list[str]:
    ratio = errors.get("psnr_db")
    psnr = f"{number(ratio, 4)} dB" if ratio is not None else "∞"
    bad = errors.get("not_finite")
    note = f'<br><span class="worse small">{text(bad)} pixels not finite</span>' if bad else ""
    ssim = errors.get("ssim")
    spreads = [_spread(errors.get(name)) for name in ("ciede2000", "itp", "flip", "absolute")]
    return [
        markup + note,
        f'<span class="number">{text(psnr)}</span>',
        "too small" if ssim is None else text(number(ssim, 4)),
        *spreads,
    ]


def _spread(told: Mapping[str, float] | None) -> str:
    """Mean, percentiles and maximum, in two lines; where all are the same, that."""
    if not told:
        return ""
    if told["mean"] == told["max"]:
        return text(number(told["max"], 3))
    shown = {name: f'<span class="number">{text(number(value, 3))}</span>' for name, value in told.items()}
    rest = " ".join(shown[name] for name in ("p50", "p95", "p99", "max") if name in shown)
    return f'{shown["mean"]}<br><span class="soft small">{rest}</span>'
