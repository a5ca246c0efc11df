"""Search for the origin of a non-finite value. The origin is a path with its vertex and factor, or a pixel of the loss.

`find_offenders` traces the paths of the step again from their seeds, and `SearchHooks` checks every factor. For each
factor, `SearchHooks` also checks the derivative along one direction. All entries of all parameters grow equally along
this direction. If the derivative along some direction is not finite, the derivative along the direction of equal growth
is not finite either.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.guiding.tables import Purpose
from reslrb_cli.integrators.plugin import make_reslrb
from reslrb_cli.integrators.protocol import Job
from reslrb_cli.integrators.reslrb import Reslrb
from reslrb_cli.integrators.step import (
    Refused,
    derivative_of,
    given_step,
    gradient_step,
    render_image,
    sample_sets,
)
from reslrb_cli.optimization.loading import LIGHT_TRACERS
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.shards import make_tasks
from reslrb_cli.optimization.state import guiding_of
from reslrb_cli.optimization.views import View
from reslrb_cli.seeds import seed
from reslrb_cli.transport.bsdf import Scattering, evaluate, tracked_factor
from reslrb_cli.transport.camera import CameraHooks, FilmRay, MetLight, NextEvent, camera_walk
from reslrb_cli.transport.connection import Connection, forward_derivatives
from reslrb_cli.transport.emission import (
    Emission,
    primary_ray,
    sample_emission,
    small_points,
    visible_radiance,
    visible_tangent,
)
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.film import Film
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Hooks, Vertex, walk


@dataclass(frozen=True)
class PathVertex:
    """A vertex of a path, with all data for tracing the path again.

    - `samples` names the set of samples that the path belongs to. `seed` is the seed of this set's sampler. `path` is
        the path's index among `paths`.
    - `vertex` is the number of the vertex. Vertex 0 is on the emitter for light paths, and on the sensor for camera
        paths. `samples` tells which kind of path it is.
    - `position` is in world space, and `surface` is the shape's id.
    """

    samples: str
    seed: int
    path: int
    paths: int
    vertex: int
    position: tuple[float, float, float]
    surface: str | None


@dataclass(frozen=True)
class Offender:
    """The first non-finite value of a view. Values are ordered by path, then by vertex.

    `quantity` names the value. `value` has one number per channel. For dL/dI and for a parameter's gradient, `value` is
    empty. `pixel` (x, y) is its place on the film, or None for a parameter's gradient. `where` is None for dL/dI, and
    for integrators whose paths are not checked. `image` and `target` are the two values that the loss compares at
    `pixel`. They are None for a path and for a parameter's gradient.
    """

    sensor: int
    pixel: tuple[int, int] | None
    quantity: str
    value: list[float]
    where: PathVertex | None
    image: list[float] | None = None
    target: list[float] | None = None


#: Quantities that may be non-finite; `Suspect.kind` is the index.
QUANTITIES = (
    "nothing",
    "emission E",
    "derivative of emission, dE",
    "scattering weight s",
    "derivative of the scattering factor, ds",
    "product of the factors E s_1 ... s_j",
    "connection factor c",
    "derivative of the connection factor, dc",
    "contribution C = E s_1 ... s_{i-1} c_i",
    "incident radiance, or radiance of a sampled emitter",
    "derivative of that radiance",
)

_E, _DE, _S, _DS, _PRODUCT, _C, _DC, _CONTRIBUTION, _L, _DL = range(1, len(QUANTITIES))


@dataclass
class Suspect:
    """A non-finite value (C,) with its kind and its vertex. Kind 0 means no value."""

    kind: Any
    vertex: Any
    p: Any
    shape: Any
    value: Any

    @staticmethod
    def none() -> Suspect:
        """Return a suspect without a value."""
        return Suspect(mi.UInt32(0), mi.UInt32(0), mi.Point3f(0), mi.UInt32(0), mi.Spectrum(0))

    def otherwise(self, other: Suspect, active: Any) -> Suspect:
        """Return this suspect. In `active` lanes where this suspect is empty, return `other` if the value of `other` is
        not finite.
        """
        take: Suspect = dr.select((self.kind == 0) & active & is_bad(other.value), other, self)
        return take


def is_bad(value: Any) -> Any:
    """Return the lanes in which a channel of `value` (C,) is not finite."""
    return ~dr.all(dr.isfinite(value))


def reaches(film: Film, u: Any, pixel: tuple[int, int] | None) -> Any:
    """Return the lanes whose film position `u` is within the filter's radius of `pixel`."""
    if pixel is None:
        return mi.Bool(False)
    centre = mi.Point2f(pixel[0] + 0.5, pixel[1] + 0.5)
    return dr.all(dr.abs(u - centre) <= film.film.rfilter().radius())


