"""The images that views are to see: read from files, or rendered with the true values of the parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np

from reslrb_cli.config import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.errors import comparison_grid
from reslrb_cli.optimization.loading import check_integrator, load_configured, make_configured
from reslrb_cli.optimization.rendering import render_in_passes
from reslrb_cli.optimization.views import to_tensor
from reslrb_cli.scene import Selection, read_image, set_values

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

Array = np.ndarray[Any, Any]

#: Weights of linear sRGB in luminance, as Mitsuba has them.
LUMINANCE = np.array([0.212671, 0.715160, 0.072169], dtype=np.float32)


def make_targets(problem: Problem, say: Callable[[str], None]) -> None:
    """Read or render every view's target, and with it what is known of the parameters, `problem.truth`.

    `say` is told what takes long. Raises ConfigError.
    """
    if problem.config.target.render is not None:
        _render_targets(problem, say)
        return
    for index, view in enumerate(problem.views):
        view.made = _fit(problem, _read_target(problem, index), view.sensor)


def _render_targets(problem: Problem, say: Callable[[str], None]) -> None:
    config, render = problem.config, problem.config.target.render
    assert render is not None, "called for rendered targets only"
    true_scene = load_configured(config)
    true_values = set_true_values(config, true_scene)
    for key in problem.selection.keys:
        problem.truth[key] = true_values.array(key)
        grid = comparison_grid(problem.selection.array(key).shape, problem.truth[key].shape)
        if grid is not None:
            say(f"{key} has another resolution than its true value: compared, resampled, at {grid[1]}x{grid[0]}")
    chosen = render.integrator or config.integrator
    check_integrator(config, chosen, true_scene, problem.sensors)
    integrator = make_configured(chosen)
    multiple = chosen.options().get("samples_per_pass")
    for view in problem.views:
        say(f"rendering the target of sensor {view.sensor}: {render.spp} spp")
        image = render_in_passes(integrator, true_scene, view.sensor, render.spp, render.seed, 0, "target", multiple)
        view.made = _fit(problem, image, view.sensor)


def set_true_values(config: Config, scene: mi.Scene) -> Selection:
    """Set the values of `target.render.parameters` in `scene`; return them, selected.

    They are checked like initial values are; an error is located in the target.
    """
    render = config.target.render
    assert render is not None, "called for rendered targets only"
    return set_values(scene, config.parameters, render.parameters, config.source, "target.render.parameters")


def _read_target(problem: Problem, index: int) -> Array:
    """Read the target image (H, W, 3) of the `index`-th view. Raises ConfigError."""
    config, sensors = problem.config, problem.sensors
    files = config.target.file
    assert files is not None, "called for target files only"
    key = "target.file" if len(files) == 1 else f"target.file[{index}]"
    if len(files) != len(sensors):
        raise ConfigError(
            config.source,
            "target.file",
            f"must name one image for each sensor; images: {len(files)}, sensors: {len(sensors)}",
        )
    width, height = problem.scene.sensors()[sensors[index]].film().crop_size()
    try:
        return read_image(files[index], config.target.color_space, (int(width), int(height)))
    except ConfigError as error:
        raise ConfigError(config.source, key, error.message) from None


def _fit(problem: Problem, image: Array, sensor: int) -> mi.TensorXf:
    """`image` as a tensor with as many channels as the film of `sensor` has without its alpha."""
    colors = color_channels(problem.scene.sensors()[sensor].film())
    if colors == 1 and image.shape[2] >= 3:
        image = image[:, :, :3] @ LUMINANCE[:, None]
    return to_tensor(image[:, :, :colors])


def color_channels(film: mi.Film) -> int:
    """How many channels an image of `film` has without alpha."""
    return 1 if int(film.base_channels_count()) <= 2 else 3
