"""BSDFs along a light path: sampling of scattering events, evaluation, and the derivatives of both.

A path has BSDF factors of two kinds: s_j (along the path) and c_i (towards the sensor). Sampling is detached, so
directions and densities do not depend on the parameters. A factor is f / pdf, where only f has a derivative
(`tracked_factor`, `tracked_factors`).

    f = bsdf * cos        a smooth lobe, evaluated for a given direction
    f = weight * pdf      a delta lobe, which has a weight and a discrete probability, but no value
    f = transmission      passing straight through (a mask, a thin sheet)

A scattering event (`scatter`) is a direction sampled from the BSDF, and its weight.

Bump and normal maps perturb the shading frame inside the BSDF, so Veach's correction does not include this change. In
scenes with bump or normal maps, a smooth lobe is evaluated as on a camera path, with the two directions exchanged.

    f = bsdf(wo -> wi) * cos_p wi * |n . wo| / |n . wi|        n: geometric normal, p: perturbed one

This is the definition of the adjoint BSDF. It needs neither p nor reciprocity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.graph import is_one_of
from reslrb_cli.transport.connection import Connection, shading_correction
from reslrb_cli.transport.plan import Plan

DEFENSIVE = 0.2  # share of samples that a perturbed BSDF does not sample itself
REFLECTS = 0.3  # share of reflection among the events of a specular chain at glass


def context_of(plan: Plan) -> mi.BSDFContext:
    """Return the context of BSDF queries. Light paths carry importance towards the sensor, so that eta^2 is not applied
    twice.
    """
    return mi.BSDFContext(mi.TransportMode.Radiance if plan.camera else mi.TransportMode.Importance)


def tracked_factor(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, scattering: Scattering, active: mi.Bool
) -> mi.Spectrum:
    """Return f (C,) of the event `scattering`, with derivatives.

    Call under `dr.resume_grad()`. Lobes that the scene does not have are not compiled.
    """
    f = evaluate(plan, si, bsdf, scattering.wo, active & ~(scattering.is_delta | scattering.is_null))
    return _singular_factor(plan, si, bsdf, scattering, active, f)


def tracked_factors(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, connection_wo: mi.Vector3f, connected: mi.Bool,
    scattering: Scattering, scattered: mi.Bool,
) -> tuple[mi.Spectrum, mi.Spectrum]:  # fmt: skip
    """Return the BSDF factors f (C,) towards the sensor and f (C,) along the path. One indirect call evaluates both
    factors, and both have derivatives.

    Call under `dr.resume_grad()`.
    """

    def both(
        self: mi.BSDF, si: mi.SurfaceInteraction3f, wo_c: mi.Vector3f, wo_s: mi.Vector3f, connected: mi.Bool,
        smooth: mi.Bool, any_: mi.Bool,
    ) -> tuple[mi.Spectrum, mi.Spectrum]:  # fmt: skip
        return evaluate(plan, si, self, wo_c, connected), evaluate(plan, si, self, wo_s, smooth)

    smooth = scattered & ~(scattering.is_delta | scattering.is_null)
    f_c, f_s = dr.dispatch(bsdf, both, si, connection_wo, scattering.wo, connected, smooth, connected | scattered)
    return f_c, _singular_factor(plan, si, bsdf, scattering, scattered, f_s)


def _singular_factor(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, scattering: Scattering, active: mi.Bool, f: mi.Spectrum
) -> mi.Spectrum:
    """Return `f`. For sampled delta lobes and null events, differentiable values replace `f`."""
    blended = is_one_of(bsdf, plan.needs.blends)
    if plan.differentiate_null:
        null = active & scattering.is_null
        f = dr.select(null, bsdf.eval_null_transmission(si, null), f)
    halves = plan.needs.null_halves if plan.differentiate_null else ()
    if plan.differentiate_delta or halves:
        # Two parts of a BSDF may have null lobes, but an event belongs to one of them.
        delta = active & (scattering.is_delta | (scattering.is_null & is_one_of(bsdf, halves)))
        sample_1 = _defensive(scattering.sample_1)[1] if mixes(plan) else scattering.sample_1
        bs, weight = bsdf.sample(context_of(plan), si, sample_1, scattering.sample_2, delta)
        pdf = bs.pdf
        smooth = mi.Spectrum(0)
        if plan.needs.blends:
            smooth = bsdf.eval(context_of(plan), si, bs.wo, delta & blended)
        for mask, opacity in plan.needs.masks:  # a mask's weight and density both carry the derivative of its opacity
            here = delta & (bsdf == mi.BSDFPtr(mask))
            once = dr.detach(pdf)
            if opacity is not None:
                o = dr.clip(opacity.eval_1(si, here), 0, 1)
                once = dr.select(sample_1 < o, pdf * (dr.detach(o) / o), once)
            pdf = dr.select(here, once, pdf)
        f = dr.select(delta, weight * pdf - smooth, f)
    return f


@dataclass
class EventNumbers:
    """Random numbers of one scattering event."""

    bsdf_2d: mi.Point2f
    bsdf_1d: mi.Float


@dataclass
class Hit:
    """Surface interaction of a vertex, its BSDF, and the ray that reaches it."""

    si: mi.SurfaceInteraction3f
    bsdf: mi.BSDFPtr
    ray: mi.Ray3f


@dataclass
class Sample:
    """Sample of a BSDF: local direction, density, weight (C,), relative index of refraction, and type of the lobe."""

    wo: mi.Vector3f
    pdf: mi.Float
    weight: mi.Spectrum
    eta: mi.Float
    lobe: mi.UInt32


@dataclass
class Aimed:
    """Aimed lanes of a scattering event. `point` is the target, `found` is true if the target exists, and `share` is
    the share of aimed paths.
    """

    active: mi.Bool
    point: mi.Point3f
    found: mi.Bool
    share: mi.Float


@dataclass
class Scattering:
    """Scattering event at a vertex.

    `s` (C,) is the factor s_j of the path, with Veach's correction. `f` (C,) is its differentiable part:
    s = f correction / pdf. `wo` is the local direction, and `d` the direction in world space.
    """

    s: mi.Spectrum
    f: mi.Spectrum
    wo: mi.Vector3f
    d: mi.Vector3f
    pdf: mi.Float
    eta: mi.Float
    correction: mi.Float
    is_delta: mi.Bool
    is_null: mi.Bool
    sample_1: mi.Float
    sample_2: mi.Point2f
    active: mi.Bool
    ways: Any = None  # `Ways`, in walks that need these densities

    def track(self, plan: Plan, hit: Hit) -> None:
        """Give `s` the derivatives of the scene's parameters, for naive AD."""
        f = tracked_factor(plan, hit.si, hit.bsdf, self, self.active)
        self.s = dr.replace_grad(self.s, f * (self.correction / self.pdf))