@dataclass
class Search:
    """Loop state.

    `first` is the first suspect of the path so far. `found` belongs to the first connection that reaches the film and
    has a non-finite value. `found` is the first non-finite value on the connection's path. `u` is the connection's film
    position. A connection that reaches the wanted pixel (`there`) takes precedence. `largest` is the largest
    contribution, which lands at `largest_u`.
    """

    first: Suspect
    found: Suspect
    u: Any
    there: Any
    largest: Suspect
    largest_u: Any


class SearchHooks(Hooks):
    """Checks every factor of a connection, the factor's derivative along the parameters' tangents, and the product of
    all factors.
    """

    def __init__(self, samples: Samples, emission: Any, derivative: Any, pixel: tuple[int, int] | None) -> None:
        """Make the hooks. `emission` has a ray and the emission E for each path. `derivative` is dE (C,). `pixel` is
        the wanted pixel, or None.
        """
        self.samples, self.emission, self.derivative, self.pixel = samples, emission, derivative, pixel

    def start(self, product: Product) -> Search:
        first = Suspect.none()
        for kind, value in ((_E, dr.detach(self.emission.weight)), (_DE, self.derivative)):
            here = Suspect(mi.UInt32(kind), mi.UInt32(0), self.emission.ray.o, mi.UInt32(0), mi.Spectrum(value))
            first = first.otherwise(here, mi.Bool(True))
        return Search(first, Suspect.none(), mi.Point2f(0), mi.Bool(False), Suspect.none(), mi.Point2f(0))

    def vertex(
        self, state: Search, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Search:  # fmt: skip
        plan, seen, scattered = self.samples.plan, connection.active, scattering.active
        shape = dr.reinterpret_array(mi.UInt32, vertex.si.shape)

        def here(kind: int, value: Any) -> Suspect:
            return Suspect(mi.UInt32(kind), vertex.depth, vertex.si.p, shape, mi.Spectrum(value))

        with dr.resume_grad(when=plan.differentiate_bsdfs):
            f_c = evaluate(plan, vertex.si, vertex.bsdf, connection.wo, seen)
            f_s = tracked_factor(plan, vertex.si, vertex.bsdf, scattering, scattered)
            df_c, df_s = forward_derivatives(f_c, f_s)
        useful = plan.differentiates(vertex.bsdf)
        C = vertex.product.times(connection.c, vertex.depth).scaled(self.samples.scale).value()
        found = state.first.otherwise(here(_C, connection.c), seen).otherwise(here(_DC, df_c), seen & useful)
        found = found.otherwise(here(_CONTRIBUTION, C), seen)
        there = reaches(self.samples.film, connection.u, self.pixel)
        new = seen & (found.kind != 0) & ((state.found.kind == 0) | (there & ~state.there))
        larger = seen & (dr.max(dr.abs(C)) > dr.max(dr.abs(state.largest.value)))

        first = state.first.otherwise(here(_S, scattering.weight), scattered)
        first = first.otherwise(here(_DS, df_s), scattered & useful)
        product = vertex.product.times(scattering.weight, vertex.depth).value()
        first = first.otherwise(here(_PRODUCT, product), scattered)
        return Search(
            first,
            dr.select(new, found, state.found),
            dr.select(new, connection.u, state.u),
            state.there | (new & there),
            dr.select(larger, here(_CONTRIBUTION, C), state.largest),
            dr.select(larger, connection.u, state.largest_u),
        )


class CameraSearch(CameraHooks):
    """Checks camera paths as `SearchHooks` checks light paths. Checks the emission, and each factor on the path before
    an emitter.
    """

    def __init__(self, samples: Samples) -> None:
        self.samples = samples
        self.u = mi.Point2f(0)

    def start(self, first: FilmRay) -> Search:
        self.u = first.u
        blank = mi.Point2f(0)
        return Search(Suspect.none(), Suspect.none(), blank, mi.Bool(False), Suspect.none(), blank)

    def vertex(
        self, state: Search, vertex: Vertex, met: MetLight | None, event: NextEvent | None, scattering: Scattering
    ) -> Search:  # fmt: skip
        plan, scene, si, P = self.samples.plan, self.samples.scene, vertex.si, vertex.product
        shape = dr.reinterpret_array(mi.UInt32, si.shape)

        def here(kind: int, value: Any) -> Suspect:
            return Suspect(mi.UInt32(kind), vertex.depth, si.p, shape, mi.Spectrum(value))

        zero = mi.Spectrum(0)
        with dr.resume_grad(when=plan.differentiate_bsdfs or plan.differentiate_emission):
            f_s = tracked_factor(plan, si, vertex.bsdf, scattering, scattering.active)
            Le_h = zero if met is None else met.radiance()
            f_c = zero if event is None else evaluate(plan, si, vertex.bsdf, event.wo, event.active)
            Le_n = zero if event is None else event.radiance(scene, si)
            df_s, dLe_h, df_c, dLe_n = forward_derivatives(f_s, Le_h, f_c, Le_n)
        useful, first = plan.differentiates(vertex.bsdf), state.first
        found, found_at, largest = first, mi.Bool(False), state.largest
        for light, C, factors in (
            (met, None if met is None else met.Le * met.weight, ((_L, None if met is None else met.Le), (_DL, dLe_h))),
            (event, None if event is None else event.c,
             ((_L, None if event is None else event.Le), (_DL, dLe_n), (_C, None if event is None else event.c))),
        ):  # fmt: skip
            if light is None:
                continue
            for kind, value in factors:
                found = found.otherwise(here(kind, value), light.active)
            if light is event:
                found = found.otherwise(here(_DC, df_c), light.active & useful)
            contribution = P.times(C, vertex.depth).scaled(self.samples.scale).value()
            found = found.otherwise(here(_CONTRIBUTION, contribution), light.active)
            found_at |= light.active
            larger = light.active & (dr.max(dr.abs(contribution)) > dr.max(dr.abs(largest.value)))
            largest = dr.select(larger, here(_CONTRIBUTION, contribution), largest)
        new = found_at & (found.kind != 0) & (state.found.kind == 0)
        first = first.otherwise(here(_S, scattering.weight), scattering.active)
        first = first.otherwise(here(_DS, df_s), scattering.active & useful)
        product = P.times(scattering.weight, vertex.depth).value()
        first = first.otherwise(here(_PRODUCT, product), scattering.active)
        return Search(first, dr.select(new, found, state.found), state.u, state.there, largest, state.largest_u)


Array = np.ndarray[Any, Any]

#: The seed of a set of samples, and its passes.
NotedSet = tuple[int, list[Samples]]


@dataclass
class Found:
    """The search result. `offender` belongs to the first path with a non-finite value. `there` is True if this path
    reaches the wanted pixel. `largest` is the largest contribution.
    """

    offender: Offender | None
    there: bool
    largest: Offender | None


def search_paths(samples: Samples, sensor: int, label: str, pixel: tuple[int, int] | None) -> Found:
    """Check every path of these samples. Paths that reach `pixel` come first. The parameters must have tangents."""
    plan, describe = samples.plan, partial(_describe, samples, sensor, label)
    with dr.suspend_grad():
        if plan.camera:
            first, state = camera_walk(samples, CameraSearch(samples))
            state.u = state.largest_u = first.u
            state.there = reaches(samples.film, first.u, pixel)
        else:
            with dr.resume_grad(when=plan.differentiate_emission):
                E = sample_emission(samples, samples.sampler())
                [dE] = forward_derivatives(E.weight) if plan.differentiate_emission else [mi.Spectrum(0)]
            state = walk(samples, SearchHooks(samples, Emission(E.ray, dr.detach(E.weight), E.emitter), dE, pixel))
        dr.eval(state)
    size = np.array(dr.max(dr.abs(state.largest.value)))
    brightest = int(np.argmax(np.where(np.isfinite(size), size, 0)))
    largest = describe(state.largest, state.largest_u, brightest) if size[brightest] > 0 else None
    lane, there = _first(np.array(state.found.kind) != 0, np.array(state.there))
    if lane is not None:
        return Found(describe(state.found, state.u, lane), there, largest)
    with dr.suspend_grad():
        for suspect, tangent, u, active in _seen_emission(samples) if plan.visible_emission and not plan.weighs else ():
            at_pixel = np.array(reaches(samples.film, u, pixel))
            for quantity, value in (("emission E towards the sensor", suspect.value), (QUANTITIES[_DE], tangent)):
                bad = np.broadcast_to(np.array(active & is_bad(value)), samples.width)
                lane, there = _first(bad, at_pixel)
                if lane is not None:
                    offender = describe(replace(suspect, value=mi.Spectrum(value)), u, lane, quantity)
                    return Found(offender, there, largest)
    return Found(None, False, largest)


def _seen_emission(samples: Samples) -> Iterator[tuple[Suspect, mi.Spectrum, mi.Point2f, mi.Bool]]:
    """Yield emission that the sensor sees directly. Primary rays come first, then emitters smaller than a pixel.

    Each item has radiance (C,) with its tangent, film positions, and active lanes.
    """
    plan, tangent = samples.plan, mi.Spectrum(0)
    primary = primary_ray(samples)
    radiance = visible_radiance(plan, samples.scene, primary)
    if plan.differentiate_emission or plan.differentiate_null:
        tangent = visible_tangent(plan, samples.scene, primary)
    si = samples.scene.ray_intersect(primary.ray, primary.active)
    p, shape = dr.select(si.is_valid(), si.p, primary.ray.o), dr.reinterpret_array(mi.UInt32, si.shape)
    yield Suspect(mi.UInt32(0), mi.UInt32(0), p, shape, radiance), tangent, primary.u, primary.active
    if not plan.small_lamps:
        return
    tangent, point = mi.Spectrum(0), small_points(samples)
    with dr.resume_grad():
        radiance = point.radiance()
        if plan.differentiate_emission:
            [tangent] = forward_derivatives(radiance)
    shape = dr.reinterpret_array(mi.UInt32, point.emitter.get_shape())
    suspect = Suspect(mi.UInt32(0), mi.UInt32(0), point.si.p, shape, dr.detach(radiance))
    yield suspect, tangent, point.u, point.active


def _first(bad: Array, there: Array) -> tuple[int | None, bool]:
    """Return the first lane that `bad` marks, and True if `there` marks this lane, too. A lane that is `there` takes
    precedence.
    """
    lanes = np.flatnonzero(bad)
    preferred = np.flatnonzero(bad & there)
    if preferred.size:
        return int(preferred[0]), True
    return (int(lanes[0]) if lanes.size else None), False


def _describe(
    samples: Samples, sensor: int, label: str, suspect: Suspect, u: Any, lane: int, quantity: str | None = None
) -> Offender:
    """Return the record of one lane's suspect."""

    def number(value: Any) -> Any:
        return np.array(value).ravel()[lane % dr.width(value)]

    where = PathVertex(
        samples=label,
        seed=int(samples.seed[0]),
        path=lane,
        paths=samples.width,
        vertex=int(number(suspect.vertex)),
        position=(float(number(suspect.p.x)), float(number(suspect.p.y)), float(number(suspect.p.z))),
        surface=_shape_name(samples.scene, int(number(suspect.shape))),
    )
    pixel = (int(np.floor(number(u.x))), int(np.floor(number(u.y))))
    value = [float(number(channel)) for channel in suspect.value]
    return Offender(sensor, pixel, quantity or QUANTITIES[int(number(suspect.kind))], value, where)


def _shape_name(scene: Any, index: int) -> str | None:
    for shape in scene.shapes():
        if int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0]) == index:
            return str(shape.id())
    return None


