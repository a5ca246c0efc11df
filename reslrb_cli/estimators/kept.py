"""Stored data of vertices and sampled events, from which the BSDF can be evaluated again."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.walk import Vertex


@dataclass
class SurfacePoint:
    """Vertex data that the BSDF reads, as plain numbers. Pointers are stored as indices.

    If BSDFs read only texture coordinates and directions, the data are `[uv, wi, bsdf]`. If just one BSDF is
    differentiated, `bsdf` is left out. Otherwise the data identify the interaction: `[t, prim_uv, prim_index, shape,
    instance, o, d]`.
    """

    numbers: list[dr.ArrayBase]

    @staticmethod
    def of(plan: Plan, vertex: Vertex) -> SurfacePoint:
        """Return the data of a walk's current vertex."""
        if not plan.keep_geometry:
            pointer = [] if plan.sole_bsdf is not None else [_index(vertex.bsdf)]
            return SurfacePoint([vertex.si.uv, vertex.si.wi, *pointer])
        pi, ray = vertex.pi, vertex.ray
        pointers = [_index(pi.shape), _index(pi.instance)]
        return SurfacePoint([pi.t, pi.prim_uv, pi.prim_index, *pointers, ray.o, ray.d])

    @staticmethod
    def blank(plan: Plan) -> SurfacePoint:
        """Return data of zeros of the same form."""
        if not plan.keep_geometry:
            pointer = [] if plan.sole_bsdf is not None else [mi.UInt32(0)]
            return SurfacePoint([mi.Point2f(0), mi.Vector3f(0), *pointer])
        indices = [mi.UInt32(0), mi.UInt32(0), mi.UInt32(0)]
        return SurfacePoint([mi.Float(0), mi.Point2f(0), *indices, mi.Point3f(0), mi.Vector3f(0)])

    def ray(self) -> mi.Ray3f:
        """Return the ray that reached the vertex. The ray is stored only in scenes whose BSDFs read geometry."""
        return mi.Ray3f(*self.numbers[-2:])

    def hit(self) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
        """Return the intersection and its ray. Both are stored only in scenes whose BSDFs read geometry."""
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = mi.Bool(True)  # not kept: a masked write of booleans to local memory crashes the process
        pi.t, pi.prim_uv, pi.prim_index, shape, instance, o, d = self.numbers
        pi.shape = dr.reinterpret_array(mi.ShapePtr, shape)
        pi.instance = dr.reinterpret_array(mi.ShapePtr, instance)
        return pi, mi.Ray3f(o, d)

    def interaction(self, plan: Plan, active: mi.Bool | bool = True) -> tuple[mi.SurfaceInteraction3f, mi.BSDFPtr]:
        """Return the surface interaction with all data that BSDFs read, and the BSDF."""
        if not plan.keep_geometry:
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.uv, si.wi, *pointer = self.numbers
            si.t = mi.Float(0)  # valid
            return si, dr.reinterpret_array(mi.BSDFPtr, pointer[0]) if pointer else plan.sole_bsdf
        pi, ray = self.hit()
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        return si, si.bsdf()


def event(wo: mi.Vector3f, lobe: list[mi.UInt32 | mi.Float | mi.Point2f]) -> Scattering:
    """Return a sampled event from its stored direction and `lobe`. The event has all data that its factor needs."""
    kind, sample_1, sample_2 = lobe or [mi.UInt32(0), None, None]
    return Scattering(
        weight=None, f=None, wo=wo, d=None, pdf=None, eta=None, correction=None,
        is_delta=kind == 1, is_null=kind == 2, sample_1=sample_1, sample_2=sample_2, active=None,
    )  # fmt: skip


def _index(pointer: mi.BSDFPtr | mi.ShapePtr) -> mi.UInt32:
    return dr.reinterpret_array(mi.UInt32, pointer)


def lobe(plan: Plan, scattering: Scattering | None) -> list[mi.UInt32 | mi.Float | mi.Point2f]:
    """Return the kind of the sampled lobe (1: delta, 2: null) and its random numbers. The result is empty if only
    smooth lobes matter.

    Without an event (None), the function returns zeros of the same form.
    """
    if not (plan.differentiate_delta or plan.differentiate_null):
        return []
    if scattering is None:
        return [mi.UInt32(0), mi.Float(0), mi.Point2f(0)]
    kind = dr.select(scattering.is_delta, mi.UInt32(1), 0) + dr.select(scattering.is_null, mi.UInt32(2), 0)
    return [kind, scattering.sample_1, scattering.sample_2]