@dataclass
class Ways:
    """Densities per solid angle of directions at a vertex. The weights of combined paths use these densities
    (`weights.py`).

    `p` is the density of the sampled direction. `back` is the density with which the walk from the path's other end
    samples the reverse direction. `ahead` and `ahead_back` are the corresponding densities for the direction of the
    connection or of the next event. Densities that are not requested are 0. `valid` and `ahead_valid` are true if both
    directions lie on consistent sides, as light paths require.
    """

    p: mi.Float
    back: mi.Float
    ahead: mi.Float
    ahead_back: mi.Float
    valid: mi.Bool
    ahead_valid: mi.Bool


def sample_bsdf(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr | mi.BSDF, sample_1: mi.Float, sample_2: mi.Point2f,
    active: mi.Bool,
) -> Sample:  # fmt: skip
    """Return Mitsuba's sample of a BSDF, with the right density and weight of singular lobes in blends.

    If a blend samples a delta or null lobe of one half, Mitsuba adds the density and the value of the other half's
    smooth lobes in this direction. But densities per solid angle cannot be added to a discrete probability. The smooth
    lobes are therefore subtracted. The remainder is the probability and the value of the singular lobe.
    """
    context, blends = context_of(plan), plan.needs.blends
    bs, weight = bsdf.sample(context, si, sample_1, sample_2, active)
    sample = Sample(bs.wo, bs.pdf, weight, bs.eta, bs.sampled_type)
    is_concrete = isinstance(bsdf, mi.BSDF)
    if not blends or (is_concrete and bsdf not in blends):
        return sample
    singular = active & mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)  # includes Null
    singular = singular if is_concrete else singular & is_one_of(bsdf, blends)
    f, smooth = bsdf.eval_pdf(context, si, bs.wo, singular)
    pdf = bs.pdf - smooth
    own = replace(sample, pdf=pdf, weight=dr.select(pdf > 0, (weight * bs.pdf - f) / pdf, 0))
    return dr.select(singular, own, sample)


