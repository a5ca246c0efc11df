"""Edges behind specular chains: places where a mirror or a lens shows a jump of light.

Along a line in the plane of the chains (`chains.py`), light jumps at two kinds of places:

- The next surface along the chain changes, or its flat normal. p is the point of the edge, and q the point of the
    chain's ray at the distance of p.
- The visibility of y from x changes. p is the point of the edge between x and y, and q = s x + (1 - s) y with
    s = |p - y| / |x - y|.

n is the normal of the edge, and points away from the surface of p. A jump satisfies <p - q(u), n> = 0, so that it moves
along the line by <v_p - v_q, n> / <dq/du, n>.

`sample_edge` tests a random interval of a random line. If the chains through both ends differ, bisection finds a jump.
The lengths of the runs without a jump on both sides give the density of the jump. Lines run along both axes of the
plane, and a jump counts along the axis in which it moves faster.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.edges import edge_normal
from reslrb_cli.scene.rays import past_lamps, ray_offset, shadow_ray
from reslrb_cli.transport.bsdf import Hit
from reslrb_cli.transport.chains import Chain, Chains, Target, surface_code
from reslrb_cli.transport.edges import pick
from reslrb_cli.transport.sobol import evenly, unit

#: Length of an interval that is tested for a jump, in cells of the plane.
INTERVAL = 0.5
#: Bisections of an interval.
BISECTIONS = 15
#: Largest distance in cells between places whose difference gives dq/du.
NEIGHBOUR = 0.06
#: Distance of the ray at a jump from an edge of the surface, in units of its uncertainty. From this distance on, the
#: jump is not an edge, but a curve in which two surfaces intersect.
MARGIN = 10.0
#: Streams of random numbers, mixed into the seed or into the key of a chain.
LINES, DIRECTION = 0xC4A1, 0x57E


@dataclass
class ScanLine:
    """Line in a cell of the plane: places `u` + `along` t for t in [0, 1].

    `across` is perpendicular to `along`. `place` is a random number, and `chance` the probability of the cell.
    """

    u: mi.Point2f
    along: mi.Vector2f
    across: mi.Vector2f
    place: mi.Float
    chance: mi.Float

    def at(self, t: mi.Float) -> mi.Point2f:
        """Return the place at distance `t` along the line."""
        return self.u + self.along * t


def random_lines(chains: Chains, weights: mi.Float, number: mi.UInt32, count: mi.UInt32) -> ScanLine:
    """Return line `number` of `count` lines. Half of the lines run along each axis.

    `weights` are the cumulative weights of the cells.
    """
    seed, width = chains.samples.seed, chains.cells[0]
    axis, y, place = evenly(seed, LINES, number)
    jitter = unit(mi.sample_tea_32(number, mi.sample_tea_32(seed, mi.UInt32(LINES + 1))[1])[0])
    cell, chance = pick(weights, (mi.Float(number) + jitter) / mi.Float(count))
    along = dr.select(axis < 0.5, mi.Vector2f(1, 0), mi.Vector2f(0, 1))
    across = mi.Vector2f(along.y, along.x)
    return ScanLine(mi.Point2f(cell % width, cell // width) + across * y, along, across, place, chance)


def _search(
    chains: Chains, line: ScanLine, inner: mi.Float, outer: mi.Float, code: mi.UInt32, active: mi.Bool
) -> tuple[mi.Float, mi.Float]:  # fmt: skip
    """Return both ends of a small interval between `inner` and `outer` in which the chain's code changes from `code`.
    If the code at `outer` is `code`, return `outer` twice.
    """

    def body(step: mi.UInt32, inner: mi.Float, outer: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        middle = 0.5 * (inner + outer)
        same = chains.follow(line.at(middle), active).code == code
        return step + 1, dr.select(same, middle, inner), dr.select(same, outer, middle)

    changes = active & (chains.follow(line.at(outer), active).code != code)
    state = mi.UInt32(0), dr.select(changes, inner, outer), mi.Float(outer)
    return dr.while_loop(state, lambda step, *_: changes & (step < BISECTIONS), body, label="bisection")[1:]


@dataclass
class Jump:
    """Jump in a line. `inner` and `outer` are places beside it, with the codes `before` and `after`. `back` and `ahead`
    are the distances to the jumps beside it. `places` is the length of the places from which the jump is found.
    """

    inner: mi.Float
    outer: mi.Float
    back: mi.Float
    ahead: mi.Float
    places: mi.Float
    active: mi.Bool


@dataclass
class Interval:
    """Random interval of a line, from `begin` to `begin` + `step`. The code at its begin is `before`. In the lanes
    `differs`, the code at its end is another one, and the chain at its begin has a specular vertex.
    """

    begin: mi.Float
    step: mi.Float
    before: mi.UInt32
    differs: mi.Bool


def random_interval(chains: Chains, line: ScanLine) -> Interval:
    """Return a random interval of the line."""
    begin = (1 + INTERVAL) * line.place - INTERVAL
    forward = mi.sample_tea_32(chains.key, mi.UInt32(DIRECTION))[0] % 2 == 0
    begin, step = dr.select(forward, begin, begin + INTERVAL), dr.select(forward, mi.Float(INTERVAL), -INTERVAL)
    first = chains.follow(line.at(begin))
    differs = (first.count > 0) & (chains.follow(line.at(begin + step), first.count > 0).code != first.code)
    return Interval(begin, step, first.code, differs)


def _find_jump(chains: Chains, line: ScanLine) -> Jump:
    """Return the first jump from the begin of a random interval of the line."""
    interval = random_interval(chains, line)
    begin, step, before, active = interval.begin, interval.step, interval.before, interval.differs
    inner, outer = _search(chains, line, begin, begin + step, before, active)
    active &= (inner >= 0) & (inner < 1)
    after = chains.follow(line.at(outer), active).code

    def run(begin: mi.Float, step: mi.Float, code: mi.UInt32, other: mi.UInt32) -> tuple[mi.Float, mi.Bool]:
        """Return the length of the run with the `code`, at most INTERVAL. Also return the lanes in which a run with the
        code `other` follows.
        """
        near, far = _search(chains, line, begin, begin + step, code, active)
        length = dr.abs(near - begin)
        ends = active & (length < INTERVAL)
        return length, ends & (chains.follow(line.at(far), ends).code == other)

    back, back_returns = run(inner, -step, before, after)
    ahead, ahead_returns = run(outer, step, after, before)
    both = dr.maximum(back + ahead - INTERVAL, 0)
    places = 0.5 * (dr.select(ahead_returns, both, back) + dr.select(back_returns, both, ahead))
    return Jump(inner, outer, back, ahead, dr.select(places > 0, places, 1), active & (places > 0))


# ---- The edge at a jump ----


@dataclass
class EdgePoint:
    """Point p of an edge: intersection `pi` of `ray`.

    `end` is the vertex that the chain reaches, and `target` its point y.
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    end: Hit
    target: Target

    @property
    def p(self) -> mi.Point3f:
        """The point."""
        return self.ray(self.pi.t)


