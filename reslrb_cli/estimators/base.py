"""Interface of all estimators, and two parts that they share.

One part turns the adjoint of a path contribution into derivatives at a vertex. The other part stores the data of a
vertex or a sampled event from which its BSDF can be evaluated again.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.bsdf import Scattering
from reslrb_cli.transport.camera import CameraHooks
from reslrb_cli.transport.connection import Connection, stand_in
from reslrb_cli.transport.emission import Emission, sample_emission
from reslrb_cli.transport.factors import MAY_LACK, NO_ZERO, Product, showing
from reslrb_cli.transport.film import AdjointImage, Colours
from reslrb_cli.transport.masks import transmittance
from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.samples import Samples
from reslrb_cli.transport.walk import Hooks, Vertex, walk

STACK_SIZE = 64  # vertices


@dataclass
class Pass:
    """One set of samples for an estimator.

    `block` is the image to splat into, or None. `adjoint` is dL/dI, or None while it is not known.
    """

    samples: Samples
    block: mi.ImageBlock | None
    adjoint: AdjointImage | None
    #: Wavelengths of the paths; None before the first walk.
    colours: Colours | None = None

    def along(self, hooks: Hooks | CameraHooks) -> Pass:
        """Return this pass with the wavelengths of the paths that `hooks` have followed."""
        return replace(self, colours=hooks.colours)

    def with_colours(self) -> Pass:
        """Return this pass with the wavelengths of its light paths, which are sampled again."""
        wavelengths = self.emission().ray.wavelengths if mi.is_spectral else mi.Color0f()
        return replace(self, colours=self.samples.film.colours(wavelengths))

    @property
    def wavelengths(self) -> mi.Wavelength:
        """Wavelengths of the paths."""
        assert self.colours is not None
        return self.colours.wavelengths

    @property
    def plan(self) -> Plan:
        """Plan of the walk."""
        return self.samples.plan

    @property
    def scale(self) -> mi.Float:
        """Factor that normalises a sum over paths to an image."""
        return self.samples.scale

    def walk(self, hooks: Hooks, active: mi.Bool | bool = True) -> Any:
        """Trace the paths and return the hooks' final state. Every call traces the same paths."""
        return walk(self.samples, hooks, active)

    def emission(self) -> Emission:
        """Return the rays that leave the emitters, and E (C,) of each path, with derivatives."""
        return sample_emission(self.samples, self.samples.sampler())

    def delta(self, u: mi.Point2f, active: mi.Bool, colours: Colours) -> mi.Spectrum:
        """Return the adjoint (C,) at film position `u`. dL/dI must be known."""
        assert self.adjoint is not None
        return self.adjoint.lookup(u, active, colours)

    def splat(self, u: mi.Point2f, value: mi.Spectrum, active: mi.Bool, colours: Colours) -> None:
        """Add `value` (C,) to the image if there is one."""
        if self.block is not None:
            self.samples.film.put(self.block, u, value, active, colours)


class Estimator(ABC):
    """Estimator of the gradient of a path's contributions without storing the path.

    `forward` splats the image and returns the stored data of each path. `backward` adds the derivatives once dL/dI is
    known. If dL/dI is known before paths are traced (`Pass.adjoint` in `forward`), an estimator may already use dL/dI
    in `forward`.

    OPTIONS maps the names of the plugin's options to their defaults. The constructor takes these options, and raises
    ValueError for a wrong value.
    """

    OPTIONS: ClassVar[dict[str, Any]] = {}
    exact: ClassVar[bool] = False  # every connection of a path counts, as in naive AD of the same paths
    stack_size: int = STACK_SIZE  # the capacity of vertex stacks, if there are any
    attached: Estimator | None = None  # the estimator of the same name for moving light; None if there is none

    def of(self, plan: Plan) -> Estimator:
        """Return this estimator, or `attached` if the plan needs attached derivatives."""
        return self.attached if plan.attached and self.attached is not None else self

    @abstractmethod
    def forward(self, p: Pass) -> Any:
        """Splat the image and return the state to store. The state is a PyTree of arrays with one entry per path. Does
        not evaluate the state.
        """

    @abstractmethod
    def backward(self, p: Pass, state: Any) -> None:
        """Add the derivatives to the parameters' gradients. `p.adjoint` is known, and `p.block` is not used."""

    @abstractmethod
    def kept(self, plan: Plan) -> Any:
        """Return a PyTree with the types of all data that are stored for a path at the same time."""


def differentiate_emission(p: Pass, adjoint: Callable[[mi.Spectrum], mi.Spectrum]) -> None:
    """Add the derivative of E (C,), multiplied by `adjoint(E)`, if the plan differentiates emission."""
    if p.plan.differentiate_emission:
        with dr.resume_grad(), dr.isolate_grad():
            E = p.emission().E
            dr.backward_from(dr.dot(adjoint(dr.detach(E)), E), flags=MAY_LACK)


@dataclass
class PathAdjoint:
    """Sensitivity of the objective to one connection of a path.

    `value` (C,) is delta times the product of the nonzero factors, including the estimator's weight. It is 0 in lanes
    without a connection. `product` identifies the zero factor, if there is one.
    """

    value: mi.Spectrum
    product: Product