def mixes(plan: Plan) -> bool:
    """Whether directions are sampled from a mixture. Light paths sample directions from a mixture at perturbed
    normals.
    """
    return plan.needs.has_perturbed_normals and not plan.camera


def density(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr | mi.BSDF, wo: mi.Vector3f, active: mi.Bool, camera: bool
) -> mi.Float:
    """Return the density per solid angle with which a walk samples the direction `wo` of smooth lobes."""
    side = replace(plan, camera=camera)
    own = bsdf.pdf(context_of(side), si, wo, active)
    if not mixes(side):
        return own
    same_side = mi.Frame3f.cos_theta(wo) * mi.Frame3f.cos_theta(si.wi) > 0
    other = dr.select(same_side, dr.abs(mi.Frame3f.cos_theta(wo)) * dr.inv_pi, 0)
    return (1 - DEFENSIVE) * own + DEFENSIVE * other


def _back(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr | mi.BSDF, wo: mi.Vector3f, active: mi.Bool
) -> mi.Float:
    """Return the density of the reverse direction. In the walk from the path's other end, a path arrives along `wo` and
    continues along `si.wi`.
    """
    turned = type(si)(si)
    turned.wi = wo
    return density(plan, turned, bsdf, si.wi, active, not plan.camera)


def _ways(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr | mi.BSDF, connection_wo: mi.Vector3f,
    connected: mi.Bool | None, wo: mi.Vector3f, pdf: mi.Float, active: mi.Bool,
) -> tuple[mi.Float, ...]:  # fmt: skip
    """Return the densities of `Ways`. Densities that are not requested are 0."""
    zero = mi.Float(0)
    back, ahead, ahead_back = zero, zero, zero
    if plan.weighs:
        back = _back(plan, si, bsdf, wo, active)
    if connected is not None:
        if plan.camera:
            ahead = density(plan, si, bsdf, connection_wo, connected, True)
        if plan.weighs:
            ahead_back = _back(plan, si, bsdf, connection_wo, connected)
    return pdf, back, ahead, ahead_back


