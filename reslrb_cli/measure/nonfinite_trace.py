"""Search for the origin of a non-finite value. The origin is a path with its vertex and factor, or a pixel of the loss.

`find_offenders` traces the paths of the step again from their seeds, and `Checks` checks every factor. For each factor,
`Checks` also checks the derivative along one direction. All entries of all parameters grow equally along this
direction. If the derivative along some direction is not finite, the derivative along the direction of equal growth is
not finite either.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from reslrb_cli.guiding.tables import Purpose
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
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.optimization.shards import make_tasks
from reslrb_cli.optimization.state import guiding_of
from reslrb_cli.optimization.views import View
from reslrb_cli.seeds import seed
from reslrb_cli.transport.bsdf import Scattering, evaluate, tracked_factor
from reslrb_cli.transport.camera import CameraHooks, FilmRay, MetLight, NextEvent, camera_walk
from reslrb_cli.transport.connection import Connection, forward_derivatives
from reslrb_cli.transport.emission import Emission, sample_emission
from reslrb_cli.transport.factors import Product
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

    `quantity` names the value. `value` has one number per channel for a path, and is empty otherwise. `pixel` (x, y) is
    its place on the film, or None for a parameter's gradient. `where` is None if no path has a non-finite value.
    `image` and `target` are the two values that the loss compares at `pixel`. They are None for a path and for a
    parameter's gradient.
    """

    sensor: int
    pixel: tuple[int, int] | None
    quantity: str
    value: list[float]
    where: PathVertex | None
    image: list[float] | None = None
    target: list[float] | None = None

    def lines(self, iteration: int) -> list[str]:
        """Return lines about this value for the terminal."""
        place = "" if self.pixel is None else f", pixel {self.pixel}"
        value = f": {_numbers(self.value)}" if self.value else ""
        lines = [f"iteration {iteration}, sensor {self.sensor}{place}", f"  {self.quantity}{value}"]
        at = self.where
        if at is not None:
            on = "" if at.surface is None else f", on {at.surface}"
            lines.append(f"  path {at.path} of {at.paths}, samples of {at.samples}, sampler seed {at.seed}")
            lines.append(f"  vertex {at.vertex}, at {_numbers(at.position)}{on}")
        if self.image is not None and self.target is not None:
            lines.append(f"  image {_numbers(self.image)}, target {_numbers(self.target)}")
        return lines


def _numbers(values: Iterable[float]) -> str:
    return f"({', '.join(f'{value:.6g}' for value in values)})"


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

#: A check of one quantity: its kind, its value (C,), and the lanes that have the quantity.
Row = tuple[int, Any, Any]


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

    def otherwise(self, rows: Iterable[Row], vertex: Any, p: Any, shape: Any) -> Suspect:
        """Return this suspect. In lanes where this suspect is empty, return the first of `rows` with a non-finite
        value.
        """
        first = self
        for kind, value, lanes in rows:
            other = Suspect(mi.UInt32(kind), vertex, p, shape, mi.Spectrum(value))
            bad = ~dr.all(dr.isfinite(other.value))
            first = dr.select((first.kind == 0) & lanes & bad, other, first)
        return first


@dataclass
class Search:
    """Loop state.

    `first` is the first suspect of the path so far. `found` belongs to the first light on the film that has a
    non-finite value. `found` is the first non-finite value on the path of this light. `u` is the light's film position.
    Light that reaches the wanted pixel (`there`) takes precedence.
    """

    first: Suspect
    found: Suspect
    u: Any
    there: Any


@dataclass
class Checks:
    """Checks at the vertices of light paths and camera paths. `pixel` is the wanted pixel, or None."""

    samples: Samples
    pixel: tuple[int, int] | None

    def contribution(self, vertex: Vertex, c: Any) -> Any:
        """Return the contribution (C,) with `c` as its last factor."""
        return vertex.product.times(c, vertex.depth).scaled(self.samples.scale).value()

    def onward(
        self, state: Search, vertex: Vertex, scattering: Scattering, df_s: Any, rows: list[Row], lit: Any, u: Any
    ) -> Search:
        """Return the state after a vertex. `rows` check the light that the vertex adds at `u` in the lanes `lit`.
        `df_s` is the derivative of the scattering factor.
        """
        product = vertex.product.times(scattering.s, vertex.depth).value()
        useful = scattering.active & self.samples.plan.differentiates(vertex.bsdf)
        scattered = (
            (_S, scattering.s, scattering.active), (_DS, df_s, useful), (_PRODUCT, product, scattering.active)
        )  # fmt: skip
        at = vertex.depth, vertex.si.p, dr.reinterpret_array(mi.UInt32, vertex.si.shape)
        found, there = state.first.otherwise(rows, *at), self._reaches(u)
        new = lit & (found.kind != 0) & ((state.found.kind == 0) | (there & ~state.there))
        return Search(
            state.first.otherwise(scattered, *at),
            dr.select(new, found, state.found),
            dr.select(new, u, state.u),
            state.there | (new & there),
        )

    def _reaches(self, u: Any) -> Any:
        """Return the lanes whose film position `u` is within the filter's radius of the wanted pixel."""
        if self.pixel is None:
            return mi.Bool(False)
        centre = mi.Point2f(self.pixel[0] + 0.5, self.pixel[1] + 0.5)
        return dr.all(dr.abs(u - centre) <= self.samples.film.film.rfilter().radius())