def adjoint_of_factor(
    adjoint: PathAdjoint, index: mi.UInt32 | mi.Int32, f: mi.Spectrum, rest: mi.Spectrum | float
) -> mi.Spectrum:
    """Return the detached derivative (C,) of the objective with respect to the factor `f * rest` at position `index` of
    the path.

    If no factor is zero, the derivative is adjoint / f. If only this factor is zero, the derivative is adjoint * rest.
    Otherwise it is 0.
    """
    f, value, zeros = dr.detach(f), adjoint.value, adjoint.product.zero
    if not zeros:
        return mi.Spectrum(dr.select(f == 0, 0, showing(value / f)))  # passes NaN on
    result, rest = mi.Spectrum(0), mi.Spectrum(rest)
    for c, zero in enumerate(zeros):
        at_zero = dr.select(zero == mi.Int32(index), value[c] * rest[c], 0)
        result[c] = dr.select((zero == NO_ZERO) & ~(f[c] == 0), value[c] / f[c], at_zero)
    return showing(result)


def differentiate_passage(
    p: Pass, si: mi.SurfaceInteraction3f, depth: mi.UInt32, connection: Connection, active: mi.Bool,
    adjoint: PathAdjoint,
) -> mi.Spectrum:  # fmt: skip
    """Return the transmittance (C,) of the masks between a vertex and the sensor, and add its derivative.

    The transmission of a mask is never zero here (`transmission_of`), so a mask is never the zero factor of a product.
    The transmittance value is needed only if another factor of the contribution is zero. If neither value nor
    derivative is needed, nothing is traced.
    """
    if not p.plan.passage_in_gradient:
        return mi.Spectrum(1)

    def differentiate(transmission: mi.Spectrum, hit: mi.Bool) -> None:
        weight = adjoint_of_factor(adjoint, mi.Int32(NO_ZERO), dr.detach(transmission), 0)
        objective = dr.select(hit, weight * transmission, 0)
        # The scene may have masks without differentiated parameters.
        dr.backward_from(objective, flags=MAY_LACK)

    with dr.resume_grad(when=p.plan.differentiate_null):
        on_crossing = differentiate if p.plan.differentiate_null else None
        target = connection.target
        return transmittance(p.plan, p.samples.scene, si, depth, target, active, on_crossing).value


def contribution(p: Pass, vertex: Vertex, connection: Connection) -> Product:
    """Return C_i of an evaluated connection."""
    return vertex.product.times(connection.c, vertex.depth, stand_in(connection)[1]).scaled(p.scale)


class VertexHooks(Hooks):
    """Hooks of one pass of an estimator."""

    def __init__(self, p: Pass) -> None:
        self.p = p

    def concerned(self, state: Any) -> mi.Bool:
        """Return the lanes with a differentiated vertex before the current one. Returns all lanes if emission is
        differentiated.
        """
        return mi.Bool(True)

    def wants(self, state: Any, vertex: Vertex) -> mi.Bool:
        """Return all lanes if there is an image. Otherwise return the connections that depend on a differentiated
        parameter.
        """
        plan = self.p.plan
        if self.p.block is not None or plan.differentiate_emission:
            return mi.Bool(True)
        return self.concerned(state) | plan.concerns(vertex.bsdf)


def vertices(plan: Plan) -> int:
    """Return the maximum number of vertices of a path."""
    return max(plan.max_depth - 1, 0)


# ---- Stored data of a vertex ----


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

    def hit(self, wavelengths: mi.Wavelength) -> tuple[mi.PreliminaryIntersection3f, mi.Ray3f]:
        """Return the intersection and its ray. Both are stored only in scenes whose BSDFs read geometry."""
        pi = dr.zeros(mi.PreliminaryIntersection3f)
        pi.valid = mi.Bool(True)  # not kept: a masked write of booleans to local memory crashes the process
        pi.t, pi.prim_uv, pi.prim_index, shape, instance, o, d = self.numbers
        pi.shape = dr.reinterpret_array(mi.ShapePtr, shape)
        pi.instance = dr.reinterpret_array(mi.ShapePtr, instance)
        ray = mi.Ray3f(o, d)
        ray.wavelengths = wavelengths
        return pi, ray

    def interaction(
        self, plan: Plan, wavelengths: mi.Wavelength, active: mi.Bool | bool = True
    ) -> tuple[mi.SurfaceInteraction3f, mi.BSDFPtr]:
        """Return the surface interaction with all data that BSDFs read, and the BSDF."""
        if not plan.keep_geometry:
            si = dr.zeros(mi.SurfaceInteraction3f)
            si.uv, si.wi, *pointer = self.numbers
            si.t = mi.Float(0)  # valid
            si.wavelengths = wavelengths
            return si, dr.reinterpret_array(mi.BSDFPtr, pointer[0]) if pointer else plan.sole_bsdf
        pi, ray = self.hit(wavelengths)
        si = pi.compute_surface_interaction(ray, mi.RayFlags.All, active)
        return si, si.bsdf()


def event(wo: mi.Vector3f, lobe: list[mi.UInt32 | mi.Float | mi.Point2f]) -> Scattering:
    """Return a sampled event from its stored direction and `lobe`. The event has all data that its factor needs."""
    kind, sample_1, sample_2 = lobe or [mi.UInt32(0), None, None]
    return Scattering(
        s=None, f=None, wo=wo, d=None, pdf=None, eta=None, correction=None,
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


# ---- Options ----


def one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise ValueError if an option's value is not one of the allowed values."""
    if value not in allowed:
        raise ValueError(f'"{name}" must be one of {", ".join(allowed)}, not "{value}"')


def at_least_one(name: str, value: int, most: int | None = None) -> None:
    """Raise ValueError if an option that counts something is less than 1, or more than `most`."""
    if value < 1:
        raise ValueError(f'"{name}" must be at least 1, not {value}')
    if most is not None and value > most:
        raise ValueError(f'"{name}" must be at most {most}, not {value}')