def find_offenders(problem: Problem, iteration: int) -> list[Offender]:
    """Return the first non-finite value of each view that has a non-finite value. The parameters are those of
    `problem`.
    """
    found: list[Offender] = []
    apart, guiding = problem.config.shards != 1, guiding_of(problem)
    views = {view.sensor: view for view in problem.views}
    seeds = [(sensor, "", seed(problem.config.run.seed, iteration, sensor, "image")) for sensor in views]
    if guiding is not None:  # a sensor that was not drawn in this iteration has updated no table
        guiding.held = apart  # tables do not learn while shards are computed
        drawn = {view.sensor for view, _ in problem.drawn(iteration)}
        seeds = [each for each in seeds if each[0] in drawn]
    if apart:
        tasks = make_tasks(problem, iteration)
        seeds = [(part.sensor, f"shard {task.shard + 1}, ", part.seed) for task in tasks for part in task.parts]
    for sensor, word, step_seed in seeds:
        offender = None
        if all(one.sensor != sensor for one in found):
            offender = _of_view(problem, views[sensor], step_seed, word)
        if offender is not None:
            found.append(offender)
    return found


def _of_view(problem: Problem, view: View, step_seed: int, word: str) -> Offender | None:
    """Return the first non-finite value of one view, or None. The search covers the view's samples, or the samples of
    the shard named `word`.

    If shards split a view's samples (`in_rounds`), the shard's own samples give the image for dL/dI. The mean image of
    the other shards is not used.
    """
    noted: list[NotedSet] = []
    step = _take_step(problem, view, step_seed, noted)
    if problem.config.integrator.type not in LIGHT_TRACERS:
        return _of_step(step, view, None)  # their paths are not ours
    if not problem.moves:
        _set_tangents(problem)
    pixel = None if step.refused is None else step.refused[:2]
    parts = _parts(problem, view, step_seed, noted)
    found = [search_paths(samples, view.sensor, word + label, pixel) for samples, label in parts]
    problem.apply()
    offenders = [part.offender for part in sorted(found, key=lambda part: not part.there) if part.offender is not None]
    if offenders:
        return offenders[0]
    largest = [part.largest for part in found if part.largest is not None]
    most = max(largest, key=lambda entry: max(map(abs, entry.value)), default=None)
    return _of_step(step, view, most)