@dataclass
class ChainEdge:
    """Random point of an edge behind a specular chain.

    `over` is the chain that reaches the edge, and `past` the chain that misses it. `here` is p, and `n` its normal.
    `weight` (C,) is the throughput divided by |<dq/du, n>| and by the density of the line. In the lanes `shadow`, the
    edge hides y from x, and p divides the segment from y to x in the ratio `s`.
    """

    over: Chain
    past: Chain
    u: mi.Point2f
    here: EdgePoint
    n: mi.Vector3f
    s: mi.Float
    shadow: mi.Bool
    weight: mi.Spectrum
    active: mi.Bool


@dataclass
class Pair:
    """Chains from both sides of a jump, at the first vertex at which they differ. In the lanes `edge`, their surfaces
    differ. In the lanes `shadow`, a surface hides y from one of them. `inner_hides` lanes hide y from `inner`.
    """

    inner: Chain
    outer: Chain
    edge: mi.Bool
    shadow: mi.Bool
    inner_hides: mi.Bool


def _compare(chains: Chains, inner: mi.Point2f, outer: mi.Point2f, active: mi.Bool) -> Pair:
    """Return the chains from two places at the first vertex at which they differ."""

    def body(active: mi.Bool, pair: Pair) -> tuple[mi.Bool, Pair]:
        ends = pair.inner, pair.outer
        valid = [end.pi.is_valid() for end in ends]
        events = [chains.event(end, active & there) for end, there in zip(ends, valid, strict=True)]
        codes = [surface_code(event[0], there) for event, there in zip(events, valid, strict=True)]
        edge = active & (codes[0] != codes[1])
        shadow, hides = mi.Bool(False), mi.Bool(False)
        if chains.has_targets:
            lit = [chains.lit(event[0], ends[0].count, active & valid[0] & ~edge) for event in events]
            hides = lit[0][1]
            shadow = lit[0][0].active & lit[1][0].active & dr.select(hides, ~lit[1][1], lit[1][1])
        passes = events[0][1].active & events[1][1].active & ~edge & ~shadow & (ends[0].count < chains.most)
        inner, outer = (chains.onward(end, hit, event, passes) for end, (hit, event) in zip(ends, events, strict=True))
        return passes, Pair(
            inner, outer, pair.edge | edge, pair.shadow | shadow, dr.select(active, hides, pair.inner_hides)
        )

    first = Pair(
        chains.start(inner, active), chains.start(outer, active), mi.Bool(False), mi.Bool(False), mi.Bool(False)
    )
    return dr.while_loop((active, first), lambda active, pair: active, body, label="chains beside a jump")[1]


