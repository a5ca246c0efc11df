"""Derivatives of the light that moving edges cover and uncover behind mirrors and glass.

The terms and their symbols are those of `edges.py` and `camera_edges.py`. `transport/jumps.py` samples the edges: jumps
of the light behind a specular chain that begins at the sensor or at a lamp. P is the throughput of the chain, v_q the
velocity of q for a fixed first ray, and g = P |<dq/du, n>|^-1 divided by the density of the sample.

From the sensor, L_p and L_x are the radiance from p and from x. At the edge of a shadow, L_p = 0, and L_x is the light
from the lamp.

    dL/dtheta  +=  g delta(u) (L_p - L_x) <v_p - v_q, n>

From a lamp, W_p and W_x are the contributions of light that continues from p and from x. At an edge that hides x from
the sensor, W_p = 0, and W_x is the contribution of x.

    dL/dtheta  +=  g (W_p - W_x) <v_p - v_q, n>

The walk back over the chain takes the adjoint of q to everything that the chain meets. `attached_camera.py` and
`attached.py` have the same flow. Edges that the first ray of the chain meets have their own terms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import Adjoint
from reslrb_cli.estimators.base import Pass, SurfacePoint
from reslrb_cli.estimators.camera import Radiance
from reslrb_cli.estimators.edges import Contribution, on_smooth
from reslrb_cli.estimators.outline_rays import AROUND, edge_samples, for_camera, moved_by
from reslrb_cli.estimators.stack import Ring, StackState, differentiate_frames
from reslrb_cli.scene.rays import ray_offset
from reslrb_cli.transport.bsdf import evaluate, reflect_or_refract
from reslrb_cli.transport.camera import FilmRay, camera_walk
from reslrb_cli.transport.chains import MOST_VERTICES, Chain, Chains, LampChains, SensorChains
from reslrb_cli.transport.edges import pick
from reslrb_cli.transport.emission import Emission
from reslrb_cli.transport.factors import MAY_LACK, Product, showing
from reslrb_cli.transport.jumps import ChainEdge, random_interval, random_lines, sample_edge
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.sobol import unit
from reslrb_cli.transport.walk import Vertex, find_vertex, walk

#: Rays per cell that look for specular surfaces, and for lamps behind them.
PROBES = 16
#: Tested intervals per sampled edge. A step tests as many intervals as it has paths, but at most about MOST_INTERVALS,
#: because it stores one number for each.
INTERVALS_PER_EDGE, MOST_INTERVALS = 16, 1 << 20
#: Streams of random numbers, mixed into the seed.
CHAIN_EDGES, CELLS, SIDE = 0xED6E4, 0xED6E5, 0x0E4


def has_edges_behind_chains(plan: Plan) -> bool:
    """Whether the scene has edges behind specular chains. Chains from lamps that move are not followed."""
    return bool(plan.needs.has_delta_lobes) and (plan.camera or not plan.moving_emission)


def _samples_of(samples: Samples, stream: int, each: int = 1) -> Samples:
    """Return samples of edges for the paths `samples`, one for `each` paths."""
    edges = edge_samples(samples, stream, each)
    if samples.plan.camera:
        return for_camera(edges)
    return replace(edges, plan=replace(edges.plan, by_class=False, paths="light"))


def _chains(samples: Samples, number: mi.UInt32) -> Chains:
    key = mi.sample_tea_32(number, samples.seed)[0]
    return SensorChains(samples, key) if samples.plan.camera else LampChains(samples, key)


def _light(p: Pass, edge: ChainEdge, over: mi.Bool) -> mi.Float:
    """Return <delta, g L_p> or W_p in the lanes `over`. In other lanes, return minus the value for x.

    At the edge of a shadow, return minus half of the value for x in all lanes.
    """
    samples, camera = p.samples, p.plan.camera
    continues, shadow = edge.active & ~edge.shadow, edge.active & edge.shadow
    ray, depth = dr.select(over, edge.over.ray, edge.past.ray), edge.over.count + 1
    x = edge.past.vertex(shadow)
    target = edge.here.target
    f = evaluate(p.plan, x.si, x.bsdf, target.wo, shadow)
    lost = edge.weight * f * target.weight
    colours = samples.film.colours(edge.over.ray.wavelengths)
    if camera:
        _, L = camera_walk(
            samples, Radiance(tracked=False), continues, FilmRay(ray, edge.u, mi.Spectrum(1), depth=depth)
        )
        delta = p.delta(edge.u, edge.active, colours)
        found, lost = dr.dot(delta * edge.weight, L), dr.dot(delta, lost)
    else:
        emission = Emission(ray, edge.weight, dr.zeros(mi.EmitterPtr))
        smooth = on_smooth(edge.over.pi.shape, p.plan.edged + p.plan.occluders, over)
        found = walk(samples, Contribution(p, smooth, depth), continues, emission, depth)[0]
        lost = dr.dot(p.delta(target.u, shadow, colours), lost)
    return showing(dr.select(edge.shadow, -0.5 * lost, dr.select(over, found, -found))) * p.scale


def weigh_cells(own: Samples) -> list[mi.Float]:
    """Return cumulative sampling weights of the cells of chains that begin at the sensor or at lamps. Without mirrors
    and glass, the result is empty.
    """
    if not has_edges_behind_chains(own.plan):
        return []
    samples = _samples_of(own, CELLS)
    width, height = _chains(samples, mi.UInt32(0)).cells
    cell = dr.arange(mi.UInt32, width * height)
    samples = replace(samples, width=width * height)
    lit, seen = _behind_chains(samples, cell)
    around = dr.zeros(mi.Float, width * height)
    for i in range(-1, 2):
        for k in range(-1, 2):
            x, y = mi.Int32(cell % width) + i, mi.Int32(cell // width) + k
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            dr.scatter_reduce(dr.ReduceOp.Add, around, seen, mi.UInt32(y * width + x), inside)
    # Half of the samples go to lamps that are seen.
    total = dr.sum(around)
    cells = around + lit * dr.select(total > 0, total / dr.maximum(dr.sum(lit), 1e-30), 0)
    cells = dr.cumsum(cells + dr.select(total > 0, 0, mi.Float(1)))
    dr.make_opaque(cells)
    return [cells]


def with_intervals(own: Samples, cells: list[mi.Float], passes: int) -> list[mi.Float]:
    """Return the weights of `weigh_cells`, and cumulative weights of random intervals. A weight is 1 if the chain
    changes within the interval. `own` are the samples of one of several `passes`.
    """
    if not cells:
        return []
    samples = _samples_of(own, CHAIN_EDGES, -(-own.width * passes // MOST_INTERVALS))
    number = dr.arange(mi.UInt32, samples.width)
    chains = _chains(samples, number)
    line = random_lines(chains, cells[0], number, dr.opaque(mi.UInt32, samples.width))
    found = dr.cumsum(dr.select(random_interval(chains, line).differs, mi.Float(1), 0))
    dr.make_opaque(found)
    return [*cells, found]


def _behind_chains(samples: Samples, cell: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Return the mean radiance of lamps that chains from a cell hit, and the share of the cell with specular chains."""
    width = _chains(samples, mi.UInt32(0)).cells[0]

    def probe(number: mi.UInt32, total: mi.Float, seen: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        chains = _chains(samples, cell * PROBES + number)
        within = (mi.Point2f(number, 0) + mi.Point2f(0.5, PROBES * chains.random(number, SIDE).x)) / PROBES
        chain = chains.follow(mi.Point2f(cell % width, cell // width) + within)
        specular = chain.count > 0
        hit = chain.vertex(specular)
        emitter = hit.si.emitter(samples.scene)
        lit = specular & (emitter != dr.zeros(mi.EmitterPtr))
        total += dr.select(lit, dr.max(chain.product * emitter.eval(hit.si, lit)), 0)
        return number + 1, total, seen + dr.select(specular, mi.Float(1), 0)

    state = mi.UInt32(0), dr.zeros(mi.Float, dr.width(cell)), dr.zeros(mi.Float, dr.width(cell))
    _, total, seen = dr.while_loop(state, lambda number, *_: number < PROBES, probe, label="probes")
    return total / PROBES if samples.plan.camera else dr.zeros(mi.Float, dr.width(cell)), seen / PROBES


@dataclass
class SpecularFrame:
    """Vertex of a specular chain on the stack. `sample` is the random number of its event."""

    point: SurfacePoint
    sample: mi.Float

    @staticmethod
    def blank(plan: Plan) -> SpecularFrame:
        """Return a frame of zeros."""
        return SpecularFrame(SurfacePoint.blank(plan), mi.Float(0))

    def differentiate(self, p: Pass, adjoint: Adjoint) -> Adjoint:
        """Add the derivatives of the vertex. Takes the adjoint of the outgoing ray, and returns that of the ray that
        reaches the vertex.
        """
        active = dr.any(adjoint.origin != 0) | dr.any(adjoint.direction != 0)
        pi, ray = self.point.hit(p.wavelengths)
        with dr.resume_grad():
            ray.o, ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
            dr.enable_grad(ray.o, ray.d)
            hit = find_vertex(ray, pi, active)
            following = hit.si.spawn_ray(reflect_or_refract(p.plan, hit, self.sample, active, attached=True).d)
            moved = dr.dot(following.o, adjoint.origin) + dr.dot(following.d, adjoint.direction)
            dr.backward_from(dr.select(active, moved, 0), flags=MAY_LACK)
            origin, direction = (dr.select(active, mi.Vector3f(dr.grad(value)), 0) for value in (ray.o, ray.d))
            return Adjoint(origin, direction, adjoint.B)


def _stack_of(p: Pass, chains: Chains, edge: ChainEdge, ring: Ring) -> StackState:
    """Return a stack with the specular vertices of the chain to an edge."""

    def body(active: mi.Bool, chain: Chain, stack: StackState) -> tuple[mi.Bool, Chain, StackState]:
        hit, event = chains.event(chain, active)
        passes = event.active
        one = Product.one(False, False)
        vertex = Vertex(hit.si, hit.bsdf, chain.ray, chain.pi, chain.count, one, active)
        stack = stack.push(SpecularFrame(SurfacePoint.of(p.plan, vertex), event.number), ring, passes, passes)
        chain = chains.onward(chain, hit, event, passes)
        return passes & (chain.count < edge.over.count), chain, stack

    stack = StackState.empty(SpecularFrame.blank(p.plan), ring, mi.Float(1))
    state = edge.active, chains.start(edge.u, edge.active), stack
    return dr.while_loop(state, lambda active, *_: active, body, label="chain to an edge")[2]


def differentiate_edges_behind_chains(own: Pass) -> None:
    """Add the derivatives of the edges behind specular chains. dL/dI must be known."""
    assert own.samples.edges is not None
    cells, found = own.samples.edges.chains
    intervals = dr.width(found)
    samples = _samples_of(own.samples, CHAIN_EDGES, INTERVALS_PER_EDGE * max(own.samples.width // intervals, 1))
    p = Pass(samples, None, own.adjoint)
    lane, ring = dr.arange(mi.UInt32, samples.width), Ring(MOST_VERTICES + 1, False)
    pairs = dr.opaque(mi.Float, (samples.width + 1) // 2)  # two lanes share an edge
    offset = unit(mi.sample_tea_32(samples.seed, mi.UInt32(SIDE))[0])
    number, chance = pick(found, (mi.Float(lane // 2) + offset) / pairs)
    count = dr.opaque(mi.UInt32, intervals)
    chains = _chains(samples, number)
    edge = sample_edge(chains, random_lines(chains, cells, number, count))
    edge.weight *= dr.select(chance > 0, dr.rcp(chance * mi.Float(count)), 0)
    shadow = edge.shadow
    # If the edge touches the surface in its shadow, the chain itself meets it.
    touches = shadow & (dr.norm(edge.here.p - edge.here.end.si.p) < 2 * AROUND * ray_offset(edge.here.p))
    size = dr.select(edge.active & ~touches, 2 * _light(p, edge, lane % 2 == 0), 0)
    # Rarely, the chain from the middle of the jump misses a surface, and has fewer vertices on the stack. The others
    # are undefined: reading them can end the process.
    form, stack = SpecularFrame.blank(own.plan), _stack_of(own, chains, edge, ring)
    active = (size != 0) & (stack.count == edge.over.count)
    at_p = size * edge.n
    with dr.resume_grad(), dr.isolate_grad():
        dr.backward_from(moved_by(edge.here.pi, edge.here.ray, at_p, active), flags=MAY_LACK)
    end, ray = active & shadow, mi.Ray3f(edge.over.ray)
    with dr.resume_grad():
        ray.o, ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
        dr.enable_grad(ray.o, ray.d)
        x = find_vertex(ray, edge.over.pi, end).si.p
        dr.backward_from(dr.select(end, dr.dot(x, -edge.s * at_p), 0), flags=MAY_LACK)
        origin, direction = mi.Vector3f(dr.grad(ray.o)), mi.Vector3f(dr.grad(ray.d))
    adjoint = Adjoint(
        dr.select(active, dr.select(shadow, origin, -at_p), 0),
        dr.select(active, dr.select(shadow, direction, -at_p * edge.over.pi.t), 0),
        mi.Spectrum(0),
    )
    vertices = dr.select(active, edge.over.count, 0)
    own = replace(own, colours=own.samples.film.colours(edge.over.ray.wavelengths))
    differentiate_frames(own, form, ring, stack, vertices, mi.UInt32(0), adjoint)
