"""One scattering event of a light path: a direction sampled from the BSDF, its weight, and derivatives of both kinds of
BSDF factor, s_j (along the path) and c_i (towards the sensor).

Sampling is detached: directions and densities do not depend on the parameters. A factor is then f / pdf, where only

    f = bsdf * cos        a smooth lobe, evaluated for a given direction
    f = weight * pdf      a delta lobe, which has a weight and a discrete probability, and no value
    f = transmission      passing straight through (a mask, a thin sheet)

has a derivative.

Bump and normal maps perturb the shading frame inside of the BSDF, where Veach's correction cannot see it. In scenes
that have them a smooth lobe is evaluated as a path from the camera would, with its two directions exchanged,

    f = bsdf(wo -> wi) * cos_p wi * |n . wo| / |n . wi|        n: geometric normal, p: perturbed one

which is the adjoint BSDF by definition, and needs neither p nor reciprocity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.plan import Plan


def importance_context() -> Any:
    """BSDF queries of a path that carries importance towards the sensor, so that eta^2 is not applied twice."""
    return mi.BSDFContext(mi.TransportMode.Importance)


@dataclass
class Scattering:
    """What happened at a vertex. `weight` is s_j (C,), with Veach's correction; `wo` is local, `d` in world space."""

    weight: Any
    wo: Any
    d: Any
    pdf: Any
    eta: Any
    correction: Any
    is_delta: Any
    is_null: Any
    sample_1: Any
    sample_2: Any
    active: Any


def shading_correction(plan: Plan, si: Any, wi_world: Any, wo_world: Any, wo: Any) -> tuple[Any, Any]:
    """Veach's factor for shading normals (thesis, p. 155) and whether both directions are on consistent sides.

    Without shading normals the factor is 1 and both sides are consistent by construction: neither is computed. With
    perturbed ones, it is |n . wo| / |n . wi|, what is left of it beside the exchanged BSDF.
    """
    if not (plan.needs.has_shading_normals or plan.needs.has_perturbed_normals):
        return mi.Float(1), mi.Bool(True)
    wi_dot_n, wo_dot_n = dr.dot(si.n, wi_world), dr.dot(si.n, wo_world)
    cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
    valid = (wi_dot_n * cos_i > 0) & (wo_dot_n * cos_o > 0)
    if plan.needs.has_perturbed_normals:
        return dr.select(valid, dr.abs(wo_dot_n / wi_dot_n), 0), valid
    return dr.select(valid, dr.abs((cos_i * wo_dot_n) / (cos_o * wi_dot_n)), 0), valid


def scatter(plan: Plan, si: Any, bsdf: Any, ray: Any, sample_1: Any, sample_2: Any, active: Any) -> Scattering:
    """Sample the next direction. Detached; `attached_factor` has the derivative."""
    with dr.suspend_grad():
        bs, weight = bsdf.sample(importance_context(), si, sample_1, sample_2, active)
        d = si.to_world(bs.wo)
        correction, valid = shading_correction(plan, si, -ray.d, d, bs.wo)
        if plan.needs.has_perturbed_normals:
            delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
            singular = delta | mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            correction = dr.select(delta, correction * _delta_correction(si.wi, bs), correction)
            f = evaluate(plan, si, bsdf, bs.wo, active & ~singular)
            weight = dr.select(singular, weight, dr.select(bs.pdf > 0, f / bs.pdf, 0))
        return Scattering(
            weight=weight * correction,
            wo=bs.wo,
            d=d,
            pdf=bs.pdf,
            eta=bs.eta,
            correction=correction,
            is_delta=mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta) if plan.needs.has_delta_lobes else mi.Bool(False),
            is_null=mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null) if plan.needs.has_null else mi.Bool(False),
            sample_1=sample_1,
            sample_2=sample_2,
            active=active & valid & (bs.pdf > 0),
        )


def _delta_correction(wi: Any, bs: Any) -> Any:
    """cos_p wi / cos_p wo of a mirror or refraction, whose normal p is along wi + eta wo."""
    h = dr.fma(bs.eta, bs.wo, wi)
    return dr.abs(dr.dot(h, wi) / dr.dot(h, bs.wo))


def evaluate(plan: Plan, si: Any, bsdf: Any, wo: Any, active: Any) -> Any:
    """A smooth lobe's bsdf * cos (C,) towards `wo`, for a path that carries importance."""
    if not plan.needs.has_perturbed_normals:
        return bsdf.eval(importance_context(), si, wo, active)
    exchanged = type(si)(si)
    exchanged.wi = wo
    return bsdf.eval(mi.BSDFContext(mi.TransportMode.Radiance), exchanged, si.wi, active)


def attached_factor(plan: Plan, si: Any, bsdf: Any, wo: Any, scattering: Scattering | None, active: Any) -> Any:
    """f (C,) with derivatives: towards `wo`, or, where `scattering` chose a delta lobe or passed through, of that.

    Call under `dr.resume_grad()`. What the scene has no lobes for is not compiled.
    """
    if scattering is None or not (plan.needs.has_delta_lobes or plan.needs.has_null):
        return evaluate(plan, si, bsdf, wo, active)
    singular = scattering.is_delta | scattering.is_null
    f = evaluate(plan, si, bsdf, wo, active & ~singular)
    if plan.needs.has_delta_lobes:
        delta = active & scattering.is_delta
        bs, weight = bsdf.sample(importance_context(), si, scattering.sample_1, scattering.sample_2, delta)
        # A mask's weight carries the derivative of its opacity already, and so does its density.
        f = dr.select(delta, weight * (dr.detach(bs.pdf) if plan.needs.has_null else bs.pdf), f)
    if plan.needs.has_null:
        null = active & scattering.is_null
        f = dr.select(null, bsdf.eval_null_transmission(si, null), f)
    return f
