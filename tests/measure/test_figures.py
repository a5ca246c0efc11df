"""Figures 1 and 5 of the paper: their checks see what they are to see."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from paper_figure1_measure import Plan, Result, check, measure
from paper_figure1_report import draw, table, to_json
from paper_figure5 import main
from paper_figure5_measure import CLOSE, tile_sums
from paper_figure5_measure import Plan as Plan_figure5
from paper_figure5_measure import Result as Result_figure5
from paper_figure5_measure import check as check_figure5
from paper_figure5_measure import measure as measure_figure5
from paper_figure5_report import draw as draw_figure5
from paper_figure5_report import table as table_figure5
from paper_figure5_report import to_json as to_json_figure5
from paper_kinds import OWN, Kind, sample
from paper_noise import fall, relative_noise
from paper_room import FLOOR, room_config

from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.comparison import Family, compare_equal_seeds, compare_expectations, entry_count
from reslrb_cli.measure.processes import Ended
from reslrb_cli.records.measurements import BenchStatus, Verdict

# Figure 1: its checks see what they are to see, its gradients agree, and its table says what came of it.

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "paper" / "figure1.yaml"
SMALL = [
    "scene.options={resx: 16, resy: 16, blur: 1.0}",
    "parameters=[{heightmap: {mesh: face, resolution: [8, 8]}}]",
    "target.render.spp=16",
]


@pytest.fixture(scope="module")
def config() -> Config:
    return load(CONFIG, SMALL)


def pretended(config: Config, *, naive_factor: float = 1.0, many_factor: float = 1.0, fits: bool = False) -> Result:
    """A result of normal noise around one gradient; `many_factor` is on the noise of many samples."""
    random, plan = np.random.default_rng(1), Plan(seeds=32, many_seeds=8)
    mean = random.normal(size=(16, 16, 1))

    def kind(spp: int, by: str, count: int, factor: float, noise: float) -> Kind:
        samples = factor * mean + noise * random.normal(size=(count, 16, 16, 1))
        name = "reslrb:stack" if by == OWN else "naive AD"
        return Kind(name, spp, by, samples.astype(np.float32), 10.0, 500.0)

    many = kind(1024, OWN, 8, 1.0, many_factor * 0.5 / np.sqrt(32))
    failing = Kind("naive AD", 1024, "ptracer", end=Ended(BenchStatus.OUT_OF_MEMORY, "jit_malloc(): out of memory"))
    if fits:
        failing = kind(1024, "ptracer", 1, 1.0, 0.1)
    image = np.random.default_rng(2).uniform(size=(16, 16, 3)).astype(np.float32)
    pictures = {"target": image, "initial": image, "adjoint": image}
    naive, ours = kind(32, "ptracer", 32, naive_factor, 0.5), kind(32, OWN, 32, 1.0, 0.5)
    result = Result(config, plan, "face.heightmap", pictures, naive, ours, many, failing, 6000.0)
    check(result)
    return result


def test_all_holds_where_it_does(config: Config) -> None:
    result = pretended(config)
    assert result.holds, table(result)
    assert len(result.comparisons) == 3


@pytest.mark.parametrize(("planted", "seen"), [(1.2, 2), (0.8, 2)])
def test_a_planted_difference_of_naive_ad_is_seen(config: Config, planted: float, seen: int) -> None:
    """In both comparisons with it, and not in that of ours with ours."""
    result = pretended(config, naive_factor=planted)
    verdicts = [figures.verdict for figures in result.comparisons.values()]
    assert verdicts.count(Verdict.FAILS) == seen
    assert verdicts[-1] is Verdict.HOLDS
    assert not result.holds


def test_noise_that_does_not_fall_is_seen(config: Config) -> None:
    result = pretended(config, many_factor=1.3)
    assert result.fall is not None
    assert result.fall.verdict is Verdict.FAILS
    assert not result.holds


def test_naive_ad_that_fits_is_seen(config: Config) -> None:
    result = pretended(config, fits=True)
    assert not result.does_not_fit
    assert not result.holds
    assert "fits under the limit: fails" in table(result)


def test_the_interval_covers_the_ratio() -> None:
    """95 of 100 times or so."""
    random, inside = np.random.default_rng(3), 0
    for _ in range(200):
        found = fall(random.normal(size=(16, 40)), random.normal(size=(8, 40)) / 4, 4.0)
        inside += found.low <= 4 <= found.high
    assert 0.9 <= inside / 200 <= 0.99


def test_a_ratio_of_few_samples_says_nothing() -> None:
    random = np.random.default_rng(4)
    assert fall(random.normal(size=(4, 5)), random.normal(size=(4, 5)), 1.0).verdict is Verdict.UNRESOLVED


def test_relative_noise_of_known_noise() -> None:
    samples = 3 + np.random.default_rng(5).normal(size=(400, 300))
    assert relative_noise(samples) == pytest.approx(1 / 3, rel=0.02)
    assert relative_noise(samples, np.full(300, 6.0)) == pytest.approx(1 / 6, rel=0.02)


def test_what_is_written(config: Config, tmp_path: Path) -> None:
    result = pretended(config)
    draw(result, tmp_path / "figure1.png")
    assert (tmp_path / "figure1.png").read_bytes().startswith(b"\x89PNG")
    written = json.loads(json.dumps(to_json(result), allow_nan=False))
    assert written["holds"] is True
    assert [one["status"] for one in written["gradients"]] == ["ok", "ok", "ok", "out_of_memory"]
    assert "about 5.9 GiB at 1024 spp" in table(result)


@pytest.mark.usefixtures("llvm")
@pytest.mark.long
def test_what_is_compared_has_one_expectation(config: Config) -> None:
    """Whatever of ours naive AD does not have is left out."""
    from paper_fixed_adjoint import Held, comparable

    y, x = np.mgrid[0:16, 0:16] / 16
    adjoint = np.repeat((np.sin(5 * x) * np.cos(4 * y) + 1.5)[:, :, None], 3, 2).astype(np.float32)

    def samples(config: Config, first: int) -> np.ndarray:
        held = Held(config, adjoint)
        return np.stack([held.gradient(first + k, 64).ravel() for k in range(16)]).astype(np.float64)

    options = comparable(config, OWN).integrator.options()
    assert (options["filter_normalization"], options["attached_sampling"]) == ("detached", "follow")
    ours, naive = samples(comparable(config, OWN), 100), samples(comparable(config, "ptracer"), 200)
    family = Family(1, entry_count((8, 8, 1)))
    figures = compare_expectations(ours, naive, family, shape=(8, 8, 1), paired=False)
    assert figures.verdict is Verdict.HOLDS, figures


@pytest.mark.usefixtures("llvm")
def test_a_process_ends_by_its_limit(tmp_path: Path) -> None:
    """It loads the scene, and has no room for the paths of a sample count that naive AD keeps."""
    np.save(tmp_path / "adjoint.npy", np.ones((16, 16, 3), np.float32))
    kind = Kind("naive AD", 2**16, "ptracer")
    assert sample(kind, 1, load(CONFIG, SMALL), tmp_path, "test", 3 << 29) == "face.heightmap"
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
def test_what_it_cannot_show_is_refused(tmp_path: Path, setting: str, key: str) -> None:
    with pytest.raises(ConfigError, match=key):
        measure(load(CONFIG, [setting]), Plan(), tmp_path, lambda line: None)


# Figure 5: its checks see what they are to see, and its experiment is made of the room that it is given.

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SMALL_ROOM = [
    "scene.options={resx: 24, resy: 24}",
    "target.render.spp=16",
    "integrator.estimator=reservoir",
    "run.spp=16",
]


@pytest.fixture(scope="module")
def config_of_room() -> Config:
    return load(CONFIGS / "cornell_floor.yaml", SMALL_ROOM)


def pretended_room(config: Config, naive_factor: float = 1.0, prb_factor: float = 1.0) -> Result_figure5:
    """A result of normal noise around one gradient, those of naive AD and `prb` so many times as large."""
    random = np.random.default_rng(1)
    mean = random.normal(1.0, 1.0, size=(16, 36, 3))

    def kind(name: str, by: str, factor: float) -> Kind:
        samples = factor * mean + 0.5 * random.normal(size=(16, *mean.shape))
        return Kind(name, 32, by, samples.astype(np.float32), 10.0)

    picture = random.uniform(size=(9, 16, 3)).astype(np.float32)
    pictures = {"target": picture, "initial": picture, "adjoint": picture}
    naive, ours = kind("naive AD", "walk_ad", naive_factor), kind("reslrb:reservoir", OWN, 1.0)
    prb = kind("prb", "prb", prb_factor)
    result = Result_figure5(config, Plan_figure5(seeds=16), "floor.reflectance.data", pictures, naive, ours, prb)
    check_figure5(result)
    return result


def test_what_agrees_holds(config_of_room: Config, tmp_path: Path) -> None:
    result = pretended_room(config_of_room)
    assert result.holds, table_figure5(result)
    assert result.z is not None
    assert result.z.shape == (8, 18)
    assert np.sqrt(np.mean(result.z**2)) == pytest.approx(1, abs=0.2)
    draw_figure5(result, tmp_path / "figure5.png")
    assert (tmp_path / "figure5.png").read_bytes().startswith(b"\x89PNG")
    written = json.loads(json.dumps(to_json_figure5(result), allow_nan=False))
    assert written["holds"] is True
    assert [one["gradient"] for one in written["gradients"]] == ["naive AD", "reslrb:reservoir", "prb"]


@pytest.mark.parametrize("of", [0, 1])
def test_a_planted_difference_is_seen(config_of_room: Config, of: int) -> None:
    result = pretended_room(config_of_room, *((1.1, 1.0), (1.0, 1.1))[of])
    verdicts = [figures.verdict for figures in result.comparisons.values()]
    assert verdicts == [Verdict.FAILS if index == of else Verdict.HOLDS for index in range(2)]
    assert not result.holds
    assert "fails" in table_figure5(result)


def test_what_is_not_the_same_at_equal_seeds_does_not_hold(config_of_room: Config) -> None:
    result = pretended_room(config_of_room)
    rows = result.ours.rows
    result.comparisons["stack", "walk_ad"] = compare_equal_seeds(rows * (1 + 2 * CLOSE), rows, CLOSE)
    assert not result.holds


def test_tiles_add_up() -> None:
    samples = np.arange(2 * 5 * 7 * 3, dtype=np.float32).reshape(2, 5, 7, 3)
    tiles = tile_sums(samples, 3)
    assert tiles.shape == (2, 2, 3)
    assert tiles[1, 0, 2] == samples[1, :3, 6:].sum()
    assert tiles.sum() == samples.sum()


@pytest.mark.long
@pytest.mark.usefixtures("llvm")
def test_of_a_small_box(config_of_room: Config, tmp_path: Path) -> None:
    result = measure_figure5(config_of_room, Plan_figure5(spp=16, reference_spp=256, seeds=16), tmp_path, print)
    print(table_figure5(result))
    assert list(result.comparisons)[1:] == [
        ("reslrb:reservoir", "prb"),
        ("reslrb:stack", "walk_ad"),
        ("reslrb:gather", "walk_ad"),
    ]
    assert result.holds, table_figure5(result)


def test_what_cannot_be_compared_is_refused(config_of_room: Config, tmp_path: Path) -> None:
    for wrong in ("integrator.estimator=auto", "integrator.max_depth=-1", "integrator.type=ptracer"):
        with pytest.raises(ConfigError, match=r"integrator\."):
            measure_figure5(load(CONFIGS / "cornell_floor.yaml", [wrong]), Plan_figure5(), tmp_path, print)


def test_the_room_is_not_changed(tmp_path: Path) -> None:
    room, folder = tmp_path / "room", tmp_path / "work"
    for made in (room / "models", room / "textures", folder):
        made.mkdir(parents=True)
    text = '<scene><string name="filename" value="textures/wood.jpg" /></scene>'
    (room / "scene.xml").write_text(text)
    config = room_config(room, folder, ["run.spp=8"])
    assert config.run.spp == 8
    assert config.parameters[0].key == FLOOR
    assert '<string name="format" value="variant" />' in (folder / "scene.xml").read_text()
    assert (room / "scene.xml").read_text() == text


@pytest.mark.parametrize("text", [None, "<scene></scene>"])
def test_what_is_no_room_is_said_in_one_line(
    text: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if text is not None:
        (tmp_path / "scene.xml").write_text(text)
    assert main([str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert str(tmp_path) in line