def scatter(
    plan: Plan, hit: Hit, numbers: EventNumbers, active: mi.Bool, connection: Connection | None, evaluates: bool = True,
    attached: bool = False, aimed: Aimed | None = None,
) -> tuple[Scattering, mi.Spectrum | None]:  # fmt: skip
    """Sample the next direction, and evaluate f (C,) towards the `connection` of the same vertex, if there is one.

    Without `evaluates`, f towards the connection is None.
    The results are detached unless `attached` is true. Sampling and evaluation share one indirect call and common work,
    for example texture lookups. `aimed` lanes use the direction to their target point. The density in `aimed` lanes is
    the BSDF's density of the target direction. If paths are weighted, the function also computes the densities
    of `Ways`.
    """
    si, bsdf = hit.si, hit.bsdf
    sample_1, sample_2 = numbers.bsdf_1d, numbers.bsdf_2d
    ways_asked = plan.camera or plan.weighs
    connection_wo = mi.Vector3f(0) if connection is None else connection.wo
    connected = connection.active if connection is not None and evaluates else None
    weighed = connection.active if connection is not None and ways_asked else None
    later = ways_asked and (mixes(plan) or aimed is not None)  # the BSDF did not sample the direction
    densities: Sequence[mi.Float] = ()

    def both(
        self: mi.BSDF, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, sample_1: mi.Float, sample_2: mi.Point2f,
        connected: mi.Bool, active: mi.Bool, any_: mi.Bool,
    ) -> tuple[Any, ...]:  # fmt: skip
        own = sample_bsdf(plan, si, self, sample_1, sample_2, active)
        here = None if weighed is None else connected  # without variables from outside the call
        ways = _ways(plan, si, self, wo, here, own.wo, own.pdf, active) if ways_asked and not later else ()
        return evaluate(plan, si, self, wo, connected), own.wo, own.pdf, own.eta, own.lobe, own.weight, *ways

    with dr.suspend_grad(when=not attached):
        if mixes(plan):
            defensive, sample_1 = _defensive(sample_1)
        if connected is None:
            f_connection, sample = None, sample_bsdf(plan, si, bsdf, sample_1, sample_2, active)
        else:
            # The last argument is used as the mask of the whole call.
            f_connection, wo, pdf, eta, lobe, weight, *densities = dr.dispatch(
                bsdf, both, si, connection_wo, sample_1, sample_2, connected, active, active | connected
            )
            sample = Sample(wo, pdf, weight, eta, lobe)
        if mixes(plan):
            sample = _mixed(plan, si, bsdf, sample_2, defensive, active, sample)
        if aimed is not None:
            sample = _to_point(plan, si, bsdf, aimed, sample)
        if attached:
            sample = (staying if plan.stays else following)(plan, si, bsdf, active, sample)
        wo, pdf, weight, lobe = sample.wo, sample.pdf, sample.weight, sample.lobe
        d = si.to_world(wo)
        correction, valid = shading_correction(plan, si, -hit.ray.d, d, wo)
        ways = None
        if ways_asked:
            if later or connected is None:
                densities = _ways(plan, si, bsdf, connection_wo, weighed, wo, pdf, active)
            _, ahead_valid = shading_correction(plan, si, -hit.ray.d, si.to_world(connection_wo), connection_wo)
            p, back, ahead, ahead_back = (dr.detach(value) for value in densities)
            ways = Ways(p, back, ahead, ahead_back, valid, ahead_valid)
        if plan.camera:
            valid = mi.Bool(True)
        is_null = mi.has_flag(lobe, mi.BSDFFlags.Null) if plan.needs.has_null else mi.Bool(False)
        # BSDFFlags.Delta includes Null.
        is_delta = mi.has_flag(lobe, mi.BSDFFlags.Delta) & ~is_null if plan.needs.has_delta_lobes else mi.Bool(False)
        if mixes(plan):
            correction = dr.select(is_delta, correction * _delta_correction(si.wi, wo, sample.eta), correction)
            singular = is_delta | is_null
            f = evaluate(plan, si, bsdf, wo, active & ~singular)
            weight = dr.select(singular, weight / (1 - DEFENSIVE), dr.select(pdf > 0, f / pdf, 0))
        scattering = Scattering(
            s=weight * correction,
            f=weight * pdf,
            wo=wo,
            d=d,
            pdf=pdf,
            eta=sample.eta,
            correction=correction,
            is_delta=is_delta,
            is_null=is_null,
            sample_1=numbers.bsdf_1d,
            sample_2=sample_2,
            active=active & valid & (pdf > 0),
            ways=ways,
        )
        return scattering, f_connection


def following(plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool, sample: Sample) -> Sample:
    """Return a sample whose derivative is the derivative of the integral that the sample estimates.

    For some BSDFs, the sample's own derivative is correct. The sampled direction then follows the surface and the
    roughness. These BSDFs sample smoothly, or weight the choice of a lobe accordingly, like Mitsuba's dielectrics.
    Other BSDFs choose a lobe by a probability that depends on their parameters and on the incident direction. The
    derivative of a sample ignores this choice. Smooth lobes of BSDFs in `plan.needs.unfollowed` therefore keep their
    direction in the local frame. The derivative of f / pdf then comes from f alone. Their delta lobes keep the
    probability.
    """
    if not plan.needs.unfollowed:
        return sample
    wo, pdf, weight = sample.wo, sample.pdf, sample.weight
    delta = mi.has_flag(sample.lobe, mi.BSDFFlags.Delta)
    fixed = mi.Bool(False)
    for other in plan.needs.unfollowed:
        fixed |= bsdf == mi.BSDFPtr(other)
    kept = dr.detach(pdf)
    weight = dr.select(fixed & delta & (kept > 0), weight * (pdf / kept), weight)
    fixed = active & fixed & ~delta & (kept > 0)
    wo, pdf = dr.select(fixed, dr.detach(wo), wo), dr.select(fixed, kept, pdf)
    f = evaluate(plan, si, bsdf, wo, fixed)
    return replace(sample, wo=wo, pdf=pdf, weight=dr.select(fixed, dr.replace_grad(weight, f / kept), weight))