def _parts(problem: Problem, view: View, step_seed: int, noted: list[NotedSet]) -> Iterator[tuple[Samples, str]]:
    """Yield a step's samples pass by pass, with a name.

    `noted` has the samples that `reslrb` traced. The samples of other light tracers are made here, from the same seeds.
    """
    options = problem.config.step_options(shard=True)
    if problem.config.in_rounds:
        options["adjoint"] = "correlated"  # both rounds have the same samples
    sets = sample_sets(step_seed, options)
    if not isinstance(problem.integrator, Reslrb):
        noted = _sets_of_others(problem, view, sets)
    names = {int(samples_seed[0]): name for name, samples_seed, _ in sets}
    for number, passes in noted:
        if number not in names:  # samples that only tables learn from
            continue
        name = names[number]
        names[number] = f"{name}, again"
        for place, samples in enumerate(passes):
            label = name if len(passes) == 1 else f"{name}, pass {place + 1}"
            for side in samples.sides():
                if side.plan.attached:  # only contributions are checked: derivatives of moving light need Jacobians
                    side = replace(side, plan=side.plan.differentiating(False, False, side.plan.track_zeros))
                yield side, f"{label}, camera paths" if side.plan.camera else label


def _sets_of_others(problem: Problem, view: View, sets: list[tuple[str, mi.UInt32, int]]) -> list[NotedSet]:
    """Return the samples of light tracers other than `reslrb`, which trace the same paths as `reslrb`."""
    given = problem.config.integrator.options()
    shared = {name: given[name] for name in ("max_depth", "rr_depth", "hide_emitters") if name in given}
    tracer = make_reslrb(estimator="gather", samples_per_pass=problem.samples_per_pass, **shared)
    # For moving light, only contributions are checked: `gather` has no derivatives of them.
    params = None if problem.moves else problem.selection.params
    scene, sensor = problem.scene, problem.scene.sensors()[view.sensor]
    return [(int(own[0]), tracer.passes(Job(scene, sensor, own, spp, params))) for _, own, spp in sets]


