"""Condition numbers of chains of Jacobians, where they are known."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from reslrb_cli.cli import main
from reslrb_cli.config.loader import load
from reslrb_cli.measure.conditioning import ChainConditions, measure_chains
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.problem import Problem

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
UNGUIDED = ["integrator.guiding=off", "integrator.sequence=independent"]
SMALL = ["scene.options={resx: 24, resy: 24}", "target.render.spp=16", "run.spp=16", *UNGUIDED]
#: Of glass against air, as the scene names them.
IOR = 1.5046 / 1.000277
pytestmark = pytest.mark.usefixtures("llvm")


def chains(name: str, *sets: str) -> list[ChainConditions]:
    return measure_chains(assemble(load(CONFIGS / name, [*SMALL, *sets])))


def test_parallel_light_that_enters_glass():
    """Directions change by 1 / n and places do not, so that the condition number is n."""
    [one] = chains("caustic_heightmap.yaml")
    assert one.vertices == 1
    assert one.paths > 10_000
    assert one.median == pytest.approx(IOR, rel=0.01)
    assert one.median <= one.percentile_99 <= one.largest < 1.1 * IOR


@pytest.mark.long
def test_two_faces_and_what_stands_still():
    """Of both faces of a lens, the second of which turns the directions back."""
    [two] = chains("lens_pose.yaml")
    assert two.vertices == 2
    assert two.largest > IOR
    assert chains("cornell_floor.yaml", "scene.options={resx: 16, resy: 16}") == []
    assert chains("caustic_heightmap.yaml", "integrator={type: ptracer, max_depth: 4}") == []


def test_they_are_shown(monkeypatch: pytest.MonkeyPatch):
    """Of the conditioning of parameters, which tests/cli/test_inspect.py looks at, nothing is measured here."""
    monkeypatch.setattr("reslrb_cli.measure.conditioning.measure_sensitivities", lambda problem, samples: [])
    measured: list[list[ChainConditions]] = []

    def once(problem: Problem) -> list[ChainConditions]:
        """As a table and as JSON the same measurement."""
        if not measured:
            measured.append(measure_chains(problem))
        return measured[0]

    monkeypatch.setattr("reslrb_cli.measure.conditioning.measure_chains", once)
    config = str(CONFIGS / "caustic_heightmap.yaml")
    arguments = ["inspect", config, "--no-counts", "--conditioning", "--samples", "2"]
    arguments += [word for each in SMALL for word in ("--set", each)]
    shown = CliRunner().invoke(main, arguments)
    assert shown.exit_code == 0, shown.output
    lines = shown.stdout.splitlines()
    assert "condition numbers" in lines[-3]
    assert lines[-2].split() == ["vertices", "paths", "median", "99", "%", "largest"]
    known = json.loads(CliRunner().invoke(main, [*arguments, "--json"]).stdout)["conditioning"]["chains"]
    assert [row["vertices"] for row in known] == [1]
    assert float(lines[-1].split()[-1]) == pytest.approx(known[0]["largest"], rel=0.01)
