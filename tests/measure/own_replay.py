"""An integrator like users' integrators: a replay of camera paths that finds lamps only with next event estimation.

`fault` plants one of many faults in the differentiating pass. `primal_fault` plants a fault in both passes.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
from mitsuba.ad.integrators.common import RBIntegrator


class Replay(RBIntegrator):
    """Integrator for scenes without mirrors and clear glass. The first segment can hit lamps. From then on, next event
    estimation samples the lamps.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.fault = str(props.get("fault", ""))
        self.primal_fault = str(props.get("primal_fault", ""))
        if self.fault == "raises":
            raise RuntimeError("of all things")

    @dr.syntax
    def sample(
        self, mode: dr.ADMode, scene: mi.Scene, sampler: mi.Sampler, ray: mi.Ray3f, δL: Any, state_in: Any,
        active: mi.Bool, **_: Any,
    ) -> tuple:  # fmt: skip
        primal = mode == dr.ADMode.Primal
        wrong = "" if primal else self.fault
        context = mi.BSDFContext()
        ray = mi.Ray3f(dr.detach(ray))
        depth, η, β = mi.UInt32(0), mi.Float(1), mi.Spectrum(1)
        L = mi.Spectrum(0 if primal else state_in)
        δL = mi.Spectrum(δL if δL is not None else 0)
        active = mi.Bool(active)
        longest = self.max_depth - (1 if wrong == "depth" else 0)
        while active:
            if dr.hint(wrong == "replay", mode="scalar"):
                sampler.next_1d(active)
            si = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=depth == 0)
            bsdf = si.bsdf(ray)
            with dr.resume_grad(when=not primal):
                Le = β * si.emitter(scene).eval(si, active & (depth == 0))
            onward = active & (depth + 1 < longest) & si.is_valid()

            reach = onward & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
            ds, _ = scene.sample_emitter_direction(si, sampler.next_2d(), True, reach)
            reach &= ds.pdf != 0
            with dr.resume_grad(when=not primal):
                wo = si.to_local(ds.d)
                f = bsdf.eval(context, si, wo, reach)
                arriving = scene.eval_emitter_direction(si, ds, reach) / ds.pdf
                if dr.hint(wrong == "cosine", mode="scalar"):
                    f /= dr.maximum(mi.Frame3f.cos_theta(wo), 1e-2)
                if dr.hint(wrong == "emitters" or self.primal_fault == "emitters", mode="scalar"):
                    arriving *= len(scene.emitters())
                if dr.hint(self.primal_fault == "nan", mode="scalar"):
                    arriving *= dr.nan
                direct = dr.select(reach, β * f * arriving, 0)

            bs, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), onward)
            ray = si.spawn_ray(si.to_world(bs.wo))
            L = L + Le + direct if primal else L - Le - direct
            behind = mi.Spectrum(L)
            if dr.hint(wrong == "kept", mode="scalar"):  # the remaining light wrongly includes this vertex's own light
                behind = L + Le + direct
            before = mi.Spectrum(β)
            η *= bs.eta
            β *= weight
            fit = dr.minimum(dr.max(β) * dr.square(η), 0.95)
            plays = depth >= self.rr_depth
            if dr.hint(not primal, mode="scalar"):
                with dr.resume_grad():
                    f = bsdf.eval(context, si, si.to_local(ray.d), onward)
                    if dr.hint(wrong == "lobe", mode="scalar"):
                        f /= bsdf.pdf(context, si, si.to_local(ray.d), onward)
                    still = dr.detach(f)
                    share = dr.select(still != 0, f / still, 0)
                    if dr.hint(wrong == "roulette", mode="scalar"):
                        chance = dr.max(before * dr.replace_grad(weight, weight * share)) * dr.square(dr.detach(η))
                        share = dr.select(plays & (fit < 0.95), share * dr.detach(chance) / chance, share)
                    if dr.hint(wrong == "first", mode="scalar"):
                        share = dr.select(depth == 0, share, dr.detach(share))
                    Lo = Le + direct + dr.select(onward, behind * share, 0)
                    if dr.hint(wrong == "sign", mode="scalar"):
                        Lo = -Lo
                    if dr.hint(wrong == "twice", mode="scalar"):
                        Lo = Lo + direct
                    if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                        dr.backward_from(δL * Lo)
                    else:
                        δL += dr.forward_to(Lo)
            β[plays] *= dr.rcp(fit)
            survives = sampler.next_1d() < fit
            active = onward & (~plays | survives) & (dr.max(β) != 0)
            depth += 1
        return L if primal else δL, depth != 0, [], L


class Black(RBIntegrator):
    """Integrator whose image has the wrong shape, is a list, or does not exist, depending on `what`."""

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.what = str(props.get("what", "wide"))

    def render(self, scene: mi.Scene, sensor: Any = 0, seed: int = 0, spp: int = 0, *_: Any, **__: Any) -> Any:
        width, height = sensor.film().crop_size()
        if self.what == "list":
            return [0.0]
        if self.what == "raises":
            return self.nothing
        return dr.full(mi.TensorXf, 1.0, (int(height), int(width) + (self.what == "wide"), 3))


NONE = 3


def makes_none(_: mi.Properties) -> str:
    """Return a text instead of an integrator."""
    return "none"
