"""The only light-path loop: random numbers, segment, hooks, roulette.

The hooks process the connections. `Hooks` is the interface between a walk and an estimator. No estimator or integrator
repeats the loop.

One segment of a light path starts with the ray that reaches a vertex. A segment consists of the vertex's connection,
the scattering event, and the next ray. A segment can be evaluated again from its ray, its intersection, its random
numbers, and the scene.

Random numbers are drawn in the order of Mitsuba's `ptracer`. This walk and `ptracer` therefore trace the same paths
from the same seed. Numbers for selections by hooks come from a separate stream. A replay that selects nothing therefore
visits the same vertices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.aim import Pending, aims_from, choose
from reslrb_cli.transport.bsdf import Aimed, EventNumbers, Hit, Scattering, begins_caustic, evaluate, scatter
from reslrb_cli.transport.connection import Connection, KnownVisibility, connect, passage
from reslrb_cli.transport.emission import Emission, sample_emission
from reslrb_cli.transport.factors import Product, first_eta, play
from reslrb_cli.transport.film import Colours
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import SELECTION_STREAM, Numbers, Samples
from reslrb_cli.transport.weights import Rivals, cosine, leave_emitter, weight_of_connection


@dataclass
class Vertex(Hit):
    """Current vertex for hooks. `product` does not include the vertex's own scattering."""

    pi: mi.PreliminaryIntersection3f
    depth: mi.UInt32
    product: Product
    active: mi.Bool


