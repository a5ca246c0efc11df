"""Rays on both sides of an outline, and the points that they reach.

Light paths (`edges.py`), camera paths (`camera_edges.py`) and chains (`chain_edges.py`) sample outlines in this way. p
is a point on an outline, seen from a viewpoint y. x is the point behind p on the ray from y.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.attached import near_share
from reslrb_cli.scene.rays import past_lamps, ray_offset
from reslrb_cli.transport.edges import Chances, Outline, sample_outline
from reslrb_cli.transport.samples import Samples

#: Paths of a step per sampled point on an outline, for each of the three terms.
PATHS_PER_OUTLINE = 4
#: Distance between an edge and the rays beside it, in units of Mitsuba's ray offset. A ray that grazes a face hits it
#: far from the edge, so the distance is as small as rounding allows.
BESIDE = 0.1
#: Distance along a ray within which a surface counts as being at the edge, in units of Mitsuba's ray offset.
AROUND = 30.0
#: Distance before an edge at which the ray that hits the shape starts, in the same units. From far away, rounding
#: decides what a ray hits so near to an edge.
NEAR = 300.0
#: Distance from an edge at which a ray to another surface starts, in the same units.
ABOVE = 3.0


def edge_samples(samples: Samples, stream: int, each: int = PATHS_PER_OUTLINE) -> Samples:
    """Return samples of outlines for the paths `samples`, one for `each` paths. Nothing along the paths of the result
    is differentiated.
    """
    plan = replace(
        samples.plan.finding_beams(), attached=False, stays=False, glossy_follows=False, moving_shapes=(), grid=None,
        aims=False, sequence=None, differentiate_bsdfs=False, differentiate_emission=False, track_zeros=False,
        only_bsdfs=(), differentiate_delta=False, differentiate_null=False, evened_lamps=(),
        sampled_spectra=(),
    )  # fmt: skip
    width = max(samples.width // each, 1)
    seed = mi.sample_tea_32(samples.seed, mi.UInt32(stream))[0]
    scale = samples.scale * (dr.opaque(mi.Float, samples.width) / dr.opaque(mi.Float, width))
    return replace(samples, plan=plan, seed=seed, spp=1, width=width, scale=scale, guide=None, net=None)


def for_camera(samples: Samples) -> Samples:
    """Return the samples for camera paths."""
    return replace(samples, plan=replace(samples.plan, camera=True, paths="camera"))


def chances_of(samples: Samples, numbers: mi.PCG32) -> Chances:
    """Return the random numbers of one outline per lane."""
    lane = dr.arange(mi.UInt32, samples.width)
    return Chances.spread(numbers, samples.seed, lane, dr.opaque(mi.UInt32, samples.width))


def halves(samples: Samples, numbers: mi.PCG32) -> tuple[mi.Bool, Chances]:
    """Return the half of the lanes that continue from p, and random numbers that two lanes share. The other lane of a
    pair continues from x.
    """
    lane = dr.arange(mi.UInt32, samples.width)
    count = dr.opaque(mi.UInt32, (samples.width + 1) // 2)
    return lane % 2 == 0, Chances.spread(numbers, samples.seed, lane // 2, count)


@dataclass
class Beside:
    """Two rays from the viewpoint beside an outline. `over` hits the shape, with intersection `pi`. `past` misses the
    edge, and has the intersection `x`. Rays in `active` lanes reach the edge.
    """

    over: mi.Ray3f
    past: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    x: mi.PreliminaryIntersection3f
    active: mi.Bool


def both_sides(
    samples: Samples, outline: Outline, creases: bool = False, everywhere: bool = False
) -> Beside:  # fmt: skip
    """Return the rays on both sides of an outline. Lanes are active if nothing hides the edge from the viewpoint.

    With `creases`, `x` exists only where it is needed: at creases, and for `share_of`. With `everywhere`, it exists in
    all active lanes.
    """
    scene, view, d = samples.scene, outline.view, -outline.view.to_y
    offset = ray_offset(outline.p)
    back = dr.minimum(0.999 * view.distance, view.distance - AROUND * offset) - view.clip
    active = outline.active & (back > 0)
    if view.passes_lamps:
        active &= ~outline.shape.is_emitter()  # nobody sees a hidden lamp

    def shown(ray: mi.Ray3f, active: mi.Bool) -> mi.Ray3f:
        return past_lamps(scene, ray, active) if view.passes_lamps else ray

    def ray(side: float | mi.Float) -> mi.Ray3f:
        return with_wavelengths(mi.Ray3f(outline.p + outline.normal * (side * offset) - d * back, d), outline)

    over, past = ray(-BESIDE), ray(BESIDE)
    # A parallel ray would hit a round side far from p. This ray is tilted towards p, and is as deep in the shape.
    tilt = dr.minimum(dr.sqrt(2 * BESIDE * offset / dr.maximum(outline.radius, 1e-30)), 0.5)
    is_round, start = outline.radius > 0, over(back)
    over.d = dr.select(is_round, dr.normalize(d - outline.normal * tilt), d)
    over.o = dr.select(is_round, outline.p, start) - over.d * dr.minimum(back, NEAR * offset)
    pi = scene.ray_intersect_preliminary(over, coherent=False, active=active)
    active = active & pi.is_valid() & (pi.shape == outline.shape)
    before = mi.Ray3f(past)
    before.maxt = back - AROUND * offset
    active = active & ~scene.ray_test(shown(before, active), active)
    past.o = past.o + d * before.maxt
    everywhere = everywhere or not creases or _shares_edges(samples)
    wanted = active if everywhere else active & outline.crease
    behind = shown(past, wanted)
    x = scene.ray_intersect_preliminary(behind, coherent=False, active=wanted)
    x.t += dr.norm(behind.o - past.o)
    if creases:
        # Behind a crease lies the other face. It may be narrower than the offset if it is seen at a grazing angle.
        active = active & (~outline.crease | (x.is_valid() & (x.shape == outline.shape)))
    return Beside(over, past, pi, x, active)


def with_wavelengths(ray: mi.Ray3f, outline: Outline) -> mi.Ray3f:
    """Return the ray, with the wavelengths of the outline's light."""
    ray.wavelengths = outline.wavelengths
    return ray


