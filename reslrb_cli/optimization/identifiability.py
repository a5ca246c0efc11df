"""Identifiability of parameters, checked before the first iteration.

`find_reached` finds the entries of a parameter that affect the images. `check_exposures` checks whether the images
distinguish exposures from parameters.

In the second check, D_k is the change of all views' images per change of parameter k's logarithm. All entries of the
parameter change together: (J((1 + h) x_k) - J(x_k)) / h, at common random numbers. The images include their exposure
and exclude masked pixels. For an exposure, D_k consists of the images of its views. For example, if all emission is
unknown, the D_k of the lamps sum to the exposure's D_k. In general, some combination has no effect if the cosine matrix
has an eigenvalue near 0. The eigenvector of an eigenvalue near 0 shows which exposures and parameters form the
combination.

    G_kl = <D_k, D_l> / (|D_k| |D_l|)
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators.freezing import MOST_PATHS
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.integrators.step import known_step
from reslrb_cli.optimization.loading import passes, samples_per_pass
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import see_images, unrecorded
from reslrb_cli.optimization.views import SHARED
from reslrb_cli.scene.visibility import visible_texels
from reslrb_cli.seeds import seed
from reslrb_cli.statistics import Array

logger = logging.getLogger(__name__)

#: Paths in one pass of the gradient if naive AD keeps every vertex of each path; light tracing keeps none.
PATHS_PER_PASS = 2**18
#: Samples per pixel for finding the entries that light and sensor reach.
REACH_SPP = 64
#: The relative step h.
STEP = 0.02
#: Eigenvalues below this count as 0: two directions with an angle of less than a degree.
LEAST = 1e-4
#: Values with a smaller component in the eigenvector are left out of the combination.
PART = 0.1


def find_reached(problem: Problem) -> Problem:
    """Return the problem with `masks` for the parameters with known true values.

    An entry counts as reached if light reaches the entry. The test differentiates the image's sum with respect to the
    entry, with `REACH_SPP` samples per pixel. The gradient must be nonzero in some channel. A texel counts as reached
    only if some sensor also sees the texel's centre. Interreflection alone determines a texel that only illuminates
    other surfaces.
    """
    if not problem.truth:
        return problem
    logger.debug(f"finding surfaces that light and sensor reach: {REACH_SPP} spp")
    sensitive, masks = sensitivity(problem), dict[str, Array]()
    for key in problem.truth:
        mask: Array = sensitive[key] | (key in problem.selection.factors)  # every image shows its exposure
        if mask.ndim == 3:
            mask = np.any(mask, axis=2)
            if key in problem.selection.params:  # a heightmap is not a visible texture
                mask = mask & _visible(problem, key)
        masks[key] = mask
    return replace(problem, masks=masks)


def shown_texels(problem: Problem, key: str) -> Array | None:
    """Return the texels (H, W) of a texture that training views show in unmasked pixels. For other parameters, return
    None.
    """
    if key not in problem.selection.params or problem.selection.array(key).ndim != 3:
        return None
    weights = [view.weights for view in problem.trained]
    return _visible(problem, key, [None if each is None else np.array(each)[:, :, 0] > 0 for each in weights])


def _visible(problem: Problem, key: str, pixels: Sequence[Array | None] = ()) -> Array:
    """Return the texels that training views show in `pixels`. Without `pixels`, all pixels count."""
    sensors = [problem.scene.sensors()[view.sensor] for view in problem.trained]
    seen, halo = (
        visible_texels(problem.scene, sensors, key, pixels, problem.paths != "light"),
        problem.selection.slot(key).halo,
    )
    return seen[:, halo : seen.shape[1] - halo]


def sensitivity(problem: Problem) -> dict[str, Array]:
    """Return booleans for each parameter, in the parameter's shape. True entries affect the mean image."""
    run, integrator, multiple = problem.config.run, unrecorded(problem.integrator), samples_per_pass(problem.config)
    # A recording takes as long as some passes, and there is usually only one.
    paths_per_pass = MOST_PATHS if isinstance(integrator, LightTracer) else PATHS_PER_PASS
    spp = -(-REACH_SPP // multiple) * multiple if multiple else REACH_SPP
    found: dict[str, Array] = {}
    for sensor in [view.sensor for view in problem.trained]:
        film = problem.scene.sensors()[sensor].film()
        width, height = (int(n) for n in film.crop_size())
        # dL/dI of the mean image: known before any path is traced, as some estimators require.
        ones = dr.ones(mi.TensorXf, (height, width, int(film.base_channels_count())))
        dr.make_opaque(ones)
        for number, part in enumerate(passes(spp, width * height, multiple, paths_per_pass)):
            at = seed(run.seed, 0, sensor, f"reach, pass {number}")
            known_step(integrator, problem.scene, sensor, ones, seed=at, spp=part, params=problem.selection.params)
            for key, gradient in problem.gradients().items():
                found[key] = (problem.selection.shown(key, gradient) != 0) | found.get(key, False)
                problem.optimizer.clear_gradient(key)
    return found


def check_exposures(problem: Problem) -> None:
    """Raise ConfigError if the images cannot distinguish an exposure from parameters. The message names them.

    Renders one image of each view for every parameter. Does nothing if the run recovers no exposure. The problem must
    already have its targets. The function does not change the problem.
    """
    found = find_ambiguous(problem) if problem.selection.factors else None
    if found is None:
        return
    (exposure, *_), parameters = found
    what = " and ".join(f"`{key}`" for key in found[0]) + " from " + ", ".join(f"`{key}`" for key in parameters)
    reason = (
        f"the images cannot distinguish {what}: changed together, they give the same image; give one of them a "
        "number, such as "
    )
    place = "target.exposure"
    config = problem.config
    for number, (spec, sensor) in enumerate(zip(config.views or (), problem.sensors, strict=False)):
        if spec.exposure is not None and exposure == f"{SHARED}.{sensor}":
            place = f"views[{number}].exposure"
    raise ConfigError(problem.config.source, place, f"{reason}exposure: 1, or remove a parameter with a known value")


def find_ambiguous(problem: Problem) -> tuple[list[str], list[str]] | None:
    """Return the first combination of exposures and parameters that has no effect on the images, or None."""
    problem.apply()
    base = _row(problem)
    factors, rows = problem.selection.factors, []
    for key in problem.selection.keys:
        value = dr.detach(problem.optimizer[key])
        moved = value * dr.opaque(dr.leaf_t(value), 1 + STEP)
        problem.apply({key: moved})
        rows.append((_row(problem) - base) / STEP)
    problem.apply()
    matrix = np.stack(rows)
    matrix = matrix[:, np.isfinite(matrix).all(axis=0)]
    norms = np.linalg.norm(matrix, axis=1)
    keys = [key for key, norm in zip(problem.selection.keys, norms, strict=True) if norm > 0]
    if not keys:
        return None
    matrix = matrix[norms > 0] / norms[norms > 0, None]
    values, vectors = np.linalg.eigh(matrix @ matrix.T)
    for value, vector in zip(values, vectors.T, strict=True):
        parts = [key for key, part in zip(keys, vector, strict=True) if abs(part) > PART]
        exposures = [key for key in parts if key in factors]
        parameters = [key for key in parts if key not in factors]
        if value < LEAST and exposures and parameters:
            return exposures, parameters
    return None


def _row(problem: Problem) -> Array:
    """Return all views' images as one flat array. Each image is multiplied by the square root of the view's loss
    share.
    """
    pairs = zip(problem.trained, see_images(problem), strict=True)
    return np.concatenate([np.sqrt(view.share) * image.ravel() for view, image in pairs])
