"""Perceptual errors: PSNR, SSIM and CIEDE2000 between images and targets.

Colours are linear sRGB (BT.709 primaries, D65), as in Mitsuba's RGB variants. Arrays are (..., 3).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.colorimetry import WHITE, adaptation, import_colour
from reslrb_cli.records.images import load_image
from reslrb_cli.report.tonemap import encode, shown_exposures

Array = np.ndarray[Any, Any]


def ciede2000(first: Array, second: Array) -> Array:
    """Return the CIEDE2000 differences between two arrays of colours. Colours are clipped to [0, 1] as on a screen.

    A difference of about 1 is just noticeable side by side, and a difference of about 10 at a glance.
    """
    labs = [to_lab(np.clip(values, 0.0, 1.0)) for values in (first, second)]
    return np.asarray(import_colour().delta_E(*labs, method="CIE 2000"))


def to_lab(values: Array) -> Array:
    """Convert linear sRGB to CIE L*a*b* under D65."""
    colour = import_colour()
    space = colour.RGB_COLOURSPACES["sRGB"]
    xyz = values.astype(np.float64) @ space.matrix_RGB_to_XYZ.T
    return np.asarray(colour.XYZ_to_Lab(xyz, space.whitepoint))


def _mean_and_max(differences: Array) -> dict[str, float]:
    """Return the mean and the maximum of `differences`, which must not be empty."""
    return {"mean": float(np.mean(differences)), "max": float(np.max(differences))}


#: Standard deviation and side length of the SSIM window in pixels, as in Wang et al. 2004.
SIGMA, WINDOW = 1.5, 11


def image_errors(
    image: Array, target: Array, exposure: float, adapted: Array | None = None, bands: int = 0
) -> dict[str, Any]:
    """Return the errors of an image (H, W, C) of linear values. Only colours that `target` has, too, count, without
    alpha. For CIEDE2000, colours are multiplied by the matrix `adapted`, which makes white surfaces white. The channels
    of a film with its own responses, such as those of a camera, are `bands`, and have no CIEDE2000.

    Image and target are multiplied by `exposure`, clipped to [0, 1] and encoded in sRGB, as on a screen. `psnr_db` is
    None if both look the same. `ssim` is None for images smaller than its window. `ciede2000` holds the mean and the
    maximum over the pixels. `not_finite` is the number of image pixels that are not finite. Pixels that are not finite
    are treated as black.
    """
    both = min(image.shape[2], target.shape[2])
    colors = min(bands, both) if bands else 3 if both >= 3 else 1
    bad = int(np.sum(~np.isfinite(image[:, :, :colors]).all(axis=2)))
    pair = [np.nan_to_num(array[:, :, :colors].astype(np.float64), posinf=0.0, neginf=0.0) for array in (image, target)]
    found: dict[str, Any] = {"not_finite": bad} if bad else {}
    shown = [encode(np.clip(array * exposure, 0.0, 1.0)) for array in pair]
    found |= {"psnr_db": psnr(*shown), "ssim": ssim(*shown)}
    if bands:
        return found
    # CIEDE2000 needs three channels, so grey is repeated.
    rgb = [np.broadcast_to(array * exposure, (*array.shape[:2], 3)) for array in pair]
    if adapted is not None:
        rgb = [array @ adapted.T for array in rgb]
    return found | {"ciede2000": _mean_and_max(ciede2000(*rgb))}


def psnr(first: Array, second: Array) -> float | None:
    """Return the peak signal-to-noise ratio in dB of values in [0, 1], or None if both arrays are equal."""
    from skimage.metrics import peak_signal_noise_ratio

    return None if np.array_equal(first, second) else float(peak_signal_noise_ratio(first, second, data_range=1.0))


def ssim(first: Array, second: Array) -> float | None:
    """Return the structural similarity (Wang et al. 2004) of values (H, W, C) in [0, 1]. Return None for images smaller
    than the window.
    """
    from skimage.metrics import structural_similarity

    if min(first.shape[:2]) < WINDOW:
        return None
    options = {"gaussian_weights": True, "sigma": SIGMA, "use_sample_covariance": False}
    return float(structural_similarity(first, second, channel_axis=2, data_range=1.0, **options))


def seen_errors(folder: Path, views: Sequence[Mapping[str, Any]] | None) -> dict[str, Any]:
    """Return the perceptual errors of the images of the run in `folder`, for `results.seen` in its manifest.

    Each sensor (`""`, `"-0"`, ...) has the `exposure` for viewing the target, and the `image_errors` of the `initial`
    and the `final` image. `views` comes from the run's manifest. Missing and damaged files are left out.
    """
    images = {}
    by_sensor = {f"-{view.get('sensor')}": view for view in views or ()}
    for suffix, exposure in shown_exposures(views).items():
        view = by_sensor[suffix] if suffix else (views or ())[0]
        adapted = adaptation(view["white"], WHITE) if "white" in view else None
        target = load_image(folder / "images" / f"target{suffix}.exr")
        if target is None:
            continue
        found: dict[str, Any] = {}
        for moment in ("initial", "final"):
            image = load_image(folder / "images" / f"{moment}{suffix}.exr")
            if image is not None and image.shape[:2] == target.shape[:2]:
                found[moment] = image_errors(image, target, exposure, adapted, len(view.get("channels") or ()))
        if found:
            images[suffix] = {"exposure": exposure} | found
    return images
