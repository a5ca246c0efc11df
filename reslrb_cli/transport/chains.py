"""Specular chains from the sensor and from lamps, as functions of a place in a plane.

A specular chain begins with a ray of the sensor or of a lamp, at a place u of a plane: the film, or the square of the
random numbers of a lamp's rays. With fixed choices between reflection and refraction, the chain is a function of u. Its
first vertex that is not specular is x. y is a point on a lamp if the chain begins at the sensor, and a point of the
sensor if the chain begins at a lamp. `code` changes along u where the chain meets another surface, or where y becomes
visible from x. `jumps.py` finds these places.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.rays import is_hidden, past_lamps, ray_offset, sensor_rays
from reslrb_cli.transport.bsdf import Hit, Specular, reflect_or_refract
from reslrb_cli.transport.camera import sample_lamp
from reslrb_cli.transport.connection import before_lamps, connect
from reslrb_cli.transport.emission import emission_of
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.sobol import unit

#: Largest number of specular vertices of a chain.
MOST_VERTICES = 8
#: Cells of the square of a lamp's random numbers, along each axis.
LAMP_CELLS = 64
#: Rounds of the hash that makes random numbers. With the usual 4 rounds, numbers of successive vertices have a
#: correlation of 0.09, so that a chain would pass both sides of a pane 4 % too often.
ROUNDS = 8
#: Streams of random numbers, mixed into the key of a chain.
EVENTS, APERTURE, TARGET, PLACE, WAVELENGTH = 0x5E1, 0xA9E, 0x1A4, 0x9C3, 0x7B5

_WITH_NORMALS = mi.RayFlags.All | mi.RayFlags.dNSdUV


def vertex_at(ray: mi.Ray3f, pi: mi.PreliminaryIntersection3f, active: mi.Bool) -> Hit:
    """Return the vertex at an intersection, with the derivatives of its normal."""
    si = pi.compute_surface_interaction(ray, _WITH_NORMALS, active)
    return Hit(si, si.bsdf(), ray)


def surface_code(hit: Hit, valid: mi.Bool) -> mi.UInt32:
    """Return a number for the surface at a vertex, and for its normal if the surface is flat."""
    si = hit.si
    flat = dr.all(si.dn_du == 0) & dr.all(si.dn_dv == 0)
    code = dr.reinterpret_array(mi.UInt32, si.shape) + 1
    for part in si.n:
        code = code * 31 + dr.select(flat, mi.UInt32(mi.Int32(dr.floor(part * 61.7 + 1000.37))), 0)
    return dr.select(valid, code, 0xFFFFFFF)


@dataclass
class Chain:
    """Specular chain. `count` vertices have been passed. `ray` leads to the next vertex, with the intersection `pi`.

    `product` (C,) is the throughput. `code` identifies all surfaces and flat normals that the chain meets, and the
    visibility of the points y.
    """

    ray: mi.Ray3f
    pi: mi.PreliminaryIntersection3f
    product: mi.Spectrum
    count: mi.UInt32
    code: mi.UInt32

    def vertex(self, active: mi.Bool) -> Hit:
        """Return the vertex that the chain reaches."""
        return vertex_at(self.ray, self.pi, active)


@dataclass
class Target:
    """Point y of a lamp or of the sensor. If `distant` is true, y is infinitely far away. `weight` (C,) is the light or
    the importance that arrives from y, divided by its density. `wo` is the local direction to y, and `u` its film
    position if y belongs to the sensor.
    """

    y: mi.Point3f
    distant: mi.Bool
    wo: mi.Vector3f
    weight: mi.Spectrum
    u: mi.Point2f
    active: mi.Bool


@dataclass
class Chains(ABC):
    """Specular chains. `key` is a random seed for each lane. Equal keys make equal choices."""

    samples: Samples
    key: mi.UInt32

    @property
    @abstractmethod
    def cells(self) -> tuple[int, int]:
        """Number of cells of the plane along both axes."""

    @abstractmethod
    def begin(self, u: mi.Point2f) -> tuple[mi.Ray3f, mi.Spectrum]:
        """Return the first ray of the chain from place `u`, and its weight (C,)."""

    @abstractmethod
    def target(self, hit: Hit, count: mi.UInt32, active: mi.Bool) -> Target:
        """Return the point y of a vertex. Visibility is not tested."""

    @property
    @abstractmethod
    def has_targets(self) -> bool:
        """Whether vertices have points y."""

    @property
    @abstractmethod
    def most(self) -> int:
        """Largest number of specular vertices of a chain."""

    @property
    def sees_through_lamps(self) -> bool:
        """Whether the first ray passes through lamps."""
        return False

    @property
    def passes_lamps(self) -> bool:
        """Whether the ways to the points y pass through lamps."""
        return self.samples.plan.passes_lamps

    def random(self, number: mi.UInt32, stream: int) -> mi.Point2f:
        """Return two random numbers of the chain."""
        return mi.Point2f(*(unit(word) for word in mi.sample_tea_32(self.key ^ stream, number, ROUNDS)))

    def start(self, u: mi.Point2f, active: mi.Bool) -> Chain:
        """Return the chain before its first vertex."""
        ray, weight = self.begin(u)
        if self.sees_through_lamps:
            ray = past_lamps(self.samples.scene, ray, active)
        pi = self.samples.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        return Chain(ray, pi, weight, mi.UInt32(0), mi.UInt32(0))

    def event(self, chain: Chain, active: mi.Bool) -> tuple[Hit, Specular]:
        """Return the vertex that the chain reaches, and its event."""
        hit = chain.vertex(active)
        return hit, reflect_or_refract(self.samples.plan, hit, self.random(chain.count, EVENTS).x, active)

    def onward(self, chain: Chain, hit: Hit, event: Specular, passes: mi.Bool) -> Chain:
        """Return the chain behind the `event` at a vertex, in the lanes `passes`."""
        ray = dr.detach(hit.si.spawn_ray(event.d))
        pi = self.samples.scene.ray_intersect_preliminary(ray, coherent=False, active=passes)
        return dr.select(passes, Chain(ray, pi, chain.product * event.s, chain.count + 1, chain.code), chain)

    def lit(self, hit: Hit, count: mi.UInt32, active: mi.Bool) -> tuple[Target, mi.Bool]:
        """Return the point y of a vertex, and the lanes in which a surface hides it.

        A point y in the plane of the vertex does not count. It sends no light there, and rounding would decide whether
        it is visible. This occurs on flat lamps.
        """
        smooth = mi.has_flag(hit.bsdf.flags(), mi.BSDFFlags.Smooth)
        target = self.target(hit, count, active & (count > 0) & smooth & (count + 2 <= self.samples.plan.max_depth))
        height = dr.abs(dr.dot(hit.si.n, target.y - hit.si.p))
        target.active &= dr.any(target.weight > 0) & (height > ray_offset(hit.si.p))
        samples = self.samples
        return target, is_hidden(
            samples.scene, hit.si, target.y, samples.plan.has_edges, target.active, self.passes_lamps
        )

    def follow(self, u: mi.Point2f, active: mi.Bool | bool = True, end: mi.UInt32 | int = MOST_VERTICES) -> Chain:
        """Return the chain from place `u`, up to vertex number `end` or its first vertex that is not specular."""

        def body(active: mi.Bool, chain: Chain) -> tuple[mi.Bool, Chain]:
            valid = chain.pi.is_valid()
            hit, event = self.event(chain, active & valid)
            passes = event.active
            code = chain.code * 0x9E3779B1 + surface_code(hit, valid)
            if self.has_targets:
                target, hidden = self.lit(hit, chain.count, active & valid)
                code += dr.select(target.active & ~hidden, mi.UInt32(77), 0)
            # A chain without specular vertices has the code 0.
            chain = dr.select(active & ((chain.count > 0) | passes), replace(chain, code=code), chain)
            passes = passes & (chain.count < self.most)
            chain = self.onward(chain, hit, event, passes)
            return passes & (chain.count < end), chain

        active = mi.Bool(active) & (mi.UInt32(end) > 0)
        state = active, self.start(u, active)
        return dr.while_loop(state, lambda active, chain: active, body, label="specular chain")[1]


class SensorChains(Chains):
    """Chains from the sensor. The plane is the film, and its cells are pixels."""

    @property
    def sees_through_lamps(self) -> bool:
        return self.samples.plan.sees_through_lamps

    @property
    def cells(self) -> tuple[int, int]:
        return int(self.samples.film.size[0]), int(self.samples.film.size[1])

    def begin(self, u: mi.Point2f) -> tuple[mi.Ray3f, mi.Spectrum]:
        samples = self.samples
        aperture = self.random(mi.UInt32(0), APERTURE) if samples.plan.needs.thin_lens else mi.Point2f(0.5)
        time = samples.time(lambda: mi.Float(0.5))
        wavelength = self.random(mi.UInt32(0), WAVELENGTH).x if mi.is_spectral else 0.5
        return dr.detach(sensor_rays(samples.sensor, time, u / mi.Vector2f(self.cells), aperture, wavelength))

    def target(self, hit: Hit, count: mi.UInt32, active: mi.Bool) -> Target:
        ds, weight = sample_lamp(self.samples, hit.si, self.random(count, TARGET), active)
        distant = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        active = active & (ds.pdf > 0) & dr.isfinite(ds.pdf)
        return Target(ds.p, distant, hit.si.to_local(ds.d), weight, mi.Point2f(0), active)

    @property
    def has_targets(self) -> bool:
        return bool(self.samples.plan.samples_emitters)

    @property
    def most(self) -> int:
        return min(self.samples.plan.max_depth - 1, MOST_VERTICES)


class LampChains(Chains):
    """Chains that begin at lamps.

    The plane is the square of the random numbers of a ray's direction, or of its place if the lamp has only one
    direction.
    """

    @property
    def cells(self) -> tuple[int, int]:
        return LAMP_CELLS, LAMP_CELLS

    def begin(self, u: mi.Point2f) -> tuple[mi.Ray3f, mi.Spectrum]:
        samples, zero = self.samples, mi.UInt32(0)
        there, other = u / LAMP_CELLS, self.random(zero, PLACE)
        choice, time = self.random(zero, APERTURE).x, samples.time(lambda: mi.Float(0.5))
        index, _, _ = samples.choose_emitter(choice, mi.Bool(True))
        emitter = dr.gather(mi.EmitterPtr, samples.scene.emitters_dr(), index)
        # Point lamps and directional lamps use only one of the numbers.
        place = dr.select(mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta), there, other)
        inside = dr.all((there >= 0) & (there < 1))
        emission = emission_of(samples, time, choice, place, there)
        return dr.detach(mi.Ray3f(emission.ray)), dr.select(inside, dr.detach(emission.E), 0)

    def target(self, hit: Hit, count: mi.UInt32, active: mi.Bool) -> Target:
        samples = self.samples
        aperture = self.random(mi.UInt32(1), APERTURE) if samples.plan.needs.thin_lens else mi.Point2f(0.5)
        active = before_lamps(samples.plan, samples.scene, hit.si, active)
        there = connect(samples.plan, samples.sensor, hit.si, hit.ray, aperture, active)
        return Target(there.target, mi.Bool(False), there.wo, there.rest, there.u, active & there.active)

    @property
    def has_targets(self) -> bool:
        return True

    @property
    def most(self) -> int:
        return min(max(self.samples.plan.max_depth - 2, 0), MOST_VERTICES)
