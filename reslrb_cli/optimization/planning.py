"""What a run's manifest says of the plan of its step."""

from __future__ import annotations

from typing import Any

from reslrb_cli.config import Reslrb as ReslrbConfig
from reslrb_cli.integrators import Reslrb
from reslrb_cli.integrators.features import GUIDED, SEQUENCE
from reslrb_cli.integrators.plan_report import plan_rows, with_reason
from reslrb_cli.optimization.problem import Problem


def plan_record(problem: Problem) -> dict[str, Any]:
    """The integrator, its estimator, and for the first view what its kernels contain and leave out, and why.

    `rows` is empty for integrators that plan nothing, and `estimator` None for those that have none.
    """
    config, integrator = problem.config.integrator, problem.integrator
    if not isinstance(integrator, Reslrb):
        return {"integrator": config.type, "estimator": None, "rows": []}
    plan = integrator.plan(problem.scene, problem.scene.sensors()[problem.sensors[0]], problem.selection.params)
    found = plan_rows(plan)
    if problem.guided is not None:
        found = with_reason(found, GUIDED, f"guiding: auto, {problem.guided.why()}")
    if problem.sequence is not None:
        found = with_reason(found, SEQUENCE, f"sequence: auto, {problem.sequence.why()}")
    rows = [{"feature": row.feature, "needed": row.needed, "reason": row.reason} for row in found]
    estimator = type(integrator.estimator).__name__.removesuffix("Estimator").lower()
    assert isinstance(config, ReslrbConfig)
    return {"integrator": config.type, "estimator": estimator, "rows": rows}
