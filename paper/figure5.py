"""Figure 5: the gradient of an image's loss with respect to the floor of the Grey & White Room, paths of length 32.

The figure shows gradients by naive AD and by our estimator at 32 spp, and the z map of their means. dL/dI is 0 where
light paths find less light than camera paths. These are the pixels where the sensor sees glass, mirrors or coats, and
the film's border.

Naive AD differentiates our own walk. Stock `ptracer` emits wrongly from the room's environment map, because the map is
rotated. The experiment's own estimator is compared at other seeds with naive AD and with `prb`, which shares no code
with ours. The exact estimators are compared with naive AD at equal seeds.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from make_figures import encode

from paper.gradients import OWN, Kind, Sampling, colored, compare, compared
from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config
from reslrb_cli.measure.comparison import Deviation, compare_equal_seeds, parts
from reslrb_cli.records.measurements import Verdict
from reslrb_cli.report.tonemap import signed_end

CONFIG = Path(__file__).resolve().parent / "room.yaml"
#: Estimators that equal naive AD of the same paths but for rounding, and the limit of their relative L2 distance.
EXACT, CLOSE = ("stack", "gather"), 1e-4
#: Tiles of the z map along each side, and the standard errors at the end of its colour scale.
TILES, FAR = 32, 5.0


@dataclass(frozen=True)
class Plan:
    """Seeds, and samples per pixel of a gradient and of the image for dL/dI."""

    spp: int = 32
    reference_spp: int = 1024
    seeds: int = 24


def room_settings(room: Path) -> list[str]:
    """Return the settings that make `room.yaml` use the room in this folder."""
    file = room if room.suffix == ".xml" else room / "scene.xml"
    return [f"scene.file={json.dumps(str(file.resolve()))}"]


def plan(sets: list[str], seeds: int, room: Path) -> tuple[Config, Plan]:
    """Return the experiment and its plan."""
    config = load(CONFIG, [*room_settings(room), *sets])
    return config, Plan(spp=config.run.spp, seeds=seeds)


def measure(config: Config, plan: Plan, say: Callable[[str], None]) -> tuple[dict[str, Any], Any]:
    """Sample and check all gradients. Return the record, and the rows of panels of the picture.

    Raises ConfigError, `processes.CannotStart`, and Ended if a gradient is missing.
    """
    made = Sampling(config, plan.reference_spp, say, masked=True)
    sampled = {"naive AD": "walk_ad", made.own: OWN, "prb": "prb"}
    kinds = [made.take(Kind(name, plan.spp, by), plan.seeds, f"figure5, {by}") for name, by in sampled.items()]
    exact = [made.take(Kind(f"reslrb:{name}", plan.spp, name), 1, "figure5, walk_ad") for name in EXACT]
    [adjoint] = made.arrays["adjoints"]
    height, width, _ = adjoint.shape
    found = {"plan": asdict(plan), "film": [width, height], "max_depth": config.integrator.max_depth,
             "left_out": float(np.mean(~adjoint.any(-1)))}  # fmt: skip
    return found | judge(kinds, exact), panels(made.initial, kinds)


def judge(kinds: list[Kind], exact: list[Kind]) -> dict[str, Any]:
    """Return the gradients and comparisons of the record, and whether all comparisons hold (`holds`)."""
    naive, ours, prb = kinds
    comparisons = compare([(ours, naive), (ours, prb)])
    comparisons += [compared(kind, naive, compare_equal_seeds(kind.rows, naive.rows[:1], CLOSE)) for kind in exact]
    mean = (naive.rows.mean(0) + ours.rows.mean(0)) / 2
    return {"gradients": [kind.record(mean) for kind in kinds], "comparisons": comparisons,
            "holds": all(row["verdict"] is Verdict.HOLDS for row in comparisons)}  # fmt: skip


def z_map(naive: Kind, ours: Kind) -> np.ndarray:
    """Return the z scores of the means of tiles, as an array (H, W) of the gradient's size. Channels are summed
    first.
    """
    height, width, channels = shape = np.shape(ours.samples)[1:]
    down, across = min(TILES, height), min(TILES, width)
    sums = [parts(kind.rows, shape, TILES).reshape(-1, down, across, channels).sum(-1) for kind in (ours, naive)]
    rows, columns = np.arange(height) * down // height, np.arange(width) * across // width
    return np.asarray(Deviation.of(*sums, 1e-5).z()[np.ix_(rows, columns)])


def panels(image: np.ndarray, kinds: list[Kind]) -> list[list[tuple[str, np.ndarray]]]:
    """Return the panels of the picture: the room, the z map, and gradients by naive AD and by our estimator from one
    seed.
    """
    naive, ours, _ = kinds
    shape, white = np.shape(naive.samples)[1:], float(np.quantile(image, 0.9)) or 1.0
    first = {kind.label: kind.rows[0].reshape(shape).sum(-1) for kind in (naive, ours)}
    end, z = signed_end(first[naive.label]), z_map(naive, ours)
    gradients = [(f"dL/d floor by {name}", colored(gradient, end)) for name, gradient in first.items()]
    means = f"z of their means, {len(ours.rows)} seeds each: rms {np.sqrt(np.mean(z**2)):.2f}"
    return [[("the room", encode(image / white)), (means, colored(z, FAR))], gradients]
