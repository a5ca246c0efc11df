"""`convergence` on the scenes that come with their configurations: fixed seeds, and steps that no clock counts."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cli.tiny import write_experiment
from scipy import stats

from reslrb_cli.cli import main
from reslrb_cli.config.loader import load
from reslrb_cli.measure.convergence.statistics import GROUPS, Reference, Samples

pytestmark = [pytest.mark.usefixtures("llvm"), pytest.mark.long]
ROOT = Path(__file__).resolve().parents[2]
OURS = "reslrb:reservoir,reslrb:event,reslrb:gather,reslrb:stack"
#: Without roulette, which naive AD does not differentiate rightly.
PTRACER = "ptracer(rr_depth=1000000)"
#: Probability that all slopes of a scene are within their intervals, widened for their number.
CONFIDENCE = 0.99


def methods(folder: Path, scene: str, size: tuple[int, int], *args: str) -> list[dict]:
    """The lines of all methods, of a film of this size."""
    file = folder / "c.jsonl"
    film = [f"--set=scene.options.resx={size[0]}", f"--set=scene.options.resy={size[1]}"]
    with pytest.raises(SystemExit) as ended:
        main(["convergence", str(ROOT / f"configs/{scene}.yaml"), *film, *args, "--json", str(file)])
    assert not ended.value.code
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    for line in lines:
        if line["kind"] == "reference" and line["bias_z"] is not None:
            assert line["biased"] is not True, line
    return [line for line in lines if line["kind"] == "method"]


@pytest.mark.parametrize(
    ("scene", "size", "spp", "rounds", "cases"),
    [
        ("cornell_floor", (64, 64), 8, 32, f"{PTRACER},prb,{OURS}"),
        ("grey_room", (64, 48), 32, 24, f"prb,{OURS}"),
        ("caustic_slab", (64, 64), 16, 32, f"{PTRACER},{OURS}"),
    ],
)
def test_unbiased_methods(tmp_path: Path, scene: str, size: tuple[int, int], spp: int, rounds: int, cases: str) -> None:
    """Slopes are -1/2 within their intervals, and no method deviates from an independent one."""
    args = [f"--set=run.spp={spp}", "--integrators", cases, "--rounds", str(rounds)]
    found = methods(tmp_path, scene, size, *args)
    assert {line["label"] for line in found} == set(cases.split(","))
    keys = {line["parameter"] for line in found}
    count = len({line["label"] for line in found}) * max(len(keys) - 1, 1)
    # The intervals are of 95 %, by Student's t with as many degrees of freedom as there are groups of steps less one.
    for line in found:
        freedom = next(groups for steps, groups in GROUPS.items() if line["steps"] >= steps) - 1
        wider = stats.t.isf((1 - CONFIDENCE) / 2 / count, freedom) / stats.t.isf(0.025, freedom)
        assert line["biased"] is not True, line
        assert abs(line["bias_z"]) < line["bias_z_limit"], line
        slope = line["slope"]
        assert abs(slope["value"] + 0.5) < wider * (slope["high"] - slope["value"]), line
    assert {line["biased"] for line in found if line["parameter"] != "all"} == {False}


def test_what_correlated_samples_do_to_the_loss(tmp_path: Path) -> None:
    cases = ",".join(f"reslrb:stack(adjoint={adjoint})" for adjoint in ("correlated", "independent", "batched"))
    args = ["--objective", "loss", "--set=run.spp=4", "--integrators", cases, "--rounds", "32"]
    found = [line for line in methods(tmp_path, "cornell_floor", (64, 64), *args) if line["parameter"] == "all"]
    assert {line["adjoint"]: line["biased"] for line in found} == {
        "correlated": True,
        "independent": False,
        "batched": False,
    }


def test_the_intervals_cover_what_they_say_on_a_scene(tmp_path: Path) -> None:
    """200 repetitions with the noise of real steps; the truth is that of all steps together. No clock takes part."""
    from reslrb_cli.measure.convergence.setup import Sampler, survey
    from reslrb_cli.optimization.assemble import assemble_scene

    write_experiment(tmp_path)
    config = load(tmp_path / "tiny.yaml")
    _, arrays = survey(assemble_scene(config), "fixed", camera=False, named=False, budget_s=None)
    sampler = Sampler(config, "known", arrays)
    repetitions, steps, rows, per_row = 200, 24, 12, 4
    taken = steps + rows * per_row
    pool = np.stack([sampler.step(seed, 16, 0)[0] for seed in range(repetitions * taken)]).astype(np.float64)
    everything = Reference(pool)
    truth = everything.signal / pool.var(0, ddof=1).sum()
    covered = {"efficiency": 0, "slope": 0}
    for part in pool.reshape(repetitions, taken, -1):
        reference = Reference(part[steps:].reshape(rows, per_row, -1).mean(1))
        samples = Samples(part[:steps], np.arange(steps) // 2, np.ones(steps // 2), reference)
        efficiency, slope = samples.efficiency(), samples.slope()
        assert efficiency is not None
        assert slope is not None
        covered["efficiency"] += efficiency.exponential().low <= truth <= efficiency.exponential().high
        covered["slope"] += slope.interval().low <= -0.5 <= slope.interval().high
    least, most = (stats.binom.ppf(p, repetitions, 0.95) for p in (0.0005, 0.9995))
    print(covered)
    assert all(least <= count <= most for count in covered.values()), covered