def _set_tangents(problem: Problem) -> None:
    """Set the tangents of all parameter entries in the scene to 1."""
    params, keys = problem.selection.params, problem.selection.keys
    keys = [key for key in keys if key in params]  # an exposure is not part of any path
    for key in keys:
        leaf = problem.optimizer[key]
        dr.set_grad(leaf, 1.0)
        params[key] = leaf
    params.update()
    for key in keys:
        dr.enqueue(dr.ADMode.Forward, problem.optimizer[key])
    dr.traverse(dr.ADMode.Forward, dr.ADFlag.ClearEdges)


@dataclass
class TracedStep:
    """Result of a step: its image (H, W, C), its gradients, and the first refused entry of dL/dI as (x, y, channel)."""

    image: Array
    gradients: dict[str, Array]
    refused: tuple[int, int, int] | None


def _take_step(problem: Problem, view: View, step_seed: int, noted: list[NotedSet]) -> TracedStep:
    """Repeat the gradient step that the run took for this view. Leaves no gradients. Adds the samples of `reslrb` to
    `noted`.
    """
    optimizer, config, tracer = problem.optimizer, problem.config, problem.integrator
    if isinstance(tracer, Reslrb):
        tracer = _noting(tracer, noted)
    at = tracer, problem.scene, view.sensor
    own: dict[str, Any] = {"params": problem.selection.params, "on_samples": problem.on_samples(view)}
    if config.in_rounds:
        image, refused = render_image(*at, step_seed, config.share_spp), Refused()
        _, gradient = derivative_of(view.objective, image, refused)
        given_step(*at, gradient, seed=step_seed, spp=config.share_spp, **own)
    else:
        own |= config.step_options(shard=True)
        step = gradient_step(*at, view.objective, seed=step_seed, **own)
        image, refused = step.image, step.refused
    gradients = {key: np.array(gradient) for key, gradient in problem.gradients().items()}
    for key in problem.selection.keys:
        optimizer.clear_gradient(key)
    return TracedStep(np.array(image), gradients, refused.entry())


