"""Derivatives of the light that moving edges cover and uncover, as the sensor sees them in mirrors and through glass.

A specular chain begins at a film position u. The chain is deterministic if its choices between reflection and
refraction are fixed. Its first vertex that is not specular is x. Along a line in the film, the radiance jumps at two
kinds of places:

- The next surface along the chain changes, or its flat normal. p is the point of the edge, q the point of the chain's
  ray at the distance of p, and n the normal of the edge, which points away from p's surface.
- The visibility of a point y on a lamp from x changes. The random numbers of y are fixed. p is the point of the edge
  between x and y, q = s x + (1 - s) y with s = |p - y| / |x - y|, and L_p = 0.

The place u of a jump along the line satisfies <p - q(u), n> = 0. The integral over all lines gives

    dL/dtheta  +=  delta(u) P (L_p - L_x) <v_p - v_q, n> / |<dq/du, n>|

P is the throughput of the chain. v_q is the velocity of q if u is fixed. The walk back of `attached_camera.py` takes the
adjoint of q through the chain.

Lines go along both axes of the film. A jump counts along the axis in which it moves faster. dq/du and n come from
differences between neighbouring film positions. n is perpendicular to the ray and to the line through two points of the
edge, which two parallel lines of the film find.

The first vertex of the chain has the terms of `camera_edges.py`. A line is a run of STEPS intervals, and one interval
whose ends differ is searched by bisection. Features of the image that are narrower than an interval are therefore
missing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import Adjoint, Before, reach
from reslrb_cli.estimators.attached_camera import AttachedCameraFrame
from reslrb_cli.estimators.base import Pass, SurfacePoint
from reslrb_cli.estimators.camera import Radiance
from reslrb_cli.estimators.edges import AROUND, MAY_LACK, edge_samples, for_camera, moved_by
from reslrb_cli.estimators.stack import Ring, StackState, pop
from reslrb_cli.scene.graph import sensor_rays
from reslrb_cli.transport.bsdf import EventNumbers, Hit, Scattering, evaluate, scatter
from reslrb_cli.transport.camera import FilmRay, camera_walk, sample_lamp
from reslrb_cli.transport.factors import showing
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Vertex

#: Length in pixels of an interval that is tested for a jump.
INTERVAL = 0.5
#: Least width in pixels of the places from which a jump is found. Weights are limited for narrower places.
NARROWEST = 0.02
#: Radius of the circle that finds the direction of an edge, relative to the distance of the edge.
CIRCLE = 4e-3
#: Bisections of an interval.
BISECTIONS = 15
#: Distance in pixels between film positions whose difference gives dq/du, and between two parallel lines.
NEIGHBOUR = 0.06
#: Probability of reflection at a vertex that also refracts or scatters.
REFLECTS = 0.3
#: Rays per pixel that look for lamps behind specular chains.
PROBES = 16
#: Most specular vertices of a chain.
MOST_VERTICES = 8

DBG={}
_NONE, _EDGE, _SHADOW = 0, 1, 2


@dataclass
class Chain:
    """Specular chain from a film position. `count` specular vertices have been passed. `ray` leads to the next vertex,
    with the intersection `pi`, and `product` (C,) is the throughput. `code` identifies all surfaces and flat normals
    that the chain meets, and the visibility of points on lamps.
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    product: mi.Spectrum
    count: mi.UInt32
    code: mi.UInt32


def _vertex(chain: Chain, active: mi.Bool) -> Hit:
    """Return the vertex that a chain reaches, with the derivatives of its normal."""
    si = chain.pi.compute_surface_interaction(chain.ray, mi.RayFlags.All | mi.RayFlags.dNSdUV, active)
    return Hit(si, si.bsdf(), chain.ray)


