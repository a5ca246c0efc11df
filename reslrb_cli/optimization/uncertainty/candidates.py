"""Parameters that the run does not recover, and that would reduce the misfit of the model (Rao's score test).

The derivative j of the image along a direction of such a parameter comes from differences of images at common random
numbers. The derivative of the loss is s, the sum of j dL/dI over the pixels, at the final values. The recovered
parameters would follow the new one. The part of j that they can also cause is therefore subtracted first. If the new
parameter was recovered too, the loss would fall by about s^2 / (2 h). Here h is the curvature that remains. All
directions of a parameter are tested together.

The response of the camera is tested as one more parameter. The derivatives along the numbers of its curve are -B_k I
(`optimization/response.py`), so they need no images. All views share the curve, as with
`target.response: {curve: auto}`.

The noise of s follows from the noise of the residual (`fit.Fit`). Directions that change all channels have the
noise of channels that are fully correlated.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reslrb_cli.config.response import MOST
from reslrb_cli.errors import describe
from reslrb_cli.optimization.optimizers import SMALL
from reslrb_cli.optimization.problem import Problem, make_optimizer
from reslrb_cli.optimization.uncertainty.curvature import (
    LossCurvature,
    ParameterChange,
    ParameterDirection,
    plan_changes,
)
from reslrb_cli.optimization.uncertainty.fit import LEVEL, Candidate, Fit, FitRecord
from reslrb_cli.optimization.uncertainty.posterior import positive, pseudo_inverse
from reslrb_cli.optimization.views import RESPONSE
from reslrb_cli.scene.catalog import ROUGHNESS, open_domain
from reslrb_cli.scene.deformation import where_moved
from reslrb_cli.scene.dispersion import bends_light
from reslrb_cli.scene.parameters import select_parameters
from reslrb_cli.scene.proposal import Proposal, propose, spec_of
from reslrb_cli.scene.response import basis, start
from reslrb_cli.statistics import Array, rms, special

logger = logging.getLogger(__name__)

#: Step of the differences, as a share of a parameter's scale, and the factor for roughnesses. A roughness moves paths,
#: so the noise of a difference hardly depends on the step.
STEP, LONGER = 0.1, 2.0
#: Largest `p` of parameters that are named.
LEVEL_OF_NAMED = 0.01
#: Smallest explained share of a parameter that is named.
LEAST_EXPLAINED = 0.05
#: Smallest eigenvalue of a curvature that counts, as a share of its largest.
LEAST_EIGENVALUE = 1e-3
#: Number of parameters that are measured with `MORE` times the samples, up to a multiple of a step's, as long as noise
#: leaves less than the share `LEAST_SURE` of their curvature.
MOST_MEASURED_AGAIN, MORE, MOST_MULTIPLE, LEAST_SURE = 5, 4, 16, 0.8
#: Maximum numbers of tested and of recorded parameters.
MOST_TESTED, MOST_RECORDED = 24, 5
#: Endings of files that cameras do not write.
LINEAR_FILES = (".exr", ".hdr", ".pfm")


def judge_fit(
    problem: Problem, fit: Fit, known: LossCurvature, go_on: Callable[[], bool], multiple: int = MOST_MULTIPLE
) -> FitRecord:
    """Return the record of a test of fit, with the parameters that would reduce a misfit significantly.

    `known` has measured the recovered directions. The test of further parameters ends when `go_on` returns false. Its
    images have at most `multiple` times the samples of a step.
    """
    if fit.p > LEVEL:
        return FitRecord(fit.p, 0.0, 0.0, False, [])
    found: list[tuple[float, float, Candidate]] = []
    tests = (
        lambda: _find_candidates(problem, fit, known, go_on, multiple),
        lambda: _test_response(problem, fit, known),
    )
    for test in () if known.biases else tests:
        try:
            found += test()
        except Exception as error:
            logger.warning(f"not all parameters were tested that would reduce the misfit: {describe(error)}")
    named = sorted((each for each in found if each[1] <= LEVEL_OF_NAMED), key=lambda each: -each[0])
    energy = max(fit.energy, *(2 * fall for fall, *_ in named), 0.0)
    candidates = [replace(each, explained=min(2 * fall / max(energy, 1e-300), 1.0)) for fall, _, each in named]
    kept = [each for each in candidates if each.explained >= LEAST_EXPLAINED][:MOST_RECORDED]
    misfit = (energy / fit.size) ** 0.5 if fit.size > 0 else 0.0
    return FitRecord(fit.p, misfit, energy, True, kept)


def _find_candidates(
    problem: Problem, fit: Fit, known: LossCurvature, go_on: Callable[[], bool], multiple: int
) -> list[tuple[float, float, Candidate]]:
    """Return the further parameters, each after the fall of the loss and its `p`. Significant ones come first."""
    proposals = {each.key: each for each in _unrecovered(problem)}
    if not proposals:
        return []
    others = _recovering(problem, proposals)
    before = others.values()
    changes, most = changes_of(others), multiple * problem.config.run.spp
    found: list[tuple[float, float, Candidate]] = []
    try:
        count, round, spp = 0, 0, known.spp
        while changes and go_on():
            curvature = LossCurvature(others, spp, of_target=False, round=round)
            directions, *_ = curvature.along(changes, go_on)
            count = count or len({direction.key for direction in directions})
            if len(directions) < sum(len(change.directions) for change in changes) and found:
                break  # the time is up, and the earlier measurement is complete
            found = _test(others, fit, known.derivatives, curvature, directions, proposals, count)
            # More samples decide on the parameters with the largest effects.
            named = {each.key for _, _, each in found[:MOST_MEASURED_AGAIN]}
            sure = [share for each, share in zip(directions, curvature.sure, strict=True) if each.key in named]
            if spp >= most or min(sure, default=1.0) >= LEAST_SURE:
                break
            spp, round = min(spp * MORE, most), round + 1
            changes = [change for change in changes if named & set(change.values)]
    finally:
        others.selection.set_arrays(before)
    return found


@dataclass(frozen=True)
class TestedGroup:
    """Parameters that are tested together. `derivatives` (K, N) are those of the images along their directions, by each
    set of samples. `tests` returns the tests of these directions beside directions with other derivatives.
    """

    derivatives: tuple[Array, Array]
    tests: Callable[[tuple[Array, Array]], _Tests]

    def beside(self, known: tuple[Array, Array]) -> tuple[float, float, Array]:
        """Return the fall of the loss, the probability that noise causes it, and the offsets of the directions, if the
        parameters were recovered beside others. `known` are the derivatives along the directions of the others.
        """
        return self.tests(known).of(range(len(self.derivatives[0])))


def measure_together(
    problem: Problem, fit: Fit, known: LossCurvature, proposals: Mapping[str, Proposal], go_on: Callable[[], bool]
) -> TestedGroup | None:
    """Return the group of all `proposals`, or None if the time ends first."""
    others = _recovering(problem, proposals)
    before = others.values()
    try:
        changes, curvature = changes_of(others), LossCurvature(others, known.spp, of_target=False)
        directions, *_ = curvature.along(changes, go_on)
        if len(directions) < sum(len(change.directions) for change in changes):
            return None
        return TestedGroup(curvature.derivatives, lambda known: _tests_of(fit, known, curvature, directions))
    finally:
        others.selection.set_arrays(before)


def group_response(problem: Problem, fit: Fit, known: LossCurvature) -> tuple[TestedGroup, Array] | None:
    """Return the numbers of a response as a group, with their places (K,) in the curve. Return None if no curve could
    be recovered.
    """
    if not may_have_response(problem):
        return None
    derivatives = _response_derivatives(problem, known)
    places = np.flatnonzero(np.any(derivatives[0], axis=1))
    new = derivatives[0][places], derivatives[1][places]
    slope, variance = _slope_and_noise(fit, known)
    channels = np.full(len(places), max(each.shape[2] for each in fit.slopes))
    return TestedGroup(new, lambda others: _Tests(others, new, known.weights, slope, variance, channels)), places


def _recovering(problem: Problem, proposals: Mapping[str, Proposal]) -> Problem:
    """Return the problem of recovering the parameters `proposals` alone."""
    specs = [spec_of(key, each.bounds) for key, each in proposals.items()]
    selection = select_parameters(problem.scene, specs, problem.config.source)
    return replace(problem, selection=selection, optimizer=make_optimizer(problem.config, selection), regularizers={})


def changes_of(problem: Problem) -> list[ParameterChange]:
    """Return the renderings for the directions of all parameters."""
    keys = problem.selection.keys
    scales = {key: _scale_of(problem, key) * (LONGER if ROUGHNESS.search(key) else 1.0) for key in keys}
    return plan_changes(problem, scales, STEP)


def _tests_of(
    fit: Fit, known: tuple[Array, Array], curvature: LossCurvature, directions: Sequence[ParameterDirection]
) -> _Tests:
    """Return the tests of `directions`, which `curvature` has measured. `known` are the derivatives along the recovered
    directions.
    """
    slope, variance = _slope_and_noise(fit, curvature)
    all_channels = max(each.shape[2] for each in fit.slopes)
    channels = np.array([1.0 if each.channel is not None else all_channels for each in directions])
    return _Tests(known, curvature.derivatives, curvature.weights, slope, variance, channels)


def _test(
    problem: Problem,
    fit: Fit,
    known: tuple[Array, Array],
    curvature: LossCurvature,
    directions: Sequence[ParameterDirection],
    proposals: Mapping[str, Proposal],
    count: int,
) -> list[tuple[float, float, Candidate]]:
    """Return the tested parameters, each after the fall of the loss and its `p`. Significant ones come first, sorted
    by the fall. `count` is the number of parameters in the first round of tests.
    """
    if not directions:
        return []
    tests, found = _tests_of(fit, known, curvature, directions), []
    for key in dict.fromkeys(direction.key for direction in directions):
        places = [place for place, direction in enumerate(directions) if direction.key == key]
        fall, p, offset = tests.of(places)
        # Noise may hide a curvature, but no parameter removes more than the residuals.
        fall, p = min(fall, 0.5 * fit.total), min(p * count, 1.0)
        own = [directions[each] for each in places]
        found.append((fall, p, _candidate(problem, proposals[key], own, offset, p)))
    return sorted(found, key=lambda each: (each[1] > LEVEL_OF_NAMED, -each[0]))


def _test_response(problem: Problem, fit: Fit, known: LossCurvature) -> list[tuple[float, float, Candidate]]:
    """Return the response of the camera as `_find_candidates` returns parameters, if a curve could be recovered."""
    found = group_response(problem, fit, known)
    if found is None:
        return []
    group, places = found
    fall, p, offsets = group.beside(known.derivatives)
    # As many tests as of other parameters, at most.
    p = min(p * (1 + MOST_TESTED), 1.0)
    return [(min(fall, 0.5 * fit.total), p, _response_candidate(places, offsets, p))]


def _slope_and_noise(fit: Fit, curvature: LossCurvature) -> tuple[Array, Array]:
    """Return dL/dI (N,) and the variance of its noise (N,) at the values of the images that `curvature` has."""
    return curvature.thinned * curvature.in_a_row(fit.slopes), curvature.thinned**2 * curvature.in_a_row(fit.variances)


def may_have_response(problem: Problem) -> bool:
    """Return whether a curve could be recovered: all targets are files that are decoded as sRGB, and all exposures are
    recovered.
    """
    return problem.config.target.white_balance is None and all(
        view.file is not None
        and view.file.suffix.lower() not in LINEAR_FILES
        and view.exposure.key
        and view.response is None
        and (view.decoded_by is None or view.decoded_by.encoding == "srgb")
        for view in problem.trained
    )


def _response_derivatives(problem: Problem, curvature: LossCurvature) -> tuple[Array, Array]:
    """Return the derivatives (K, N) of the images along the numbers of a curve, by each set of samples."""
    parts = [basis("curve", np.array(view.target, dtype=np.float64)) for view in problem.trained]
    one, other = (
        np.stack([
            curvature.in_a_row([-part[k] * image for part, image in zip(parts, images, strict=True)])
            for k in range(start("curve").size)
        ])
        for images in curvature.images
    )  # fmt: skip
    return one, other


def _response_candidate(places: Array, offsets: Array, p: float) -> Candidate:
    """Return the record of a curve whose numbers at `places` would change by `offsets`."""
    value = start("curve")
    proposed = value.copy()
    proposed[places] += offsets
    is_inside = bool(np.all((proposed > 0) & (proposed < MOST)))
    return Candidate(RESPONSE, p, 0.0, value.tolist(), proposed.tolist() if is_inside else [])


def _unrecovered(problem: Problem) -> list[Proposal]:
    """Return the parameters that could be recovered too, the most visible ones first, at most `MOST_TESTED`."""
    params, found = problem.selection.params, []
    for each in propose(problem.scene, problem.trained[0].sensor):
        info = each.info
        is_large = len(info.shape) != 3 and int(np.prod(info.shape)) > SMALL
        if info.key in problem.selection.scene_keys or info.bits is not None or is_large or info.value is None:
            continue
        if bends_light(params, info.key):  # a step would move the light out of the picture
            continue
        low, high = open_domain(params, info.key)
        if low <= info.value.low and info.value.high <= high:  # others would be moved, such as weights of 0
            found.append(each)
    moved = {item.key for item in where_moved(params, [each.info.key for each in found])}
    return [each for each in found if each.info.key not in moved][:MOST_TESTED]


def _scale_of(problem: Problem, key: str) -> float:
    """Return the scale of a parameter: its value, or half the distance between its bounds, if that is larger."""
    low, high = problem.selection.specs[key].bounds or (0.0, 0.0)
    return max(rms(problem.selection.array(key)), 0.5 * (high - low) if np.isfinite(high - low) else 0.0) or 1.0


def _candidate(
    problem: Problem, proposal: Proposal, directions: Sequence[ParameterDirection], offset: Array, p: float
) -> Candidate:
    """Return the record of a parameter whose directions would change by `offset`."""
    key = proposal.key
    value = problem.selection.array(key).astype(np.float64).ravel()
    if directions[0].entry is None:
        value, proposed = np.ones(len(directions)), 1 + offset
    else:
        proposed = value.copy()
        proposed[[direction.entry for direction in directions]] += offset
    bounds = problem.selection.specs[key].bounds if directions[0].entry is not None else (0.0, np.inf)
    low, high = bounds or (-np.inf, np.inf)
    is_inside = bool(np.all((low < proposed) & (proposed < high) & (proposed * value >= 0)))
    return Candidate(key, p, 0.0, value.tolist(), proposed.tolist() if is_inside else [], proposal.bounds or "")


class _Tests:
    """Score tests of directions. `known` and `new` are the derivatives of N values of the images along directions, each
    by two sets of samples. `weights` (N,) are d2L/dI2. `slope` and `variance` (N,) are dL/dI and its noise. `channels`
    (M,) is the number of channels that each new direction changes.
    """

    def __init__(
        self,
        known: tuple[Array, Array],
        new: tuple[Array, Array],
        weights: Array,
        slope: Array,
        variance: Array,
        channels: Array,
    ) -> None:
        halves, products = list(new), new[0] * weights * new[1]
        self.H = (new[0] * weights) @ new[1].T
        if len(known[0]):
            between = 0.5 * ((new[0] * weights) @ known[1].T + (new[1] * weights) @ known[0].T)
            followed = between @ pseudo_inverse((known[0] * weights) @ known[1].T, LEAST_EIGENVALUE)
            others = followed @ (0.5 * (known[0] + known[1]))
            halves = [half - others for half in halves]
            self.H = self.H - followed @ between.T
        # At least a standard error: where noise hides the curvature, the fall would have no limit.
        self.H = positive(self.H)
        error = np.sqrt(np.sum(products**2, axis=1))
        self.H += np.diag(np.maximum(error - np.diag(self.H), 0.0))
        s = [half @ slope for half in halves]
        self.s = 0.5 * (s[0] + s[1])
        # Noise of the derivatives of images shows in the difference of both sets.
        of_residual = positive((halves[0] * variance) @ halves[1].T * np.sqrt(np.outer(channels, channels)))
        self.V = of_residual + np.diag(0.25 * (s[0] - s[1]) ** 2)

    def of(self, places: Sequence[int]) -> tuple[float, float, Array]:
        """Return the fall of the loss, the probability that noise causes it, and the offsets of the directions."""
        s, at = self.s[places], np.ix_(places, places)
        inverse = pseudo_inverse(self.H[at], LEAST_EIGENVALUE)
        z2 = float(s @ pseudo_inverse(self.V[at], 1e-9) @ s)
        p = float(special().chdtrc(len(places), z2))
        return 0.5 * float(s @ inverse @ s), p, np.asarray(-inverse @ s)