def touches_behind(outline: Outline, beside: Beside) -> mi.Bool:
    """True if the shape touches the surface behind it."""
    return beside.x.is_valid() & (beside.x.t < 2 * AROUND * ray_offset(outline.p))


def _shares_edges(samples: Samples) -> bool:
    """Whether two shapes with edges can end at the same place."""
    return len(samples.plan.edged) > 1 or samples.plan.moving_emission


def share_of(samples: Samples, outline: Outline, beside: Beside) -> mi.Float:
    """Return 1/2 where the shape touches another shape that also ends there, otherwise 1."""
    if not _shares_edges(samples):
        return mi.Float(1)
    x, offset = beside.x, ray_offset(outline.p)
    touches = beside.active & touches_behind(outline, beside) & (x.shape != outline.shape)
    n, n_x = (
        mi.Vector3f(hit.compute_surface_interaction(ray, mi.RayFlags.All, touches).n)
        for hit, ray in ((beside.pi, beside.over), (x, beside.past))
    )
    n, n_x = (dr.mulsign(normal, dr.dot(normal, outline.view.to_y)) for normal in (n, n_x))
    # The other shape goes on if it has a point behind the first shape.
    along = n_x * dr.dot(n, n_x) - n
    there = outline.p + along * (8 * offset / dr.norm(along)) + n_x * (2 * offset)
    ray = mi.Ray3f(there, -n_x)
    ray.maxt = 4 * offset
    behind = samples.scene.ray_intersect_preliminary(ray, coherent=False, active=touches)
    return dr.select(touches & ~(behind.is_valid() & (behind.shape == x.shape)), 0.5, 1)


def moved_by(pi: mi.PreliminaryIntersection3f, ray: mi.Ray3f, adjoint: mi.Vector3f, active: mi.Bool) -> mi.Float:
    """Return <p, `adjoint`> with the derivative of the intersection p of `ray`. p moves with its surface."""
    si = pi.compute_surface_interaction(ray, mi.RayFlags.All | mi.RayFlags.FollowShape, active)
    return dr.select(active, dr.dot(si.p, adjoint), 0)


def slid(adjoint: mi.Vector3f, n: mi.Vector3f, towards: mi.Vector3f) -> mi.Vector3f:
    """Return the adjoint of the surface below a point. The point slides along `towards` and has this `adjoint`. `n` is
    the normal of the surface.
    """
    cos = dr.dot(n, towards)
    return n * dr.select(cos != 0, dr.dot(adjoint, towards) / cos, 0)


@dataclass
class Between:
    """An outline on a segment between two surfaces. The ray `back` leads from the outline to y. `y` is the intersection
    there, and `beside.x` the intersection behind the outline, if there is one. p divides the segment from y to x in the
    ratio `s`.
    """

    outline: Outline
    beside: Beside
    back: mi.Ray3f
    y: mi.PreliminaryIntersection3f
    s: mi.Float
    active: mi.Bool

    def side(self, near: float, numbers: mi.PCG32) -> Side:
        """Return a side, chosen at random by the shares of the light that the edge moves there. At an outline, all
        light of x is lost, and light of p has the share with fixed directions. At a crease, the light of both has this
        share.
        """
        beside, crease, distance = self.beside, self.outline.crease, self.outline.view.distance
        share, share_x = (near_share(near**2, dr.square(each)) for each in (distance, distance / self.s))
        both = share + dr.select(beside.x.is_valid(), dr.select(crease, share, 1), 0)
        over = numbers.next_float32() * both < share
        ray = dr.select(over, beside.over, beside.past)
        return Side(over, ray, both, dr.select(over | crease, 0, self.s * (1 - share_x)))


@dataclass
class Side:
    """Side of an edge on which a path goes on: p in the lanes `over`, otherwise x. `ray` leads there, and `weight` is
    the share of the light divided by the probability of the side. x moves the edge with the factor `s`, and y with the
    factor 1 - s.
    """

    over: mi.Bool
    ray: mi.Ray3f
    weight: mi.Float
    s: mi.Float


def sample_between(samples: Samples, numbers: mi.PCG32) -> Between:
    """Return a random outline or crease for each lane, seen from a random direction."""
    assert samples.edges is not None
    outline = sample_outline(samples, samples.edges.anywhere, None, chances_of(samples, numbers), creases=True)
    offset = ray_offset(outline.p)
    # If the shape stands on a surface, the point beside the edge may lie below this surface. The ray starts above it.
    start = outline.p + outline.normal * (BESIDE * offset) + outline.view.to_y * (ABOVE * offset)
    back = with_wavelengths(mi.Ray3f(start, outline.view.to_y), outline)
    y = samples.scene.ray_intersect_preliminary(back, coherent=False, active=outline.active)
    outline.active = outline.active & y.is_valid()
    distance = y.t + ABOVE * offset
    outline.view.distance = distance
    beside = both_sides(samples, outline, creases=True, everywhere=True)
    s = distance / (distance + beside.x.t - AROUND * offset)
    return Between(outline, beside, back, y, s, beside.active)
