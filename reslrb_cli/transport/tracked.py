"""Derivatives of both kinds of BSDF factor of a light path, s_j (along the path) and c_i (towards the sensor).

Sampling is detached: directions and densities do not depend on the parameters. A factor is then f / pdf, where only

    f = bsdf * cos        a smooth lobe, evaluated for a given direction
    f = weight * pdf      a delta lobe, which has a weight and a discrete probability, and no value
    f = transmission      passing straight through (a mask, a thin sheet)

has a derivative.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from reslrb_cli.transport.plan import Plan
from reslrb_cli.transport.scattering import Scattering, evaluate, importance_context


def tracked_factor(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, scattering: Scattering, active: mi.Bool
) -> mi.Spectrum:
    """f (C,) with derivatives, of the event that `scattering` is.

    Call under `dr.resume_grad()`. What the scene has no lobes for is not compiled.
    """
    f = evaluate(plan, si, bsdf, scattering.wo, active & ~(scattering.is_delta | scattering.is_null))
    return _singular_factor(plan, si, bsdf, scattering, active, f)


def tracked_factors(
    plan: Plan,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    connection_wo: mi.Vector3f,
    connected: mi.Bool,
    scattering: Scattering,
    scattered: mi.Bool,
) -> tuple[mi.Spectrum, mi.Spectrum]:
    """f (C,) towards the sensor and f along the path, both with derivatives, from one indirect call.

    Call under `dr.resume_grad()`.
    """

    def both(
        self: mi.BSDF,
        si: mi.SurfaceInteraction3f,
        wo_c: mi.Vector3f,
        wo_s: mi.Vector3f,
        connected: mi.Bool,
        smooth: mi.Bool,
        any_: mi.Bool,
    ) -> tuple[mi.Spectrum, mi.Spectrum]:
        return evaluate(plan, si, self, wo_c, connected), evaluate(plan, si, self, wo_s, smooth)

    smooth = scattered & ~(scattering.is_delta | scattering.is_null)
    f_c, f_s = dr.dispatch(bsdf, both, si, connection_wo, scattering.wo, connected, smooth, connected | scattered)
    return f_c, _singular_factor(plan, si, bsdf, scattering, scattered, f_s)


def _singular_factor(
    plan: Plan,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    scattering: Scattering,
    active: mi.Bool,
    f: mi.Spectrum,
) -> mi.Spectrum:
    """`f`, replaced where a delta lobe was sampled or light passed straight through, where that has derivatives."""
    if plan.differentiate_delta:
        delta = active & scattering.is_delta
        bs, weight = bsdf.sample(importance_context(), si, scattering.sample_1, scattering.sample_2, delta)
        pdf = bs.pdf
        if plan.differentiate_null:
            # A mask's weight carries the derivative of its opacity already, and so does its density. Other BSDFs divide
            # by a density that may depend on their parameters (plastic).
            pdf = dr.select(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null), dr.detach(pdf), pdf)
        f = dr.select(delta, weight * pdf, f)
    if plan.differentiate_null:
        null = active & scattering.is_null
        f = dr.select(null, bsdf.eval_null_transmission(si, null), f)
    return f
