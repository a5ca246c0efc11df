"""What a run says, and notes in its manifest, of scales and memory while it is at work."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from reslrb_cli.optimization import Problem
from reslrb_cli.optimization.scaling import Scaled, step_line
from reslrb_cli.records.manifest import Manifest
from reslrb_cli.records.metrics import Record

logger = logging.getLogger(__name__)


def note_scaling(manifest: Manifest, problem: Problem, measured: Sequence[Scaled]) -> None:
    """Note what was measured for `scale: auto`, and say what it makes of a step."""
    manifest.scaling = [row.to_json() for row in measured]
    for row in measured:
        spec = problem.selection.spec(row.key)
        line = step_line(row, spec.transform, spec.learning_rate or problem.config.optimizer.learning_rate)
        (logger.warning if row.own_length is None else logger.info)(f"scale auto: {line}")


def check_memory(manifest: Manifest, problem: Problem, record: Record) -> None:
    """Note the memory that was used, where there is a budget; warn the first time that it is above that."""
    if problem.memory is not None:
        warning = problem.memory.check(record.peak_mib)
        if warning is not None:
            logger.warning(warning)
        manifest.memory = problem.memory.to_json()
