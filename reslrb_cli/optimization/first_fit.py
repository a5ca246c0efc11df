"""First fit of a photograph: which parameters does the photograph ask for, beside the colours?

`init` writes a configuration that recovers the colours of the materials in view. A scene file seldom has the true
roughnesses, and a photograph may have a film curve. The colours would make up for both. `try_out` therefore fits the
photograph with few samples, and tests whether the colours explain it.

The fit takes Gauss-Newton steps (Levenberg 1944) with derivatives from differences of images, so it needs no reverse
step. An image has two sets of samples, and each product has one factor of either set, so noise does not bias it. All
steps use the same samples, so the loss is comparable:

    L = 1/2 sum W r_a r_b,   g = 1/2 (J_a W r_b + J_b W r_a),   H = J_a W J_b
    x <- x - (H + d diag H)^-1 g

r is the residual, J are the derivatives of the image, and W is d2L/dI2. A step that raises L is tried again with a
larger d. Entries at a bound do not move outwards.

All roughnesses are then tested together, and so are the numbers of the camera's response (`candidates.py`). The group
with the larger effect is recovered if noise would hardly have the same effect, and if it explains at least half as much
of the misfit as the best other parameter. Several parameters can explain one misfit. Exporters write the same default
roughness for many materials, so a wrong roughness is likely. After a second fit, the other group is tested again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import mitsuba as mi
import numpy as np

from reslrb_cli.config.loader import changed
from reslrb_cli.config.parameters import tinted_by
from reslrb_cli.config.schema import Config
from reslrb_cli.optimization.assemble import assemble, set_values
from reslrb_cli.optimization.nonfinite import finite
from reslrb_cli.optimization.optimizers import SMALL
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.uncertainty.candidates import (
    changes_of,
    group_response,
    judge_fit,
    measure_together,
)
from reslrb_cli.optimization.uncertainty.curvature import LossCurvature
from reslrb_cli.optimization.uncertainty.fit import LEVEL, Fit, measure_fit
from reslrb_cli.optimization.views import RESPONSE, SHARED
from reslrb_cli.scene.catalog import COLOUR, EMISSION
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.proposal import LEAST_SHARE, ROUGHNESS, Proposal
from reslrb_cli.scene.visibility import sees_materials
from reslrb_cli.statistics import Array

#: Samples of each image, and their maximum number per pixel.
SAMPLES, MOST_SPP = 2**14, 64
#: Maximum number of steps, and of lengths that are tried for each.
MOST_STEPS, MOST_TRIES = 12, 6
#: First d, and the factor by which it falls after a step and rises after a refused one.
DAMPING, FACTOR = 1e-3, 10.0
#: Relative decrease of the loss below which the fit ends.
CONVERGED = 0.03
#: Roughnesses are recovered if noise has the same effect with at most this probability. The test ignores errors of the
#: fit itself: in rooms with the right roughnesses, the probability was as small as 6e-4.
CERTAIN = 1e-6
#: Share of the best other parameter's effect that a group needs.
AS_GOOD = 0.5
#: Smallest effect of a group that is recovered beside another one, as a share of the residuals' loss.
LEAST_EFFECT = 0.05
#: Name of the group of roughnesses. The response has its own key.
ROUGHNESSES = "roughnesses"
#: Largest logarithm of a factor in one step.
LONGEST = 0.7
#: Step of the differences, as a share of a parameter's scale.
STEP = 0.05
#: Samples for the test, as multiples of those of a step. The second number is for roughnesses that noise may hide.
MORE = 4, 16


@dataclass(frozen=True)
class FirstFit:
    """Result of `try_out`. `freed` are the parameters to recover too. `explained` has the share of the misfit that each
    tested parameter explains on its own, for those that explain a part. `misfit` is the size of the misfit as a share
    of the photograph, or 0 if the model explains the photograph. It is None if the time ended first.
    """

    misfit: float | None
    freed: list[str] = field(default_factory=list)
    explained: dict[str, float] = field(default_factory=dict)


def assemble_first_fit(
    config: Config, size: tuple[int, int], has_camera: bool, to_run: bool = False, keys: Sequence[str] = ()
) -> Problem:
    """Return the problem of `config` with settings that need no measurements, and with camera paths if they can render
    the scene (`has_camera`). `size` is the film's (width, height). `to_run` and `keys` are those of `assemble`.
    """
    spp = min(2 ** math.ceil(math.log2(max(SAMPLES / (size[0] * size[1]), 1))), MOST_SPP)
    settings = ["guiding=off", "pixels=even", *(["paths=camera"] if has_camera else [])]
    return assemble(changed(config, [f"run.spp={spp}", *(f"integrator.{each}" for each in settings)]), to_run=to_run,
                    keys=keys)  # fmt: skip


def try_out(
    make: Callable[[Sequence[str]], Problem], proposals: Sequence[Proposal], go_on: Callable[[], bool]
) -> FirstFit | None:
    """Fit a photograph, and test which further parameters it asks for. Return None if textures fill the photograph.

    `make` returns the problem of recovering the colours and the parameters with the given keys. The colours are small
    parameters or textures. Only the brightness of a texture's channels is fitted. Pixels that see a texture with many
    texels are left out, because its texels would explain their residuals.
    """
    problem = make([])
    if not _leave_textures_out(problem):
        return None
    rough = {each.key: each for each in proposals if is_roughness(each)}
    problem, is_fitted = fit_by_differences(problem, go_on)
    look = _look(problem, rough, go_on) if is_fitted else None
    if look is None:
        return FirstFit(None)
    if not look.effects and look.fit.p > LEVEL:
        return FirstFit(0.0)
    # A group that is certain is a misfit, even if the test of fit does not see it.
    record = judge_fit(problem, replace(look.fit, p=0.0 if look.effects else look.fit.p), look.known, go_on)
    explained = {each.key: each.explained for each in record.candidates}
    others = {key: share for key, share in explained.items() if key not in rough and key != RESPONSE}
    best = max(others, key=lambda key: others[key], default="")
    least = AS_GOOD * others.get(best, 0.0) * record.energy
    name = max(look.effects, key=lambda name: look.effects[name], default="")
    if not name or look.effects[name] < least:
        # The images distinguish a lamp from the exposure only if there is another lamp.
        is_lamp = bool(EMISSION.search(best)) and len(problem.scene.emitters()) > 1
        return FirstFit(record.misfit, [best] if is_lamp or tinted_by(best) else [], explained)
    keys = {ROUGHNESSES: list(rough), RESPONSE: [RESPONSE]}
    freed, rest = keys[name], {} if name == ROUGHNESSES else rough
    # A response and roughnesses explain a part of each other's misfits, so the rest is tested after a second fit.
    second = set_values(make(freed), problem.values())
    if _leave_textures_out(second):
        second, is_fitted = fit_by_differences(second, go_on)
        again = _look(second, rest, go_on) if is_fitted else None
        if again is not None:
            least = LEAST_EFFECT * again.fit.total
            freed = freed + [key for other, effect in again.effects.items() if effect >= least for key in keys[other]]
    return FirstFit(record.misfit, freed, explained)


@dataclass(frozen=True)
class _FitTest:
    """Test of fit, and the effects of groups of parameters that noise hardly causes. An effect is twice the fall of
    the loss. `known` has measured the recovered directions.
    """

    fit: Fit
    known: LossCurvature
    effects: dict[str, float]


def _look(problem: Problem, rough: Mapping[str, Proposal], go_on: Callable[[], bool]) -> _FitTest | None:
    """Test the roughnesses `rough`, and the response of the camera, at the values of `problem`. Return None if the time
    ends first.
    """
    for more in MORE:
        known = LossCurvature(problem, more * problem.config.run.spp, of_target=False)
        known.along(changes_of(problem, STEP), go_on)
        if not go_on():
            return None
        fit = measure_fit(problem, known, go_on)
        response = group_response(problem, fit, known)
        groups = {RESPONSE: None if response is None else response[0]}
        groups[ROUGHNESSES] = measure_together(problem, fit, known, rough, go_on) if rough else None
        tests = {name: group.beside(known.derivatives) for name, group in groups.items() if group is not None}
        effects = {name: min(2 * fall, fit.total) for name, (fall, p, _) in tests.items() if p <= CERTAIN}
        if effects:
            break
    return _FitTest(fit, known, effects)


def has_candidates(scene: mi.Scene, proposals: Sequence[Proposal], has_response: bool) -> bool:
    """Return whether a first fit may add parameters: a response that may be unknown, roughnesses in view, tints of
    textures, or lamps beside others.
    """
    has_lamp = any(EMISSION.search(each.info.key) and not each.first for each in proposals)
    is_lamp = has_lamp and len(scene.emitters()) > 1
    return has_response or is_lamp or any(is_roughness(each) or tinted_by(each.key) for each in proposals)


def is_roughness(proposal: Proposal) -> bool:
    """Return whether a proposal is a visible material's roughness that `init` does not recover by default."""
    info = proposal.info
    is_flat = len(info.shape) != 3 and int(np.prod(info.shape)) <= SMALL
    return bool(ROUGHNESS.search(info.key)) and is_flat and not proposal.first and proposal.share >= LEAST_SHARE


