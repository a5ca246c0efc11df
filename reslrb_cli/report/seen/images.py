"""The error of an image against its target, as a person sees it."""

from __future__ import annotations

from typing import Any

import numpy as np

from reslrb_cli.report.seen.difference import Array, ciede2000, itp, told
from reslrb_cli.report.seen.flip import flip_map
from reslrb_cli.report.tone import encode

#: Standard deviation of SSIM's window in pixels, and the sides of it, as Wang et al. have them.
SIGMA, WINDOW = 1.5, 11


def image_errors(image: Array, target: Array, exposure: float, flip: bool = False) -> dict[str, Any]:
    """Errors of an image (H, W, C) of linear values; what `target` lacks of its channels is left out, alpha too.

    `psnr_db` (None where both look the same) and `ssim` (None for images smaller than its window) are of both times
    `exposure` as a screen shows them, in sRGB and clipped, as is `ciede2000`; `itp` is of both times `exposure`, not
    clipped; `absolute` of |I - T| as it is, the mean over the channels; `flip` (if asked for) is HDR-FLIP. Each but
    the first two is told by mean, percentiles over the pixels, and maximum. `not_finite` counts the pixels of the image
    that are not finite; they are taken for black.
    """
    colors = 3 if min(image.shape[2], target.shape[2]) >= 3 else 1
    bad = int(np.sum(~np.isfinite(image[:, :, :colors]).all(axis=2)))
    pair = [np.nan_to_num(array[:, :, :colors].astype(np.float64), posinf=0.0, neginf=0.0) for array in (image, target)]
    found: dict[str, Any] = {"not_finite": bad} if bad else {}
    shown = [encode(np.clip(array * exposure, 0.0, 1.0)) for array in pair]
    found |= {"psnr_db": psnr(*shown), "ssim": ssim(*shown)}
    # Grey is a colour, too: three channels alike.
    rgb = [np.broadcast_to(array * exposure, (*array.shape[:2], 3)) for array in pair]
    found["ciede2000"] = told(ciede2000(*rgb))
    found["itp"] = told(itp(*rgb))
    found["absolute"] = told(np.abs(pair[0] - pair[1]).mean(axis=2))
    if flip:
        error = flip_map(*(np.broadcast_to(array, (*array.shape[:2], 3)) for array in pair))
        found["flip"] = None if error is None else told(error)
    return found


def psnr(first: Array, second: Array) -> float | None:
    """The peak signal-to-noise ratio in dB of values from 0 to 1; None where they are the same, and it is infinite."""
    from skimage.metrics import peak_signal_noise_ratio

    return None if np.array_equal(first, second) else float(peak_signal_noise_ratio(first, second, data_range=1.0))


def ssim(first: Array, second: Array) -> float | None:
    """The structural similarity (Wang et al. 2004) of values (H, W, C) from 0 to 1; None for less than a window."""
    from skimage.metrics import structural_similarity

    if min(first.shape[:2]) < WINDOW:
        return None
    options = {"gaussian_weights": True, "sigma": SIGMA, "use_sample_covariance": False}
    return float(structural_similarity(first, second, channel_axis=2, data_range=1.0, **options))
