"""The identifiability of parameters: what the images tell of them, asked before the first iteration.

Two things are asked: which entries of a parameter the images tell something about (`find_reached`), and whether they
tell exposures from parameters (`check_exposures`).

For the second let D_k be how all views' images, exposed and without what their masks leave out, change with the
logarithm of parameter k, all its entries at once: (J((1 + h) x_k) - J(x_k)) / h, at common random numbers. An
exposure's own is its views' images themselves. With all emission unknown, for example, the sum over the lamps is the
exposure's. In general there are combinations without an effect where the matrix of cosines

    G_kl = <D_k, D_l> / (|D_k| |D_l|)

has an eigenvalue near 0; its eigenvector says which values are in the combination.
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

#: Paths in one pass of the gradient where naive AD keeps every vertex of each of them; light tracing keeps none.
PATHS_PER_PASS = 2**18
#: Samples per pixel that say which entries light and sensor reach.
REACH_SPP = 64
#: The relative step h.
STEP = 0.02
#: Eigenvalues below it are taken for 0: two directions at less than a degree to each other.
LEAST = 1e-4
#: A value whose part in the eigenvector is smaller has none in the combination.
PART = 0.1


def find_reached(problem: Problem) -> Problem:
    """The problem with its `masks`, of the parameters whose true value is known.

    An entry counts as reached where light reaches it (the gradient of the image's sum with respect to it, over
    `REACH_SPP` samples per pixel, is not 0 in some channel) and, for a texel, where some sensor also sees its
    centre: a texel that only lights others is held by interreflection alone.
    """
    if not problem.truth:
        return problem
    logger.debug(f"finding what light and sensor reach: {REACH_SPP} spp")
    sensitive, masks = sensitivity(problem), dict[str, Array]()
    for key in problem.truth:
        mask: Array = sensitive[key] | (key in problem.selection.factors)  # every image shows its exposure
        if mask.ndim == 3:
            mask = np.any(mask, axis=2)
            if key in problem.selection.params:  # a heightmap is no texture to be seen
                mask = mask & _visible(problem, key)
        masks[key] = mask
    return replace(problem, masks=masks)


def shown_texels(problem: Problem, key: str) -> Array | None:
    """Which texels (H, W) of a texture some view that is trained on shows in pixels that count; None of what is no
    texture to be seen."""
    if key not in problem.selection.params or problem.selection.array(key).ndim != 3:
        return None
    weights = [view.weights for view in problem.trained]
    return _visible(problem, key, [None if each is None else np.array(each)[:, :, 0] > 0 for each in weights])


def _visible(problem: Problem, key: str, pixels: Sequence[Array | None] = ()) -> Array:
    """The texels that views that are trained on show, in these pixels, or in any."""
    sensors = [problem.scene.sensors()[view.sensor] for view in problem.trained]
    seen, halo = (
        visible_texels(problem.scene, sensors, key, pixels, problem.paths != "light"),
        problem.selection.slot(key).halo,
    )
    return seen[:, halo : seen.shape[1] - halo]


def sensitivity(problem: Problem) -> dict[str, Array]:
    """For each parameter whether the mean image depends on an entry, boolean, of the parameter's shape."""
    run, integrator, multiple = problem.config.run, unrecorded(problem.integrator), samples_per_pass(problem.config)
    # A recording takes as long as some passes, of which there is mostly one.
    paths_per_pass = MOST_PATHS if isinstance(integrator, LightTracer) else PATHS_PER_PASS
    spp = -(-REACH_SPP // multiple) * multiple if multiple else REACH_SPP
    found: dict[str, Array] = {}
    for sensor in [view.sensor for view in problem.trained]:
        film = problem.scene.sensors()[sensor].film()
        width, height = (int(n) for n in film.crop_size())
        # dL/dI of the mean image: known before any path is traced, which some estimators ask for.
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
    """Raise ConfigError where the images cannot tell an exposure from parameters, which it names.

    Takes one image of each view for every parameter; nothing where no exposure is recovered. The problem has its
    targets, and is left as it was.
    """
    found = find_ambiguous(problem) if problem.selection.factors else None
    if found is None:
        return
    (exposure, *_), parameters = found
    what = " and ".join(f"`{key}`" for key in found[0]) + " from " + ", ".join(f"`{key}`" for key in parameters)
    reason = f"the images cannot tell {what}: changed together, they look the same; give one of them a number, such as "
    place = "target.exposure"
    for number, spec in enumerate(problem.config.views or ()):
        if spec.exposure is not None and exposure == f"{SHARED}.{spec.sensor}":
            place = f"views[{number}].exposure"
    raise ConfigError(problem.config.source, place, f"{reason}exposure: 1, or remove a parameter whose value is known")


def find_ambiguous(problem: Problem) -> tuple[list[str], list[str]] | None:
    """The first combination of exposures and parameters that the images do not show; None where there is none."""
    problem.apply()
    base = _row(problem)
    factors, rows, keys = problem.selection.factors, [], []
    for key in problem.selection.keys:
        value = dr.detach(problem.optimizer[key])
        moved = value * dr.opaque(dr.leaf_t(value), 1 + STEP)
        problem.apply({key: moved})
        row = (_row(problem) - base) / STEP
        if np.isfinite(row).all() and (norm := float(np.linalg.norm(row))) > 0:
            rows.append(row / norm)
            keys.append(key)
    problem.apply()
    if not rows:
        return None
    matrix = np.stack(rows)
    values, vectors = np.linalg.eigh(matrix @ matrix.T)
    for value, vector in zip(values, vectors.T, strict=True):
        parts = [key for key, part in zip(keys, vector, strict=True) if abs(part) > PART]
        exposures = [key for key in parts if key in factors]
        parameters = [key for key in parts if key not in factors]
        if value < LEAST and exposures and parameters:
            return exposures, parameters
    return None


def _row(problem: Problem) -> Array:
    """The images of all views in a row, each by the root of its share of the loss."""
    pairs = zip(problem.trained, see_images(problem), strict=True)
    return np.concatenate([np.sqrt(view.share) * image.ravel() for view, image in pairs])
