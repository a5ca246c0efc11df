"""Points on outlines: places where an edge of a shape starts to block rays from a viewpoint.

`weigh_edges` gives the edges of a table (`scene/edges.py`) their sampling weights. `sample_outline` samples points on
outlines, as a lamp, the sensor, or any direction sees them. A segment belongs to the outline if, seen from the
viewpoint, both of its faces lie on the same side of it. A segment with one face always belongs to the outline.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.edges import SEGMENT, SPHERE, TUBE, EdgeTable, edge_kinds, outline_direction
from reslrb_cli.transport.camera import sample_lamp
from reslrb_cli.transport.connection import connect
from reslrb_cli.transport.lamps import wavelengths_of
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.sobol import evenly, unit

#: Sampling weight of an edge that no probe sees as an outline, relative to an outline of the same length.
UNLIKELY = 0.02
#: Share of random directions that see an edge as a crease, if it can be one.
CREASES = 0.2
#: Number of points on the lamps that probe whether an edge is an outline.
PROBES = 4
#: Stream of random numbers, mixed into the seed.
SPREAD_STREAM = 0x5B4EAD


@dataclass
class EdgeView:
    """EdgeView of a point from a viewpoint `y`: a place on a lamp or on the sensor's aperture.

    `weight` (C,) is the radiance or the importance that arrives at the point, divided by the density of the viewpoint.
    Occlusion is not included. `to_y` is the unit vector to the viewpoint, and `distance` is the distance of the
    viewpoint. If `parallel` is true, the viewpoint is infinitely far away. `surface` is the lamp's normal if the
    viewpoint lies on a surface, otherwise zero. `u` is the film position if the viewpoint is the sensor. `emitter` is
    the lamp if there is one. If `passes_lamps` is true, lamps do not block the view. Nothing blocks it within the
    distance `clip` of the viewpoint.
    """

    y: mi.Point3f
    to_y: mi.Vector3f
    distance: mi.Float
    parallel: mi.Bool
    weight: mi.Spectrum
    surface: mi.Normal3f
    u: mi.Point2f
    active: mi.Bool
    emitter: mi.EmitterPtr
    passes_lamps: bool = False
    clip: mi.Float | float = 0.0


@dataclass
class Outline:
    """Point `p` on a shape's outline, seen from a viewpoint.

    `normal` is perpendicular to the edge and to the ray from the viewpoint, and points away from the shape. `weight`
    (C,) is the light or the importance that the edge covers per unit of its velocity along the normal, divided by the
    density of the sample. Occlusion is not included. In `crease` lanes, the edge is a crease and not an outline, and
    `normal` points away from its first face. `radius` is the radius of the sphere or the cylinder whose round side has
    the outline, otherwise 0.
    """

    p: mi.Point3f
    normal: mi.Vector3f
    view: EdgeView
    weight: mi.Spectrum
    shape: mi.ShapePtr
    active: mi.Bool
    crease: mi.Bool
    radius: mi.Float
    wavelengths: mi.Wavelength


Viewer = Callable[[Any, Any], EdgeView]  # (point, active lanes) -> view


def view_from_lamps(samples: Samples, numbers: mi.Point2f, wavelengths: mi.Wavelength | None = None) -> Viewer:
    """Return the view from lamps. The random `numbers` select the lamp and the place on the lamp. If no `wavelengths`
    are given, they are spread over visible light.
    """
    if wavelengths is None:
        wavelengths, _ = wavelengths_of(mi.Float(0.5))

    def view(p: mi.Point3f, active: mi.Bool) -> EdgeView:
        here = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        here.p, here.wavelengths = p, wavelengths
        ds, weight = sample_lamp(samples, here, numbers, active)
        flags = ds.emitter.flags()
        parallel = mi.has_flag(flags, mi.EmitterFlags.Infinite) | mi.has_flag(flags, mi.EmitterFlags.DeltaDirection)
        surface = dr.select(ds.delta | parallel, mi.Normal3f(0), ds.n)
        seen = active & (ds.pdf > 0) & dr.isfinite(ds.pdf) & dr.any(weight > 0)
        return EdgeView(ds.p, ds.d, ds.dist, parallel, weight, surface, mi.Point2f(0), seen, ds.emitter)

    return view


def view_from_sensor(samples: Samples, aperture: mi.Point2f) -> Viewer:
    """Return the view from the sensor, through the point `aperture` of its aperture."""

    def view(p: mi.Point3f, active: mi.Bool) -> EdgeView:
        here = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        here.p = p
        seen = connect(samples.plan, samples.sensor, here, None, aperture, active)
        ds, _ = samples.sensor.sample_direction(here, aperture, active)
        return EdgeView(
            ds.p, ds.d, ds.dist, parallel=mi.Bool(False), weight=seen.rest, surface=mi.Normal3f(0), u=seen.u,
            active=active & seen.active, emitter=dr.zeros(mi.EmitterPtr),
            passes_lamps=samples.plan.sees_through_lamps,
            clip=dr.norm(seen.target - ds.p) if samples.plan.needs.near_clip else 0.0,
        )  # fmt: skip

    return view


@dataclass
class Chances:
    """Random numbers of an outline: the edge, the place on it, and the viewpoint. They are spread evenly over lanes."""

    edge: mi.Float
    place: mi.Float
    viewpoint: mi.Point2f
    #: Wavelengths of the light, and the inverse of their density (C,).
    wavelengths: mi.Wavelength
    inverse: mi.Spectrum

    @staticmethod
    def spread(numbers: mi.PCG32, seed: mi.UInt32, index: mi.UInt32, count: mi.UInt32) -> Chances:
        """Return the numbers of points with an `index` below `count`. `count` is opaque.

        The numbers of the edge are in ascending order, and the others those of `evenly`.
        """
        edge = (mi.Float(index) + numbers.next_float32()) / mi.Float(count)
        place, x, y = evenly(seed, SPREAD_STREAM, index)
        offset = mi.sample_tea_32(seed, mi.UInt32(SPREAD_STREAM + 1))[1]
        return Chances(edge, place, mi.Point2f(x, y), *wavelengths_of(unit(index * 2654435769 + offset)))


def pick(weights: mi.Float, number: mi.Float) -> tuple[mi.UInt32, mi.Float]:
    """Return the entry of cumulative `weights` that a random `number` selects, and its probability."""
    last = dr.width(weights) - 1
    number, total = dr.minimum(number, dr.one_minus_epsilon(mi.Float)), dr.gather(mi.Float, weights, last)
    entry = mi.UInt32(dr.binary_search(0, last, lambda i: dr.gather(mi.Float, weights, i) <= number * total))
    below = dr.select(entry > 0, dr.gather(mi.Float, weights, dr.maximum(entry, 1) - 1), 0)
    return entry, (dr.gather(mi.Float, weights, entry) - below) / total


def sample_outline(
    samples: Samples, weights: mi.Float, view: Viewer | None, chances: Chances, creases: bool = False
) -> Outline:  # fmt: skip
    """Return a random point on an outline for each lane. `weights` are cumulative sampling weights of the edges.

    If `view` is None, each outline is seen from a random direction. If `creases` is true, points may also lie on
    creases, where `normal` points away from the first face of the edge. Code for spheres and cylinders is compiled only
    if there are any.
    """
    table, only_hide = samples.edges, _occluders_only_hide(samples)
    first = creases and view is not None  # rays that start a path
    kinds = edge_kinds(samples.plan.edged + (() if first and only_hide else samples.plan.occluders))
    assert table is not None
    (row, probability), place = pick(weights, chances.edge), chances.place
    kind = dr.gather(mi.UInt32, table.kind, row)
    a, b = dr.gather(mi.Point3f, table.a, row), dr.gather(mi.Point3f, table.b, row)
    along = b - a
    length = dr.norm(along)
    along = along / dr.maximum(length, 1e-30)

    # ---- Choose a point on the edge. On a segment, it does not depend on the viewpoint ----
    p, density, active = a + (b - a) * place, dr.rcp(length), probability > 0
    is_round, is_crease = mi.Bool(False), mi.Bool(False)
    if SPHERE in kinds or TUBE in kinds:
        is_round = kind != SEGMENT
        p = dr.select(kind == SPHERE, a, dr.select(kind == TUBE, dr.lerp(a, b, 0.5), p))
    if view is None:
        view = _view_from_anywhere(table, kinds, row, kind, along, p, chances, creases)
        if only_hide:
            view = _towards_balls(table, row, view, chances)
    elif only_hide and samples.plan.needs.environment is not None:
        view = _past_balls(samples, table, row, view, chances)
    seen = view(p, active)
    normal, radius = mi.Vector3f(0), mi.Float(0)
    if SPHERE in kinds or TUBE in kinds:
        radius, y = dr.gather(mi.Float, table.radius, row), seen.y
        if SPHERE in kinds:
            cos = dr.select(seen.parallel, 0, radius / seen.distance)
            sin, frame = dr.safe_sqrt(1 - dr.square(cos)), mi.Frame3f(seen.to_y)
            s, c = dr.sincos(dr.two_pi * place)
            out = cos * seen.to_y + sin * (c * frame.s + s * frame.t)
            here = kind == SPHERE
            normal, p = dr.select(here, out, normal), dr.select(here, a + radius * out, p)
            density = dr.select(here, dr.rcp(dr.two_pi * radius * sin), density)
            active &= ~here | (sin > 0) & (cos < 1)
        if TUBE in kinds:
            to_y = dr.select(seen.parallel, seen.to_y, y - a)
            across = to_y - along * dr.dot(along, to_y)
            distance = dr.norm(across)
            first = across / distance
            cos = dr.select(seen.parallel, 0, radius / distance)
            sin = dr.safe_sqrt(1 - dr.square(cos)) * dr.select(place < 0.5, 1, -1)
            out = cos * first + sin * dr.cross(along, first)
            here = kind == TUBE
            axis = a + (b - a) * (2 * place - dr.floor(2 * place))
            normal, p = dr.select(here, out, normal), dr.select(here, axis + radius * out, p)
            density = dr.select(here, dr.rcp(2 * length), density)
            active &= ~here | (distance > 0) & (cos < 1)
        seen = _from(seen, p, view(p, active & is_round), is_round)

    # ---- Test whether the edge is an outline, and on which side of it the shape lies ----
    d = -seen.to_y
    raw = dr.cross(along, d)
    sine = dr.norm(raw)
    if SEGMENT in kinds:
        c, other = dr.gather(mi.Point3f, table.c, row), dr.gather(mi.Point3f, table.d, row)
        side, across_it = dr.dot(raw, c - p), dr.dot(raw, other - p)
        outlines = is_round | (side * across_it > 0)
        if creases:
            is_crease = ~outlines & (dr.gather(mi.Float, table.crease, row) > 0)
        active &= outlines | is_crease
        normal = dr.select(is_round, normal, -dr.mulsign(raw, side) / dr.maximum(sine, 1e-30))
    if SPHERE in kinds:
        sine = dr.select(kind == SPHERE, 1, sine)
    active &= seen.active & (sine > 1e-6)
    weight = seen.weight * dr.select(active, sine / (density * probability), 0)
    if mi.is_spectral:
        weight *= chances.inverse
    shape = dr.reinterpret_array(mi.ShapePtr, dr.gather(mi.UInt32, table.shape, row, active))
    return Outline(p, normal, seen, weight, shape, active, is_crease, radius, chances.wavelengths)


def _from(first: EdgeView, p: mi.Point3f, again: EdgeView, moved: mi.Bool) -> EdgeView:
    """Return the view of `p` from the viewpoint of `first`, in the lanes `moved`. `again` is the view of `p` with the
    same random numbers. The first view of parallel light needs no light.

    The same random numbers may select another place on a lamp for another point `p`. If the lamp has a surface, the
    place of `first` is used, and the weight is multiplied by the ratio of the solid angles of this place.
    """
    on_surface = dr.any(first.surface != 0)
    there = first.y - p
    distance = dr.norm(there)
    to_y = there / distance
    before = -dr.dot(first.surface, first.to_y) / dr.square(first.distance)
    solid = dr.maximum(-dr.dot(first.surface, to_y), 0) / dr.square(distance) / before
    keeps = moved & on_surface
    return EdgeView(
        y=dr.select(moved & ~on_surface, again.y, first.y),
        to_y=dr.select(keeps, to_y, dr.select(moved, again.to_y, first.to_y)),
        distance=dr.select(keeps, distance, dr.select(moved, again.distance, first.distance)),
        parallel=first.parallel,
        weight=dr.select(keeps, first.weight * solid, dr.select(moved, again.weight, first.weight)),
        surface=first.surface,
        u=dr.select(moved, again.u, first.u),
        active=dr.select(moved & first.parallel, again.active, first.active & (~moved | on_surface | again.active)),
        emitter=dr.select(moved & ~on_surface, again.emitter, first.emitter),
        passes_lamps=first.passes_lamps,
        clip=first.clip,
    )


# ---- Sampling weights ----


def weigh_edges(samples: Samples, table: EdgeTable) -> EdgeTable:
    """Return the edges with cumulative sampling weights for the lamps and the sensor of `samples`.

    A weight is the length of the edge, times a factor. The factor favours edges that probes see as outlines. For all
    directions, it is the solid angle of the directions that see the edge as an outline. The rays that start a path keep
    their directions, so creases count for lamps, or for the sensor if the paths are camera paths. If no lamp moves, the
    edge of a shape that does not move must have a moving shape behind it, and has no weight for the rays that start a
    path.
    """
    camera = samples.plan.camera
    samples = replace(samples, plan=samples.plan.finding_beams())
    with dr.suspend_grad():
        lamp, sensor = _seen_from_lamps(samples, table, not camera), _seen_from_sensor(samples, table, camera)
        anywhere = table.anywhere
        if _occluders_only_hide(samples):
            middle = dr.lerp(table.a, table.b, dr.select(table.kind == SPHERE, 0, 0.5))
            towards = sum(4 * dr.pi * (1 - ball.cosine(middle)) for ball in table.balls)
            anywhere = dr.select(table.moves, anywhere, table.lamp * dr.minimum(towards, 4 * dr.pi))
            if camera:
                hides = dr.zeros(mi.Bool, dr.width(table.moves))
                for numbers in _probes():
                    hides |= _hides_ball(samples, table, middle, view_from_lamps(samples, numbers))
                lamp *= dr.select(table.moves | hides, 1, dr.maximum(UNLIKELY, towards / (4 * dr.pi)))
                sensor = dr.select(table.moves, sensor, 0)
            else:
                hides = _hides_ball(samples, table, middle, view_from_sensor(samples, mi.Point2f(0.5)))
                lamp = dr.select(table.moves, lamp, 0)
                sensor *= dr.select(table.moves | hides, 1, 0)
        table = replace(
            table,
            lamp=dr.cumsum(table.lamp * lamp),
            sensor=dr.cumsum(table.sensor * sensor),
            anywhere=dr.cumsum(anywhere),
        )
        dr.make_opaque(table)
        return table


def _occluders_only_hide(samples: Samples) -> bool:
    """Whether shapes at rest matter only because they hide moving shapes. If a lamp moves, their shadows move."""
    return bool(samples.plan.occluders) and not samples.plan.moving_emission


def _hides_ball(samples: Samples, table: EdgeTable, middle: mi.Point3f, viewer: Viewer) -> mi.Bool:
    """True if there may be a ball behind the edge. Edges as long as half of their distance are never left out."""
    view = viewer(middle, mi.Bool(True))
    d, reach = -view.to_y, 0.5 * dr.norm(table.b - table.a) + table.radius
    found = mi.Bool(samples.plan.needs.thin_lens) | (reach > 0.5 * view.distance)
    for ball in table.balls:
        behind = dr.dot(ball.center - middle, d)
        beside = dr.norm(ball.center - middle - d * behind)
        spread = 1 + 2 * dr.maximum(behind + ball.radius, 0) / view.distance
        found |= (behind > -ball.radius - reach) & (beside < ball.radius + reach * spread)
    return found


def _view_from_anywhere(
    table: EdgeTable, kinds: frozenset[int], row: mi.UInt32, kind: mi.UInt32, along: mi.Vector3f, p: mi.Point3f,
    chances: Chances, creases: bool,
) -> Viewer:  # fmt: skip
    """Return the view of an edge from a random direction, uniform in solid angle. For a segment, the directions are
    limited to those that see the segment as an outline, and with `creases` to those that see it as a crease.
    """
    to_y, density = mi.warp.square_to_uniform_sphere(chances.viewpoint), mi.Float(dr.inv_four_pi)
    if SEGMENT in kinds:
        c, d = dr.gather(mi.Point3f, table.c, row) - p, dr.gather(mi.Point3f, table.d, row) - p
        own_to_y, own_density = outline_direction(
            along, c, d, chances.viewpoint,
            dr.select(dr.gather(mi.Float, table.crease, row) > 0, mi.Float(CREASES), 0) if creases else mi.Float(0),
        )  # fmt: skip
        here = kind == SEGMENT
        to_y, density = dr.select(here, own_to_y, to_y), dr.select(here, own_density, density)

    def view(p: mi.Point3f, active: mi.Bool) -> EdgeView:
        seen = active & dr.isfinite(density)
        weight = mi.Spectrum(dr.select(seen, dr.rcp(density), 0))
        return EdgeView(
            p, to_y, mi.Float(1), parallel=mi.Bool(True), weight=weight, surface=mi.Normal3f(0), u=mi.Point2f(0),
            active=seen, emitter=dr.zeros(mi.EmitterPtr),
        )  # fmt: skip

    return view


def _towards_balls(table: EdgeTable, row: mi.UInt32, other: Viewer, chances: Chances) -> Viewer:
    """Return a view of the edges of shapes that do not move: from a random direction in which, or opposite to which,
    there is a moving shape. Edges of moving shapes have the `other` view.
    """
    balls, moves = table.balls, dr.gather(mi.Bool, table.moves, row)
    number = chances.viewpoint.x * len(balls)
    place = mi.Point2f(number - dr.floor(number), 2 * chances.viewpoint.y)
    place.y, backward = dr.select(place.y < 1, place.y, place.y - 1), place.y >= 1

    def view(p: mi.Point3f, active: mi.Bool) -> EdgeView:
        cones = [(dr.normalize(ball.center - p), ball.cosine(p)) for ball in balls]
        to_y = mi.Vector3f(0)
        for index, (axis, cos) in enumerate(cones):
            drawn = mi.Frame3f(axis).to_world(mi.warp.square_to_uniform_cone(place, cos))
            to_y = dr.select(mi.UInt32(number) == index, drawn, to_y)
        to_y = dr.select(backward, -to_y, to_y)
        density = mi.Float(0)
        for axis, cos in cones:
            inside = dr.select(dr.dot(axis, to_y) >= cos, 1, 0) + dr.select(-dr.dot(axis, to_y) >= cos, 1, 0)
            density += inside / (2 * dr.two_pi * (1 - cos) * len(balls))
        first = other(p, active)
        weight = dr.select(moves, first.weight, mi.Spectrum(dr.select(density > 0, dr.rcp(density), 0)))
        return replace(
            first, to_y=dr.select(moves, first.to_y, to_y), weight=weight, active=active & (first.active | ~moves)
        )

    return view


def _past_balls(samples: Samples, table: EdgeTable, row: mi.UInt32, other: Viewer, chances: Chances) -> Viewer:
    """Return the `other` view. If it is that of the sky from a segment of a shape that does not move, its direction is
    replaced by one whose opposite leads to a moving shape.
    """
    moves = dr.gather(mi.Bool, table.moves, row) | (dr.gather(mi.UInt32, table.kind, row) != SEGMENT)

    def view(p: mi.Point3f, active: mi.Bool) -> EdgeView:
        first, scene = other(p, active), samples.scene
        _, chosen, number = samples.choose_emitter(chances.viewpoint.x, active)
        number = number * len(table.balls)
        place = mi.Point2f(number - dr.floor(number), chances.viewpoint.y)
        away, density = mi.Vector3f(0), mi.Float(0)
        cones = [(ball.frame(p), ball.cosine(p)) for ball in table.balls]
        for index, (frame, cos) in enumerate(cones):
            drawn = frame.to_world(mi.warp.square_to_uniform_cone(place, cos))
            away = dr.select(mi.UInt32(number) == index, drawn, away)
        for frame, cos in cones:
            density += dr.select(dr.dot(frame.n, away) >= cos, dr.rcp(dr.two_pi * (1 - cos) * len(cones)), 0)
        sky = dr.zeros(mi.SurfaceInteraction3f, dr.width(p))
        sky.wi, sky.wavelengths = away, chances.wavelengths
        environment = scene.environment()
        here = active & ~moves & (first.emitter == mi.EmitterPtr(environment)) & (density > 0)
        weight = environment.eval(sky, here) * (chosen / density)
        return replace(
            first, to_y=dr.select(here, -away, first.to_y), weight=dr.select(here, weight, first.weight),
            active=first.active | here,
        )  # fmt: skip

    return view


def _probes() -> list[mi.Point2f]:
    """Return the random numbers of the points on lamps that probe edges."""
    return [mi.Point2f((number + 0.5) / PROBES, (0.5 + 0.618034 * number) % 1) for number in range(PROBES)]


def _seen_from_lamps(samples: Samples, table: EdgeTable, creases: bool) -> mi.Float:
    found = mi.Bool(False)
    for numbers in _probes():
        view = view_from_lamps(samples, numbers)(dr.lerp(table.a, table.b, 0.5), mi.Bool(True))
        found |= is_outline(table, view) & (view.active | view.parallel)
    return _likely(table, found, creases)


def _seen_from_sensor(samples: Samples, table: EdgeTable, creases: bool) -> mi.Float:
    view = view_from_sensor(samples, mi.Point2f(0.5))(dr.lerp(table.a, table.b, 0.5), mi.Bool(True))
    return _likely(table, is_outline(table, view), creases)


def _likely(table: EdgeTable, found: mi.Bool, creases: bool) -> mi.Float:
    """Return the factor of a weight. `found` edges are outlines, and creases count if `creases` is true."""
    other = dr.maximum(table.crease, UNLIKELY) if creases else mi.Float(UNLIKELY)
    return dr.select(found | (table.kind != SEGMENT), 1.0, other)


def is_outline(table: EdgeTable, view: EdgeView) -> mi.Bool:
    """True if the middle of an edge lies on the outline in the `view` of this point."""
    raw = dr.cross(table.b - table.a, view.to_y)
    return dr.dot(raw, table.c - table.a) * dr.dot(raw, table.d - table.a) > 0
