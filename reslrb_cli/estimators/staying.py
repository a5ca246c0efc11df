"""Vertices that stay where they are on their surfaces, instead of going where a turned direction meets them.

Behind a vertex i-1 that is not specular, light goes to all places. `follow` has the sampled direction turn with surface
i-1, so that x_i slides over whatever it meets. `stay` integrates over places instead: x_i moves with its own surface
alone, and the factor of the scattering carries what that changes,

    s_{i-1} = f_{i-1}(x_{i-2}, x_{i-1}, x_i) |cos_i| / |x_i - x_{i-1}|^2 dA_i / (the same density, detached)

with dA_i the area that a piece of surface i takes. All of it but what f_{i-1} changes with x_{i-1} is differentiated at
vertex i, whose adjoint then hands to i-1 a derivative by its place and none by its direction.

Source: Worchel et al. 2025, "Radiative Backpropagation with Non-Static Geometry", whose surface-integral form this
is. Edges at rest are not swept over, so that their part in the derivative is not lost; visibility's part is, in
either form.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.estimators.surface import SurfacePoint
from reslrb_cli.transport.hooks import Vertex
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.scattering import Scattering, evaluate, stays_behind
from reslrb_cli.transport.segment import find_following_vertex, find_vertex


@dataclass
class Before:
    """The vertex before the current one; `stays` is 1 where it is not specular, so that the current one stays."""

    point: SurfacePoint
    stays: mi.UInt32

    @staticmethod
    def start(plan: Plan) -> list[Before]:
        """At the beginning of a path; nothing where no vertex stays."""
        return [Before(SurfacePoint.blank(plan), mi.UInt32(0))] if plan.stays else []

    @staticmethod
    def of(plan: Plan, vertex: Vertex, scattering: Scattering) -> list[Before]:
        """What the vertex is to the next one."""
        if not plan.stays:
            return []
        stays = stays_behind(plan, vertex.bsdf, scattering.is_delta)
        return [Before(SurfacePoint.of(plan, vertex), dr.select(stays, mi.UInt32(1), 0))]

    def members(self) -> list[dr.ArrayBase]:
        """All arrays, in the order of `like`."""
        return [*self.point.numbers, self.stays]

    def like(self, members: list[dr.ArrayBase]) -> Before:
        """One of the same form that has these members."""
        return Before(SurfacePoint(members[:-1]), members[-1])


def is_staying(before: list[Before]) -> mi.Bool:
    """Lanes in which the vertex behind `before` stays where it is."""
    return before[0].stays != 0 if before else mi.Bool(False)


def reach(
    plan: Plan,
    before: list[Before],
    ray: mi.Ray3f,
    pi: mi.PreliminaryIntersection3f,
    active: mi.Bool,
    parameters: bool = True,
) -> tuple[mi.SurfaceInteraction3f, mi.BSDFPtr, mi.Ray3f, mi.Spectrum]:
    """The vertex where `ray` hits what `pi` says, its BSDF, the ray that reaches it, and a factor (C,) of value 1 that
    carries the derivatives of s_{i-1} which belong to it.

    Call under `dr.resume_grad()`, the ray being differentiable; without `parameters`, where it is resumed for the ray
    alone.
    """
    if not before:
        return *find_vertex(ray, pi, active), ray, mi.Spectrum(1)
    stays = active & is_staying(before)
    slid, _ = find_vertex(ray, pi, active & ~stays)
    stayed, reaching, factor = find_following_vertex(ray, pi, stays)
    with dr.suspend_grad():
        other, other_bsdf = before[0].point.interaction(plan, stays)
    # What f changes by its own parameters belongs to the vertex before: where they are resumed, the direction alone
    # is. (A variable that is made under one selective scope counts as suspended under another.)
    with dr.suspend_grad(when=parameters), dr.resume_grad(reaching.d, when=parameters):
        f = evaluate(plan, other, other_bsdf, other.to_local(reaching.d), stays)
    changed = dr.select(stays & (f != 0), dr.replace_grad(mi.Spectrum(1), f / dr.detach(f)), 1) * factor
    si = dr.select(stays, stayed, slid)
    there = mi.Ray3f(ray)
    there.d = dr.select(stays, reaching.d, ray.d)
    return si, si.bsdf(), there, dr.select(stays, changed, 1)
