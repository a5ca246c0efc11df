"""Errors as people see them: of images against their targets, and of recovered colours.

Colours are linear sRGB (BT.709 primaries, D65), as Mitsuba's RGB variants have them. Arrays are (..., 3).
HDR-FLIP tells how an error strikes someone who flips between two images, at all exposures that show something; its
package `flip-evaluator` is an extra: `pip install reslrb[flip]`.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.optimization.errors import comparison_grid, nearest, on_grid
from reslrb_cli.records.images import load_image, read_mask, read_parameters
from reslrb_cli.report.sources import Run, Source
from reslrb_cli.report.tonemap import encode, exposure_for, shown_exposures

Array = np.ndarray[Any, Any]

#: Luminance of a linear value of 1 in cd/m², for what needs absolute units: the reference white of ITU-R BT.2408.
WHITE = 203.0

#: Percentiles that are told.
PERCENTILES = (50, 95, 99)


def ciede2000(first: Array, second: Array) -> Array:
    """CIEDE2000 between colours of surfaces, or of a picture as a screen shows it: clipped to [0, 1].

    Some 1 is just noticeable side by side, some 10 at a glance.
    """
    return ciede2000_of_lab(*(to_lab(np.clip(values, 0.0, 1.0)) for values in (first, second)))


def ciede2000_of_lab(first: Array, second: Array) -> Array:
    """The same of CIE L*a*b* colours."""
    return np.asarray(_colour().delta_E(first, second, method="CIE 2000"))


def to_lab(values: Array) -> Array:
    """CIE L*a*b* under D65, the white of linear sRGB."""
    colour = _colour()
    space = colour.RGB_COLOURSPACES["sRGB"]
    xyz = values.astype(np.float64) @ space.matrix_RGB_to_XYZ.T
    return np.asarray(colour.XYZ_to_Lab(xyz, space.whitepoint))


def itp(first: Array, second: Array) -> Array:
    """ΔE_ITP (ITU-R BT.2124), for high dynamic range: nothing is clipped but what is negative, or beyond 10,000 cd/m².

    A value of 1 is taken for `WHITE`. 1 is just noticeable to the most critical eye.
    """
    colour = _colour()
    to_bt2020 = colour.matrix_RGB_to_RGB("sRGB", "ITU-R BT.2020")
    light = [np.clip(WHITE * (values.astype(np.float64) @ to_bt2020.T), 0.0, 1e4) for values in (first, second)]
    return np.asarray(colour.delta_E(*map(colour.RGB_to_ICtCp, light), method="ITP"))


def told(values: Array) -> dict[str, float]:
    """`mean`, the percentiles as `p50` and so on, and `max` of differences, of at least one."""
    shares = zip(PERCENTILES, np.percentile(values, PERCENTILES), strict=True)
    between = {f"p{share}": float(value) for share, value in shares}
    return {"mean": float(np.mean(values)), **between, "max": float(np.max(values))}


def _colour() -> Any:
    """The package, which takes a second to be imported, and warns then of packages that nothing here needs."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour


#: Parameters of three numbers that are no colours to look at.
NO_COLORS = ("eta", "k")

#: What is no light and no colour, but where something is.
PLACES = ("length", "degrees", "scale")


def is_color(key: str, quantity: str) -> bool:
    """Whether three channels of a parameter are those of a colour."""
    return quantity not in PLACES and not any(part in NO_COLORS for part in key.split(".")[-2:])


def color_errors(moments: Mapping[str, Array], true: Array, mask: Array | None, quantity: str) -> dict[str, Any]:
    """Differences of a parameter's colours at each of `moments` from the true ones, over the entries in `mask`.

    Arrays are colours (3,) or textures (H, W, 3); where resolutions differ, they are compared on the finer grid.
    What surfaces reflect (`quantity` is empty) is told in CIEDE2000, what lamps emit in ΔE_ITP, at an `exposure` that
    shows it. Empty where these are no such arrays, or the mask is.
    """
    found: dict[str, Any] = {}
    target = _texture(true)
    if target is None:
        return {}
    exposure = exposure_for(target) if quantity else 1.0
    for moment, value in moments.items():
        texture = _texture(value)
        if texture is not None and value.ndim == true.ndim:
            pair = _entries(texture, target, mask)
            if pair[0].size:
                difference = itp(*(exposure * array for array in pair)) if quantity else ciede2000(*pair)
                found[moment] = told(difference)
    return {"measure": "itp" if quantity else "ciede2000", "exposure": exposure} | found if found else {}


def _texture(array: Array) -> Array | None:
    """Colours (3,) or (H, W, 3) as (H, W, 3); None for anything else."""
    array = array.reshape(1, 1, 3) if array.shape == (3,) else array
    return array if array.ndim == 3 and array.shape[2] == 3 else None


def _entries(value: Array, true: Array, mask: Array | None) -> tuple[Array, Array]:
    """The colours (N, 3) to be compared, of both."""
    grid = comparison_grid(value.shape, true.shape)
    if mask is None or mask.shape != value.shape[:2]:
        mask = np.ones(value.shape[:2], dtype=bool)
    if grid is not None:
        value, true, mask = on_grid(value, grid), on_grid(true, grid), nearest(mask, grid)
    return np.nan_to_num(value[mask]), np.nan_to_num(true[mask])


