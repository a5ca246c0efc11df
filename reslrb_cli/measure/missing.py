"""Terms that attached gradients lack: silhouettes, shadow edges, and light that leaves the film.

`integrator.edges` adds silhouettes and shadow edges (`estimators/edges.py`). Images at common random numbers have all
terms. `Tracing` compares images and gradients along K segments a <= s <= b of the lines x + s d_k through the initial
values x. w_k is dL/dI at the end of the segment with the higher loss.

    F_k = <w_k, I(b) - I(a)> / (b - a),   g_k = d_k . gradient of <w_k, I> at a random s,   m_k = F_k - g_k
    share = sqrt(sum_k E[m_k]^2 / sum_k E[F_k]^2)

g_k is an unbiased sample of the mean derivative F_k if nothing is missing, whatever the segment's length, so no
truncation error looks like a missing part. At the initial values themselves, the derivative of the loss may vanish.
Along a segment, the image changes by about 3 % (`AIM`), or less if the segment would be longer than `LONGEST`.

A significant share differs from 0 by Student's t (`MissingRecord.margin`), with a limit for all directions and for all
`LOOKS` at the samples. A complete derivative counts as incomplete with a probability of at most `ALARM`.

`gradcheck --missing` and runs share `MissingCheck`. `check_missing` measures before a run's first iteration, and
decides `edges: auto`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from reslrb_cli.config.parameters import HEIGHTMAP
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.integrators.plugin import make_integrator
from reslrb_cli.integrators.reslrb import LightTracer
from reslrb_cli.measure.gradients import (
    REACH,
    UNITS,
    Case,
    Direction,
    all_directions,
    embed,
    moves_light,
    seeds,
    smooth_rows,
)
from reslrb_cli.measure.methods import NEVER, parse_cases
from reslrb_cli.measure.participants import PATHS
from reslrb_cli.measure.references import ends
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.autotune.sampling import as_decided, is_auto
from reslrb_cli.optimization.loading import with_lamps_of_views
from reslrb_cli.optimization.memory import pixels_of
from reslrb_cli.optimization.optimizers import SMALL
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.sensitivity import AIM, take_gradient
from reslrb_cli.optimization.views import View, to_tensor
from reslrb_cli.records.decisions import Decision
from reslrb_cli.records.measurements import LOOKS, MissingRecord, student
from reslrb_cli.scene.deformation import where_moved
from reslrb_cli.scene.edges import has_edges
from reslrb_cli.scene.needs import camera_finds_all
from reslrb_cli.statistics import jackknife_variance

#: Minimum number of seeds for a share, and the factor from one look at the samples to the next.
FEWEST, GROWTH = 8, 4

#: Longest and shortest segment to either side, as fractions of a direction.
LONGEST, SHORTEST = 0.1, 0.001

#: Seeds of the images that decide the length of a segment.
PILOTS = seeds(2, 9)


@dataclass(frozen=True)
class LineSegment:
    """Values x + s `vector` with `low` <= s <= `high`, where x (P,) are the initial values. `weights` has dL/dI of each
    view, (H, W, C).
    """

    vector: np.ndarray
    low: float
    high: float
    weights: Sequence[np.ndarray] = ()


@dataclass
class Tracing:
    """Images and gradients at values along segments, for one case per view.

    `images` and `gradients` are the integrators. `spent` counts the samples per pixel of images and gradients.
    `before` is called before each image and gradient, and may raise. A move of a large mesh takes longer than an image.
    Everything that needs one place is therefore rendered after one move.
    """

    cases: Sequence[Case]
    images: Any
    gradients: Any
    spp: int
    before: Callable[[], None] = lambda: None
    spent: int = 0

    def values(self, vector: np.ndarray, s: float) -> dict[str, np.ndarray]:
        """Return the values x + s `vector` by parameter."""
        case = self.cases[0]
        return {key: case.initial[key] + s * vector[at] for key, at in case.places.items()}

    def segment(self, direction: Direction, trials: int = 4, step: float = LONGEST) -> LineSegment:
        """Return a segment without weights. Up to `trials` lengths are tried, until the image changes by about `AIM`
        along the segment. The first trial ends at `step`.
        """
        back = 1.0 if direction.sides == "both" else 0.0
        for _ in range(trials):
            change = self._change(direction.vector, -back * step, step)
            wanted = min(max(step * AIM / change, SHORTEST), LONGEST) if change else LONGEST
            if step / 2 <= wanted <= 2 * step:
                break
            step = wanted
        return LineSegment(direction.vector, -back * step, step)

    def _change(self, vector: np.ndarray, low: float, high: float) -> float:
        """Return the change of the images from `low` to `high` relative to their size. Products of two independent
        images have no bias from noise.
        """
        (a, b), (c, d) = (self._see(vector, s, PILOTS) for s in (low, high))
        change = size = 0.0
        for first, second, third, fourth in zip(a, b, c, d, strict=True):
            change += float(np.sum((third - first) * (fourth - second)))
            size += float(np.sum(first * second))
        return float(np.sqrt(max(change, 0.0) / size)) if size > 0 else 0.0

    def _see(self, vector: np.ndarray, s: float, seeds: Sequence[int]) -> list[list[np.ndarray]]:
        """Return the images (H, W, C) of all views at x + s `vector`, for each seed."""
        self.cases[0].set(self.values(vector, s))
        self.spent += self.spp * len(seeds)
        found = []
        for seed in seeds:
            self.before()
            found.append([case.image(self.images, seed, self.spp) for case in self.cases])
        return found

    def samples(self, segments: Sequence[LineSegment], seeds: Sequence[int]) -> np.ndarray:
        """Return the difference along each of K segments, and the gradient at a random point of it, for N seeds:
        (N, K, 2).
        """
        return np.stack([self.sample(segment, seeds) for segment in segments], 1)

    def sample(self, segment: LineSegment, seeds: Sequence[int]) -> np.ndarray:
        """Return the difference and the gradient of one segment, (N, 2)."""
        found = np.zeros((len(seeds), 2))
        for s, sign in ((segment.high, 1), (segment.low, -1)):
            for row, images in zip(found, self._see(segment.vector, s, seeds), strict=True):
                pairs = zip(images, segment.weights, strict=True)
                row[0] += sign * sum(float(np.sum(image * weights)) for image, weights in pairs)
        found[:, 0] /= segment.high - segment.low
        for row, seed in zip(found, seeds, strict=True):
            self.before()
            at = np.random.default_rng(seed).uniform(segment.low, segment.high)
            leaves = self.cases[0].leaves(self.values(segment.vector, at))
            self.spent += self.spp
            for case, weights in zip(self.cases, segment.weights, strict=True):
                case.weigh(weights)
                gradient = case.gradient_of(leaves, self.gradients, seed, self.spp, step=case.known_step)
                row[1] += float(segment.vector @ gradient)
        return found

    def weigh(self, segment: LineSegment, problem: Problem, views: Sequence[View], spp: int) -> LineSegment:
        """Return the segment with the weights dL/dI at its end with the higher loss."""
        found: list[tuple[float, list[np.ndarray]]] = []
        for s in (segment.high, segment.low):
            self.cases[0].set(self.values(segment.vector, s))
            self.before()
            self.spent += spp
            loss, weights = 0.0, []
            for case, view in zip(self.cases, views, strict=True):
                view.follow(problem.scene)
                image = problem.render(view.sensor, spp, 0, "missing")
                loss += float(view.compare(to_tensor(image))[0]) * view.share
                slope = problem.image_gradient(view, image).astype(np.float64)[:, :, : case.weights.shape[2]]
                weights.append(np.nan_to_num(slope) * view.share)
            found.append((loss, weights))
        weights = max(found, key=lambda each: each[0])[1]
        # The size of dL/dI does not affect a share, and tiny numbers would vanish in the rounding of a sum.
        size = max(float(np.abs(each).mean()) for each in weights) or 1.0
        return replace(segment, weights=[each / size for each in weights])


def missing_record(case: str, parameter: str, samples: np.ndarray) -> MissingRecord:
    """Return the record of a parameter from the `samples` of `Tracing`, (N, K, 2). The record has no share if the
    differences are not significantly different from 0.
    """
    whole, ours = np.moveaxis(samples, 2, 0)
    share, error = (share_of(whole, whole - ours) if len(samples) > 1 else None) or (None, None)
    return MissingRecord(case, parameter, share, error, samples.shape[1], len(samples))


def share_of(whole: np.ndarray, missing: np.ndarray) -> tuple[float, float] | None:
    """Return the share of `missing` in `whole`, and the share's standard error. Both arguments are samples (N, K).

    Returns None if `whole` is not significantly different from 0.
    """
    limit, count = student(*whole.shape), len(whole)
    (part, part_noise), (size, noise) = _squared_mean(missing), _squared_mean(whole)
    if size <= limit**2 * noise:
        return None
    found = float(_ratio(missing, whole))
    if part + part_noise <= limit**2 * part_noise:
        return found, float(np.sqrt(part_noise / size))
    # The noise of the part and of the whole: leave out one seed at a time (jackknife).
    others = np.nonzero(~np.eye(count, dtype=bool))[1].reshape(count, -1)
    return found, float(np.sqrt(jackknife_variance(_ratio(missing[others], whole[others]))))


def _ratio(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return rms(part) / rms(whole) for samples (..., N, K). rms is the root mean square of the means, without
    noise.
    """
    return np.asarray(np.sqrt(np.maximum(_squared_mean(part)[0], 0.0) / _squared_mean(whole)[0]))


