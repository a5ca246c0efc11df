"""Light straight through surfaces that only mask or filter it. These surfaces have Mitsuba's `Null` lobes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from reslrb_cli.scene.rays import shadow_ray
from reslrb_cli.transport.plan import Plan


def forward_derivatives(*values: mi.Spectrum) -> list[mi.Spectrum]:
    """Return the derivatives of `values` along the parameters' tangents. Values that depend on no parameter have zero
    derivatives.

    One propagation handles all values. A second propagation would meet the graph edges of the first propagation. The
    tangents of the parameters remain for the next vertex.
    """
    tracked = [value for value in values if dr.grad_enabled(value)]
    if tracked:
        dr.forward_to(tracked, flags=dr.ADFlag.ClearEdges | dr.ADFlag.ClearInterior)
    return [dr.detach(dr.grad(value)) if dr.grad_enabled(value) else dr.zeros(type(value)) for value in values]


#: Least transmission of a pane, where a factor with a derivative may be zero.
FLOOR = 1e-8


def transmission_of(plan: Plan, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Spectrum:
    """Return the transmission (C,) straight through the surface at `si`.

    A transmission of 0 has a derivative, which is the product of the path's other factors. If parameters of panes may
    be 0, the transmission is therefore at least FLOOR. Every product and quotient of transmissions then exists. The
    error of an image is at most FLOOR of the light that a clear pane would let through. A mask that is opaque stays so,
    because no path that scatters there passes it, either.
    """
    bsdf = si.bsdf()
    transmission = bsdf.eval_null_transmission(si, active)
    if not (plan.track_zeros and plan.differentiate_null):
        return transmission
    flags = bsdf.flags()
    is_pane = dr.any(transmission > 0) | ~mi.has_flag(flags, mi.BSDFFlags.Smooth)
    is_pane = active & mi.has_flag(flags, mi.BSDFFlags.Null) & is_pane
    return transmission + dr.select(is_pane, dr.maximum(FLOOR - dr.detach(transmission), 0), 0)


@dataclass
class Passage:
    """Loop state of a ray on its way through null surfaces.

    `value` (C,) is the product of the transmissions so far, and `tangent` its derivative (empty unless requested).
    `reached` becomes true once nothing blocks the way.
    """

    active: mi.Bool
    value: mi.Spectrum
    crossings: mi.UInt32
    reached: mi.Bool
    tangent: list[mi.Spectrum] = field(default_factory=list)


def transmittance(
    plan: Plan, scene: mi.Scene, start: mi.Interaction3f, depth: mi.UInt32, target: mi.Point3f, active: mi.Bool,
    on_crossing: Callable[[mi.Spectrum, mi.Bool], None] | None = None, loop_mode: str = "symbolic",
    tangents: bool = False,
) -> Passage:  # fmt: skip
    """Follow the ray from the vertex `start` at `depth` to `target`, through null surfaces, as far as the depth limit
    allows.

    Each crossing counts as a vertex, as in Mitsuba's `path`. At each crossing, `on_crossing(transmission, active)` gets
    the crossing's transmission (C,). `transmission` is tracked if gradients are enabled. `on_crossing` can therefore
    differentiate the transmission. With `tangents`, the derivative along the parameters' tangents is computed (forward
    mode). With `tangents`, gradients must be suspended, because the loop itself must not track any gradients. If
    `plan.passes_lamps`, lamps do not block the way.
    """
    limit = plan.max_depth - depth - 1

    def body(passage: Passage, ray: mi.Ray3f) -> tuple[Passage, mi.Ray3f]:
        si = scene.ray_intersect(ray, passage.active)
        hit = passage.active & si.is_valid()
        with dr.resume_grad(when=tangents):
            transmission = transmission_of(plan, si, hit)
            if tangents:
                [d_transmission], transmission = forward_derivatives(transmission), dr.detach(transmission)
        if on_crossing is not None:
            on_crossing(transmission, hit)
            transmission = dr.detach(transmission)
        tangent = passage.tangent
        if tangents:
            tangent = [dr.select(hit, tangent[0] * transmission + passage.value * d_transmission, tangent[0])]
        lamp = mi.Bool(False)
        if plan.passes_lamps:
            lamp = hit & (si.emitter(scene) != dr.zeros(mi.EmitterPtr))
            transmission = dr.select(lamp, 1, transmission)
            tangent = [dr.select(lamp, passage.tangent[0], own) for own in tangent]
        blocked = hit & ~lamp & (dr.all(transmission == 0) | (passage.crossings >= limit))
        state = Passage(
            active=hit & ~blocked,
            value=dr.select(hit, passage.value * transmission, passage.value),
            crossings=passage.crossings + dr.select(hit & ~lamp, mi.UInt32(1), 0),
            reached=passage.reached | (passage.active & ~hit),
            tangent=tangent,
        )
        return state, dr.select(hit, si.spawn_ray_to(target), ray)

    passage = Passage(
        mi.Bool(active), mi.Spectrum(1), mi.UInt32(0), mi.Bool(False), [mi.Spectrum(0)] if tangents else []
    )
    passage, _ = dr.while_loop(
        state=(passage, shadow_ray(start, target, plan.has_edges)),
        cond=lambda passage, ray: passage.active,
        body=body,
        label="null surfaces",
        mode=loop_mode,
    )
    return passage
