"""The one light-path loop. It samples emission, connects, scatters, and calls hooks; what is done with the connections
is theirs to say, and no estimator or integrator repeats the loop.

Random numbers are drawn in the order of Mitsuba's `ptracer`, so that both trace the same paths from the same seed.
Those that hooks need for a selection come from a stream of their own: a replay that selects nothing stays in step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.connection import Connection, Seen, connect, passage
from reslrb_cli.transport.emission import sample_emission
from reslrb_cli.transport.factors import Product
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.scattering import Scattering, attached_factor, evaluate, scatter

ROULETTE_LIMIT = 0.95  # the largest probability of going on, as in `ptracer`
DIMMEST = 1e-30  # the least emission that roulette knows, well above what single precision rounds to zero


@dataclass
class Path:
    """Loop state of one light path."""

    active: Any  # active lanes
    depth: Any  # index of the current vertex; the first after the emitter is 1
    ray: Any  # the ray that reaches it
    pi: Any  # where it does
    product: Product  # E s_1 ... s_{depth-1}, roulette weights included
    eta: Any  # accumulated relative index of refraction, for roulette alone; begins larger where emission is dim


@dataclass
class Vertex:
    """The current vertex as hooks see it; `product` does not include the vertex's own scattering."""

    pi: Any
    si: Any
    bsdf: Any
    ray: Any
    depth: Any
    product: Product
    active: Any


class Hooks:
    """What an estimator does along a walk. All are pure: state in, state out; none draws a random number.

    `numbers` says how many random numbers `connection` wants at each vertex; without `connects` no connection is
    evaluated, and `connection` is not called. A walk whose hooks are `replaying` follows a path that is known to get as
    far as `goes_on` asks, so that neither its throughput nor its roulette is computed.
    Hooks that are `attached` keep derivatives in the loop state, which is then evaluated vertex by vertex (naive AD);
    with `max_iterations` the loop stays symbolic, and Dr.Jit itself reverses it, from a record of the loop state in
    thread-local memory.
    """

    numbers: int = 0
    connects: bool = True
    replaying: bool = False
    attached: bool = False
    max_iterations: int | None = None

    def start(self, product: Product) -> Any:
        """State before the first vertex, any PyTree; `product` is E."""
        return []

    def seen(self, vertex: Vertex) -> Seen | None:
        """What is known of the sensor's visibility from this vertex."""
        return None

    def wants(self, state: Any, vertex: Vertex) -> Any:
        """Lanes whose connection from this vertex is of use; others trace no shadow ray."""
        return mi.Bool(True)

    def connection(self, state: Any, vertex: Vertex, connection: Connection, numbers: list[Any]) -> Any:
        """Called at each vertex with its connection to the sensor."""
        return state

    def goes_on(self, state: Any, vertex: Vertex) -> Any:
        """Lanes that scatter on from this vertex, as far as the hooks care."""
        return mi.Bool(True)

    def is_followed(self, state: Any, vertex: Vertex) -> Any:
        """In a replay: lanes that `goes_on` let scatter, and whose next vertex is wanted as well."""
        return mi.Bool(True)

    def scattering(self, state: Any, vertex: Vertex, connection: Connection, scattering: Scattering) -> Any:
        """Called at each vertex with the sampled scattering event, also in lanes that `goes_on` ended."""
        return state

    def survived(self, state: Any, weight: Any) -> Any:
        """Called with the weight that roulette has just given the path's product, 1 where it was not played."""
        return state


