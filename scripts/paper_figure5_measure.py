"""Figure 5: the gradient of an image's loss with respect to a room's floor, by naive AD and by ours, and their z map.

All have one dL/dI (`paper_kinds.py`), which is 0 where light paths find less than paths from the sensor do: where the
sensor sees glass, mirrors or coats, and at the film's border. Naive AD is that of our own walk: stock `ptracer` emits
wrongly from the room's environment map, which is turned. The experiment's own estimator is compared at other seeds, in
standard errors, with naive AD and with `prb`, which shares nothing with us; the exact estimators with naive AD at equal
seeds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from paper_kinds import OWN, Kind, check_config, sample, take_pictures

from reslrb_cli.config.schema import Config
from reslrb_cli.measure.comparison import (
    Family,
    compare_equal_seeds,
    compare_expectations,
    entry_count,
    z_scores,
)
from reslrb_cli.records.measurements import Comparison, Verdict

#: Estimators that equal naive AD of the same paths but for rounding; and how far they may be from it, in relative L2.
EXACT, CLOSE = ("stack", "gather"), 1e-4


@dataclass(frozen=True)
class Plan:
    """Samples per pixel of a gradient and of dL/dI's image, seeds, and tiles of the z map across the texture."""

    spp: int = 32
    reference_spp: int = 1024
    seeds: int = 24
    tiles: int = 32


@dataclass
class Result:
    """What was measured. `comparisons` are by the names of the two gradients; `z` is of tiles (rows, columns)."""

    config: Config
    plan: Plan
    key: str
    pictures: dict[str, np.ndarray]
    naive: Kind
    ours: Kind
    prb: Kind
    comparisons: dict[tuple[str, str], Comparison] = field(default_factory=dict)
    z: np.ndarray | None = None

    @property
    def kinds(self) -> tuple[Kind, Kind, Kind]:
        """What was sampled at seeds of its own."""
        return self.naive, self.ours, self.prb

    @property
    def left_out(self) -> float:
        """The share of pixels in which dL/dI is 0."""
        return float(np.mean(~self.pictures["adjoint"].any(-1)))

    @property
    def holds(self) -> bool:
        """Whether all gradients agree."""
        return all(figures.verdict is Verdict.HOLDS for figures in self.comparisons.values())


def measure(config: Config, plan: Plan, folder: Path, say: Callable[[str], None]) -> Result:
    """Sample everything and check it; arrays go by way of `folder`, which is the caller's to remove.

    Raises ConfigError, processes.Refused, and Ended where a gradient that has to be there is not.
    """
    estimator = check_config(config)
    say(f"image and dL/dI, {plan.reference_spp} spp")
    pictures = take_pictures(config, plan.reference_spp, folder, masked=True)
    naive, ours = Kind("naive AD", plan.spp, "walk_ad"), Kind(estimator, plan.spp, OWN)
    result = Result(config, plan, "", pictures, naive, ours, Kind("prb", plan.spp, "prb"))
    for kind in result.kinds:
        say(f"{kind.label}: {plan.seeds} seeds")
        result.key = _taken(kind, plan.seeds, config, folder, f"figure5, {kind.by}")
    check(result)
    say(f"at naive AD's first seed: {', '.join(EXACT)}")
    for name in EXACT:
        kind = Kind(f"reslrb:{name}", plan.spp, name)
        _taken(kind, 1, config, folder, f"figure5, {naive.by}")
        result.comparisons[kind.name, naive.by] = compare_equal_seeds(kind.rows, naive.rows[:1], CLOSE)
    return result


def check(result: Result) -> None:
    """Compare our mean with the others' in the tiles of `gradcheck`, and make the z map of ours and naive AD's."""
    ours, naive, prb = result.ours, result.naive, result.prb
    assert ours.samples is not None
    assert naive.samples is not None
    shape = ours.samples.shape[1:]
    family = Family(2, 2 * entry_count(shape))
    for other in (naive, prb):
        result.comparisons[ours.name, other.name] = compare_expectations(
            ours.rows, other.rows, family, shape=shape, paired=False
        )
    side = max(-(-shape[1] // result.plan.tiles), 1)
    result.z = z_scores(tile_sums(ours.samples, side), tile_sums(naive.samples, side))


def tile_sums(samples: np.ndarray, side: int) -> np.ndarray:
    """Sums over squares of `side` texels and over channels of (N, H, W, C) samples: (N, rows, columns)."""
    gray = samples.astype(np.float64).sum(-1)
    rows = np.add.reduceat(gray, np.arange(0, gray.shape[1], side), axis=1)
    return np.asarray(np.add.reduceat(rows, np.arange(0, gray.shape[2], side), axis=2))


def _taken(kind: Kind, count: int, config: Config, folder: Path, series: str) -> str:
    key = sample(kind, count, config, folder, series)
    if kind.end is not None:
        raise kind.end
    return key
