"""Target images, and the pixels that a view's loss excludes.

Excluded pixels are counted for each kind of exclusion. All other pixels have weights (`mask_of`). Images are read from
files, or rendered with the true values of the parameters (`make_targets`).
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from dataclasses import replace

import mitsuba as mi
import numpy as np

from reslrb_cli.colorimetry import WHITE, adaptation, illuminant
from reslrb_cli.config.schema import Config
from reslrb_cli.config.views import WhiteBalance
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.loading import (
    are_upright,
    check_integrator,
    load_configured,
    make_configured,
    paths_of,
    render_in_passes,
)
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.views import Array, Masked, View, color_channels, own_channels
from reslrb_cli.records.images import luminance
from reslrb_cli.scene.images import Photo, photo_lines, read_photo
from reslrb_cli.scene.needs import scene_needs
from reslrb_cli.scene.parameters import Selection, set_values
from reslrb_cli.scene.rays import visible
from reslrb_cli.scene.response import LINEAR, SRGB
from reslrb_cli.scene.values import resample
from reslrb_cli.scene.visibility import interior, sees_even_lamps, sees_specular, spread, widened
from reslrb_cli.transport.film import FINE, responses_of

#: The seed of rendered targets.
TARGET_SEED = 0
#: Remarks on views that are shown in full.
FEW_REMARKS = 2
#: Light of a decoded file, 1 at white, from which a pixel of a lamp counts as near white. Film curves show a lamp of 10
#: times middle grey at 0.64 (Reinhard), 0.68 (Hable), 0.72 (AgX, Reinhard with white), 0.80 (Hejl) and 0.90 (ACES).
NEAR_WHITE = 0.6
#: Width in pixels of a lamp's edge.
EDGE = 2
#: Descriptions of pixels of each kind.
WORDS = {
    "specular": "show smooth glass or mirrors",
    "border": "are at the film's border",
    "clipped": "are clipped",
    "beside": "are within the film's filter of clipped ones",
    "lamps": "show lamps near white",
    "alpha": "have alpha 0",
    "nonfinite": "are not finite",
    "file": "have weight 0 in the mask's file",
}


def mask_of(config: Config, view: View, scene: mi.Scene, photo: Photo | None, lacking: bool) -> Masked:
    """Find the pixels of a view that its mask excludes.

    `photo` is the file of the target, or None for a rendered target. `lacking` is true if only the target or only the
    image contains the light that light paths cannot find. Raises ConfigError for an invalid weights file.
    """
    mask, sensor, found = view.mask, scene.sensors()[view.sensor], Masked()
    width, height = (int(n) for n in sensor.film().crop_size())
    if lacking:
        if "specular" in mask.kinds:
            found.left_out["specular"] = sees_specular(scene, sensor)
        if "border" in mask.kinds:
            found.left_out["border"] = ~interior((height, width), sensor)
    if photo is not None:
        if "clipped" in mask.kinds:
            # The image contains the filter's spread of the lamp itself; the file, that of a lamp clipped to white.
            # Beside a lamp 45 times as bright as white, the file is half as bright as it should be.
            found.left_out["clipped"] = photo.clipped
            found.left_out["beside"] = spread(photo.clipped, sensor) & ~photo.clipped
            response = view.decoded_by or SRGB
            if photo.is_integer and not response.is_linear and response.curve is None:
                known = found.left_out["clipped"] | found.left_out["beside"]
                found.left_out["lamps"] = _compressed_lamps(scene, sensor, photo.image) & ~known
        if "alpha" in mask.kinds:
            found.left_out["alpha"] = photo.transparent
        found.left_out["nonfinite"] = photo.nonfinite
    if mask.file is not None:
        try:
            weights = read_photo(mask.file, LINEAR, (width, height), are_upright(config))
            found.weights = weights.image.mean(axis=2)
        except ConfigError as error:
            raise ConfigError(config.source, f"{view.mask_key}.file", str(error)) from None
        found.left_out["file"] = found.weights == 0
    return found


def _compressed_lamps(scene: mi.Scene, sensor: mi.Sensor, image: Array) -> Array:
    """Return the pixels, boolean (H, W), of lamps that a film curve may have compressed below white. `image` (H, W, C)
    is a file of integers, decoded.

    The edges of a lamp count if the lamp is near white.
    """
    bright = image.max(axis=2) >= NEAR_WHITE
    if not bright.any():
        return np.zeros_like(bright)
    lamps = sees_even_lamps(scene, sensor)
    return lamps & widened(lamps & bright, EDGE)


def mask_line(name: str, masked: Masked, weights: Array) -> str | None:
    """Return a line for the user about a view's mask. Return None if no pixel is excluded or weighted."""
    counts = masked.counts()
    if not counts and masked.weights is None:
        return None
    left, total = int((weights == 0).sum()), weights.size
    parts = [f"{count} {WORDS[kind]}" for kind, count in counts.items()]
    line = f"{name}: {left} of {total} pixels ({left / total:.1%}) are left out"
    return line + (f": {', '.join(parts)}" if parts else "")


