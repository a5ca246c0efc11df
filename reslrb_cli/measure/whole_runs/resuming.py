"""Going on from the whole runs that an earlier session has made: the same target, the same time for each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.measure import earlier
from reslrb_cli.measure.earlier import Earlier
from reslrb_cli.measure.processes import Ended, Refused
from reslrb_cli.measure.whole_runs.plan import RunsPlan
from reslrb_cli.measure.whole_runs.run import Run
from reslrb_cli.records.samples import Kept
from reslrb_cli.records.whole_runs import RunPointRecord

#: What is kept says that it is of this.
KIND = "convergence --runs"
#: Losses of the same values on the same samples differ by rounding alone, relatively: far less than this.
ROUNDING = 1e-3


def settings(plan: RunsPlan, device: str = "") -> dict[str, Any]:
    """What has to be the same in all sessions; the number of runs does not."""
    return earlier.settings(
        plan.config,
        plan.variant,
        device,
        integrators=[case.label for case in plan.cases],
        reference=plan.reference.label,
        spp=list(plan.spps),
        rates=list(plan.rates),
        **{"memory limit": plan.memory_limit},
    )


def check(plan: RunsPlan, before: Earlier, device: str = "") -> None:
    """Raise ConfigError where a session cannot go on from an earlier one, or has nothing to add to it."""
    before.check(settings(plan, device))
    done = before.head["seeds"]
    if done >= plan.runs:
        word = "run" if done == 1 else "runs"
        raise before.complete(f"{done} {word} of each", "more with --runs")


def kept(
    settings: Mapping[str, Any],
    facts: Mapping[str, Any],
    targets: Path,
    limit_s: float,
    runs: Sequence[Run],
    seeds: int,
) -> Kept:
    """What a later session needs to go on: the runs of the first so many `seeds`, which are over, and the targets."""
    with np.load(targets) as found:
        arrays = {name: found[name] for name in found.files}
    order = list(dict.fromkeys(run.seed for run in runs))[:seeds]
    entries = [_entry(run) for run in runs if run.seed in order]
    return earlier.head(KIND, settings, facts=facts, limit_s=limit_s, seeds=seeds, runs=entries), arrays


def _entry(run: Run) -> dict[str, Any]:
    refusal = None if run.refusal is None else {"line": str(run.refusal), "exit_code": int(run.refusal.exit_code)}
    points = [[p.elapsed_s, p.iteration, p.loss, p.parameter_error] for p in run.points]
    return {"label": run.method.label, "seed": run.seed, "first_s": run.first_s, "refusal": refusal,
            "points": points, "end": run.end and run.end.kept()}  # fmt: skip


def restore(before: Earlier, plan: RunsPlan) -> list[Run]:
    """The runs of an earlier session, none of which is under way."""
    methods = {method.label: method for method in map(plan.method_of, plan.sides)}
    runs = []
    for entry in before.head["runs"]:
        method, seed, refusal = methods[entry["label"]], entry["seed"], entry["refusal"]
        points = [RunPointRecord(method, seed, *point) for point in entry["points"]]
        facts = before.head["facts"]
        runs.append(
            Run(
                process=None,
                may_refuse=plan.default,
                end=Ended.restored(entry["end"]),
                refusal=None if refusal is None else Refused(refusal["line"], refusal["exit_code"]),
                method=method,
                seed=seed,
                out=Path(),
                state=points[-1] if points else RunPointRecord(method, seed, 0.0, 0, facts["loss"], facts["error"]),
                first_s=entry["first_s"],
                points=points,
            )
        )
    return runs


def restore_targets(before: Earlier, file: Path) -> None:
    """Write the targets where the processes look for them."""
    np.savez(file, **before.arrays)  # type: ignore[arg-type]


def check_judge(before: Earlier, now: Mapping[str, Any]) -> None:
    """Raise ConfigError where the initial values have another loss than they had: files of the scene have changed."""
    loss, then = now["loss"], before.head["facts"]["loss"]
    if math.isfinite(loss) and math.isfinite(then) and abs(loss - then) > ROUNDING * max(abs(loss), abs(then)):
        raise before.other(f"the initial loss is {then:.4g} there, {loss:.4g} here: has a file of the scene changed?")