def walk(
    plan: Plan, scene: Any, sensor: Any, sampler: Any, hooks: Hooks, active: Any = True, selection: Any = None
) -> Any:
    """Trace one light path per lane of `sampler` and return the final state of `hooks`.

    `selection` is the random stream of the hooks (`mi.PCG32`), needed where `hooks.numbers` is not 0.
    """

    def intersect(ray: Any, active: Any) -> tuple[Any, Any]:
        pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        active = active & pi.is_valid()
        pi.valid = mi.Bool(True)  # in active lanes
        if not plan.needs.has_instances:
            pi.instance = dr.zeros(mi.ShapePtr)
        return pi, active

    loop_mode = "evaluated" if hooks.attached and hooks.max_iterations is None else "symbolic"
    emission = sample_emission(plan, scene, sensor, sampler)
    product, active, eta = Product.one(plan.track_zeros, hooks.attached), mi.Bool(active), mi.Float(1)
    if not hooks.replaying:
        product = product.times(emission.weight, mi.Int32(0))
        active &= product.alive()
        if plan.roulette:
            # Relative to emission where that is dim: else light of small lamps, or in large units, would end at once.
            eta = dr.rsqrt(dr.clip(dr.max(product.weight()), DIMMEST, 1))
    state = hooks.start(product)
    active &= plan.max_depth > 1
    pi, active = intersect(emission.ray, active)
    path = Path(active, mi.UInt32(1), emission.ray, pi, product, eta)

    def next_vertex(path: Path, active: Any, si: Any, scattering: Scattering, product: Product, eta: Any) -> Path:
        ray = dr.detach(si.spawn_ray(scattering.d))
        pi, active = intersect(ray, active)
        return Path(active, path.depth + 1, ray, pi, product, eta)

    def body(path: Path, state: Any, sampler: Any, selection: Any) -> tuple[Path, Any, Any, Any]:
        si = path.pi.compute_surface_interaction(path.ray, mi.RayFlags.All, path.active)
        vertex = Vertex(path.pi, si, si.bsdf(), path.ray, path.depth, path.product, path.active)

        # ---- Connect to the sensor, scatter, and evaluate both in one call ----
        connected = path.active & hooks.wants(state, vertex)
        connection = connect(plan, sensor, si, path.ray, sampler.next_2d(path.active), connected)
        sample_2, sample_1 = sampler.next_2d(path.active), sampler.next_1d(path.active)
        active = path.active & (path.depth + 1 < plan.max_depth) & hooks.goes_on(state, vertex)
        wanted = connection.active if hooks.connects and not hooks.attached else None
        scattering, connection.f = scatter(
            plan, si, vertex.bsdf, path.ray, sample_1, sample_2, active, connection.wo, wanted
        )
        if hooks.connects:
            if not (hooks.attached or plan.track_zeros):
                # No shadow ray where neither light nor its derivative would arrive.
                connection.active = connection.active & ~dr.all(connection.f == 0)  # NaN arrives
            with dr.suspend_grad(when=not plan.differentiate_null):
                shadow = passage(plan, scene, si, path.depth, connection, hooks.seen(vertex), loop_mode)
            connection.active, transmittance = shadow
            if hooks.attached:
                connection.f = evaluate(plan, si, vertex.bsdf, connection.wo, connection.active)
            else:
                connection.f = dr.select(connection.active, connection.f, 0)
            connection.c = connection.f * transmittance * connection.weight
            numbers = [selection.next_float32() for _ in range(hooks.numbers)]
            state = hooks.connection(state, vertex, connection, numbers)
        state = hooks.scattering(state, vertex, connection, scattering)
        if hooks.replaying:
            sampler.next_1d(active)  # roulette's
            active &= hooks.is_followed(state, vertex)
            return next_vertex(path, active, si, scattering, path.product, path.eta), state, sampler, selection
        weight = scattering.weight
        if hooks.attached:
            f = attached_factor(plan, si, vertex.bsdf, scattering, scattering.active)
            weight = dr.replace_grad(weight, f * (scattering.correction / scattering.pdf))
        product = path.product.times(weight, path.depth)
        eta = path.eta * scattering.eta
        active = scattering.active & product.alive()

        # ---- Russian roulette ----
        number = sampler.next_1d(active)
        if plan.roulette:
            throughput = dr.max(dr.abs(product.weight()))
            q = dr.minimum(throughput * dr.square(eta), ROULETTE_LIMIT)
            playing = path.depth + 1 > plan.rr_depth
            active &= ~playing | (number < q)
            roulette_weight = dr.select(playing, dr.rcp(q), 1)
            product, state = product.scaled(roulette_weight), hooks.survived(state, roulette_weight)

        return next_vertex(path, active, si, scattering, product, eta), state, sampler, selection

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


def _without_masks(path: Path) -> Path:
    """The same for a record of the loop state: masked writes of booleans to thread-local memory end the process."""
    path.pi.valid = mi.Bool(True)
    return replace(path, active=dr.select(path.active, mi.UInt32(1), 0))


def _with_masks(path: Path) -> Path:
    path.pi.valid = mi.Bool(True)  # in active lanes
    return replace(path, active=path.active != 0)