def _squared_mean(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the squared norm of the mean of samples (..., N, K) without the part due to noise, and that part."""
    noise = samples.var(-2, ddof=1).sum(-1) / samples.shape[-2]
    return np.square(samples.mean(-2)).sum(-1) - noise, noise


#: Maximum numbers of seeds and views.
MOST_SEEDS, MOST_VIEWS = FEWEST * GROWTH ** (LOOKS - 1), 4

#: Light paths of the image at which the command takes dL/dI.
IMAGE_PATHS = 2**22

#: Estimator that the command checks: exact, and attached if anything moves.
ESTIMATOR = "reslrb:stack"


class MissingCheck:
    """Measurement of the missing shares of the parameters `keys`, for the losses of the `views`.

    `images` and `gradients` are the integrators, and `spp` are their samples per pixel. dL/dI is that of images with
    `image_spp` samples per pixel.
    """

    def __init__(
        self, problem: Problem, keys: Sequence[str], views: Sequence[View], images: Any, gradients: Any, spp: int,
        image_spp: int,
    ) -> None:  # fmt: skip
        cases = [Case(problem.scene, keys, view.sensor, problem.selection) for view in views]
        self.tracing = Tracing(cases, images, gradients, spp, problem.stop_if_interrupted)
        self.problem, self.keys, self.views, self.image_spp = problem, keys, views, image_spp
        self.source = str(problem.config.source)
        moving = where_moved(problem.selection.params, problem.selection.scene_keys)
        sizes = [_size(item.node.bbox()) for item in moving if item.is_shape]
        self._extent = min([size for size in sizes if size > 0], default=_size(problem.scene.bbox()))

    @classmethod
    def of_run(cls, problem: Problem, keys: Sequence[str]) -> MissingCheck:
        """Return the check before a run. The run's own integrator takes the samples."""
        run, integrator = problem.config.run, problem.integrator
        if isinstance(integrator, LightTracer):
            integrator = integrator.to_measure()
        spp = min(max(run.spp // 16, 1), problem.samples_per_pass or run.spp)
        return cls(problem, keys, problem.trained[:MOST_VIEWS], integrator, integrator, spp, max(run.spp // 4, 1))

    @classmethod
    def of_config(cls, config: Config, spp: int | None) -> MissingCheck:
        """Return the check of the command `gradcheck --missing`. A variant must be set. Raises ConfigError and
        UnsupportedScene.
        """
        depth, asked = config.integrator.max_depth, config.integrator.options()
        [listed] = parse_cases(ESTIMATOR + ("(paths=auto)" if asked.get("paths", "auto") == "auto" else ""))
        problem = assemble(listed.at(config, depth, known=True, auto=True).with_exposures_fixed())
        options = problem.config.integrator.options() | {"paths": problem.paths}
        options["edges"] = "off" if asked.get("edges") == "off" else "on"
        shared = {name: options[name] for name in ("max_depth", "hide_emitters")} | {"paths": problem.paths}
        never = NEVER if ends(depth) else options["rr_depth"]
        images, gradients = (
            with_lamps_of_views(problem.config, type, make_integrator(type, **own), problem.scene)
            for type, own in (("walk_ad", {**shared, "rr_depth": never}), ("reslrb", {**options, "freeze": True}))
        )  # fmt: skip
        [pixels] = pixels_of(problem.scene, problem.sensors[:1])
        spp, image_spp = spp or max(PATHS // pixels, 1), max(IMAGE_PATHS // pixels, 1)
        return cls(problem, problem.selection.keys, problem.views[:1], images, gradients, spp, image_spp)

    def conditions(self) -> str:
        """Describe the measurement in one line."""
        height, width, _ = self.tracing.cases[0].weights.shape
        film = f"film {width}x{height}, {self.tracing.spp} spp"
        return f"{self.source}, {film}, dL/dI of the loss beside the initial values"

    def directions(self, key: str) -> list[Direction]:
        """Return the directions of a parameter. A small parameter that moves light has one direction for each entry. A
        large one has two smooth directions, and any other parameter has two random directions.
        """
        case, selection = self.tracing.cases[0], self.problem.selection
        size, value = case.initial[key].size, case.values.value(key)
        if not moves_light(selection.params, key):
            return all_directions(case, selection, 2, 2)[key]
        if size > SMALL:
            rows = smooth_rows(key, value, self._extent, 2)
        else:
            rows = list((UNITS.get(key.rpartition(".")[2]) or REACH * self._extent) * np.eye(size))
        return [Direction(embed(case, key, row), "both") for row in rows]

    def measured(
        self, key: str, affords: Callable[[int], bool], most: int = MOST_SEEDS, looks: bool = True
    ) -> MissingRecord:
        """Measure one parameter with at most `most` seeds. With `looks`, the measurement ends when its record is
        decided.

        `affords` tells whether a number of further samples may be taken. The record has no share if they are too few,
        or if dL/dI is zero.
        """
        tracing, directions, fewest = self.tracing, self.directions(key), min(FEWEST, most)
        at_a_seed, trial = 3 * tracing.spp * len(directions), 2 * len(PILOTS) * tracing.spp * len(directions)
        least, segments = 2 * self.image_spp * len(directions) + fewest * at_a_seed, list[LineSegment]()
        trials = next((count for count in range(4, 0, -1) if affords(least + count * trial)), 0)
        for direction in directions if trials else ():
            # Directions of one parameter have similar effects: the length of the last segment suits the next one.
            segment = tracing.segment(direction, trials, segments[-1].high if segments else LONGEST)
            segments.append(tracing.weigh(segment, self.problem, self.views, self.image_spp))
        if not any(np.any(weights) for segment in segments for weights in segment.weights):
            return MissingRecord(self.source, key, None, None, len(directions), 0)
        samples, look = np.zeros((0, len(segments), 2)), fewest
        while True:
            count = len(samples)
            samples = np.concatenate([samples, tracing.samples(segments, seeds(most)[count : count + FEWEST])])
            count = len(samples)
            if looks and count == look:
                if missing_record(self.source, key, samples).is_decided:
                    break
                look *= GROWTH
            if count == most or not affords(min(FEWEST, most - count) * at_a_seed):
                break
        return missing_record(self.source, key, samples)


def _size(box: Any) -> float:
    return float(np.linalg.norm(np.array(box.max - box.min)))


# --- before a run's first iteration -----------------------------------------------------------------------------------


def check_missing(
    problem: Problem, say: Callable[[str], None], warn: Callable[[str], None]
) -> tuple[Problem, list[MissingRecord]]:  # fmt: skip
    """Measure the missing share of the loss's derivative before a run, for each parameter that moves light. Return the
    problem, and one record per parameter.

    With `integrator.edges: auto`, edges are turned on in the returned problem if a significant share is missing without
    them, or if the share is unknown. The share is then measured again. If it is not smaller with edges, edges stay off.
    `say` receives the decision. If everything that moves has known edges, and edges are on, records of unknown shares
    are dropped.

    `warn` receives one line if a derivative is incomplete, or if its missing share is unknown. Raises ConfigError if a
    significant missing share exceeds one half, unless `run.accept_incomplete` is true.
    """
    config, found = problem.config, measure_missing(problem)
    moving = where_moved(problem.selection.params, problem.selection.scene_keys)
    edged = [item for item in moving if not item.is_shape or has_edges(item.node)]
    tracer = problem.integrator if edged and isinstance(problem.integrator, LightTracer) else None
    if tracer is not None and is_auto(config, "edges") and found:
        problem, found = _decide_edges(problem, tracer, found, say)
        tracer = problem.integrator
    has_edge_terms = tracer is not None and "edges" in tracer.preparation.sampling.on
    if has_edge_terms and len(edged) == len(moving):
        found = [record for record in found if not record.is_unknown]
    told = [record for record in found if record.is_incomplete]
    if not told:
        return problem, found
    line, way = "; ".join(record.line() for record in told), "integrator.type=prb_projective includes all of it"
    helps = camera_finds_all(problem.scene, config.integrator.max_depth)
    if tracer is not None and not has_edge_terms and not is_auto(config, "edges"):
        way, helps = "integrator.edges=on includes silhouettes and shadow edges", True
    if any(record.is_for_the_most_part for record in told) and not config.run.accept_incomplete:
        first = f"--set {way}, and" if helps else "the steps would have wrong directions;"
        raise ConfigError(config.source, "integrator.type", f"{line}; {first} --set run.accept_incomplete=true runs it "
                                                            "anyway")  # fmt: skip
    warn(f"{line}; --set {way}" if helps else line)
    return problem, found


def _decide_edges(
    problem: Problem, tracer: LightTracer, found: list[MissingRecord], say: Callable[[str], None]
) -> tuple[Problem, list[MissingRecord]]:  # fmt: skip
    """Return the problem with `edges` on or off, and the records of the shares that are then missing. `found` are the
    records without edges.
    """
    lacking = [record for record in found if record.is_incomplete]
    value, why = "off", "no significant part of the derivative is missing without them"
    if lacking:
        edges_on = as_decided(tracer, [Decision(setting="edges", value="on", why="")])
        after = {record.parameter: record for record in measure_missing(replace(problem, integrator=edges_on))}
        clear = next((record for record in lacking if not record.is_unknown), lacking[0])
        lost = f"the derivative of {clear.parameter} lacks"
        if any(record.is_reduced_to(after.get(record.parameter)) for record in lacking):
            amount = "an unknown share" if clear.is_unknown else clear.percent()
            value, why, found = "on", f"without them, {lost} {amount}", list(after.values())
        else:
            why = f"{lost} {clear.percent()} without them, and as much with them"
    decision = Decision(setting="edges", value=value, why=why)
    if lacking:
        say(f"chosen by measurement: {decision.line()}")
    decisions = [*problem.decisions, decision]
    return replace(problem, decisions=decisions, integrator=as_decided(tracer, [decision])), found


def measure_missing(problem: Problem) -> list[MissingRecord]:
    """Measure the missing share of each parameter that moves light. The sample limit is the fraction `run.measuring` of
    the run's samples.

    The parameters keep their values. If the sample limit is too low for a measurement, the parameter's record has no
    share. Heightmaps with an unknown share are left out, because their rims hardly move. The function restores the
    scene, and leaves no gradients.
    """
    selection, kind = problem.selection, problem.config.integrator.type
    moving = [key for key in selection.keys if key not in selection.factors and moves_light(selection.params, key)]
    if not moving or kind == "custom" or kind.endswith("_projective"):  # these have edges, or may have them
        return []
    problem.apply()
    try:
        found, check, run = [], MissingCheck.of_run(problem, moving), problem.config.run
        limit = run.measuring * run.iterations * run.spp * len(problem.drawn(0)) / len(check.views)
        for place, key in enumerate(moving):  # each one gets an equal part of the samples that the earlier ones left
            end = check.tracing.spent + (limit - check.tracing.spent) / (len(moving) - place)
            found.append(check.measured(key, lambda more, end=end: check.tracing.spent + more <= end))  # type: ignore[misc]
    finally:
        take_gradient(problem)
        problem.apply()
    return [record for record in found if not (record.parameter.endswith(f".{HEIGHTMAP}") and record.is_unknown)]
