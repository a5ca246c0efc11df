"""Straight passage through surfaces that only mask or filter light (Mitsuba's `Null` lobes)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi


@dataclass
class Passage:
    """State of a ray on its way through null surfaces; loop state.

    `value` is the product of the transmissions so far, (C,); `reached` becomes true where nothing is left in the way.
    """

    active: Any
    value: Any
    crossings: Any
    reached: Any


def transmittance(
    scene: Any,
    start: Any,
    target: Any,
    limit: Any,
    active: Any,
    on_crossing: Callable[[Any, Any], None] | None = None,
    loop_mode: str = "symbolic",
) -> Passage:
    """Follow the segment from the interaction `start` to the point `target` through at most `limit` null surfaces.

    Each crossing counts as a vertex, as it does for `path`. `on_crossing(transmission, active)` is called at each one
    with its transmission (C,), attached where gradients are enabled, to take its derivative there and then.
    """

    def body(passage: Passage, ray: Any) -> tuple[Passage, Any]:
        si = scene.ray_intersect(ray, passage.active)
        hit = passage.active & si.is_valid()
        transmission = si.bsdf().eval_null_transmission(si, hit)
        if on_crossing is not None:
            on_crossing(transmission, hit)
            transmission = dr.detach(transmission)
        blocked = hit & (dr.all(transmission == 0) | (passage.crossings >= limit))
        state = Passage(
            active=hit & ~blocked,
            value=dr.select(hit, passage.value * transmission, passage.value),
            crossings=passage.crossings + dr.select(hit, mi.UInt32(1), 0),
            reached=passage.reached | (passage.active & ~hit),
        )
        return state, dr.select(hit, si.spawn_ray_to(target), ray)

    passage = Passage(mi.Bool(active), mi.Spectrum(1), mi.UInt32(0), mi.Bool(False))
    passage, _ = dr.while_loop(
        state=(passage, start.spawn_ray_to(target)),
        cond=lambda passage, ray: passage.active,
        body=body,
        label="null surfaces",
        mode=loop_mode,
    )
    return passage
