"""Figure 1 as it is shown: its picture, its table, and its figures as JSON, from `paper_figure1_measure.py`."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
from paper_figure1_measure import Result
from paper_kinds import MIB, Kind
from paper_noise import CONFIDENCE

from reslrb_cli.records.metrics import finite
from reslrb_cli.report.tonemap import encode

#: Inches: a panel's side, what is between two, and above one.
PANEL, GAP, TITLE = 2.1, 0.08, 0.24
DPI = 100

#: Blue where heights are to rise, red where they are to fall; white where nothing is to be gained.
COLORS = ("#053061", "#4393c3", "#ffffff", "#d6604d", "#67001f")

#: Of the texels of our gradient with the most samples, so many go beyond the scale.
BEYOND = 0.01


def table(result: Result) -> str:
    """The figures in lines, as they are printed."""
    config, plan = result.config, result.plan
    height, width = result.pictures["initial"].shape[:2]
    rows, columns = result.ours.samples.shape[1:3]  # type: ignore[union-attr]
    lines = [
        f"{config.source}: film {width}x{height}, {result.key} {columns}x{rows}, max_depth "
        f"{config.integrator.max_depth}, dL/dI held at an image of {plan.reference_spp} spp; "
        f"each process under {plan.limit / 2**30:g} GiB of address space",
        "",
        f"{'gradient':24} {'seeds':>6} {'relative noise':>15} {'arrays MiB':>11} {'address space MiB':>18}",
    ]
    for kind in result.kinds:
        if kind.end is not None:
            lines.append(f"{kind.label:24} {'':6} {kind.end.status.value}: {kind.end.reason}")
            continue
        noise = f"{result.noise(kind):.4f}" if len(kind.rows) > 1 else ""
        lines.append(f"{kind.label:24} {len(kind.rows):6} {noise:>15} {kind.arrays_mib:11.1f} {kind.address_mib:18.0f}")
    lines += [
        f"{'':24} {'':6} its arrays by their growth from {plan.half_spp} to {plan.few_spp} spp: {_asked(result)}",
        "",
    ]
    lines.append(f"{'means compared':46} {'z rms':>6} {'limit':>6} {'max |z|':>8} {'limit':>6}")
    for (one, other), figures in result.comparisons.items():
        numbers = (figures.z_rms, figures.z_rms_limit, figures.z_max, figures.z_max_limit)
        cells = [f"{math.nan if value is None else value:.2f}" for value in numbers]
        lines.append(
            f"{f'{one} - {other}':46} {cells[0]:>6} {cells[1]:>6} {cells[2]:>8} {cells[3]:>6}  "
            f"{figures.verdict.value}{': ' if figures.message else ''}{figures.message}"
        )
    assert result.fall is not None, "a result that is shown has been checked"
    ratio = result.fall
    lines += [
        "",
        f"noise at {plan.few_spp} spp over that at {plan.many_spp}: {ratio.ratio:.2f}, {ratio.low:.2f} to "
        f"{ratio.high:.2f} ({CONFIDENCE:.0%}), expected {ratio.expected:.2f}: {ratio.verdict.value}",
        f"naive AD at {plan.many_spp} spp {_fate(result)}",
    ]
    return "\n".join(lines)


def to_json(result: Result) -> dict[str, Any]:
    """The same, to be read by programs."""
    plan = result.plan
    return {
        "config": str(result.config.source),
        "parameter": result.key,
        "plan": dataclasses.asdict(plan),
        "gradients": [_kind_json(result, kind) for kind in result.kinds],
        "naive_at_many_spp_mib": result.asked_mib,
        "comparisons": [
            {"gradient": one, "reference": other, **finite(vars(figures))}
            for (one, other), figures in result.comparisons.items()
        ],
        "noise": None if result.fall is None else finite(dataclasses.asdict(result.fall)),
        "holds": result.holds,
    }


def draw(result: Result, path: Path) -> None:
    """Write the picture: target and caustic, gradients of one seed each, and what does not fit as words."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    colors = LinearSegmentedColormap.from_list("gradient", COLORS)
    shown = {kind.label: kind.samples[0].sum(-1) for kind in result.kinds if kind.samples is not None}
    end = float(np.quantile(np.abs(shown[result.many.label]), 1 - BEYOND)) or 1.0
    white = float(np.quantile(result.pictures["target"], 0.999)) or 1.0
    size = 3 * PANEL + 2 * GAP, 2 * (PANEL + TITLE)
    figure = Figure(figsize=size, dpi=DPI, facecolor="white")
    canvas = FigureCanvasAgg(figure)

    def axes(row: int, column: int, title: str) -> Any:
        left, bottom = column * (PANEL + GAP), (1 - row) * (PANEL + TITLE)
        made = figure.add_axes((left / size[0], bottom / size[1], PANEL / size[0], PANEL / size[1]))
        made.set_title(title, fontsize=8, pad=3, parse_math=False)
        made.set(xticks=[], yticks=[])
        return made

    for row, (name, title) in enumerate((("target", "target"), ("initial", "caustic at the start"))):
        image = encode(np.clip(result.pictures[name] / white, 0, 1))
        axes(row, 0, title).imshow(image if image.shape[2] == 3 else image[:, :, 0], cmap="gray", vmin=0, vmax=1)
    places = {(0, 1): result.naive, (1, 1): result.ours, (0, 2): result.failing, (1, 2): result.many}
    for (row, column), kind in places.items():
        panel = axes(row, column, f"dL/dh by {kind.label}")
        if kind.label in shown:
            panel.imshow(shown[kind.label], cmap=colors, vmin=-end, vmax=end, interpolation="nearest")
            words = f"{kind.arrays_mib:.0f} MiB"
            panel.text(0.98, 0.02, words, fontsize=7, ha="right", va="bottom", transform=panel.transAxes)
        else:
            limit = f"{result.plan.limit / 2**30:g} GiB"
            words = f"does not fit\nunder {limit}\n\n{_asked(result)}\nby its growth before"
            panel.set_facecolor("#eeeeee")
            panel.text(0.5, 0.5, words, fontsize=9, ha="center", va="center", transform=panel.transAxes)
    canvas.draw()
    write(np.asarray(canvas.buffer_rgba())[:, :, :3].copy(), path)


def write(pixels: np.ndarray, path: Path) -> None:
    """In 256 colours: noise compresses badly, and the repository is to stay small."""
    from PIL import Image as Picture

    Picture.fromarray(pixels).quantize(256).save(path, format="png", optimize=True)


def _asked(result: Result) -> str:
    return f"about {result.asked_mib * MIB / 2**30:.1f} GiB at {result.plan.many_spp} spp"


def _fate(result: Result) -> str:
    if result.does_not_fit:
        return f"does not fit under {result.plan.limit / 2**30:g} GiB: holds"
    return "fits under the limit: fails" if result.failing.end is None else "ended otherwise: fails"


def _kind_json(result: Result, kind: Kind) -> dict[str, Any]:
    return {
        "gradient": kind.name,
        "spp": kind.spp,
        "seeds": 0 if kind.samples is None else len(kind.samples),
        "relative_noise": None if kind.samples is None or len(kind.samples) < 2 else result.noise(kind),
        "arrays_mib": kind.arrays_mib,
        "address_space_mib": kind.address_mib,
        "status": "ok" if kind.end is None else kind.end.status.value,
        "reason": None if kind.end is None else kind.end.reason,
    }
