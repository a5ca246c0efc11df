"""Sheet for the workshop that makes a lens or a mirror: pictures, set-up, allowed errors, solid, tool and material."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from reslrb_cli.glasses import GLASSES
from reslrb_cli.report.format import number
from reslrb_cli.report.page.images import show
from reslrb_cli.report.page.layout import document, lay_out

Array = np.ndarray[Any, Any]

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
    off = [_picture(name, f"{name}: SSIM {number(entry['ssim'], 3)}", pictures)
           for name, entry in found.items() if name not in (*shown, "as planned")]  # fmt: skip
    return {
        "Picture": (
            lay_out("note", numbers.get("warnings") or [])
            + lay_out("gallery", [each for each in large if each], "", "", True)
            + lay_out("workshop.quality", numbers)
        ),
        "Set-up": Markup() if setup is None else lay_out("facts", setup_facts(setup)),
        "Allowed errors of the set-up": lay_out("workshop.allowed", numbers.get("allowed_errors") or {}),
        "Solid": (
            lay_out("gallery", [each for each in views if each])
            + lay_out("workshop.solid", numbers, material(kind, numbers.get("ior"), numbers.get("glass")))
        ),
        "Deviations": lay_out("gallery", [each for each in off if each]) + lay_out("workshop.deviations", found),
    }  # fmt: skip


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


def material(kind: str, ior: float | None, glass: str | None = None) -> dict[str, str]:
    """Return material and finish for the `kind` of solid, by name. `glass` is the name of the material, if known."""
    if kind == "mirror":
        return {
            "material": "any that can be polished",
            "finish": "Make the relief reflect like a mirror: polish it, or polish and coat it. A polish must not "
                      "round the relief.",
        }  # fmt: skip
    near = [] if ior is None else [name for name, known in GLASSES.items() if abs(known.nd - ior) <= NEAR]
    example = f", such as {near[0]}" if near and glass is None else ""
    clear = "clear" if ior is None else f"clear, with an index of refraction of {number(ior, 4)}{example}"
    return {
        "material": clear if glass is None else f"{glass}, {clear}",
        "finish": "Polish the relief and the back until they are clear. A polish must not round the relief.",
    }
