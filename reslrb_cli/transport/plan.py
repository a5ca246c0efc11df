"""What one walk has to do, decided before it is traced: what a scene does not need never reaches the kernel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi

from reslrb_cli.scene.needs import SceneNeeds

UNBOUNDED = 0xFFFFFFFF


@dataclass(frozen=True)
class Plan:
    """Static choices of a walk; all of them Python values, none of them part of a kernel's data.

    `max_depth`, `rr_depth` count path edges as Mitsuba's `ptracer` does; `max_depth` is UNBOUNDED for -1.
    """

    needs: SceneNeeds
    max_depth: int
    rr_depth: int
    hide_emitters: bool = False
    track_zeros: bool = False
    differentiate_bsdfs: bool = False
    differentiate_emission: bool = False
    # The BSDFs of surfaces that are differentiated, where not all of them are.
    only_bsdfs: tuple[Any, ...] = ()

    @property
    def roulette(self) -> bool:
        """Whether Russian roulette can end a path before the depth limit does."""
        return self.rr_depth < self.max_depth - 1

    @property
    def visible_emission(self) -> bool:
        """Whether any emitter can be seen directly and is to be."""
        return self.needs.has_visible_emitters and not self.hide_emitters and self.max_depth > 0

    @property
    def environment_map(self) -> bool:
        """Whether an environment map emits, whose rays we place ourselves."""
        return (
            self.needs.environment is not None
            and self.needs.emitters[self.needs.environment] == "EnvironmentMapEmitter"
        )

    def differentiates(self, bsdf: Any) -> Any:
        """Lanes in which the BSDF (a pointer) has anything to differentiate."""
        if not self.only_bsdfs:
            return mi.Bool(self.differentiate_bsdfs)
        result = bsdf == mi.BSDFPtr(self.only_bsdfs[0])
        for other in self.only_bsdfs[1:]:
            result |= bsdf == mi.BSDFPtr(other)
        return result

    def differentiating(self, bsdfs: bool, emission: bool, track_zeros: bool, only_bsdfs: tuple[Any, ...] = ()) -> Plan:
        """The same plan for a step that differentiates these; `track_zeros`: some of their factors may be zero."""
        return replace(
            self,
            differentiate_bsdfs=bsdfs,
            differentiate_emission=emission,
            track_zeros=track_zeros,
            only_bsdfs=only_bsdfs,
        )


def make_plan(needs: SceneNeeds, max_depth: int, rr_depth: int, hide_emitters: bool) -> Plan:
    """Plan of a walk through a scene with these needs; `max_depth` may be -1."""
    return Plan(needs, UNBOUNDED if max_depth < 0 else max_depth, rr_depth, hide_emitters)
