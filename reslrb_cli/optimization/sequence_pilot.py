"""Whether low-discrepancy numbers pay here: steps with them take turns with steps without, guided if the run's are.

Both draw from one table, where they are guided. What a run goes on learning takes both the same time; it is left out,
which makes more of the time that such numbers take.

Noise of evenly spread numbers falls faster than with one over the samples, or as fast. So short steps find less of the
gain than whole ones have, and what pays here pays there.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from reslrb_cli.optimization.pilot_records import ITERATIONS
from reslrb_cli.optimization.step_pilot import StepPilot
from reslrb_cli.optimization.step_sizes import PLANNED
from reslrb_cli.records.paid import SequenceRecord

#: Share of a run of ITERATIONS that is left for this by what is measured before, compilation apart.
SHARE = 0.005
#: A step with such numbers may take so many times as long as another.
LONGER = 1.25
#: What of the share the rounds are planned for; the first step takes a part too, and is no round.
ROUNDS_SHARE = 0.8


def planned(share: float) -> float:
    """Steps' worth of time that the rounds are planned for: the longer they are, the more of the gain is seen."""
    return min(ROUNDS_SHARE * share * ITERATIONS, PLANNED)


class SequencePilot(StepPilot[SequenceRecord]):
    """One decision: low-discrepancy numbers, or independent ones."""

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> SequenceRecord:
        return SequenceRecord(low_discrepancy=other, **found)


class InsteadPilot(SequencePilot):
    """One decision: low-discrepancy numbers in place of guided emission, or that with independent ones."""

    def _decide(self, other: bool, images: bool, found: dict[str, Any]) -> SequenceRecord:
        return replace(super()._decide(other, images, found), alone=True)