def _noting(tracer: Reslrb, noted: list[NotedSet]) -> Reslrb:
    """Return a copy of the tracer that adds the samples of each of its jobs to `noted`."""

    def passes(job: Job, purpose: Purpose | None = None, delta: mi.TensorXf | None = None) -> list[Samples]:
        made = tracer.passes(job, purpose, delta)
        noted.append((int(job.seed[0]), made))
        return made

    noting = copy.copy(tracer)
    noting.passes = passes  # type: ignore[method-assign]
    return noting


def _of_step(step: TracedStep, view: View, largest: Offender | None) -> Offender | None:
    """Return another cause if no path has a non-finite value. Possible causes are the loss, an overflow of sums, and
    paths that were not checked.
    """
    image, target = step.image, np.array(view.target)
    if step.refused is not None:
        x, y, channel = step.refused
        if np.isfinite(image[y, x]).all():
            what = f"derivative of the loss, dL/dI, channel {channel}"
            return Offender(view.sensor, (x, y), what, [], None, image[y, x].tolist(), target[y, x].tolist())
    bad = [key for key, gradient in step.gradients.items() if not np.isfinite(gradient).all()]
    if np.isfinite(image).all() and not bad:
        return None
    if largest is not None:
        what = "sum of contributions, each of which is finite; the largest"
        return replace(largest, sensor=view.sensor, quantity=what)
    unseen = "(the paths of this integrator are not checked)"
    if bad and np.isfinite(image).all():
        return Offender(view.sensor, None, f"gradient {unseen} of {bad[0]}", [], None)
    y, x, _ = (int(index) for index in np.argwhere(~np.isfinite(image))[0])
    value = image[y, x].tolist()
    return Offender(view.sensor, (x, y), f"image {unseen}", value, None, value, target[y, x].tolist())
