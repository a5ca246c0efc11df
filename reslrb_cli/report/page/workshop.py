"""Sheet for the workshop that makes a lens or a mirror: pictures, set-up, allowed errors, solid, tool and material."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from reslrb_cli.report.format import number
from reslrb_cli.report.page.images import show
from reslrb_cli.report.page.layout import document, lay_out

Array = np.ndarray[Any, Any]

#: Clear materials and their indices of refraction at 589 nm.
MATERIALS = {"acrylic (PMMA)": 1.491, "crown glass (N-BK7)": 1.517, "polycarbonate": 1.585, "fused silica": 1.458}

#: Largest difference of an index from that of a material that the sheet names.
NEAR = 0.01

#: Names of the pictures with their captions. The other pictures of a sheet are those of deviations.
CAPTIONS = {
    "picture": "the original picture",
    "caustic": "the caustic, as computed",
}

#: Names of the views of the solid with their captions.
VIEWS = {
    "solid": "seen from a corner, in grazing light",
    "solid-front": "the relief, lit from the upper left",
    "solid-side": "seen from the side",
}


def sheet(numbers: Mapping[str, Any], pictures: Mapping[str, Array], name: str) -> str:
    """Return the sheet (see `workshop`) as a page of its own with the title `name`."""
    return document(name, lay_out("header", name), [(title, body) for title, body in parts(numbers, pictures).items()])


def workshop(numbers: Mapping[str, Any], pictures: Mapping[str, Array]) -> Markup:
    """Return the workshop sheet as a part of the run's page.

    `numbers` is the content of fabrication.json. `pictures` are linear images (H, W, C). Their names are in `CAPTIONS`
    and `VIEWS`, or are names of deviations. Pictures and numbers that are missing are left out.
    """
    return Markup().join(lay_out("heading", title) + body for title, body in parts(numbers, pictures).items() if body)


def parts(numbers: Mapping[str, Any], pictures: Mapping[str, Array]) -> dict[str, Markup]:
    """Return the parts of the sheet by title. Parts that do not apply are empty."""
    kind, found = numbers["kind"], numbers.get("tolerances") or {}
    setup = numbers.get("setup")
    light = next((name for name in found if name.startswith("light of ")), "")
    shown = [*CAPTIONS, light]
    large = [_picture(name, CAPTIONS.get(name, f"the caustic in {name}"), pictures) for name in shown]
    views = [_picture(name, f"the {kind}, {caption}", pictures) for name, caption in VIEWS.items()]
    off = [_picture(name, f"{name}: SSIM {number(shown_ssim(entry), 3)}", pictures)
           for name, entry in found.items() if name not in (*shown, "as planned")]  # fmt: skip
    return {
        "Picture": (
            lay_out("note", numbers.get("warnings") or [])
            + lay_out("gallery", [each for each in large if each], "", "", True)
            + lay_out("workshop.quality", numbers)
        ),
        "Set-up": (
            Markup() if setup is None
            else sketch(setup, numbers["thickness"]) + lay_out("facts", setup_facts(setup))
        ),
        "Allowed errors of the set-up": lay_out("workshop.allowed", numbers.get("allowed_errors") or {}),
        "Solid": (
            lay_out("gallery", [each for each in views if each])
            + lay_out("workshop.solid", numbers, material(kind, numbers.get("ior")))
        ),
        "Deviations": lay_out("gallery", [each for each in off if each]) + lay_out("workshop.deviations", found),
    }  # fmt: skip


def shown_ssim(entry: Mapping[str, Any]) -> float:
    """Return the SSIM that the sheet shows. The SSIM refers to the original picture if that picture is known, otherwise
    to the target.
    """
    value = entry.get("ssim_of_picture")
    return float(entry["ssim"] if value is None else value)


def _picture(name: str, caption: str, pictures: Mapping[str, Array]) -> Any:
    image = pictures.get(name)
    return None if image is None else show(image, caption, caption)


def setup_facts(setup: Mapping[str, Any]) -> dict[str, str]:
    """Describe a set-up (`runs/workshop.py`) in words. Returns the descriptions by name."""
    lens, back = setup["kind"] == "lens", setup["lit_side"] == "back"
    side = "flat back" if lens and back else "relief"
    toward, normal = (np.array(setup[name], dtype=float) for name in ("light_direction", "receiver_normal"))
    way = np.array(setup["receiver"], dtype=float)
    parallel = setup["light_distance"] == "parallel"
    incidence, lean = _angle(np.abs(toward[2])), _angle(np.abs(normal @ way) / np.linalg.norm(way))
    where = "behind the receiver, through translucent material" if setup["through"] else (
        f"on the side of the {setup['kind']}"
    )  # fmt: skip
    return {
        "side towards the lamp": f"the {side}",
        "light": "parallel, such as the sun" if parallel else (
            f"a small lamp, {number(setup['light_distance'], 4)} mm from the {side}"
        ),
        "direction of the light": "perpendicular to the solid" if incidence < 0.05 else (
            f"{number(incidence, 3)}° from the perpendicular of the solid"
        ),
        "receiver": f"{number(setup['receiver_distance'], 4)} mm from the middle of the relief, " + (
            "perpendicular to the light that arrives" if lean < 0.05 else
            f"tilted by {number(lean, 3)}° against the light that arrives"
        ),
        "picture": " × ".join(number(size, 4) for size in setup["picture_size"]) + " mm on the receiver",
        "orientation": f"y of the files points to the top of the picture. It reads correctly for a viewer {where}.",
    }  # fmt: skip


def _angle(cosine: float) -> float:
    return float(np.degrees(np.arccos(min(1.0, float(cosine)))))


def material(kind: str, ior: float | None) -> dict[str, str]:
    """Return material and finish for the `kind` of solid, by name."""
    if kind == "mirror":
        return {
            "material": "any that can be polished",
            "finish": "Make the relief reflect like a mirror: polish it, or polish and coat it. A polish must not "
                      "round the relief.",
        }  # fmt: skip
    near = [] if ior is None else [name for name, index in MATERIALS.items() if abs(index - ior) <= NEAR]
    example = f", such as {near[0]}" if near else ""
    return {
        "material": "clear" if ior is None else f"clear, with an index of refraction of {number(ior, 4)}{example}",
        "finish": "Polish the relief and the back until they are clear. A polish must not round the relief.",
    }


# --- sketch of the set-up, as SVG, seen from above and to scale -------------------------------------------------------

#: Width of the sketch, its margin, and the largest height, in pixels.
WIDTH, MARGIN, MOST_HEIGHT = 640, 56, 420

#: A lamp farther away than this multiple of the receiver's distance is drawn at this multiple.
MOST_LAMP = 1.2


def sketch(setup: Mapping[str, Any], thickness: float) -> Markup:
    """Return the sketch of a `setup` (`runs/workshop.py`). Lengths are in mm.

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