@dataclass
class Chains:
    """Specular chains of one random seed per lane, `key`. Equal keys make equal choices."""

    samples: Samples
    key: mi.UInt32

    def _random(self, count: mi.UInt32, stream: int) -> mi.Point2f:
        words = mi.sample_tea_32(self.key ^ stream, count)
        return mi.Point2f(*(mi.Float(word >> 8) * 2.0**-24 for word in words))

    def start(self, u: mi.Point2f, active: mi.Bool) -> Chain:
        """Return the chain before its first vertex."""
        samples = self.samples
        aperture = self._random(mi.UInt32(0), 0xA9E) if samples.plan.needs.thin_lens else mi.Point2f(0.5)
        ray, weight = sensor_rays(samples.sensor, samples.time(lambda: mi.Float(0.5)), u / mi.Vector2f(samples.film.size), aperture)
        ray = dr.detach(ray)
        pi = samples.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        return Chain(ray, pi, dr.detach(weight), mi.UInt32(0), mi.UInt32(0))

    def numbers(self, count: mi.UInt32) -> EventNumbers:
        """Return the random numbers of the event at a vertex: the first or the last lobe of the BSDF."""
        reflects = self._random(count, 0x5E1).x < REFLECTS
        return EventNumbers(mi.Point2f(0.5), dr.select(reflects, 0, dr.one_minus_epsilon(mi.Float)))

    def event(self, chain: Chain, active: mi.Bool) -> tuple[Hit, Scattering, mi.Bool, mi.Spectrum]:
        """Return the vertex that the chain reaches, its event, the lanes that pass it, and the throughput behind it."""
        hit = _vertex(chain, active)
        numbers = self.numbers(chain.count)
        scattering, _ = scatter(self.samples.plan, hit, numbers, active, None)
        flags = hit.bsdf.flags()
        several = mi.has_flag(flags, mi.BSDFFlags.Smooth) | mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)
        reflects = numbers.bsdf_1d == 0
        mirrored = mi.Frame3f.cos_theta(scattering.wo) * mi.Frame3f.cos_theta(hit.si.wi) > 0
        chance = dr.select(several, dr.select(reflects, REFLECTS, 1 - REFLECTS), 1)
        # At total reflection, only the lanes that reflect continue.
        passes = scattering.active & scattering.is_delta & (~several | (reflects == mirrored))
        weight = chain.product * scattering.weight * (scattering.pdf / chance)
        return hit, scattering, passes, weight

    def onward(self, chain: Chain, hit: Hit, scattering: Scattering, passes: mi.Bool, product: mi.Spectrum) -> Chain:
        """Return the chain behind a vertex, in the lanes `passes`."""
        ray = dr.detach(hit.si.spawn_ray(scattering.d))
        pi = self.samples.scene.ray_intersect_preliminary(ray, coherent=False, active=passes)
        count = chain.count + 1
        return dr.select(passes, Chain(ray, pi, product, count, chain.code), chain)

    def surface(self, hit: Hit, valid: mi.Bool) -> mi.UInt32:
        """Return a number for the surface at a vertex, and for its normal if the surface is flat."""
        si = hit.si
        flat = dr.all(si.dn_du == 0) & dr.all(si.dn_dv == 0)
        code = dr.reinterpret_array(mi.UInt32, si.shape) + 1
        for part in si.n:
            code = code * 31 + dr.select(flat, mi.UInt32(mi.Int32(dr.floor(part * 61.7 + 1000.37))), 0)
        return dr.select(valid, code, 0xFFFFFFF)

    def lamp(self, hit: Hit, count: mi.UInt32, active: mi.Bool) -> tuple[mi.DirectionSample3f, mi.Spectrum, mi.Bool]:
        """Return the point on a lamp, radiance / density (C,), and the lanes in which a vertex behind the chain samples
        this point. Visibility is not tested.
        """
        plan = self.samples.plan
        active = active & (count > 0) & mi.has_flag(hit.bsdf.flags(), mi.BSDFFlags.Smooth) & (count + 2 <= plan.max_depth)
        ds, weight = sample_lamp(self.samples, hit.si, self._random(count, 0x1A4), active)
        active &= (ds.pdf > 0) & dr.isfinite(ds.pdf) & dr.any(weight > 0)
        return ds, weight, active

    def hides(self, hit: Hit, ds: mi.DirectionSample3f, active: mi.Bool) -> mi.Bool:
        """Return the lanes in which the point on the lamp is not visible."""
        return self.samples.scene.ray_test(hit.si.spawn_ray_to(ds.p), active)

    def normal(self, edge: EdgePoint, outwards: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """Return the normal of an edge. `outwards` points away from the surface, and is not parallel to the edge.

        The direction of the edge is that of the two points in which a small circle around the edge's point crosses it.
        """
        scene, ray, p = self.samples.scene, edge.ray, edge.p
        first = dr.normalize(outwards - ray.d * dr.dot(outwards, ray.d))
        second = dr.cross(ray.d, first)

        def on_surface(angle: mi.Float) -> mi.Bool:
            s, c = dr.sincos(angle)
            there = mi.Ray3f(ray)
            there.d = dr.normalize(p + (c * first + s * second) * (CIRCLE * edge.pi.t) - ray.o)
            there.maxt = dr.inf
            pi = scene.ray_intersect_preliminary(there, coherent=False, active=active)
            si = pi.compute_surface_interaction(there, mi.RayFlags.All | mi.RayFlags.dNSdUV, active)
            return self.surface(Hit(si, si.bsdf(), there), pi.is_valid()) == code

        si = edge.pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.dNSdUV, active)
        code = self.surface(Hit(si, si.bsdf(), ray), edge.pi.is_valid())

        def body(step: mi.UInt32, left: mi.Float, right: mi.Float, half: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float, mi.Float]:
            up = on_surface(left + half)
            down = on_surface(-(right + half))
            return step + 1, dr.select(up, left, left + half), dr.select(down, right, right + half), 0.5 * half

        state = mi.UInt32(0), mi.Float(0), mi.Float(0), mi.Float(0.5 * dr.pi)
        _, left, right, _ = dr.while_loop(state, lambda step, *_: active & (step < 12), body, label="edge direction")
        (s0, c0), (s1, c1) = dr.sincos(left), dr.sincos(-right)
        tangent = (c0 - c1) * first + (s0 - s1) * second
        n = dr.normalize(dr.cross(tangent, ray.d))
        return dr.mulsign(n, dr.dot(n, outwards))

    def follow(self, u: mi.Point2f, active: mi.Bool, end: mi.UInt32 | int = MOST_VERTICES) -> Chain:
        """Return the chain through film position `u`, up to vertex number `end` or its first vertex that is not
        specular.
        """
        plan = self.samples.plan
        most = min(plan.max_depth - 1, MOST_VERTICES)

        def body(active: mi.Bool, chain: Chain) -> tuple[mi.Bool, Chain]:
            valid = chain.pi.is_valid()
            hit, scattering, passes, product = self.event(chain, active & valid)
            code = chain.code * 0x9E3779B1 + self.surface(hit, valid)
            if plan.samples_emitters:
                ds, _, lit = self.lamp(hit, chain.count, active & valid)
                code += dr.select(lit & ~self.hides(hit, ds, lit), mi.UInt32(77), 0)
            chain = dr.select(active & ((chain.count > 0) | passes), replace(chain, code=code), chain)
            passes &= active & (chain.count < most)
            chain = self.onward(chain, hit, scattering, passes, product)
            return passes & (chain.count < end), chain

        first = self.start(u, active)
        return dr.while_loop((mi.Bool(active) & (mi.UInt32(end) > 0), first), lambda active, chain: active, body, label="specular chain")[1]


