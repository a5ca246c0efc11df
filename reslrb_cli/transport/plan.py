"""What one walk has to do, decided before it is traced: what a scene does not need never reaches the kernel."""

from __future__ import annotations

from dataclasses import dataclass, replace

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

    def differentiating(self, bsdfs: bool, emission: bool, track_zeros: bool) -> Plan:
        """The same plan for a step that differentiates these; `track_zeros`: some of their factors may be zero."""
        return replace(self, differentiate_bsdfs=bsdfs, differentiate_emission=emission, track_zeros=track_zeros)


def make_plan(needs: SceneNeeds, max_depth: int, rr_depth: int, hide_emitters: bool) -> Plan:
    """Plan of a walk through a scene with these needs; `max_depth` may be -1."""
    return Plan(needs, UNBOUNDED if max_depth < 0 else max_depth, rr_depth, hide_emitters)
