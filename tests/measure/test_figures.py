"""Figures 1 and 5 of the paper. The tests show that the figures' checks detect planted faults."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from make_figures import write_panels

from paper import figure1, figure5
from paper.figures import main
from paper.gradients import OWN, Kind, Sampling, comparable, fall, relative_noise
from paper.page import FIGURES
from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.comparison import Family, compare_expectations, entry_count
from reslrb_cli.measure.methods import NEVER
from reslrb_cli.measure.processes import Ended
from reslrb_cli.records.measurements import BenchStatus, Verdict

# Figure 1: its checks detect what they should, its gradients agree, and its table reports the results.

SMALL = [
    "scene.options={resx: 16, resy: 16, blur: 1.0}",
    "parameters=[{heightmap: {mesh: face, resolution: [8, 8]}}]",
    "target.render.spp=16",
]
ORIGIN = {"device": "a machine", "variant": "llvm_ad_rgb", "command": ["scripts/paper"], "commit": "0" * 12}


@pytest.fixture(scope="module")
def config() -> Config:
    return load(figure1.CONFIG, SMALL)


def pretended(*, naive_factor: float = 1.0, many_factor: float = 1.0, fits: bool = False) -> list[Kind]:
    """Return kinds with normal noise around one gradient. `many_factor` scales the noise of the kind with many
    samples.
    """
    random, mean = np.random.default_rng(1), np.random.default_rng(2).normal(size=(16, 16, 1))

    def kind(spp: int, by: str, count: int, factor: float, noise: float) -> Kind:
        samples = factor * mean + noise * random.normal(size=(count, 16, 16, 1))
        name = "reslrb:stack" if by == OWN else "naive AD"
        return Kind(name, spp, by, samples.astype(np.float32), 10.0)

    many = kind(1024, OWN, 8, 1.0, many_factor * 0.5 / np.sqrt(32))
    failing = Kind("naive AD", 1024, "ptracer", end=Ended(BenchStatus.OUT_OF_MEMORY, "jit_malloc(): out of memory"))
    if fits:
        failing = kind(1024, "ptracer", 1, 1.0, 0.1)
    return [kind(32, "ptracer", 32, naive_factor, 0.5), kind(32, OWN, 32, 1.0, 0.5), many, failing]


def judged(kinds: list[Kind]) -> dict[str, Any]:
    """Return the record of figure 1 as its file contains it."""
    record = {"origin": ORIGIN} | figure1.judge(figure1.Plan(), kinds, 6000.0)
    return json.loads(json.dumps(record, allow_nan=False))


def test_a_correct_result_holds() -> None:
    record = judged(pretended())
    assert record["holds"], record
    assert len(record["comparisons"]) == 3


@pytest.mark.parametrize("planted", [1.2, 0.8])
def test_a_planted_difference_from_naive_ad_is_found(planted: float) -> None:
    """Both comparisons with naive AD fail, and the comparison between our two sample counts holds."""
    record = judged(pretended(naive_factor=planted))
    assert [row["verdict"] for row in record["comparisons"]] == ["fails", "fails", "holds"]
    assert not record["holds"]


def test_noise_that_does_not_fall_is_found() -> None:
    record = judged(pretended(many_factor=1.3))
    assert record["noise"]["verdict"] == "fails"
    assert not record["holds"]


def test_naive_ad_that_fits_is_found() -> None:
    assert not judged(pretended(fits=True))["holds"]


def test_the_interval_has_its_coverage() -> None:
    """About 95 of 100 intervals cover the truth."""
    random, inside = np.random.default_rng(3), 0
    for _ in range(200):
        found = fall(random.normal(size=(16, 40)), random.normal(size=(8, 40)) / 4, 4.0)
        inside += found["low"] <= 4 <= found["high"]
    assert 0.9 <= inside / 200 <= 0.99


def test_a_ratio_of_few_samples_is_undecided() -> None:
    random = np.random.default_rng(4)
    assert fall(random.normal(size=(4, 5)), random.normal(size=(4, 5)), 1.0)["verdict"] is Verdict.UNRESOLVED


def test_relative_noise_of_known_noise() -> None:
    samples = 3 + np.random.default_rng(5).normal(size=(400, 300))
    assert relative_noise(samples, samples.mean(0)) == pytest.approx(1 / 3, rel=0.02)
    assert relative_noise(samples, np.full(300, 6.0)) == pytest.approx(1 / 6, rel=0.02)


def test_written_files(tmp_path: Path) -> None:
    kinds, image = pretended(), np.random.default_rng(2).uniform(size=(16, 16, 3)).astype(np.float32)
    panels = figure1.panels(image, image, kinds, figure1.Plan.limit)
    assert [title for title, _ in panels[0]][2] == "naive AD, 1024 spp: over 2 GiB"
    write_panels(panels, tmp_path / "figure1.png")
    assert (tmp_path / "figure1.png").read_bytes().startswith(b"\x89PNG")
    said = FIGURES["figure1"](judged(kinds))
    assert "| naive AD | 1024 | | | out of memory |" in said
    assert "about 5.9 GiB at 1024 spp" in said


@pytest.mark.parametrize("by", [OWN, "stack", "walk_ad", "ptracer", "prb"])
def test_compared_methods_differ_in_no_more_than_the_estimator(config: Config, by: str) -> None:
    changed, own = comparable(config, by), config.integrator.options()
    options = changed.integrator.options()
    assert options["rr_depth"] == NEVER
    assert all(options[name] == own[name] for name in ("max_depth", "hide_emitters"))
    assert changed.integrator.type == (by if by in ("walk_ad", "ptracer", "prb") else "reslrb")
    if changed.integrator.type in ("reslrb", "walk_ad"):
        assert options["filter_normalization"] == "detached"
    if changed.integrator.type == "reslrb":
        assert options["attached_sampling"] == "follow"
        assert options["estimator"] == (own["estimator"] if by == OWN else by)


@pytest.mark.long
def test_compared_methods_have_one_expectation(config: Config) -> None:
    """The comparison disables every part of our method that naive AD lacks."""
    y, x = np.mgrid[0:16, 0:16] / 16
    adjoint = np.repeat((np.sin(5 * x) * np.cos(4 * y) + 1.5)[:, :, None], 3, 2).astype(np.float32)
    made = Sampling(config, 16, print)
    made.arrays["adjoints"] = adjoint[None]
    kinds = [made.take(Kind(by, 64, by), 16, by) for by in (OWN, "ptracer")]
    assert [np.shape(kind.samples) for kind in kinds] == [(16, 8, 8, 1)] * 2
    ours, naive = (kind.rows for kind in kinds)
    family = Family(1, entry_count((8, 8, 1)))
    figures = compare_expectations(ours, naive, family, shape=(8, 8, 1), paired=False)
    assert figures.verdict is Verdict.HOLDS, figures


@pytest.mark.long
def test_a_process_ends_at_its_limit() -> None:
    """The process loads the scene, but its memory limit is too small for the paths that naive AD stores at this sample
    count.
    """
    made = Sampling(load(figure1.CONFIG, SMALL), 16, print, limit=3 << 29)
    kind = made.take(Kind("naive AD", 2**16, "ptracer"), 1, "test", may_end=True)
    assert kind.end is not None
    assert kind.end.status is BenchStatus.OUT_OF_MEMORY
    assert kind.samples is None


@pytest.mark.parametrize(
    ("setting", "key"),
    [
        ("variant=cuda_ad_rgb", "variant"),
        ("integrator.estimator=auto", "integrator.estimator"),
        ("integrator={type: prb}", "integrator.estimator"),
        ("integrator.max_depth=-1", "integrator.max_depth"),
        ("parameters=[{key: face.vertex_positions}]", "parameters"),
    ],
)
def test_unsupported_figures_are_refused(setting: str, key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        figure1.measure(load(figure1.CONFIG, [setting]), figure1.Plan(), lambda line: None)


# Figure 5: its checks detect what they should, and its experiment uses the given room.

BOX = figure1.CONFIG.parents[1] / "cornell_floor.yaml"
SMALL_ROOM = [
    "scene.options={resx: 24, resy: 24}",
    "target.render.spp=16",
    "integrator.estimator=reservoir",
    "run.spp=16",
]


def pretended_room(naive_factor: float = 1.0, prb_factor: float = 1.0) -> list[Kind]:
    """Return kinds with normal noise around one gradient. The factors scale the gradients of naive AD and `prb`."""
    random = np.random.default_rng(1)
    mean = random.normal(1.0, 1.0, size=(16, 36, 3))

    def kind(name: str, by: str, factor: float) -> Kind:
        samples = factor * mean + 0.5 * random.normal(size=(16, *mean.shape))
        return Kind(name, 32, by, samples.astype(np.float32), 10.0)

    return [
        kind("naive AD", "walk_ad", naive_factor),
        kind("reslrb:reservoir", OWN, 1.0),
        kind("prb", "prb", prb_factor),
    ]


def test_agreement_holds(tmp_path: Path) -> None:
    kinds = pretended_room()
    record = figure5.judge(kinds, [])
    assert record["holds"], record
    z = figure5.z_map(*kinds[:2])
    assert z.shape == (16, 36)
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=0.2)
    write_panels(figure5.panels(np.ones((9, 16, 3)), kinds), tmp_path / "figure5.png")
    assert (tmp_path / "figure5.png").read_bytes().startswith(b"\x89PNG")
    plan = {"origin": ORIGIN, "plan": {"spp": 32}, "film": [16, 9], "max_depth": 32, "left_out": 0.25}
    said = FIGURES["figure5"](json.loads(json.dumps(plan | record, allow_nan=False)))
    assert "The film has 16x9 pixels, and the paths have length 32. dL/dI is 0 in 25.0% of the pixels." in said
    assert "| reslrb:reservoir, 32 spp - prb, 32 spp |" in said


@pytest.mark.parametrize("of", [0, 1])
def test_a_planted_difference_is_found(of: int) -> None:
    record = figure5.judge(pretended_room(*((1.1, 1.0), (1.0, 1.1))[of]), [])
    verdicts = [row["verdict"] for row in record["comparisons"]]
    assert verdicts == [Verdict.FAILS if index == of else Verdict.HOLDS for index in range(2)]
    assert not record["holds"]


def test_a_difference_at_equal_seeds_fails() -> None:
    kinds = pretended_room()
    assert kinds[0].samples is not None
    exact = Kind("reslrb:stack", 32, "stack", kinds[0].samples[:1] * (1 + 2 * figure5.CLOSE))
    assert not figure5.judge(kinds, [exact])["holds"]


@pytest.mark.long
def test_a_small_box() -> None:
    plan = figure5.Plan(spp=16, reference_spp=256, seeds=16)
    record, _ = figure5.measure(load(BOX, SMALL_ROOM), plan, print)
    assert [row["gradient"] for row in record["comparisons"][2:]] == ["reslrb:stack, 16 spp", "reslrb:gather, 16 spp"]
    assert record["holds"], record


def test_invalid_comparisons_are_refused() -> None:
    for wrong in ("integrator.estimator=auto", "integrator.max_depth=-1", "integrator.type=ptracer"):
        with pytest.raises(ConfigError, match=r"integrator\."):
            figure5.measure(load(BOX, [wrong]), figure5.Plan(), print)


@pytest.mark.parametrize("text", [None, "<scene version='3.0.0'></scene>"])
def test_too_little_memory_is_one_line(text: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if text is not None:
        (tmp_path / "scene.xml").write_text(text)
    assert main(["figure5", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("figure5: ")
    assert str(tmp_path) in line
