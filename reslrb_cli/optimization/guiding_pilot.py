"""Whether guided emission pays here: a table is learned, and held; then steps with it take turns with steps without.

To a guided step's time is added its part of what a run of that length learns: each time one more walk of one pass, with
what Python does for a new table, often at first and then rarely.

Short steps make the table less worth than a run's, which has learned from more, and draws more paths from each of its
cells. So the gain is rather more than what is found here, and what pays here pays there.
"""

from __future__ import annotations

from typing import Any

from reslrb_cli.optimization.step_pilot import StepPilot
from reslrb_cli.records.paid import GuidedRecord

#: Share of a run of ITERATIONS that this is planned for, compilation apart; where it is not clear by then, it may take
#: what a pilot has left of its own.
SHARE = 0.025
#: A guided step may take so many times as long as another.
LONGER = 3.0


class GuidingPilot(StepPilot[GuidedRecord]):
    """One decision: guided, or not."""

    @property
    def _apart(self) -> bool:
        return self._sizes.alone

    def _more_ms(self) -> float:
        """What learning adds, in the mean over the run."""
        sizes = self._sizes
        kernel = self._walk.kernel_ms * sizes.part / sizes.learning
        return (kernel + self._walk.beside_ms) * sizes.lessons * sizes.trial / sizes.call

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> GuidedRecord:
        return GuidedRecord(guided=other, images=images, **found)
