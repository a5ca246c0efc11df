"""Figures and pictures of the sheet for the workshop that makes a lens or a mirror (`report/page/workshop.py`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config.schema import Fabrication
from reslrb_cli.lens.solid import Sheet
from reslrb_cli.lens.workshop import allowed_errors, blacks, light_warnings, unlit_corners
from reslrb_cli.measure.tolerance import (
    DISTANCE,
    INDEX,
    TURN,
    OpticalBench,
    figures,
    picture_within,
    tolerances,
    where_light_goes,
)
from reslrb_cli.records.images import luminance
from reslrb_cli.runs.setup import setup_of
from reslrb_cli.scene.images import read_image

Array = np.ndarray[Any, Any]


def add_sheet(
    numbers: dict[str, Any],
    plan: Fabrication,
    scene: mi.Scene,
    sensor: int,
    sheets: Sequence[Sheet],
    thrown: Array,
    wanted: Array,
) -> dict[str, Array]:
    """Add quality, light, set-up and warnings of a solid to `numbers`. Returns the original picture and the caustic.

    `thrown` (H, W) is the luminance of the image of the sensor with index `sensor`. `wanted` (H, W) is the luminance of
    the sensor's target.
    """
    original = original_of(plan, wanted)
    numbers["thrown"] = figures(thrown, wanted)
    if original is not None:
        numbers["thrown"]["ssim_of_picture"] = figures(thrown, original)["ssim"]
    if {plan.faces[0], plan.receiver} <= {shape.id() for shape in scene.shapes()}:
        numbers["light"] = where_light_goes(scene, scene.sensors()[sensor], plan, wanted)
        numbers["setup"] = setup_of(scene, scene.sensors()[sensor], plan, sheets[0], wanted)
    shown = wanted if original is None else original
    inside = picture_within(wanted)
    numbers["blacks"] = blacks(thrown[inside], shown[inside])
    corners = unlit_corners(thrown[inside], shown[inside])
    numbers["warnings"] = numbers["warnings"] + light_warnings(numbers["blacks"], corners)
    return {"picture": as_picture(shown, shown, inside), "caustic": as_picture(thrown, shown, inside)}


def add_tolerances(
    numbers: dict[str, Any],
    bench: OpticalBench,
    sheets: Sequence[Sheet],
    planned: Array,
    wanted: Array,
    spp: int,
    say: Callable[[str], None],
) -> dict[str, Array]:
    """Add measured tolerances and allowed errors to `numbers`. Returns the picture of each deviation by name."""
    original, inside = original_of(bench.plan, wanted), picture_within(wanted)
    shown = wanted if original is None else original
    pictures: dict[str, Array] = {}

    def keep(name: str, image: Array) -> None:
        pictures[name] = as_picture(image, shown, inside)

    found = tolerances(bench, sheets, planned, wanted, spp, say, original, keep)
    setup = numbers.get("setup")
    deviations = {"turn": TURN, "index": INDEX}
    if setup is not None:
        deviations["distance"] = DISTANCE * setup["receiver_distance"]
    numbers["tolerances"] = found
    numbers["allowed_errors"] = allowed_errors(found, bench.plan.kind, deviations)
    return pictures


def original_of(plan: Fabrication, wanted: Array) -> Array | None:
    """Return the luminance (H, W) of the picture before its dark parts were raised. Return None if the picture is
    unknown, or does not have the size of `wanted`.
    """
    if plan.picture is None:
        return None
    picture = luminance(read_image(plan.picture))
    # Nonzero in the same rectangle as in the target.
    return np.where(wanted > 0, np.maximum(picture, 1e-9), 0) if picture.shape == wanted.shape else None


def as_picture(image: Array, original: Array, inside: tuple[slice, slice]) -> Array:
    """Crop an image (H, W) to the picture. Return the crop (H, W, 1), scaled to the mean brightness of the `original`.

    A value of 1 is the brightest part of the original.
    """
    seen, wanted = image[inside], original[inside]
    scaled = seen / max(float(seen.mean()), 1e-30) * (wanted.mean() / max(float(wanted.max()), 1e-30))
    return np.asarray(scaled, dtype=np.float32)[:, :, None]