class Hooks:
    """Hooks of an estimator along a walk. All hooks are pure functions (state in, state out). No hook draws a random
    number.

    - `numbers` is the number of random numbers that `vertex` gets at each vertex.
    - Without `connects`, no connection is evaluated, and `vertex` gets only the connection's geometry.
    - Without `needs_product`, the walk computes no throughput and no roulette. An earlier walk has then found that the
        path continues as far as `goes_on` requests.
    - `tracked` hooks keep derivatives of the factors in the loop state. The loop is then evaluated vertex by vertex
        (naive AD). With `max_iterations`, the loop stays symbolic. Dr.Jit then reverses the loop from a record of the
        loop state in thread-local memory. If the hooks are also `attached`, the rays have derivatives, too.
    """

    numbers: int = 0
    connects: bool = True
    needs_product: bool = True
    tracked: bool = False
    attached: bool = False
    max_iterations: int | None = None
    colours: Colours  # of the paths; assigned by the walk before `start`

    def start(self, product: Product) -> Any:
        """Return the state before the first vertex. The state can be any PyTree. `product` is E."""
        return []

    def known_visibility(self, vertex: Vertex) -> KnownVisibility | None:
        """Return the visibility of the sensor from this vertex if an earlier walk has found it, otherwise None."""
        return None

    def wants(self, state: Any, vertex: Vertex) -> mi.Bool:
        """Return the lanes that need a connection from this vertex. Other lanes trace no shadow ray."""
        return mi.Bool(True)

    def goes_on(self, state: Any, vertex: Vertex) -> mi.Bool:
        """Return the lanes that scatter at this vertex and go on. In other lanes, this vertex is the last one. It still
        connects to the sensor.
        """
        return mi.Bool(True)

    def is_followed(self, state: Any, vertex: Vertex) -> mi.Bool:
        """Return the lanes that need their next vertex, in a walk without `needs_product`. Candidates are the lanes of
        `goes_on`.
        """
        return mi.Bool(True)

    def vertex(
        self, state: Any, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Any:  # fmt: skip
        """Return the state after a vertex, given its connection to the sensor and the sampled scattering event.

        The walk also calls `vertex` in lanes that `goes_on` has ended.
        """
        return state

    def survived(self, state: Any, factor: mi.Float) -> Any:
        """Return the state after roulette has multiplied the path's product by `factor`, 1/q."""
        return state

    def aimed(self, state: Any, factor: mi.Float) -> Any:
        """Return the state after aiming (`aim.py`). Aiming multiplies the path's product by the factor r."""
        return self.survived(state, factor)


class Splat(Hooks):
    """Hooks that splat every connection and store nothing."""

    def __init__(self, samples: Samples, block: mi.ImageBlock) -> None:
        self.samples, self.block = samples, block

    def vertex(
        self, state: Any, vertex: Vertex, connection: Connection, scattering: Scattering, numbers: list[mi.Float]
    ) -> Any:  # fmt: skip
        s = self.samples
        C = vertex.product.times(connection.c, vertex.depth).scaled(s.scale)
        normalization = self.attached and s.plan.attached_normalization
        s.film.put(self.block, connection.u, C.value(), connection.active, self.colours, normalization)
        return state


@dataclass
class Segment:
    """Segment from a vertex, without visibility.

    `connection.c` is not set. `connection.active` tells whether the sensor would see the vertex without occlusion.
    """

    si: mi.SurfaceInteraction3f
    connection: Connection
    scattering: Scattering

    def next_ray(self, attached: bool = False) -> mi.Ray3f:
        """Return the ray in the sampled direction, with derivatives if `attached`."""
        ray = self.si.spawn_ray(self.scattering.d)
        return ray if attached else dr.detach(ray)


def find_vertex(ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> Hit:
    """Return the vertex at the intersection `pi` of `ray`."""
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
    return Hit(si, si.bsdf(), ray)


def segment(
    samples: Samples, hit: Hit, numbers: Numbers, connected: mi.Bool, scattered: mi.Bool, evaluates: bool = True,
    attached: bool = False, aimed: Aimed | None = None,
) -> Segment:  # fmt: skip
    """Return the segment from a vertex. `connected` lanes connect to the sensor, and `scattered` lanes scatter.

    Without `evaluates`, the BSDF is not evaluated towards the sensor. With `attached`, everything has derivatives,
    otherwise nothing has. `aimed` lanes scatter to their points.
    """
    plan, si = samples.plan, hit.si
    connection = connect(plan, samples.sensor, si, hit.ray, numbers.aperture, connected, attached)
    scattering, connection.f = scatter(plan, hit, numbers, scattered, connection, evaluates, attached, aimed)
    return Segment(si, connection, scattering)


@dataclass
class Path:
    """Loop state of one light path."""

    active: mi.Bool  # active lanes
    depth: mi.UInt32  # index of the current vertex; the first after the emitter is 1
    ray: mi.Ray3f  # the ray that reaches this vertex
    pi: mi.PreliminaryIntersection3f  # the intersection of this ray
    product: Product  # P_depth = E s_1 ... s_{depth-1}, and roulette's factors 1/q
    eta: mi.Float  # accumulated relative index of refraction, only for roulette; starts larger if emission is dim
    early: list[EventNumbers]  # random numbers of the first vertices, if low-discrepancy; never changed
    pending: Pending | None = None  # how the last event was aimed, if events are and there is a product
    rivals: Rivals | None = None  # if camera paths find the same light


def walk(
    samples: Samples, hooks: Hooks, active: mi.Bool | bool = True, emission: Emission | None = None,
    depth: mi.UInt32 | int = 1,
) -> Any:  # fmt: skip
    """Trace one light path per lane of `samples`, in `active` lanes, and return the final state of `hooks`.

    If `emission` is given, the paths start with its rays, and their first vertices have index `depth`.
    """
    plan, scene, sensor = samples.plan, samples.scene, samples.sensor
    sampler = samples.sampler()
    selection = samples.stream(SELECTION_STREAM) if hooks.numbers else None
    aim = samples.guide.table.aim if samples.guide is not None and plan.aimed else None

    # ---- Leave the emitter ----
    begins = mi.Bool(False)  # whether the path's light is its own class from the start
    loop_mode = "evaluated" if hooks.tracked and hooks.max_iterations is None else "symbolic"
    emission = sample_emission(samples, sampler) if emission is None else emission
    for lamp in plan.needs.lamps if plan.by_class else ():
        if lamp.parallel:  # no camera path finds its light
            begins |= emission.emitter == mi.EmitterPtr(lamp.emitter)
    hooks.colours = samples.film.colours(emission.ray.wavelengths)
    product, active, eta = Product.one(plan.track_zeros, hooks.tracked), mi.Bool(active), mi.Float(1)
    if hooks.needs_product:
        product = product.times(emission.E, mi.Int32(0))
        active &= product.alive()
        if plan.roulette:
            eta = first_eta(dr.max(hooks.colours.seen(product.magnitude())), emission.guided)
    state = hooks.start(product)
    depth = mi.UInt32(depth)
    active &= depth < plan.max_depth
    pi, active = intersect(plan, scene, emission.ray, active)
    path = Path(active, depth, emission.ray, pi, product, eta, samples.early_numbers())
    if aim is not None and hooks.needs_product:
        path.pending = Pending(mi.Float(0), mi.Float(1), mi.Float(-1))  # no vertex, so nothing is aimed
    if plan.weighs:
        assert samples.emitters is not None
        path.rivals = leave_emitter(plan, samples.emitters, scene, emission)

    def body(
        path: Path, state: Any, sampler: mi.Sampler, selection: mi.PCG32 | None
    ) -> tuple[Path, Any, mi.Sampler, mi.PCG32 | None]:
        hit = find_vertex(path.ray, path.pi, path.active)
        si, bsdf = hit.si, hit.bsdf
        numbers = Numbers.draw(sampler, path.active).of_early(path.early, path.depth)
        slot = None if aim is None else sampler.next_1d(path.active)
        known = None
        if path.pending is not None:
            assert aim is not None
            here = connect(plan, sensor, si, None, numbers.aperture, path.active & aims_from(bsdf))
            visible = here.active & ~scene.ray_test(si.spawn_ray_to(here.target), here.active)
            known = KnownVisibility(visible)
            r = path.pending.factor(aim, sensor, si, path.ray, here, visible)
            path = replace(path, active=path.active & (r != 0), product=path.product.scaled(r))  # passes NaN on
            state = hooks.aimed(state, r)
        vertex = Vertex(si, bsdf, path.ray, path.pi, path.depth, path.product, path.active)

        # ---- Connect to the sensor, and scatter ----
        connected = path.active & hooks.wants(state, vertex)
        if plan.by_class:
            connected &= begins | (path.depth > 1)
        active = path.active & (path.depth + 1 < plan.max_depth) & hooks.goes_on(state, vertex)
        aimed = None
        if aim is not None:
            able = active & aims_from(bsdf)
            aimed, bsdf_1d = choose(scene, sensor, aim, path.ray.time, numbers.bsdf_1d, numbers.bsdf_2d, slot, able)
            numbers = replace(numbers, bsdf_1d=bsdf_1d)
        evaluates = hooks.connects and not hooks.tracked  # tracked connections are evaluated later, if visible
        this = segment(samples, vertex, numbers, connected, active, evaluates, hooks.attached, aimed)
        connection, scattering = this.connection, this.scattering
        if hooks.tracked and not hooks.attached:
            scattering.track(plan, vertex)
        rivals = None
        if path.rivals is not None:
            arrived = path.rivals.arrive(si, path.ray)
            ways, cos = scattering.ways, cosine(si, scattering.d)
            N = samples.ratio_at(connection.u)
            connection.rest *= weight_of_connection(arrived, connection.p_cam, N, ways.ahead_back)
            behind = arrived.after(mi.Float(0), arrived.M + arrived.V * ways.back, scattering, cos)
            rivals = dr.select(scattering.is_null, path.rivals.after_null(arrived), behind)
        chosen_by: list[mi.Float] = []
        if hooks.connects:
            if not (hooks.tracked or plan.track_zeros):
                # No shadow ray if neither light nor its derivative would arrive.
                connection.active = connection.active & ~dr.all(connection.f == 0)  # passes NaN on
            with dr.suspend_grad(when=not plan.differentiate_null):
                known = known or hooks.known_visibility(vertex)
                shadow = passage(plan, scene, si, path.depth, connection, known, loop_mode)
            connection.active, connection.through = shadow
            if hooks.tracked:
                connection.f = evaluate(plan, si, bsdf, connection.wo, connection.active)
            else:
                connection.f = dr.select(connection.active, connection.f, 0)
            connection.c = connection.f * connection.through * connection.rest
            chosen_by = [] if selection is None else [selection.next_float32() for _ in range(hooks.numbers)]
        state = hooks.vertex(state, vertex, connection, scattering, chosen_by)
        if not hooks.needs_product:
            sampler.next_1d(active)  # the number of roulette
            active &= hooks.is_followed(state, vertex)
            path = replace(path, rivals=rivals)
            return _next(path, active, this.next_ray(hooks.attached)), state, sampler, selection
        product = path.product.times(scattering.s, path.depth)
        eta = path.eta * dr.detach(scattering.eta)
        active = scattering.active & product.alive()
        if plan.by_class:
            active &= begins | (path.depth > 1) | begins_caustic(bsdf, scattering.is_delta)

        # ---- Russian roulette ----
        number = sampler.next_1d(active)
        if plan.roulette:
            throughput = dr.max(dr.abs(hooks.colours.seen(product.magnitude())))
            survives, factor = play(plan, path.depth, throughput, eta, number)
            active &= survives
            product, state = product.scaled(factor), hooks.survived(state, factor)

        pending = None
        if aimed is not None:
            pending = Pending.of(aimed, si, scattering.pdf, scattering.is_delta | scattering.is_null)
        path = replace(path, product=product, eta=eta, pending=pending, rivals=rivals)
        return _next(path, active, this.next_ray(hooks.attached)), state, sampler, selection

    def _next(path: Path, active: mi.Bool, ray: mi.Ray3f) -> Path:
        pi, active = intersect(plan, scene, ray, active)
        return replace(path, active=active, depth=path.depth + 1, ray=ray, pi=pi)

    def recorded_body(path: Path, *rest: Any) -> tuple[Any, ...]:
        path, *changed = body(_with_masks(path), *rest)
        return _without_masks(path), *changed

    recorded = hooks.max_iterations is not None
    _, state, _, _ = dr.while_loop(
        state=(_without_masks(path) if recorded else path, state, sampler, selection),
        cond=lambda path, state, sampler, selection: path.active != 0 if recorded else path.active,
        body=recorded_body if recorded else body,
        labels=("path", "state", "sampler", "selection"),
        label="light path",
        mode=loop_mode,
        max_iterations=hooks.max_iterations,
    )
    return state


def intersect(
    plan: Plan, scene: mi.Scene, ray: mi.Ray3f, active: mi.Bool, surrounded: bool = False
) -> tuple[mi.PreliminaryIntersection3f, mi.Bool]:
    """Return the intersection of the ray, and the active lanes with a hit. If `surrounded`, rays may reach an
    environment, and lanes without a hit stay active.
    """
    pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    if not surrounded:
        active = active & pi.is_valid()
        pi.valid = mi.Bool(True)  # in active lanes
    if not plan.needs.has_instances:
        pi.instance = dr.zeros(mi.ShapePtr)
    return pi, active


def _without_masks(path: Path) -> Path:
    """Return the path without masks, for a record of the loop state. Masked writes of booleans to thread-local memory
    crash the process.
    """
    path.pi.valid = mi.Bool(True)
    return replace(path, active=dr.select(path.active, mi.UInt32(1), 0))


def _with_masks(path: Path) -> Path:
    path.pi.valid = mi.Bool(True)  # in active lanes
    return replace(path, active=path.active != 0)