def _edge_point(chains: Chains, chain: Chain, shadow: mi.Bool, active: mi.Bool) -> EdgePoint:
    """Return the point of the edge that the chain's next segment reaches, or in the lanes `shadow` the segment from its
    end to y.
    """
    end = chain.vertex(active)
    target = chains.target(end, chain.count, active & shadow)
    # A surface between the vertex and the start of this ray touches the vertex. Such an edge would not count anyway, so
    # the second ray of `is_hidden` is not needed.
    to_target = shadow_ray(end.si, target.y, chains.samples.plan.has_edges)
    if chains.passes_lamps:
        to_target = past_lamps(chains.samples.scene, to_target, active & shadow)
    pi = chains.samples.scene.ray_intersect_preliminary(to_target, coherent=False, active=active & shadow)
    ray = dr.select(shadow, mi.Ray3f(to_target), mi.Ray3f(chain.ray))
    return EdgePoint(dr.detach(ray), dr.select(shadow, pi, chain.pi), end, target)


def sample_edge(chains: Chains, line: ScanLine) -> ChainEdge:
    """Return the edge of a jump in a random interval of the line."""
    jump = _find_jump(chains, line)
    pair = _compare(chains, line.at(jump.inner), line.at(jump.outer), jump.active)
    count, shadow = pair.inner.count, pair.shadow
    active = jump.active & (count > 0) & (shadow | pair.edge)
    # p belongs to the nearer surface.
    distances = [dr.select(end.pi.is_valid(), end.pi.t, dr.inf) for end in (pair.inner, pair.outer)]
    from_inner = dr.select(shadow, pair.inner_hides, distances[0] <= distances[1])
    over, past = (dr.select(from_inner, *ends) for ends in ((pair.inner, pair.outer), (pair.outer, pair.inner)))
    here = _edge_point(chains, over, shadow, active)
    active &= here.pi.is_valid()
    s = 1 - dr.norm(here.p - here.end.si.p) / dr.norm(here.target.y - here.end.si.p)
    s = dr.select(shadow & ~here.target.distant, s, 1)

    # ---- dq/du, along the line and across it ----
    d, p, end_code = here.ray.d, here.p, surface_code(here.end, mi.Bool(True))
    distance = dr.minimum(NEIGHBOUR, 0.2 * dr.minimum(jump.back, jump.ahead))
    code = chains.follow(line.at(jump.inner), active, count).code

    def probe(
        step: mi.UInt32, same: mi.Bool, along: mi.Vector3f, across: mi.Vector3f
    ) -> tuple[mi.UInt32, mi.Bool, mi.Vector3f, mi.Vector3f]:
        change, is_across = dr.select(step % 2 == 0, distance, -distance), step >= 2
        u = line.at(jump.inner) + dr.select(is_across, line.across, line.along) * change
        chain = chains.follow(u, active, count)
        end = chain.vertex(active & shadow)
        target = chains.target(end, count, active & shadow)
        q = chain.ray.o + chain.ray.d * (dr.dot(p - chain.ray.o, d) / dr.dot(chain.ray.d, d))
        q = dr.select(shadow, s * end.si.p + dr.select(s < 1, (1 - s) * target.y, 0), q) / (2 * change)
        same &= (chain.count == count) & (chain.code == code)
        same &= ~shadow | (target.active & (surface_code(end, mi.Bool(True)) == end_code))
        return step + 1, same, along + dr.select(is_across, 0, q), across + dr.select(is_across, q, 0)

    state = mi.UInt32(0), active, mi.Vector3f(0), mi.Vector3f(0)
    _, active, along, across = dr.while_loop(state, lambda step, *_: active & (step < 4), probe, label="neighbours")

    n, beside = edge_normal(here.pi, here.ray, chains.samples.plan.needs.has_instances, active)
    n = dr.mulsign(n, dr.dot(n, along) * dr.select(from_inner, 1, -1) * (jump.outer - jump.inner))
    active &= beside < MARGIN * (dr.norm(along) * dr.abs(jump.outer - jump.inner) + ray_offset(p))
    slope = dr.abs(dr.dot(n, along))
    active &= (slope > 0) & (slope >= dr.abs(dr.dot(n, across)))
    density = jump.places * line.chance * (chains.cells[0] * chains.cells[1] / (2 * (1 + INTERVAL)))
    weight = over.product * dr.select(active, dr.rcp(slope * density), 0)
    return ChainEdge(over, past, line.at(0.5 * (jump.inner + jump.outer)), here, n, s, shadow, weight, active)