MISSING = "HDR-FLIP was not measured: its package is not installed (`pip install reslrb[flip]`)"

#: Exposures at most. FLIP takes one a stop between what shows the brightest pixel and what shows the median one.
MOST_EXPOSURES = 8

#: Luminance of linear sRGB, as FLIP has it.
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

#: The ACES curve (a x² + b x + c) / (d x² + e x + f) that FLIP takes for its tone mapper, and the output that counts as
#: bright.
_ACES, _BRIGHT = np.array([0.36 * 2.51, 0.6 * 0.03, 0.0, 0.36 * 2.43, 0.6 * 0.59, 0.14]), 0.85


def is_installed() -> bool:
    """Whether the package can be imported."""
    try:
        import flip_evaluator  # noqa: F401
    except ImportError:
        return False
    return True


def flip_map(image: Array, target: Array) -> Array | None:
    """The error (H, W), from 0 to 1, of an image against its target, both linear (H, W, 3).

    None for a black target, which no exposure shows. Seen at FLIP's usual distance, 67 pixels a degree.
    """
    import flip_evaluator

    # The package ends the process where it does not like its input: it is given what it takes, exposures too.
    exposures = find_exposures(target)
    if exposures is None:
        return None
    low, high = exposures
    options = {"startExposure": low, "stopExposure": high, "numExposures": max(2, math.ceil(high - low))}
    pair = [np.ascontiguousarray(np.clip(np.nan_to_num(a), 0.0, 1e30), dtype=np.float32) for a in (target, image)]
    error, _, _ = flip_evaluator.evaluate(*pair, "HDR", applyMagma=False, computeMeanError=False, parameters=options)
    return np.asarray(error)[:, :, 0]


def find_exposures(target: Array) -> tuple[float, float] | None:
    """The first and the last exposure in stops, as FLIP chooses them, of a target (H, W, 3); None for a black one.

    Where most of the image is black the median is taken of the rest: FLIP's own would be infinite.
    """
    light = np.nan_to_num(target.astype(np.float64)) @ _LUMINANCE
    shown = light[light > 0]
    if not shown.size:
        return None
    median = float(np.median(light)) or float(np.median(shown))
    a, b, c = _ACES[:3] - _BRIGHT * _ACES[3:]
    bright = -0.5 * b / a + math.sqrt((0.5 * b / a) ** 2 - c / a)
    low, high = (math.log2(bright / max(level, 1e-30)) for level in (float(shown.max()), median))
    return low, min(max(high, low + 1.0), low + MOST_EXPOSURES)


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


_TARGET = re.compile(r"target(-\d+)?\.exr")
MOMENTS = ("initial", "final")


def seen_errors(
    folder: Path, results: Mapping[str, Any], views: Sequence[Mapping[str, Any]] | None = None
) -> dict[str, Any]:
    """What the manifest of the run in `folder` says of errors as people see them; empty where nothing can be compared.

    `images` has, by sensor (`""`, `"-0"`, ...), the `exposure` that the target is shown with, and `image_errors` of the
    `initial` and the `final` image. HDR-FLIP is of the final one, which takes seconds for a large image; where its
    package is missing, `note` says so. `colors` has, by key, `color_errors` of the colours whose true value is known;
    `results` is what the manifest says of them, and `views` of the views. What is missing in the folder or damaged is
    left out.
    """
    images, exposures = {}, shown_exposures(views)
    for path in sorted((folder / "images").glob("target*.exr")):
        match, target = _TARGET.fullmatch(path.name), load_image(path)
        if match is None or target is None:
            continue
        suffix = match[1] or ""
        exposure = exposures.get(suffix) or exposure_for(target)
        found: dict[str, Any] = {}
        for moment in MOMENTS:
            image = load_image(folder / "images" / f"{moment}{suffix}.exr")
            if image is not None and image.shape[:2] == target.shape[:2]:
                with_flip = moment == "final" and is_installed()
                found[moment] = image_errors(image, target, exposure, with_flip)
        if found:
            images[suffix] = {"exposure": exposure} | found
    colors = _colors(folder / "parameters", results)
    if not images and not colors:
        return {}
    note = "" if is_installed() or not any("final" in about for about in images.values()) else MISSING
    return {"images": images, "colors": colors, "note": note}


def _colors(folder: Path, results: Mapping[str, Any]) -> dict[str, Any]:
    true = read_parameters(folder / "true")
    found: dict[str, Any] = {}
    moments = {"initial": read_parameters(folder / "initial"), "final": read_parameters(folder)}
    for key, about in (results.get("parameters") or {}).items():
        quantity = about.get("quantity") or ""
        if key in true and is_color(key, quantity):
            values = {moment: arrays[key] for moment, arrays in moments.items() if key in arrays}
            errors = color_errors(values, true[key], read_mask(folder, key), quantity)
            found |= {key: errors} if errors else {}
    return found


def with_seen_errors(source: Source) -> Source:
    """The same, with those errors among its results where it is a run that can have them and does not."""
    if not isinstance(source, Run) or "seen" in source.results:
        return source
    try:
        found = seen_errors(source.path, source.results, source.manifest.get("views"))
    except Exception:  # what lies in the folder is damaged, in a way that nobody thought of; the page goes on without
        return source
    results = {**source.results, "seen": found}
    return replace(source, manifest={**source.manifest, "results": results}) if found else source
