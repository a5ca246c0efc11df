"""Figure 5: its checks see what they are to see, and its experiment is made of the room that it is given."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from paper_figure5 import main
from paper_figure5_measure import CLOSE, Plan, Result, check, measure, tile_sums
from paper_figure5_report import draw, table, to_json
from paper_kinds import OWN, Kind
from paper_room import FLOOR, room_config

from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.comparison import compare_equal_seeds
from reslrb_cli.records.measurements import Verdict

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SMALL = ["scene.options={resx: 24, resy: 24}", "target.render.spp=16", "integrator.estimator=reservoir", "run.spp=16"]


@pytest.fixture(scope="module")
def config() -> Config:
    return load(CONFIGS / "cornell_floor.yaml", SMALL)


def pretended(config: Config, naive_factor: float = 1.0, prb_factor: float = 1.0) -> Result:
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
    result = Result(config, Plan(seeds=16), "floor.reflectance.data", pictures, naive, ours, prb)
    check(result)
    return result


def test_what_agrees_holds(config: Config, tmp_path: Path) -> None:
    result = pretended(config)
    assert result.holds, table(result)
    assert result.z is not None
    assert result.z.shape == (8, 18)
    assert np.sqrt(np.mean(result.z**2)) == pytest.approx(1, abs=0.2)
    draw(result, tmp_path / "figure5.png")
    assert (tmp_path / "figure5.png").read_bytes().startswith(b"\x89PNG")
    written = json.loads(json.dumps(to_json(result), allow_nan=False))
    assert written["holds"] is True
    assert [one["gradient"] for one in written["gradients"]] == ["naive AD", "reslrb:reservoir", "prb"]


@pytest.mark.parametrize("of", [0, 1])
def test_a_planted_difference_is_seen(config: Config, of: int) -> None:
    result = pretended(config, *((1.1, 1.0), (1.0, 1.1))[of])
    verdicts = [figures.verdict for figures in result.comparisons.values()]
    assert verdicts == [Verdict.FAILS if index == of else Verdict.HOLDS for index in range(2)]
    assert not result.holds
    assert "fails" in table(result)


def test_what_is_not_the_same_at_equal_seeds_does_not_hold(config: Config) -> None:
    result = pretended(config)
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
def test_of_a_small_box(config: Config, tmp_path: Path) -> None:
    result = measure(config, Plan(spp=16, reference_spp=256, seeds=16), tmp_path, print)
    print(table(result))
    assert list(result.comparisons)[1:] == [
        ("reslrb:reservoir", "prb"),
        ("reslrb:stack", "walk_ad"),
        ("reslrb:gather", "walk_ad"),
    ]
    assert result.holds, table(result)


def test_what_cannot_be_compared_is_refused(config: Config, tmp_path: Path) -> None:
    for wrong in ("integrator.estimator=auto", "integrator.max_depth=-1", "integrator.type=ptracer"):
        with pytest.raises(ConfigError, match=r"integrator\."):
            measure(load(CONFIGS / "cornell_floor.yaml", [wrong]), Plan(), tmp_path, print)


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
