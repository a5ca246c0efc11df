"""Figures for a workshop: allowed errors, cutters for the relief, grey blacks, and unlit corners.

The functions are pure functions of arrays and numbers. Lengths are in mm, angles in degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Loss of SSIM that counts as still acceptable.
ALLOWED_LOSS = 0.05

#: Errors that a careful workshop keeps: distance in mm, rotations in degrees, index of refraction.
TOLERANCES = {"distance": 1.0, "light turned": 0.5, "solid turned": 0.5, "index": 0.002}

#: Share of the face that the largest ball must reach.
REACHED = 0.99

#: Height of the scallops between two passes of the tool, in mm.
SCALLOP = 0.005

#: Share of the darkest pixels of a picture, and the brightness up to which they count as black, in means.
DARKEST, BLACK = 0.05, 0.2

#: Brightness in means by which black may be brighter than in the picture.
GREY = 0.05

#: Side of a corner as a fraction of the picture, and the least share of its light. Darker corners count as black.
CORNER, LIT = 0.1, 0.5


def largest_ball_radius(curvature: Array) -> float | None:
    """Return the largest radius (mm) of a ball that fits into the hollows of 99 % of a face, or None if any ball fits.

    `curvature` (n,) is the larger principal curvature at each vertex in 1/mm, positive in hollows. The function
    considers only curvature. A ball may still not reach a narrow gap between ridges.
    """
    if not curvature.size:
        return None
    sharp = float(np.quantile(curvature, REACHED, method="higher"))
    return 1 / sharp if sharp > 1e-9 else None


def stepover(radius: float, scallop: float = SCALLOP) -> float:
    """Return the distance (mm) between passes of a ball with this `radius`. The passes leave scallops of the height
    `scallop` (mm).
    """
    height = min(scallop, radius)
    return float(2 * np.sqrt(2 * radius * height - height**2))


def cutter(curvature: Array, radius: float | None) -> dict[str, float | None]:
    """Return the largest radius of a ball cutter for a face, and the step between passes of the cutter, in mm.

    `radius` is the radius of the cutter. If `radius` is None, the largest radius is used. `curvature` is as in
    `largest_ball_radius`.
    """
    largest = largest_ball_radius(curvature)
    used = largest if radius is None else radius
    step = None if used is None else stepover(used)
    return {"largest_radius": largest, "radius": used, "stepover": step, "scallop": SCALLOP}


def allowed_errors(
    found: Mapping[str, Mapping[str, Any]], kind: str, deviations: Mapping[str, float]
) -> dict[str, dict[str, Any]]:
    """Return the deviation at which SSIM has fallen by `ALLOWED_LOSS`, for each measured kind of deviation.

    `found` holds the figures of each image, by image name, as returned by `tolerances`. `kind` is `lens` or `mirror`.
    `deviations` are the measured amounts: `distance` in mm, `index`, and `turn` in degrees. The result has the keys of
    `TOLERANCES`.

    Each entry has the `value`, its `unit` and the stated `tolerance`. `at_least` is true if SSIM falls by less than
    `ALLOWED_LOSS` even at the measured deviation. `passes` tells whether the tolerance is met. `passes` is None if the
    answer is unknown. The answer is unknown if the measured deviation is below the tolerance and SSIM falls by less
    than `ALLOWED_LOSS`.
    """
    planned = found.get("as planned")
    if planned is None:
        return {}
    kinds = {
        "distance": ("distance ", "mm", deviations.get("distance")),
        "light turned": ("light turned", "degrees", deviations["turn"]),
        "solid turned": (f"{kind} turned", "degrees", deviations["turn"]),
        "index": ("index ", "", deviations["index"]),
    }
    allowed = {}
    for name, (prefix, unit, deviation) in kinds.items():
        entries = [entry for key, entry in found.items() if key.startswith(prefix)]
        if entries and deviation:
            fall = max(shown_ssim(planned) - shown_ssim(entry) for entry in entries)
            value, tolerance = allowed_error(fall, deviation), TOLERANCES[name]
            at_least = fall < ALLOWED_LOSS
            passes = None if at_least and value < tolerance else value >= tolerance
            allowed[name] = {"value": value, "unit": unit, "tolerance": tolerance, "at_least": at_least,
                             "passes": passes}  # fmt: skip
    return allowed


def allowed_error(fall: float, deviation: float) -> float:
    """Return the deviation at which SSIM has fallen by `ALLOWED_LOSS`, at most `deviation`.

    The function assumes that SSIM falls linearly, and that SSIM has fallen by `fall` at `deviation`. Nothing larger was
    measured.
    """
    return deviation * min(1.0, ALLOWED_LOSS / fall) if fall > 0 else deviation


def shown_ssim(entry: Mapping[str, Any]) -> float:
    """Return the SSIM that the sheet shows. The SSIM refers to the original picture if that picture is known, otherwise
    to the target.
    """
    value = entry.get("ssim_of_picture")
    return float(entry["ssim"] if value is None else value)


def blacks(image: Array, picture: Array) -> dict[str, float]:
    """Return the mean brightness of the darkest 5 % of a `picture` (H, W). Also return the mean brightness of the same
    pixels of an `image`.

    Both images are divided by their means.
    """
    seen, wanted = (each / max(float(each.mean()), 1e-30) for each in (image, picture))
    dark = wanted <= np.quantile(wanted, DARKEST)
    return {"image": float(seen[dark].mean()), "picture": float(wanted[dark].mean())}


def unlit_corners(image: Array, picture: Array) -> list[str]:
    """Return the names of the corners in which an `image` (H, W) has less than half the light of the `picture` (H, W).

    A corner spans a tenth of the width and a tenth of the height. Both images are divided by their means. Black corners
    of the picture do not count.
    """
    seen, wanted = (each / max(float(each.mean()), 1e-30) for each in (image, picture))
    height, width = (max(1, round(CORNER * size)) for size in picture.shape)
    rows = {"top": slice(None, height), "bottom": slice(-height, None)}
    columns = {"left": slice(None, width), "right": slice(-width, None)}
    return [
        f"{row} {column}"
        for row, of_row in rows.items()
        for column, of_column in columns.items()
        if (light := float(wanted[of_row, of_column].mean())) > GREY
        and float(seen[of_row, of_column].mean()) < LIT * light
    ]


def light_warnings(dark: Mapping[str, float], corners: list[str]) -> list[str]:
    """Return a warning sentence if black comes out grey. Return another sentence if `corners` are unlit. `dark` is a
    result of `blacks`.
    """
    lines = []
    if dark["picture"] <= BLACK and dark["image"] > dark["picture"] + GREY:
        lines.append(f"Black parts of the picture come out at {100 * dark['image']:.0f} % of the mean brightness "
                     f"({100 * dark['picture']:.0f} % in the picture), so they look grey")  # fmt: skip
    if corners:
        named = ", ".join(corners[:-1]) + " and " + corners[-1] if len(corners) > 1 else corners[0]
        lines.append(f"The {named} corner{'s' if len(corners) > 1 else ''} of the picture "
                     f"get{'' if len(corners) > 1 else 's'} less than half of {'their' if len(corners) > 1 else 'its'} "
                     "light")  # fmt: skip
    return lines