@dataclass
class Line:
    """Line in a pixel of the film: points `u` + `along` t for t in [0, 1]. `across` is perpendicular to `along`. `place`
    is a random number, and `chance` the probability of the pixel.
    """

    u: mi.Point2f
    along: mi.Vector2f
    across: mi.Vector2f
    place: mi.Float
    chance: mi.Float

    def at(self, t: mi.Float | float, beside: mi.Float | float = 0) -> mi.Point2f:
        """Return the point at distance `t` along the line, and at distance `beside` from it."""
        return self.u + self.along * t + self.across * beside


def _lines(samples: Samples, weights: mi.Float | None, lane: mi.UInt32, count: mi.UInt32) -> Line:
    """Return line number `lane` of `count` lines. Half of the lines are horizontal.

    `weights` are the cumulative weights of the pixels. If `weights` is None, line number k lies in pixel number k.
    """
    first, second = mi.sample_tea_32(samples.seed, mi.UInt32(0xC4A1))
    third, fourth = mi.sample_tea_32(samples.seed, mi.UInt32(0xC4A2))
    words = lane * 3242174889 + first, lane * 2447445414 + second, dr.brev(lane) + third
    y, place, axis = (mi.Float(word >> 8) * 2.0**-24 for word in words)
    size = samples.film.size
    pixels = int(dr.prod(size))
    if weights is None:
        pixel, chance = lane % pixels, mi.Float(1 / pixels)
    else:
        total = dr.gather(mi.Float, weights, pixels - 1)
        jitter = mi.Float(mi.sample_tea_32(lane, fourth)[0] >> 8) * 2.0**-24
        number = dr.minimum((mi.Float(lane) + jitter) / mi.Float(count), dr.one_minus_epsilon(mi.Float)) * total
        pixel = dr.binary_search(0, pixels - 1, lambda i: dr.gather(mi.Float, weights, i) <= number)
        below = dr.select(pixel > 0, dr.gather(mi.Float, weights, dr.maximum(pixel, 1) - 1), 0)
        chance = (dr.gather(mi.Float, weights, pixel) - below) / total
    along = dr.select(axis < 0.5, mi.Vector2f(1, 0), mi.Vector2f(0, 1))
    across = mi.Vector2f(along.y, along.x)
    corner = mi.Point2f(pixel % int(size[0]), pixel // int(size[0]))
    return Line(corner + across * y, along, across, place, chance)


def _search(
    chains: Chains, line: Line, left: mi.Float, right: mi.Float, code: mi.UInt32, beside: mi.Float | float, active: mi.Bool
) -> tuple[mi.Float, mi.Float]:  # fmt: skip
    """Return both ends of a small interval between `left` and `right` in which the chain's code changes from `code`. If
    the code at `right` is `code`, return `right` twice.
    """

    def body(step: mi.UInt32, left: mi.Float, right: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        middle = 0.5 * (left + right)
        same = chains.follow(line.at(middle, beside), active).code == code
        return step + 1, dr.select(same, middle, left), dr.select(same, right, middle)

    changes = active & (chains.follow(line.at(right, beside), active).code != code)
    left = dr.select(changes, left, right)
    return dr.while_loop(
        (mi.UInt32(0), left, mi.Float(right)), lambda step, *_: changes & (step < BISECTIONS), body, label="bisection"
    )[1:]


@dataclass
class Jump:
    """Both chains beside a jump, the kind of the jump, and the stack of the vertices before it."""

    left: Chain
    right: Chain
    kind: mi.UInt32
    hidden: mi.UInt32  # 1 if the lamp is hidden on the left
    stack: StackState


def _compare(p: Pass, chains: Chains, left: mi.Point2f, right: mi.Point2f, ring: Ring, active: mi.Bool) -> Jump:
    """Return the first vertex at which the chains from two film positions differ."""
    plan = chains.samples.plan

    def body(active: mi.Bool, jump: Jump) -> tuple[mi.Bool, Jump]:
        a, b = jump.left, jump.right
        valid = a.pi.is_valid(), b.pi.is_valid()
        hit, scattering, passes, product = chains.event(a, active & valid[0])
        other, other_scattering, other_passes, other_product = chains.event(b, active & valid[1])
        edge = chains.surface(hit, valid[0]) != chains.surface(other, valid[1])
        kind, hidden = dr.select(edge, mi.UInt32(_EDGE), _NONE), mi.UInt32(0)
        shadow = mi.Bool(False)
        if plan.samples_emitters:
            sides = []
            for end, own, there in ((a, hit, valid[0]), (b, other, valid[1])):
                ds, _, lit = chains.lamp(own, end.count, active & there & ~edge)
                sides.append((lit, chains.hides(own, ds, lit)))
            shadow = sides[0][0] & sides[1][0] & (sides[0][1] != sides[1][1])
            kind, hidden = dr.select(shadow, _SHADOW, kind), dr.select(sides[0][1], mi.UInt32(1), 0)
        passes &= active & other_passes & ~edge & ~shadow & (a.count < MOST_VERTICES)
        frame = AttachedCameraFrame(
            SurfacePoint.of(p.plan, Vertex(hit.si, hit.bsdf, a.ray, a.pi, a.count, None, active)),
            scattering.sample_1, scattering.sample_2, mi.Spectrum(0), mi.Float(0), [], [], [], [], [],
        )  # fmt: skip
        stack = jump.stack.pushed(frame, ring, passes, passes)
        a = chains.onward(a, hit, scattering, passes, product)
        b = chains.onward(b, other, other_scattering, passes, other_product)
        kind, hidden = dr.select(active, kind, jump.kind), dr.select(active, hidden, jump.hidden)
        return passes, Jump(a, b, kind, hidden, stack)

    first = Jump(
        chains.start(left, active), chains.start(right, active), mi.UInt32(_NONE), mi.UInt32(0),
        StackState.begin(_blank(p), ring, mi.Float(1)),
    )  # fmt: skip
    _, jump = dr.while_loop((mi.Bool(active), first), lambda active, jump: active, body, label="chains beside a jump")
    return jump


@dataclass
class EdgePoint:
    """Point p of an edge: intersection `pi` of `ray`. `x` is the end of the chain, and `y` the point on the lamp."""

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    hit: Hit
    ds: mi.DirectionSample3f
    light: mi.Spectrum

    @property
    def p(self) -> mi.Point3f:
        return self.ray(self.pi.t)


def _edge_point(chains: Chains, chain: Chain, shadow: mi.Bool, active: mi.Bool) -> EdgePoint:
    """Return the point of the edge that the chain's next segment reaches, or in the lanes `shadow` the segment from its
    end to a lamp.
    """
    hit = _vertex(chain, active)
    ds, light, _ = chains.lamp(hit, chain.count, active & shadow)
    to_lamp = hit.si.spawn_ray_to(ds.p)
    pi = chains.samples.scene.ray_intersect_preliminary(to_lamp, coherent=False, active=active & shadow)
    ray = dr.select(shadow, to_lamp, mi.Ray3f(chain.ray))
    return EdgePoint(dr.detach(ray), dr.select(shadow, pi, chain.pi), hit, ds, light)


@dataclass
class ChainEdge:
    """Random point of an edge behind a specular chain.

    `over` is the chain that reaches the edge, and `past` the chain that misses it. `here` is p, and `shadow` lanes hide
    a lamp. `n` is the normal of the edge. `s` is the place of p between y and x. `weight` (C,) is P / |<dq/du, n>|,
    divided by the density of the line.
    """

    over: Chain
    past: Chain
    here: EdgePoint
    shadow: mi.Bool
    n: mi.Vector3f
    s: mi.Float
    weight: mi.Spectrum
    u: mi.Point2f
    active: mi.Bool
    stack: StackState


def _sample_edge(samples: Samples, attached: Pass, line: Line, key: mi.UInt32, ring: Ring) -> ChainEdge:
    """Return one edge that the line crosses. `key` is the seed of the chain."""
    chains = Chains(samples, key)

    # ---- Find the first jump from one end of a random interval, and the distances to the jumps beside it ----
    start = (1 + INTERVAL) * line.place - INTERVAL
    step = dr.select(mi.sample_tea_32(key, mi.UInt32(0x57E))[0] % 2 == 0, mi.Float(INTERVAL), -INTERVAL)
    start = dr.select(step > 0, start, start + INTERVAL)
    before, last = (chains.follow(line.at(start + end), mi.Bool(True)).code for end in (0, step))
    active = before != last
    near_end, far_end = _search(chains, line, start, start + step, before, 0, active)
    active &= (near_end >= 0) & (near_end < 1)
    after = chains.follow(line.at(far_end), active).code
    DBG['1 differ']=mi.Bool(active)

    def run(begin: mi.Float, step: mi.Float, code: mi.UInt32, other: mi.UInt32) -> tuple[mi.Float, mi.Bool]:
        """Return the length of the run with the `code`, at most INTERVAL. Also return the lanes in which a run with the
        code `other` follows.
        """
        inner, outer = _search(chains, line, begin, begin + step, code, 0, active)
        length = dr.abs(inner - begin)
        ends = length < INTERVAL
        return length, ends & (chains.follow(line.at(outer), active & ends).code == other)

    back, back_returns = run(near_end, -step, before, after)
    ahead, ahead_returns = run(far_end, step, after, before)
    # Length of the places where an interval may start and find this jump, from both of its ends.
    both = dr.maximum(back + ahead - INTERVAL, 0)
    places = 0.5 * (dr.select(ahead_returns, both, back) + dr.select(back_returns, both, ahead))
    near = mi.Float(dr.minimum(NEIGHBOUR, 0.2 * dr.minimum(back, ahead)))
    active &= places > 0
    places = dr.maximum(places, NARROWEST)
    forward = step > 0
    left, right = dr.select(forward, near_end, far_end), dr.select(forward, far_end, near_end)
    before, after = dr.select(forward, before, after), dr.select(forward, after, before)
    DBG['3 places']=mi.Bool(active); DBG.update(tl=back,tr=ahead,line=line,left=left,places=places)

    # ---- Compare both sides ----
    jump = _compare(attached, chains, line.at(left), line.at(right), ring, active)
    count = jump.left.count
    shadow, edge = jump.kind == _SHADOW, jump.kind == _EDGE
    active &= (count > 0) & (shadow | edge)
    DBG['4 kind']=mi.Bool(active); DBG['kind']=jump.kind; DBG['count']=count
    t_left, t_right = (dr.select(end.pi.is_valid(), end.pi.t, dr.inf) for end in (jump.left, jump.right))
    from_left = dr.select(shadow, jump.hidden == 1, t_left <= t_right)
    over, past = dr.select(from_left, jump.left, jump.right), dr.select(from_left, jump.right, jump.left)
    here = _edge_point(chains, over, shadow, active)
    d = here.ray.d
    active &= here.pi.is_valid()
    distant = mi.has_flag(here.ds.emitter.flags(), mi.EmitterFlags.Infinite)
    s = dr.select(shadow & ~distant, 1 - here.pi.t / dr.norm(here.ds.p - here.hit.si.p), 1)

    # ---- dq/du, along the line and across it ----
    base = chains.follow(line.at(left), active, count).code
    surface = chains.surface(here.hit, mi.Bool(True))

    def probe(
        step: mi.UInt32, same: mi.Bool, along: mi.Vector3f, across: mi.Vector3f
    ) -> tuple[mi.UInt32, mi.Bool, mi.Vector3f, mi.Vector3f]:
        sign = dr.select(step % 2 == 0, near, -near)
        is_across = step >= 2
        u = line.at(left) + dr.select(is_across, line.across, line.along) * sign
        chain = chains.follow(u, active, count)
        ray, hit = chain.ray, _vertex(chain, active & shadow)
        ds, _, lit = chains.lamp(hit, count, active & shadow)
        q = ray.o + ray.d * (dr.dot(here.p - ray.o, d) / dr.dot(ray.d, d))
        q = dr.select(shadow, s * hit.si.p + dr.select(s < 1, (1 - s) * ds.p, 0), q)
        same &= (chain.count == count) & (chain.code == base)
        same &= ~shadow | (lit & (chains.surface(hit, lit) == surface))
        change = q / (2 * sign)
        return step + 1, same, along + dr.select(is_across, 0, change), across + dr.select(is_across, change, 0)

    state = mi.UInt32(0), mi.Bool(active), mi.Vector3f(0), mi.Vector3f(0)
    _, active, along, across = dr.while_loop(state, lambda step, *_: active & (step < 4), probe, label="neighbours")
    DBG['5 neigh']=mi.Bool(active)

    outwards = along * dr.select(from_left, 1, -1)
    n = chains.normal(here, outwards, active)
    slope = dr.abs(dr.dot(n, along))
    active &= (slope >= dr.abs(dr.dot(n, across))) & (slope > 0)
    DBG['7 slope']=mi.Bool(active); DBG.update(D1=along,D2=across,slope=slope,near=near)
    # If the edge touches the surface in its shadow, the chain itself sees it.
    offset = 2 * AROUND * mi.math.RayEpsilon * (1 + dr.max(dr.abs(here.p)))
    active &= ~shadow | (here.pi.t > offset)
    pixels = float(dr.prod(samples.film.size))
    weight = over.product * dr.select(active, 2 * (1 + INTERVAL) / (places * slope * line.chance * pixels), 0)
    u = line.at(0.5 * (left + right))
    return ChainEdge(over, past, here, shadow, n, s, weight, u, active, jump.stack)


def _light(samples: Samples, edge: ChainEdge, over: mi.Bool, halved: bool) -> mi.Spectrum:
    """Return the radiance from p in the lanes `over`, otherwise minus the radiance from x. At the edges of shadows,
    return minus the light from the lamp, divided by 2 if it counts in two lanes (`halved`).
    """
    first = FilmRay(dr.select(over, edge.over.ray, edge.past.ray), edge.u, mi.Spectrum(1), depth=edge.over.count + 1)
    _, L = camera_walk(samples, Radiance(tracked=False), edge.active & ~edge.shadow, first)
    lit = edge.active & edge.shadow
    x = _vertex(edge.past, lit)
    f = evaluate(samples.plan, x.si, x.bsdf, x.si.to_local(edge.here.ds.d), lit)
    return dr.select(edge.shadow, f * edge.here.light * (-0.5 if halved else -1), L * dr.select(over, 1, -1))


def _behind_chains(samples: Samples, pixel: mi.UInt32) -> tuple[mi.Float, mi.Float]:
    """Return the mean radiance of lamps that the sensor sees in a pixel behind specular chains, and the share of the
    pixel with specular chains.
    """
    width = int(samples.film.size[0])

    def probe(index: mi.UInt32, total: mi.Float, seen: mi.Float) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        word = mi.sample_tea_32(pixel * PROBES + index, samples.seed)[0]
        within = mi.Point2f(mi.Float(index) + 0.5, mi.Float(word >> 8) * (PROBES * 2.0**-24)) / PROBES
        u = mi.Point2f(pixel % width, pixel // width) + within
        chain = Chains(samples, word).follow(u, mi.Bool(True))
        hit = _vertex(chain, chain.count > 0)
        emitter = hit.si.emitter(samples.scene)
        lit = (chain.count > 0) & (emitter != dr.zeros(mi.EmitterPtr))
        total += dr.select(lit, dr.max(chain.product * emitter.eval(hit.si, lit)), 0)
        return index + 1, total, seen + dr.select(chain.count > 0, mi.Float(1), 0)

    state = mi.UInt32(0), dr.zeros(mi.Float, dr.width(pixel)), dr.zeros(mi.Float, dr.width(pixel))
    _, total, seen = dr.while_loop(state, lambda index, *_: index < PROBES, probe, label="probes")
    return total / PROBES, seen / PROBES


def weigh_pixels(own: Samples) -> mi.Float:
    """Return cumulative sampling weights of the film's pixels for edges behind specular chains. One line per pixel
    probes for edges, and the weights are smoothed over neighbours.
    """
    width, height = (int(n) for n in own.film.size)
    samples = for_camera(edge_samples(own, 0xED6E5))
    attached = Pass(own, None, None)
    lane = dr.arange(mi.UInt32, width * height)
    samples = replace(samples, width=width * height)
    key = mi.sample_tea_32(lane, samples.seed)[0]
    line = _lines(samples, None, lane, mi.UInt32(width * height))
    edge = _sample_edge(samples, attached, line, key, Ring(MOST_VERTICES + 1, False))
    over = mi.sample_tea_32(key, mi.UInt32(0x0E4))[0] % 2 == 0
    size = dr.select(edge.active, dr.max(dr.abs(edge.weight * _light(samples, edge, over, False))), 0)
    found, seen = _behind_chains(samples, lane)
    around = dr.zeros(mi.Float, width * height), dr.zeros(mi.Float, width * height)
    for i in range(-1, 2):
        for k in range(-1, 2):
            x, y = mi.Int32(lane % width) + i, mi.Int32(lane // width) + k
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            for total, value in zip(around, (size, seen), strict=True):
                dr.scatter_reduce(dr.ReduceOp.Add, total, value, mi.UInt32(y * width + x), inside)
    found, seen = found + around[0], around[1]
    # Probes do not find all edges.
    floor = dr.select(dr.sum(seen) > 0, dr.sum(found) / dr.sum(seen), 0)
    weights = dr.cumsum(found + dr.select(floor > 0, floor, 1) * seen)
    dr.make_opaque(weights)
    return weights


def differentiate_edges_behind_chains(p: Pass, numbers: mi.PCG32, attached: Pass) -> None:
    """Add the derivatives of the edges that the sensor sees in mirrors and through glass. dL/dI must be known.

    `p.samples` are the samples of `edge_samples`, for camera paths. `attached` has the plan with attached derivatives.
    """
    samples = p.samples
    lane = dr.arange(mi.UInt32, samples.width)
    key = mi.sample_tea_32(lane // 2, samples.seed)[0]
    line = _lines(samples, samples.edges.pixels[0], lane // 2, dr.opaque(mi.UInt32, (samples.width + 1) // 2))
    ring = Ring(MOST_VERTICES + 1, False)
    edge = _sample_edge(samples, attached, line, key, ring)
    over = lane % 2 == 0
    # Two lanes share a line.
    weight = p.delta(edge.u, edge.active) * edge.weight * (2 * p.scale)
    size = showing(dr.dot(weight, _light(samples, edge, over, True)))
    active = edge.active & (size != 0)
    adjoint = dr.select(active, size, 0) * edge.n
    DBG.update(edge=edge,size=size,act=active,key=key)
    with dr.resume_grad(), dr.isolate_grad():
        dr.backward_from(moved_by(edge.here.pi, edge.here.ray, adjoint, active), flags=MAY_LACK)
    # ---- The chain ----
    ray, end = mi.Ray3f(edge.over.ray), active & edge.shadow
    with dr.resume_grad():
        ray.o, ray.d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
        dr.enable_grad(ray.o, ray.d)
        x = reach(attached.plan, [], ray, edge.over.pi, end)[0].si.p
        dr.backward_from(dr.select(end, dr.dot(x, -edge.s * adjoint), 0), flags=MAY_LACK)
        at_o, at_d = mi.Vector3f(dr.grad(ray.o)), mi.Vector3f(dr.grad(ray.d))
    behind = Adjoint(
        dr.select(active, dr.select(edge.shadow, at_o, -adjoint), 0),
        dr.select(active, dr.select(edge.shadow, at_d, -adjoint * edge.over.pi.t), 0),
        mi.Spectrum(0),
    )
    pop(attached, _blank(attached), ring, edge.stack, dr.select(active, edge.over.count, 0), mi.UInt32(0), behind)


def _blank(p: Pass) -> AttachedCameraFrame:
    zeros = mi.Float(0), mi.Point2f(0), mi.Spectrum(0), mi.Float(0)
    return AttachedCameraFrame(SurfacePoint.blank(p.plan), *zeros, [], [], [], [], [])