def stays_behind(plan: Plan, bsdf: mi.BSDFPtr, is_delta: mi.Bool) -> mi.Bool:
    """Return the lanes in which the vertex after a scattering event keeps its place on its surface.

    With `plan.glossy_follows`, directions at BSDFs with glossy lobes rotate with the surface. At a BSDF with a glossy
    and a diffuse lobe, directions of both lobes rotate.
    """
    if not plan.glossy_follows:
        return ~is_delta
    return ~is_delta & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)


def staying(plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool, sample: Sample) -> Sample:
    """Return the sample of `following`, with other directions for smooth lobes. Smooth lobes are directed towards a
    point that does not move with this vertex.

    The vertex at the far end accounts for the change of direction (`estimators.attached`). Here the direction is
    constant in world space, and f / pdf changes only through f. Delta lobes are as in `following`.
    """
    followed = following(plan, si, bsdf, active, sample)
    kept = dr.detach(sample.pdf)
    smooth = active & stays_behind(plan, bsdf, mi.has_flag(sample.lobe, mi.BSDFFlags.Delta)) & (kept > 0)
    there = si.to_local(dr.detach(si.to_world(sample.wo)))
    f = evaluate(plan, si, bsdf, there, smooth)
    return dr.select(
        smooth, replace(followed, wo=there, pdf=kept, weight=dr.replace_grad(sample.weight, f / kept)), followed
    )


def begins_caustic(bsdf: mi.BSDFPtr, is_delta: mi.Bool | bool) -> mi.Bool:
    """Return the lanes in which a scattering event begins a caustic if it is the first event of light from an emitter:
    a delta event, or any event at a BSDF without a diffuse lobe.
    """
    return mi.Bool(is_delta) | ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)


def _defensive(sample_1: mi.Float) -> tuple[mi.Bool, mi.Float]:
    """Return the lanes in which a perturbed BSDF does not sample the direction itself. Also returns the random number
    `sample_1`, rescaled for the lanes in which the BSDF samples the direction.
    """
    defensive = sample_1 < DEFENSIVE
    return defensive, dr.select(defensive, sample_1 / DEFENSIVE, (sample_1 - DEFENSIVE) / (1 - DEFENSIVE))


def _mixed(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, sample_2: mi.Point2f, defensive: mi.Bool,
    active: mi.Bool, sample: Sample,
) -> Sample:  # fmt: skip
    """Return a BSDF's sample with the density of the mixture. In `defensive` lanes, the sample is a cosine-weighted
    direction.

    A BSDF with a perturbed normal samples directions around the normal that faces wi. The evaluation with exchanged
    directions uses the normal that faces wo. Some directions therefore have a nonzero value, although the BSDF never
    samples them.
    """
    hemisphere = mi.warp.square_to_cosine_hemisphere(sample_2)
    hemisphere.z = dr.mulsign(hemisphere.z, mi.Frame3f.cos_theta(si.wi))
    singular = mi.has_flag(sample.lobe, mi.BSDFFlags.Delta) & ~defensive  # includes Null
    wo = dr.select(defensive, hemisphere, sample.wo)
    same_side = mi.Frame3f.cos_theta(wo) * mi.Frame3f.cos_theta(si.wi) > 0
    other = dr.select(same_side, dr.abs(mi.Frame3f.cos_theta(wo)) * dr.inv_pi, 0)
    own = dr.select(defensive, bsdf.pdf(context_of(plan), si, wo, active & defensive), sample.pdf)
    pdf = (1 - DEFENSIVE) * own + dr.select(singular, 0, DEFENSIVE * other)
    return Sample(wo, pdf, sample.weight, dr.select(defensive, 1, sample.eta), _glossy(defensive, sample.lobe))


def _to_point(plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, aimed: Aimed, sample: Sample) -> Sample:
    """Return a BSDF's sample. In aimed lanes, the sample is the direction to the target point.

    The density is 0 if there is no point, or if the BSDF itself never samples this direction.
    """
    there = si.to_local(dr.normalize(aimed.point - si.p))
    f, own = bsdf.eval_pdf(context_of(plan), si, there, aimed.active & aimed.found)
    own = dr.select(aimed.found, own, 0)
    towards = Sample(there, own, dr.select(own > 0, f / own, 0), mi.Float(1), _glossy(aimed.active, sample.lobe))
    return dr.select(aimed.active, towards, sample)