def fit_by_differences(problem: Problem, go_on: Callable[[], bool]) -> tuple[Problem, bool]:
    """Return the problem with values that fit its targets, and whether the fit has ended before the time."""
    values = {key: np.array(value, dtype=np.float64) for key, value in problem.values().items()}
    damping = DAMPING
    for _ in range(MOST_STEPS):
        curvature, changes = LossCurvature(problem, problem.config.run.spp, of_target=False), changes_of(problem, STEP)
        curvature.along(changes, go_on)
        if len(curvature.directions) < sum(len(change.directions) for change in changes):
            return problem, False
        before = _loss(curvature, _residuals(problem, curvature, curvature.images))
        for _ in range(MOST_TRIES):
            moved = _moved(problem, curvature, values, damping)
            tried = set_values(problem, moved)
            after = _loss(curvature, _residuals(tried, curvature, curvature.see()))
            if after < before or not go_on():
                break
            damping *= FACTOR
        if not after < before:
            return set_values(problem, values), go_on()
        problem, values, damping = tried, moved, damping / FACTOR
        if after > (1 - CONVERGED) * before:
            break
    return problem, True


def _residuals(problem: Problem, curvature: LossCurvature, images: Sequence[Sequence[Array]]) -> list[Array]:
    """Return the differences (N,) of two sets of images and the targets."""
    trues = [view.kept(np.array(view.target, dtype=np.float64)) for view in problem.trained]
    return [curvature.in_a_row([finite(image - true) for image, true in zip(own, trues, strict=True)])
            for own in images]  # fmt: skip


