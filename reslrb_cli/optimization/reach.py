"""Which entries of a parameter the images tell something about."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.integrators import known_step
from reslrb_cli.integrators.freezing import MOST_PATHS
from reslrb_cli.integrators.tracer import LightTracer
from reslrb_cli.optimization.loading import samples_per_pass
from reslrb_cli.optimization.rendering import passes
from reslrb_cli.scene import visible_texels
from reslrb_cli.seeds import seed

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

Array = np.ndarray[Any, Any]

#: Paths in one pass of the gradient where naive AD keeps every vertex of each of them; light tracing keeps none.
PATHS_PER_PASS = 2**18


def find_reached(problem: Problem, say: Callable[[str], None] = lambda line: None) -> None:
    """Fill `problem.masks` for the parameters whose true value is known.

    An entry counts as reached where light reaches it (the gradient of the image's sum with respect to it, over
    `run.reach_spp` samples per pixel, is not 0 in some channel) and, for a texel, where some sensor also sees its
    centre: a texel that only lights others is held by interreflection alone.
    """
    if not problem.truth:
        return
    say(f"finding what light and sensor reach: {problem.config.run.reach_spp} spp")
    sensitive = sensitivity(problem)
    for key in problem.truth:
        mask: Array = sensitive[key] | (key in problem.selection.factors)  # every image shows its exposure
        if mask.ndim == 3:
            mask = np.any(mask, axis=2)
            if key in problem.selection.params:  # a heightmap is no texture to be seen
                sensors = [problem.scene.sensors()[view.sensor] for view in problem.trained]
                mask = mask & _without_halo(visible_texels(problem.scene, sensors, key), mask.shape[1])
        problem.masks[key] = mask


def shown_texels(problem: Problem, key: str) -> Array | None:
    """Which texels (H, W) of a texture some view that is trained on shows in pixels that count; None of what is no
    texture to be seen."""
    if key not in problem.selection.params or problem.selection.array(key).ndim != 3:
        return None
    sensors = [problem.scene.sensors()[view.sensor] for view in problem.trained]
    pixels = [None if view.weights is None else np.array(view.weights)[:, :, 0] > 0 for view in problem.trained]
    width = problem.selection.array(key).shape[1]
    return _without_halo(visible_texels(problem.scene, sensors, key, pixels), width)


def sensitivity(problem: Problem) -> dict[str, Array]:
    """For each parameter whether the mean image depends on an entry, boolean, of the parameter's shape."""
    run, optimizer = problem.config.run, problem.optimizer
    integrator, paths_per_pass = problem.integrator, PATHS_PER_PASS
    if isinstance(integrator, LightTracer):  # a recording takes as long as some passes, of which there is mostly one
        integrator = integrator.with_options(samples_per_pass=integrator.samples_per_pass, freeze=False)
        paths_per_pass = MOST_PATHS
    found: dict[str, Array] = {}
    for sensor in [view.sensor for view in problem.trained]:
        film = problem.scene.sensors()[sensor].film()
        width, height = (int(n) for n in film.crop_size())
        # dL/dI of the mean image: known before any path is traced, which some estimators ask for.
        ones = dr.ones(mi.TensorXf, (height, width, int(film.base_channels_count())))
        dr.make_opaque(ones)
        multiple = samples_per_pass(problem.config)
        spp = -(-run.reach_spp // multiple) * multiple if multiple else run.reach_spp
        for number, part in enumerate(passes(spp, width * height, multiple, paths_per_pass)):
            known_step(
                integrator,
                problem.scene,
                sensor,
                ones,
                seed=seed(run.seed, 0, sensor, f"reach, pass {number}"),
                spp=part,
                params=problem.selection.params,
            )
            for key, gradient in problem.gradients().items():
                nonzero = np.array(gradient != 0.0)
                optimizer.clear_gradient(key)
                found[key] = found[key] | nonzero if key in found else nonzero
    return {key: _like(problem.selection.array(key), value) for key, value in found.items()}


def _like(array: Array, mask: Array) -> Array:
    """`mask` in the shape of `array`, without the halo columns that an environment map's tensor has."""
    if array.ndim == 3 and mask.ndim == 3:
        mask = _without_halo(mask, array.shape[1])
    return mask.reshape(array.shape)


def _without_halo(mask: Array, width: int) -> Array:
    """The middle `width` columns of a mask (H, W, ...)."""
    halo = (mask.shape[1] - width) // 2
    return mask[:, halo : halo + width]
