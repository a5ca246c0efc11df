"""Figure 1: a caustic, its target, and the gradient of their distance with respect to the heights of the glass.

The gradients are by naive AD (Mitsuba's `ptracer`) and by our estimator, with few samples and with many. All kinds of
gradient have the same memory limit. The means must agree. The noise of our gradients must fall with the square root of
the sample count. Naive AD with many samples must run out of memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from make_figures import encode

from paper.gradients import OWN, Kind, Sampling, colored, compare, fall
from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.measurements import BenchStatus, Verdict
from reslrb_cli.report.tonemap import signed_end

CONFIG = Path(__file__).resolve().parent.parent / "configs" / "paper" / "figure1.yaml"
#: Seeds with few samples for each seed with many.
MANY = 4
#: The grey of a gradient that does not fit.
GREY = 0.93


@dataclass(frozen=True)
class Plan:
    """Samples per pixel, seeds, and the memory limit of each process in bytes."""

    few_spp: int = 32
    many_spp: int = 1024
    reference_spp: int = 4096
    seeds: int = 32
    many_seeds: int = 8
    limit: int = 2 << 30


def plan(sets: list[str], seeds: int, _room: Path | None) -> tuple[Config, Plan]:
    """Return the experiment and its plan."""
    return load(CONFIG, sets), Plan(seeds=seeds, many_seeds=seeds // MANY)


def measure(config: Config, plan: Plan, say: Callable[[str], None]) -> tuple[dict[str, Any], Any]:
    """Sample and check all gradients. Return the record, and the rows of panels of the picture.

    Raises ConfigError, `processes.CannotStart`, and Ended if a required gradient is missing.
    """
    if config.parameters[0].heightmap is None:
        raise ConfigError(config.source, "parameters[0]", "must be a heightmap, whose gradient is shown")
    made = Sampling(config, plan.reference_spp, say, limit=plan.limit)

    def taken(name: str, spp: int, by: str, count: int, may_end: bool = False) -> Kind:
        series = f"figure1, {'ours' if by == OWN else 'naive'}, {spp} spp"
        return made.take(Kind(name, spp, by), count, series, may_end)

    # Memory grows in proportion to the samples, so two sample counts predict that of many.
    half = taken("naive AD", max(plan.few_spp // 2, 1), "ptracer", 1)
    naive = taken("naive AD", plan.few_spp, "ptracer", plan.seeds)
    ours = taken(made.own, plan.few_spp, OWN, plan.seeds)
    many = taken(made.own, plan.many_spp, OWN, plan.many_seeds)
    kinds = [naive, ours, many, taken("naive AD", plan.many_spp, "ptracer", 1, may_end=True)]
    growth = ((naive.arrays_mib or 0) - (half.arrays_mib or 0)) / (naive.spp - half.spp)
    asked_mib = (naive.arrays_mib or 0) + growth * (plan.many_spp - naive.spp)
    return judge(plan, kinds, asked_mib), panels(made.target, made.initial, kinds, plan.limit)


def judge(plan: Plan, kinds: list[Kind], asked_mib: float) -> dict[str, Any]:
    """Return the record: the comparisons of the means, the decrease of the noise, and whether the whole figure
    `holds`.
    """
    naive, ours, many, failing = kinds
    comparisons = compare([(ours, naive), (many, naive), (many, ours)])
    noise = fall(ours.rows, many.rows, float(np.sqrt(many.spp / ours.spp)))
    does_not_fit = failing.end is not None and failing.end.status is BenchStatus.OUT_OF_MEMORY
    return {
        "plan": asdict(plan), "gradients": [kind.record(many.rows.mean(0)) for kind in kinds],
        "naive_at_many_spp_mib": asked_mib, "comparisons": comparisons, "noise": noise,
        "holds": does_not_fit and all(row["verdict"] is Verdict.HOLDS for row in (*comparisons, noise)),
    }  # fmt: skip


def panels(
    target: np.ndarray, initial: np.ndarray, kinds: list[Kind], limit: int
) -> list[list[tuple[str, np.ndarray]]]:
    """Return the panels of the picture: target, caustic, and one gradient of each kind from one seed."""
    naive, ours, many, failing = kinds
    shape, white = np.shape(many.samples)[1:], float(np.quantile(target, 0.999)) or 1.0
    end = signed_end(many.rows[0].reshape(shape).sum(-1))

    def shown(kind: Kind) -> tuple[str, np.ndarray]:
        if kind.samples is None:
            return f"{kind.label}: over {limit / 2**30:g} GiB", np.full((*shape[:2], 3), GREY)
        return f"{kind.label}: {kind.arrays_mib:.0f} MiB", colored(kind.samples[0].sum(-1), end)

    return [
        [("target", encode(target / white)), shown(naive), shown(failing)],
        [("caustic at the start", encode(initial / white)), shown(ours), shown(many)],
    ]
