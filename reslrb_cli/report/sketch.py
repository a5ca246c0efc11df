"""Sketch of the set-up of a lens or a mirror as SVG, seen from above and to scale."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup, escape

Array = np.ndarray[Any, Any]

#: Width of the sketch, its margin, and the largest height, in pixels.
WIDTH, MARGIN, MOST_HEIGHT = 640, 56, 420

#: A lamp farther away than this multiple of the receiver's distance is drawn at this multiple.
MOST_LAMP = 1.2


def sketch(setup: Mapping[str, Any], thickness: float) -> Markup:
    """Return the sketch of a `setup` (`runs/setup.py`). Lengths are in mm.

    The solid stands at the origin. +z points to the right, the direction from a lens's relief to the receiver.
    """
    half = setup["face_size"][0] / 2
    receiver, across = _flat(setup["receiver"]), _flat(setup["picture_right"])
    across = across / max(float(np.linalg.norm(across)), 1e-9) * setup["picture_size"][0] / 2
    toward = _flat(setup["light_direction"])
    toward = toward / max(float(np.linalg.norm(toward)), 1e-9)
    lens = setup["kind"] == "lens"
    entrance = np.array([-thickness if setup["lit_side"] == "back" else 0.0, 0.0])
    parallel = setup["light_distance"] == "parallel"
    far = MOST_LAMP * setup["receiver_distance"]
    away = 0.45 * setup["receiver_distance"] if parallel else min(setup["light_distance"], far)
    lamp = entrance - away * toward
    side = np.array([-toward[1], toward[0]])
    corners = [(-thickness, -half), (0.0, half)]
    points = np.array([*corners, receiver + across, receiver - across, lamp + half * side, lamp - half * side])
    low, high = points.min(axis=0), points.max(axis=0)
    scale = min((WIDTH - 2 * MARGIN) / (high[0] - low[0]), (MOST_HEIGHT - 2 * MARGIN) / max(high[1] - low[1], 1e-9))
    height = scale * (high[1] - low[1]) + 2 * MARGIN

    def at(point: Sequence[float] | Array) -> tuple[float, float]:
        return MARGIN + scale * (point[0] - low[0]), MARGIN + scale * (high[1] - point[1])

    parts = []
    if parallel:
        for offset in (-0.8, 0.0, 0.8):
            parts.append(_line(at(lamp + offset * half * side), at(entrance + offset * half * side), "light", True))
    else:
        parts += [_line(at(lamp), at(entrance + offset * half * np.array([0, 1])), "light", True)
                  for offset in (-0.9, 0.9)]  # fmt: skip
        x, y = at(lamp)
        parts.append(f'<circle class="lamp" cx="{x:.1f}" cy="{y:.1f}" r="5"/>')
    left, top = at((-thickness, half))
    parts.append(f'<rect class="solid" x="{left:.1f}" y="{top:.1f}" width="{max(scale * thickness, 3):.1f}" '
                 f'height="{scale * 2 * half:.1f}"/>')  # fmt: skip
    parts.append(_line(at((0, half)), at((0, -half)), "relief"))
    parts.append(_line(at(receiver + across), at(receiver - across), "screen"))
    parts.append(_line(at((0, 0)), at(receiver), "axis"))
    middle = receiver / 2
    parts.append(_text((at(middle)[0], at(middle)[1] - 6), f"{setup['receiver_distance']:.4g} mm"))
    lit = ("flat back" if setup["lit_side"] == "back" else "relief") if lens else "relief"
    name = "parallel light" if parallel else f"lamp, {setup['light_distance']:.4g} mm from the {lit}"
    x, y = at(lamp)
    parts.append(_text((min(max(x, 70), WIDTH - 70), min(y + scale * half * abs(side[1]) + 18, height - 8)), name))
    x, y = at((-thickness / 2, half))
    parts.append(_text((min(max(x, 50), WIDTH - 50), y - 8), f"{setup['kind']}, relief to the right"))
    x, y = at(receiver + (across if across[1] > 0 else -across))
    parts.append(_text((min(max(x, 40), WIDTH - 40), y - 8), "receiver"))
    about = escape(f"Sketch from above: {name}, {setup['kind']}, receiver at {setup['receiver_distance']:.4g} mm")
    return Markup(
        f'<svg class="sketch" role="img" aria-label="{about}" viewBox="0 0 {WIDTH} {height:.0f}">'
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z"/></marker></defs>' + "".join(parts) + "</svg>"
    )


def _flat(vector: Sequence[float]) -> Array:
    """Return (z, x) of a vector (x, y, z). The sketch shows this plane from +y, with z to the right and x upwards."""
    return np.array([vector[2], vector[0]], dtype=float)


def _line(start: tuple[float, float], end: tuple[float, float], kind: str, tip: bool = False) -> str:
    marker = ' marker-end="url(#tip)"' if tip else ""
    return (f'<line class="{kind}" x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" y2="{end[1]:.1f}"'
            f"{marker}/>")  # fmt: skip


def _text(place: tuple[float, float], words: str) -> str:
    return f'<text x="{place[0]:.1f}" y="{place[1]:.1f}">{escape(words)}</text>'
