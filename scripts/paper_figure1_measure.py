"""Figure 1: gradients of a caustic's loss by naive AD and by ours, with few samples and with many, and their memory.

Each kind of gradient is sampled under the same limit of memory, and all have the same dL/dI (`paper_kinds.py`), so that
their means are to agree within standard errors, and the noise of ours is to fall with the root of the samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from paper_kinds import OWN, Kind, check_config, sample, take_pictures
from paper_noise import Fall, fall, relative_noise

from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.comparison import Family, compare_expectations, entry_count
from reslrb_cli.records.measurements import BenchStatus, Comparison, Verdict


@dataclass(frozen=True)
class Plan:
    """Samples per pixel, seeds, and the limit of each process in bytes."""

    few_spp: int = 32
    many_spp: int = 1024
    reference_spp: int = 4096
    seeds: int = 32
    many_seeds: int = 8
    limit: int = 2 << 30

    @property
    def half_spp(self) -> int:
        """Samples at which naive AD's memory is looked at too, to see how it grows."""
        return max(self.few_spp // 2, 1)


@dataclass
class Result:
    """What was measured; `asked_mib` is what naive AD takes with many samples, by its growth with few."""

    config: Config
    plan: Plan
    key: str
    pictures: dict[str, np.ndarray]
    naive: Kind
    ours: Kind
    many: Kind
    failing: Kind
    asked_mib: float
    comparisons: dict[tuple[str, str], Comparison] = field(default_factory=dict)
    fall: Fall | None = None

    @property
    def kinds(self) -> list[Kind]:
        """All, in the order of the table."""
        return [self.naive, self.ours, self.many, self.failing]

    def noise(self, kind: Kind) -> float:
        """The noise of one gradient of a kind, over the gradient itself as the most samples show it."""
        return relative_noise(kind.rows, self.many.rows.mean(0))

    @property
    def does_not_fit(self) -> bool:
        """Whether naive AD with many samples ran out of memory."""
        return self.failing.end is not None and self.failing.end.status is BenchStatus.OUT_OF_MEMORY

    @property
    def holds(self) -> bool:
        """Whether all does that the figure is to show."""
        agree = all(figures.verdict is Verdict.HOLDS for figures in self.comparisons.values())
        return agree and self.fall is not None and self.fall.verdict is Verdict.HOLDS and self.does_not_fit


def measure(config: Config, plan: Plan, folder: Path, say: Callable[[str], None]) -> Result:
    """Sample everything and check it; arrays go by way of `folder`, which is the caller's to remove.

    Raises ConfigError, processes.Refused, and Ended where a gradient that has to be there is not.
    """
    estimator = check_config(config)
    if config.parameters[0].heightmap is None:
        raise ConfigError(config.source, "parameters[0]", "must be a heightmap, whose gradient is shown")
    say(f"target and initial image, {plan.reference_spp} spp")
    pictures = take_pictures(config, plan.reference_spp, folder)
    naive, failing = (Kind("naive AD", spp, "ptracer") for spp in (plan.few_spp, plan.many_spp))
    ours, many = (Kind(estimator, spp, OWN) for spp in (plan.few_spp, plan.many_spp))
    # Twice the samples take so much more memory: what does not depend on samples drops out.
    half = Kind("naive AD", plan.half_spp, "ptracer")
    key = ""
    for kind, count in ((half, 1), (naive, plan.seeds), (ours, plan.seeds), (many, plan.many_seeds), (failing, 1)):
        say(f"{kind.label}: {count} seed{'s' if count > 1 else ''}")
        series = f"figure1, {'ours' if kind.by == OWN else 'naive'}, {kind.spp} spp"
        key = sample(kind, count, config, folder, series, plan.limit) or key
        if kind.end is not None and kind is not failing:
            raise kind.end
    assert half.arrays_mib is not None, "else it has ended"
    assert naive.arrays_mib is not None, "else it has ended"
    growth = (naive.arrays_mib - half.arrays_mib) / (naive.spp - half.spp)
    asked = naive.arrays_mib + growth * (plan.many_spp - naive.spp)
    result = Result(config, plan, key, pictures, naive, ours, many, failing, asked)
    check(result)
    return result


def check(result: Result) -> None:
    """Compare the means of the kinds with each other, and the noise of ours with few samples and with many."""
    naive, ours, many = result.naive, result.ours, result.many
    assert ours.samples is not None
    shape = ours.samples.shape[1:]
    pairs = [(ours, naive), (many, naive), (many, ours)]
    family = Family(len(pairs), len(pairs) * entry_count(shape))
    for one, other in pairs:
        result.comparisons[one.label, other.label] = compare_expectations(
            one.rows, other.rows, family, shape=shape, paired=False
        )
    result.fall = fall(ours.rows, many.rows, float(np.sqrt(many.spp / ours.spp)))
