"""Straight passage through surfaces that only mask or filter light (Mitsuba's `Null` lobes)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi


def forward_derivatives(*values: mi.Spectrum) -> list[mi.Spectrum]:
    """Derivatives of `values` along the parameters' tangents; zero for those that depend on none of them.

    In one propagation: a second one would meet the edges of the first. It leaves the parameters' own tangents standing,
    for the next vertex.
    """
    tracked = [value for value in values if dr.grad_enabled(value)]
    if tracked:
        dr.forward_to(tracked, flags=dr.ADFlag.ClearEdges | dr.ADFlag.ClearInterior)
    return [dr.detach(dr.grad(value)) if dr.grad_enabled(value) else dr.zeros(type(value)) for value in values]


@dataclass
class Passage:
    """State of a ray on its way through null surfaces; loop state.

    `value` is the product of the transmissions so far, (C,), `tangent` its derivative (empty unless asked for);
    `reached` becomes true where nothing is left in the way.
    """

    active: mi.Bool
    value: mi.Spectrum
    crossings: mi.UInt32
    reached: mi.Bool
    tangent: list[mi.Spectrum] = field(default_factory=list)


def transmittance(
    scene: mi.Scene,
    start: mi.Interaction3f,
    target: mi.Point3f,
    limit: mi.UInt32,
    active: mi.Bool,
    on_crossing: Callable[[mi.Spectrum, mi.Bool], None] | None = None,
    loop_mode: str = "symbolic",
    tangents: bool = False,
) -> Passage:
    """Follow the segment from the interaction `start` to the point `target` through at most `limit` null surfaces.

    Each crossing counts as a vertex, as it does for `path`. `on_crossing(transmission, active)` is called at each one
    with its transmission (C,), tracked where gradients are enabled, to take its derivative there and then.
    With `tangents`, the derivative along the parameters' tangents is carried along (forward mode); call it where
    gradients are suspended then, since the loop itself must not track any.
    """

    def body(passage: Passage, ray: mi.Ray3f) -> tuple[Passage, mi.Ray3f]:
        si = scene.ray_intersect(ray, passage.active)
        hit = passage.active & si.is_valid()
        with dr.resume_grad(when=tangents):
            transmission = si.bsdf().eval_null_transmission(si, hit)
            if tangents:
                [d_transmission], transmission = forward_derivatives(transmission), dr.detach(transmission)
        if on_crossing is not None:
            on_crossing(transmission, hit)
            transmission = dr.detach(transmission)
        tangent = passage.tangent
        if tangents:
            tangent = [dr.select(hit, tangent[0] * transmission + passage.value * d_transmission, tangent[0])]
        blocked = hit & (dr.all(transmission == 0) | (passage.crossings >= limit))
        state = Passage(
            active=hit & ~blocked,
            value=dr.select(hit, passage.value * transmission, passage.value),
            crossings=passage.crossings + dr.select(hit, mi.UInt32(1), 0),
            reached=passage.reached | (passage.active & ~hit),
            tangent=tangent,
        )
        return state, dr.select(hit, si.spawn_ray_to(target), ray)

    passage = Passage(
        mi.Bool(active), mi.Spectrum(1), mi.UInt32(0), mi.Bool(False), [mi.Spectrum(0)] if tangents else []
    )
    passage, _ = dr.while_loop(
        state=(passage, start.spawn_ray_to(target)),
        cond=lambda passage, ray: passage.active,
        body=body,
        label="null surfaces",
        mode=loop_mode,
    )
    return passage