@dataclass
class Specular:
    """Reflection or refraction at a vertex. `s` (C,) is the factor of the path, divided by the probability of the lobe.
    `number` is the random number that has selected the lobe.
    """

    d: mi.Vector3f
    s: mi.Spectrum
    number: mi.Float
    active: mi.Bool


def reflect_or_refract(
    plan: Plan, hit: Hit, number: mi.Float, active: mi.Bool, attached: bool = False
) -> Specular:  # fmt: skip
    """Return the event of a delta lobe of the BSDF. The random `number` selects the lobe among all delta lobes on the
    side of `hit`. The probabilities do not depend on the place.

    The results are detached unless `attached` is true. `d` then moves with the vertex.
    """
    mode = mi.TransportMode.Radiance if plan.camera else mi.TransportMode.Importance

    def sample(
        self: mi.BSDF, si: mi.SurfaceInteraction3f, number: mi.Float, active: mi.Bool, any_: mi.Bool
    ) -> tuple[mi.Vector3f, mi.Float, mi.Spectrum]:  # fmt: skip
        wo, eta, s = mi.Vector3f(0), mi.Float(1), mi.Spectrum(0)
        front = mi.Frame3f.cos_theta(si.wi) > 0
        for side, here in ((mi.BSDFFlags.FrontSide, active & front), (mi.BSDFFlags.BackSide, active & ~front)):
            lobes = _delta_lobes(self, side)
            end = 0.0
            for component, chance in lobes.items():
                begin, end = end, end + chance
                chosen = here & (number >= begin) & (number < end if component != [*lobes][-1] else mi.Bool(True))
                context = mi.BSDFContext(mode)
                context.component = component
                bs, weight = self.sample(context, si, 0.5, mi.Point2f(0.5), chosen)
                chosen &= bs.pdf > 0
                wo, eta = dr.select(chosen, bs.wo, wo), dr.select(chosen, bs.eta, eta)
                s = mi.Spectrum(dr.select(chosen, weight / chance, s))
        return wo, eta, s

    with dr.suspend_grad(when=not attached):
        si = hit.si
        wo, eta, s = dr.dispatch(hit.bsdf, sample, si, number, active, active)
        d = si.to_world(wo)
        correction, valid = shading_correction(plan, si, -hit.ray.d, d, wo)
        if mixes(plan):
            correction = correction * _delta_correction(si.wi, wo, eta)
        if plan.camera:
            valid = mi.Bool(True)
        active = active & valid & dr.any(s != 0)
        return Specular(d, dr.select(active, s * correction, 0), number, active)


def _delta_lobes(bsdf: mi.BSDF, side: mi.BSDFFlags) -> dict[int, float]:
    """Return the probabilities of the delta lobes of a BSDF on one side, by the number of their component."""
    flags = {number: int(bsdf.flags(number)) for number in range(bsdf.component_count())}
    reflection, transmission = int(mi.BSDFFlags.DeltaReflection), int(mi.BSDFFlags.DeltaTransmission)
    shares = {
        number: REFLECTS if flag & reflection else 1 - REFLECTS
        for number, flag in flags.items()
        if flag & (reflection | transmission) and flag & int(side)
    }
    return {number: share / sum(shares.values()) for number, share in shares.items()}


def _glossy(mask: mi.Bool, lobe: mi.UInt32) -> mi.UInt32:
    """Return the sample's lobe type. In the lanes of `mask`, the type is glossy reflection."""
    return dr.select(mask, mi.UInt32(int(mi.BSDFFlags.GlossyReflection)), lobe)


def _delta_correction(wi: mi.Vector3f, wo: mi.Vector3f, eta: mi.Float) -> mi.Float:
    """Return cos_p wi / cos_p wo of a mirror or refraction. The normal p is along wi + eta wo."""
    h = dr.fma(eta, wo, wi)
    return dr.abs(dr.dot(h, wi) / dr.dot(h, wo))


def evaluate(
    plan: Plan, si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr | mi.BSDF, wo: mi.Vector3f, active: mi.Bool
) -> mi.Spectrum:
    """Return bsdf * cos (C,) of smooth lobes towards `wo`, for a path that carries importance."""
    if not mixes(plan):
        return bsdf.eval(context_of(plan), si, wo, active)
    exchanged = type(si)(si)
    exchanged.wi = wo
    return bsdf.eval(mi.BSDFContext(mi.TransportMode.Radiance), exchanged, si.wi, active)