def _loss(curvature: LossCurvature, residuals: Sequence[Array]) -> float:
    return 0.5 * float(np.sum(curvature.weights * residuals[0] * residuals[1]))


def _moved(problem: Problem, curvature: LossCurvature, values: Mapping[str, Array], damping: float) -> dict[str, Array]:
    """Return the values after a step from `values`. Positive parameters without an upper bound change by a factor."""
    bounds = {key: problem.selection.specs[key].bounds or (-np.inf, np.inf) for key in values}
    own = [(each.key, each.entry) for each in curvature.directions]
    at = np.array([1.0 if entry is None else values[key].ravel()[entry] for key, entry in own])
    low, high = np.array([(-np.inf, np.inf) if entry is None else bounds[key] for key, entry in own]).T
    is_factor = np.array([entry is not None for _, entry in own]) & (at > 0) & np.isinf(high)
    unit = np.where(is_factor, at, 1.0)
    (a, b), (one, other) = curvature.derivatives, _residuals(problem, curvature, curvature.images)
    g = 0.5 * unit * (a @ (curvature.weights * other) + b @ (curvature.weights * one))
    H = curvature.for_steps(curvature.directions)[0] * np.outer(unit, unit)
    H += damping * np.diag(np.diag(H))
    free = np.diag(H) > 0
    while True:
        step = np.zeros(len(g))
        step[free] = -np.linalg.solve(H[np.ix_(free, free)], g[free])
        outwards = free & ((at <= low) & (step < 0) | (at >= high) & (step > 0))
        if not outwards.any():
            break
        free &= ~outwards
    step[is_factor] = np.clip(step[is_factor], -LONGEST, LONGEST)
    du = next((size for (key, _), size in zip(own, step, strict=True) if key == SHARED), 0.0)
    new = at + step
    # The images hardly change if the exposure rises and all colours fall. A step is one of E and E c, as in `block.py`.
    is_colour = np.array([bool(COLOUR.search(key)) for key, _ in own])
    new[is_colour] = ((1 + du) * at + step)[is_colour] * np.exp(-du)
    new[is_factor] = (at * np.exp(step))[is_factor]
    moved = {key: value.copy() for key, value in values.items()}
    for each, value in zip(curvature.directions, new, strict=True):
        if each.entry is None:
            moved[each.key][..., slice(None) if each.channel is None else each.channel] *= value
        else:
            moved[each.key].reshape(-1)[each.entry] = value
    return {key: np.array(np.clip(value, *bounds[key])) for key, value in moved.items()}


def _leave_textures_out(problem: Problem) -> bool:
    """Exclude the pixels that see a texture with many texels. Return whether pixels are left."""
    keys = [key for key in problem.selection.keys if not problem.optimizer.is_small(key)]
    graph, properties = SceneGraph.of(problem.scene), problem.selection.params.properties
    materials = [bsdf for key in keys if key in properties for bsdf in graph.bsdfs_above(properties[key][2])]
    left = True
    for view in problem.trained if materials else ():
        sees = sees_materials(problem.scene, problem.scene.sensors()[view.sensor], materials)
        known = np.ones(sees.shape) if view.weights is None else np.array(view.weights)[:, :, 0]
        weights = np.where(sees, 0.0, known)
        left = left and bool(weights.any())
        if weights.any():
            view.weigh(weights.astype(np.float32))
    return left