class LightSearch(Hooks):
    """Checks light paths: every factor of a connection, the factor's derivative along the parameters' tangents, and the
    product of all factors.
    """

    def __init__(self, checks: Checks, emission: Any, derivative: Any) -> None:
        """Make the hooks. `emission` has a ray and the emission E for each path. `derivative` is dE (C,)."""
        self.checks, self.emission, self.derivative = checks, emission, derivative

    def start(self, product: Product) -> Search:
        rows = (_E, dr.detach(self.emission.E), mi.Bool(True)), (_DE, self.derivative, mi.Bool(True))
        first = Suspect.none().otherwise(rows, mi.UInt32(0), self.emission.ray.o, mi.UInt32(0))
        return Search(first, Suspect.none(), mi.Point2f(0), mi.Bool(False))

    def vertex(
        self, state: Search, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Search:  # fmt: skip
        plan, seen = self.checks.samples.plan, connection.active
        with dr.resume_grad(when=plan.differentiate_bsdfs):
            f_c = evaluate(plan, vertex.si, vertex.bsdf, connection.wo, seen)
            f_s = tracked_factor(plan, vertex.si, vertex.bsdf, scattering, scattering.active)
            df_c, df_s = forward_derivatives(f_c, f_s)
        useful, C = seen & plan.differentiates(vertex.bsdf), self.checks.contribution(vertex, connection.c)
        rows = [(_C, connection.c, seen), (_DC, df_c, useful), (_CONTRIBUTION, C, seen)]
        return self.checks.onward(state, vertex, scattering, df_s, rows, seen, connection.u)


class CameraSearch(CameraHooks):
    """Checks camera paths: the emission that a path finds, and each factor before an emitter."""

    def __init__(self, checks: Checks) -> None:
        self.checks = checks

    def start(self, first: FilmRay) -> Search:
        return Search(Suspect.none(), Suspect.none(), first.u, mi.Bool(False))

    def vertex(
        self, state: Search, vertex: Vertex, met: MetLight | None, event: NextEvent | None, scattering: Scattering
    ) -> Search:  # fmt: skip
        samples, si, zero = self.checks.samples, vertex.si, mi.Spectrum(0)
        plan = samples.plan
        with dr.resume_grad(when=plan.differentiate_bsdfs or plan.differentiate_emission):
            f_s = tracked_factor(plan, si, vertex.bsdf, scattering, scattering.active)
            Le_h = zero if met is None else met.radiance()
            f_c = zero if event is None else evaluate(plan, si, vertex.bsdf, event.wo, event.active)
            Le_n = zero if event is None else event.radiance(samples.scene, si)
            df_s, dLe_h, df_c, dLe_n = forward_derivatives(f_s, Le_h, f_c, Le_n)
        rows: list[Row] = []
        lit = mi.Bool(False)
        if met is not None:
            C = self.checks.contribution(vertex, met.Le * met.weight)
            rows += [(kind, value, met.active) for kind, value in ((_L, met.Le), (_DL, dLe_h), (_CONTRIBUTION, C))]
            lit = lit | met.active
        if event is not None:
            C, useful = self.checks.contribution(vertex, event.c), event.active & plan.differentiates(vertex.bsdf)
            rows += [(kind, value, event.active) for kind, value in ((_L, event.Le), (_DL, dLe_n), (_C, event.c))]
            rows += [(_DC, df_c, useful), (_CONTRIBUTION, C, event.active)]
            lit = lit | event.active
        return self.checks.onward(state, vertex, scattering, df_s, rows, lit, state.u)


def search_paths(
    samples: Samples, sensor: int, label: str, pixel: tuple[int, int] | None
) -> tuple[bool, Offender] | None:
    """Return the first path with a non-finite value, and True if it reaches `pixel`. Paths that reach `pixel` come
    first. Return None if all paths are finite. The parameters must have tangents.
    """
    plan, checks = samples.plan, Checks(samples, pixel)
    with dr.suspend_grad():
        if plan.camera:
            _, state = camera_walk(samples, CameraSearch(checks))
        else:
            with dr.resume_grad(when=plan.differentiate_emission):
                first = sample_emission(samples, samples.sampler())
                [dE] = forward_derivatives(first.E) if plan.differentiate_emission else [mi.Spectrum(0)]
            state = walk(samples, LightSearch(checks, Emission(first.ray, dr.detach(first.E), first.emitter), dE))
        dr.eval(state)
    bad = np.array(state.found.kind) != 0
    preferred = np.flatnonzero(bad & np.array(state.there))
    if not bad.any():
        return None
    lane = int(preferred[0] if preferred.size else np.flatnonzero(bad)[0])
    return bool(preferred.size), _describe(samples, sensor, label, state, lane)


def _describe(samples: Samples, sensor: int, label: str, state: Search, lane: int) -> Offender:
    """Return the record of what one lane has found."""

    def number(value: Any) -> Any:
        return np.array(value).ravel()[lane % dr.width(value)]

    suspect = state.found
    where = PathVertex(
        samples=label,
        seed=int(samples.seed[0]),
        path=lane,
        paths=samples.width,
        vertex=int(number(suspect.vertex)),
        position=(float(number(suspect.p.x)), float(number(suspect.p.y)), float(number(suspect.p.z))),
        surface=_shape_name(samples.scene, int(number(suspect.shape))),
    )
    pixel = (int(np.floor(number(state.u.x))), int(np.floor(number(state.u.y))))
    value = [float(number(channel)) for channel in suspect.value]
    return Offender(sensor, pixel, QUANTITIES[int(number(suspect.kind))], value, where)


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


Array = np.ndarray[Any, Any]

#: The seed of a set of samples, and its passes.
NotedSet = tuple[int, list[Samples]]

#: Remarks about a value that is not finite although no path has a non-finite value.
FINITE = "each path is finite; their sum overflows, or the sensor sees a non-finite emitter"
UNCHECKED = "the paths of this integrator are not checked"


def _of_view(problem: Problem, view: View, step_seed: int, word: str) -> Offender | None:
    """Return the first non-finite value of one view, or None. The search covers the view's samples, or the samples of
    the shard named `word`.

    If shards split a view's samples (`in_rounds`), the shard's own samples give the image for dL/dI. The mean image of
    the other shards is not used.
    """
    noted: list[NotedSet] = []
    image, gradients, refused = _take_step(problem, view, step_seed, noted)
    ours = isinstance(problem.integrator, Reslrb)
    if ours:
        if not problem.moves:
            _set_tangents(problem)
        pixel = None if refused is None else refused[:2]
        searched = [
            search_paths(samples, view.sensor, word + label, pixel)
            for samples, label in _parts(problem, step_seed, noted)
        ]
        problem.apply()
        offenders = [each for each in searched if each is not None]
        if offenders:
            return max(offenders, key=lambda each: each[0])[1]
    remark = FINITE if ours else UNCHECKED
    place = refused
    if place is None and not np.isfinite(image).all():
        y, x, channel = map(int, np.argwhere(~np.isfinite(image))[0])
        place = x, y, channel
    if place is not None:
        x, y, channel = place
        what = f"image ({remark})"
        if np.isfinite(image[y, x]).all():
            what = f"derivative of the loss, dL/dI, channel {channel}"
        target = np.array(view.target)[y, x].tolist()
        return Offender(view.sensor, (x, y), what, [], None, image[y, x].tolist(), target)
    key = next((key for key, gradient in gradients.items() if not np.isfinite(gradient).all()), None)
    return None if key is None else Offender(view.sensor, None, f"gradient of {key} ({remark})", [], None)


def _parts(problem: Problem, step_seed: int, noted: list[NotedSet]) -> Iterator[tuple[Samples, str]]:
    """Yield a step's samples pass by pass, with a name. `noted` has the samples that the step traced."""
    options = problem.config.step_options(shard=True)
    if problem.config.in_rounds:
        options["adjoint"] = "correlated"  # both rounds have the same samples
    names = {int(samples_seed[0]): name for name, samples_seed, _ in sample_sets(step_seed, options)}
    for number, passes in noted:
        if number not in names:  # samples that only tables learn from
            continue
        for place, samples in enumerate(passes):
            label = names[number] if len(passes) == 1 else f"{names[number]}, pass {place + 1}"
            for side in samples.sides():
                if side.plan.attached:  # only contributions are checked: derivatives of moving light need Jacobians
                    side = replace(side, plan=side.plan.differentiating(False, False, side.plan.track_zeros))
                yield side, f"{label}, camera paths" if side.plan.camera else label


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


def _take_step(
    problem: Problem, view: View, step_seed: int, noted: list[NotedSet]
) -> tuple[Array, dict[str, Array], tuple[int, int, int] | None]:
    """Repeat the gradient step that the run took for this view. Leaves no gradients. Adds the samples of `reslrb` to
    `noted`.

    Returns the image (H, W, C), the gradients, and the first refused entry of dL/dI as (x, y, channel).
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
    return np.array(image), gradients, refused.entry()


def _noting(tracer: Reslrb, noted: list[NotedSet]) -> Reslrb:
    """Return a copy of the tracer that adds the samples of each of its jobs to `noted`."""

    def passes(job: Job, purpose: Purpose | None = None, delta: mi.TensorXf | None = None) -> list[Samples]:
        made = tracer.passes(job, purpose, delta)
        noted.append((int(job.seed[0]), made))
        return made

    noting = copy.copy(tracer)
    noting.passes = passes  # type: ignore[method-assign]
    return noting
