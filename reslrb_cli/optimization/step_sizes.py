"""How many samples, and how often, the steps have that a `StepPilot` takes."""

from __future__ import annotations

from dataclasses import dataclass

#: Rounds that are planned for, of gradients of many entries, and of few, which tell less each.
ROUNDS, ROUNDS_OF_FEW, FEW_ENTRIES = 8, 16, 64
#: Samples of each walk that a table learns from, as a share of a step's.
LEARNING_SHARE = 0.4
#: Steps' worth of time that the rounds are planned for.
PLANNED = 3.4


@dataclass(frozen=True)
class Sizes:
    """Samples per pixel: of a step of the run (`step`), of each set of its samples that has one dL/dI (`call`), and of
    a pass of these (`part`). `alone`: images have samples of their own. `entries` are those of all gradients.
    `lessons` says how often tables of guided emission learn for each such set, in the mean over the run. A step of the
    other kind may take `longer` times as long as one of this; `planned` are PLANNED, or less."""

    step: int
    call: int
    part: int
    alone: bool
    entries: int
    lessons: float
    longer: float
    planned: float = PLANNED

    @property
    def rounds(self) -> int:
        """How many rounds are planned for."""
        return ROUNDS_OF_FEW if self.entries < FEW_ENTRIES else ROUNDS

    @property
    def trial(self) -> int:
        """Samples of each step that is taken here."""
        return max(min(int(self.planned * self.step / ((1 + self.longer) * self.rounds)), self.part), 1)

    @property
    def learning(self) -> int:
        """Samples of each walk that is learned from here."""
        return max(min(int(LEARNING_SHARE * self.step), self.part), 1)