def multiple_of(spp: int, unit: int | None) -> int:
    """Return the greatest multiple of `unit` that is at most `spp`, but at least `unit`."""
    unit = unit or 1
    return max(spp // unit, 1) * unit


def with_short_target(config: Config, most: int) -> Config:
    """Return the experiment with at most `most` samples per pixel for a rendered target, or with one pass of more."""
    render = config.target.render
    if render is None:
        return config
    spp = min(render.spp, multiple_of(most, (render.integrator or config.integrator).options().get("samples_per_pass")))
    target = config.target.model_copy(update={"render": render.model_copy(update={"spp": spp})})
    return config.model_copy(update={"target": target})


def make_targets(problem: Problem, say: Callable[[str], None]) -> Problem:
    """Read or render every view's target. Returns the problem with `truth` set to the true values of rendered targets.

    `say` is called with lines about slow work and excluded pixels. Raises ConfigError.
    """
    config, upright = problem.config, are_upright(problem.config)
    remarks: list[str] = []
    if (balance := config.target.white_balance) is not None:
        say(f"white balance: colours are adapted from {balance.photograph or 'white'} to {balance.scene}")
    for view in problem.views:
        film = problem.scene.sensors()[view.sensor].film()
        if view.file is None:
            continue
        size, response = (int(film.crop_size()[0]), int(film.crop_size()[1])), view.decoded_by
        try:
            # Pure spectral colours are outside of sRGB, and have negative channels.
            photo = read_photo(
                view.file, response, size, upright, nonfinite=True, signed=mi.is_spectral,
                channels=own_channels(film),
            )  # fmt: skip
        except ConfigError as error:
            raise ConfigError(config.source, view.file_key, str(error)) from None
        remarks += photo_lines(view.file, upright, response)
        image = photo.image
        if balance is not None:
            image = (image @ _adapted(balance, film).T).astype(np.float32)
            image = image if mi.is_spectral else np.maximum(image, 0)  # a few saturated colours are outside of sRGB
        _see(problem, view, image, photo, remarks.append)
    _say_few(remarks, say)
    if problem.config.target.render is not None:
        problem = replace(problem, truth=_render_targets(problem, say))
        gc.collect()  # a second scene takes part in all tracing until it is freed
    elif problem.config.target.truth:
        true_scene = load_configured(config)
        problem = replace(
            problem, truth=_truth(problem, set_values(true_scene, config.parameters, {}, config.source, ""), say)
        )
        del true_scene
        gc.collect()
    if problem.config.own_scene is not None:  # the scene of the true values
        problem.config.own_scene.restore()
        problem.apply()
    _check_light(problem, say)
    return problem


def _adapted(balance: WhiteBalance, film: mi.Film) -> Array:
    """Return the matrix (C, C) by which colours of a photograph become colours under the lamps of the scene."""
    responses = responses_of(film) if own_channels(film) else None
    if responses is None:
        return adaptation(balance.photograph or WHITE, balance.scene)
    # The channels of a camera have factors. A camera that balances colours keeps the channel with most light.
    wavelengths = visible(FINE)
    by_channel = np.array(responses, np.float64).reshape(-1, wavelengths.size)
    scene = by_channel @ illuminant(balance.scene, wavelengths)
    shown = by_channel @ illuminant(balance.photograph, wavelengths) if balance.photograph else scene.max()
    return np.diag(scene / shown)


def _say_few(remarks: Sequence[str], say: Callable[[str], None]) -> None:
    """Pass remarks on views to `say`. If there are many remarks, pass only the first ones and the number of the
    remaining remarks.
    """
    for line in remarks[:FEW_REMARKS]:
        say(line)
    if len(remarks) > FEW_REMARKS:
        say(f"{len(remarks) - FEW_REMARKS} more remarks of this kind on other views; the page lists the masks")


def _check_light(problem: Problem, say: Callable[[str], None]) -> None:
    """Raise ConfigError if all targets are black. If only some targets are black, report their sensors through
    `say`.
    """
    black = [view.sensor for view in problem.views if not np.any(np.array(view.target))]
    if not black:
        return
    which = f"sensor{'s' * (len(black) > 1)} {', '.join(map(str, black))}"
    if len(black) == len(problem.views):
        render = problem.config.target.render
        said = "; `reslrb inspect` lists the visible objects"
        why = "" if render is None else f": no light arrives there in {render.spp} spp{said}"
        raise ConfigError(problem.config.source, "target", f"the image of {which} is black everywhere{why}")
    say(f"the target of {which} is black everywhere")


def _see(problem: Problem, view: View, image: Array, photo: Photo | None, say: Callable[[str], None]) -> None:
    """Set a view's target (H, W, C) and mask. `photo` is the file that was read, if any."""
    config = problem.config
    colors = color_channels(problem.scene.sensors()[view.sensor].film())
    if colors == 1 and image.shape[2] >= 3:
        image = luminance(image)[:, :, None].astype(np.float32)
    target = image[:, :, :colors]
    render, made_of = config.target.render, "camera"  # a photograph has all light
    if photo is None and render is not None:
        made_of = paths_of(render.integrator or config.integrator, problem.scene, problem.sensors, problem.moves)
    # Light paths miss light that other paths have.
    lacking = (made_of == "light") != (problem.paths == "light")
    view.masked = mask_of(config, view, problem.scene, photo, lacking)
    weights = view.masked.total(target.shape[:2])
    line = mask_line(f"view {view.sensor}", view.masked, weights)
    if not weights.any():
        advice = "leave out fewer kinds, as in {kinds: [border]}, or set it to none"
        raise ConfigError(config.source, view.mask_key, f"leaves no pixel to compare ({line}); {advice}")
    masked = "specular" in view.masked.left_out
    if masked and problem.moves and scene_needs(problem.scene, problem.scene.sensors()[view.sensor]).has_delta_lobes:
        others = {kind: pixels for kind, pixels in view.masked.left_out.items() if kind != "specular"}
        view.fixed = replace(view.masked, left_out=others).total(target.shape[:2])
        line = f"{line or f'view {view.sensor}'}; each iteration leaves out the current pixels of glass and mirrors"
    if line is not None:
        say(line)
    view.see(target, weights)


def _render_targets(problem: Problem, say: Callable[[str], None]) -> dict[str, Array]:
    """Render the targets of views without a file. Returns the parameters' true values."""
    config, render = problem.config, problem.config.target.render
    assert render is not None, "requires rendered targets"
    true_scene = load_configured(config)
    key = "target.render.parameters"
    truth = _truth(problem, set_values(true_scene, config.parameters, render.parameters, config.source, key), say)
    chosen = render.integrator or config.integrator
    check_integrator(config, chosen, true_scene, problem.sensors, problem.moves)
    paths = paths_of(chosen, true_scene, problem.sensors, problem.moves)
    integrator = make_configured(config, chosen, paths, true_scene)
    multiple = chosen.options().get("samples_per_pass")
    rendered = [view for view in problem.views if view.file is None]
    if rendered:
        images = "the target image" if len(rendered) == 1 else f"{len(rendered)} target images"
        say(f"rendering {images}: {render.spp} samples per pixel")
    remarks: list[str] = []
    for view in rendered:
        image = render_in_passes(integrator, true_scene, view.sensor, render.spp, TARGET_SEED, 0, "target", multiple)
        _see(problem, view, image, None, remarks.append)
    _say_few(remarks, say)
    return truth


def _truth(problem: Problem, true_values: Selection, say: Callable[[str], None]) -> dict[str, Array]:
    """Return the parameters' true values, with textures in the resolution of the parameters."""
    truth: dict[str, Array] = {}
    for key in problem.selection.keys:
        shape = problem.selection.array(key).shape
        if key in problem.selection.factors:  # the target is an image of the scene itself
            truth[key] = np.ones(shape, np.float32)
            continue
        truth[key] = true_values.array(key)
        if len(shape) == 3 and truth[key].shape[:2] != shape[:2]:
            say(f"the true value of {key} is resampled to its resolution, {shape[1]}x{shape[0]}")
            truth[key] = resample(truth[key], (shape[1], shape[0]))
    return truth
