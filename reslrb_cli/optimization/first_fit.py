"""First fit of a photograph: which parameters does the photograph ask for, beside the colours?

`init` writes a configuration that recovers the colours of the materials in view. A scene file seldom has the true
roughnesses, and a photograph may have a film curve. The colours would make up for both. `try_out` therefore fits the
photograph with few samples, and tests whether the colours explain it.

The fit needs no reverse steps (`image_fit.py`).

All roughnesses are then tested together, and so are the numbers of the camera's response (`candidates.py`). The group
with the larger effect is recovered if noise would hardly have the same effect, and if it explains at least half as much
of the misfit as the best other parameter. Several parameters can explain one misfit. Exporters write the same default
roughness for many materials, so a wrong roughness is likely. After a second fit, the other group is tested again. The
second fit of roughnesses begins with a scan, because they have local minima. A run then starts at its values.
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
from reslrb_cli.optimization.image_fit import fit_by_differences, scan_roughnesses
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
from reslrb_cli.optimization.views import RESPONSE
from reslrb_cli.scene.catalog import EMISSION, ROUGHNESS
from reslrb_cli.scene.graph import SceneGraph
from reslrb_cli.scene.proposal import LEAST_SHARE, Proposal
from reslrb_cli.scene.visibility import sees_materials
from reslrb_cli.statistics import Array

#: Samples of each image, and their maximum number per pixel.
SAMPLES, MOST_SPP = 2**14, 64
#: Roughnesses are recovered if noise has the same effect with at most this probability. The test ignores errors of the
#: fit itself: in rooms with the right roughnesses, the probability was as small as 6e-4.
CERTAIN = 1e-6
#: Share of the best other parameter's effect that a group needs.
AS_GOOD = 0.5
#: Smallest effect of a group that is recovered beside another one, as a share of the residuals' loss.
LEAST_EFFECT = 0.05
#: Name of the group of roughnesses. The response has its own key.
ROUGHNESSES = "roughnesses"
#: Samples for the test, as multiples of those of the first steps. The second number is for roughnesses that noise may
#: hide. The last fit has the first number.
MORE = 4, 16


@dataclass(frozen=True)
class FirstFit:
    """Result of `try_out`. `freed` are the parameters to recover too. `explained` has the share of the misfit that each
    tested parameter explains on its own, for those that explain a part. `misfit` is the size of the misfit as a share
    of the photograph, or 0 if the model explains the photograph. It is None if the time ended first. `values` are those
    of the last fit. They are empty if a response or a lamp is recovered, which starts anew.
    """

    misfit: float | None
    freed: list[str] = field(default_factory=list)
    explained: dict[str, float] = field(default_factory=dict)
    values: dict[str, Array] = field(default_factory=dict)


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
    rough, spp = {each.key: each for each in proposals if is_roughness(each)}, problem.config.run.spp
    problem, is_fitted = fit_by_differences(problem, spp, go_on)
    look = _look(problem, rough, go_on) if is_fitted else None
    if look is None:
        return FirstFit(None)
    if not look.effects and look.fit.p > LEVEL:
        return FirstFit(0.0, values=_small_values(problem))
    # A group that is certain is a misfit, even if the test of fit does not see it.
    fit = replace(look.fit, p=0.0 if look.effects else look.fit.p)
    record = judge_fit(problem, fit, look.known, go_on, look.known.spp // spp)
    explained = {each.key: each.explained for each in record.candidates}
    others = {key: share for key, share in explained.items() if key not in rough and key != RESPONSE}
    best = max(others, key=lambda key: others[key], default="")
    least = AS_GOOD * others.get(best, 0.0) * record.energy
    name = max(look.effects, key=lambda name: look.effects[name], default="")
    if not name or look.effects[name] < least:
        # The images distinguish a lamp from the exposure only if there is another lamp.
        is_lamp = bool(EMISSION.search(best)) and len(problem.scene.emitters()) > 1
        more = [best] if is_lamp or tinted_by(best) else []
        return FirstFit(record.misfit, more, explained, {} if more and is_lamp else _small_values(problem))
    keys = {ROUGHNESSES: list(rough), RESPONSE: [RESPONSE]}
    freed, rest = keys[name], {} if name == ROUGHNESSES else rough
    # A response and roughnesses explain a part of each other's misfits, so the rest is tested after a second fit.
    problem = set_values(make(freed), problem.values())
    if not _leave_textures_out(problem):
        return FirstFit(record.misfit, freed, explained)
    before = problem.values()
    if name == ROUGHNESSES:
        problem = set_values(problem, scan_roughnesses(problem, list(rough), look.known, go_on))
    problem, is_fitted = fit_by_differences(problem, spp, go_on)
    if not is_fitted:  # the colours may not follow the roughnesses of the scan
        problem = set_values(problem, before)
    elif name == ROUGHNESSES:
        problem, is_fitted = fit_by_differences(problem, MORE[0] * spp, go_on)
    again = _look(problem, rest, go_on) if is_fitted else None
    if again is not None:
        least = LEAST_EFFECT * again.fit.total
        freed = freed + [key for other, effect in again.effects.items() if effect >= least for key in keys[other]]
    return FirstFit(record.misfit, freed, explained, {} if RESPONSE in freed else _small_values(problem))


def _small_values(problem: Problem) -> dict[str, Array]:
    """Return the values of all parameters but large textures."""
    return {key: value for key, value in problem.values().items() if problem.optimizer.is_small(key)}


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
        known.along(changes_of(problem), go_on)
        if not go_on():
            return None
        fit = measure_fit(problem, known, go_on)
        response = group_response(problem, fit, known)
        groups = {RESPONSE: None if response is None else response[0]}
        groups[ROUGHNESSES] = measure_together(problem, fit, known, rough, go_on) if rough else None
        tests = {name: group.beside(known.derivatives) for name, group in groups.items() if group is not None}
        effects = {name: min(2 * fall, fit.total) for name, (fall, p, _) in tests.items() if p <= CERTAIN}
        if effects or not rough or fit.p > LEVEL:
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
