"""`reslrb inspect` shows what a step is planned to do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from reslrb_cli.cli import main

pytestmark = pytest.mark.usefixtures("llvm")

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "cornell_floor.yaml"
TINY = ["--set", "scene.options={resx: 16, resy: 16}", "--set", "integrator.max_depth=4"]


def inspect(*arguments: str) -> str:
    """What the command prints."""
    result = CliRunner().invoke(main, ["inspect", str(CONFIG), *TINY, *arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


def plan_lines(text: str) -> list[str]:
    """The lines below `plan`."""
    lines = text.splitlines()
    return lines[lines.index("plan") + 1 : lines.index("parameters")]


def test_plan_lists_what_is_needed_and_what_is_left_out():
    lines = plan_lines(inspect("--no-counts"))
    assert any(line.split()[:3] == ["needed", "derivatives", "of"] for line in lines)
    assert any("left out" in line and "delta lobes" in line for line in lines)
    assert not any(word.isdigit() for line in lines for word in line.split()), "counts were asked not to be made"


def test_counts_come_in_columns():
    lines = plan_lines(inspect("--set", "integrator.estimator=stack"))
    assert "estimator stack" in lines[0]
    assert lines[1].split() == ["with", "without"]
    [row] = [line for line in lines if "visible emitters" in line]
    assert row.index(row.split()[3]) + len(row.split()[3]) == lines[1].index("with") + len("with")


def test_plan_as_json():
    plan = json.loads(inspect("--json", "--no-counts"))["plan"]
    rows = {row["feature"]: row for row in plan["rows"]}
    assert rows["derivatives of BSDFs"]["needed"]
    assert not rows["null surfaces"]["needed"]
    assert plan["kernels"] is None


def test_without_a_plan_the_reason_is_given():
    [line] = plan_lines(inspect("--set", "integrator.type=ptracer"))
    assert "none" in line
    assert "ptracer" in line
    [line] = plan_lines(inspect("--set", "parameters=[{key: no.such.key}]"))
    assert "parameters[0].key" in line


STIFF = Path(__file__).resolve().parents[2] / "configs" / "stiff" / "lamp.yaml"


def conditioning(*arguments: str) -> str:
    """What `inspect --conditioning` prints of the stiff lamp, small."""
    small = ["scene.options={resx: 12, resy: 12}", "integrator={max_depth: 2}", "run.spp=32", "target.render.spp=64"]
    sets = [word for each in small for word in ("--set", each)]
    result = CliRunner().invoke(main, ["inspect", str(STIFF), "--no-counts", "--conditioning", *sets, *arguments])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_conditioning_as_a_table_and_as_json():
    lines = conditioning("--samples", "3").splitlines()
    assert lines[-4].split() == [
        "parameter",
        "entries",
        "value",
        "gradient",
        "noise",
        "image",
        "/",
        "unit",
        "curvature",
        "length",
    ]
    assert lines[-5] == "conditioning (3 gradients of 32 spp, seed 0)"
    measured = json.loads(conditioning("--samples", "3", "--json"))["conditioning"]
    floor, lamp = measured["parameters"]
    for row, line in ((floor, lines[-3]), (lamp, lines[-2])):
        cells = line.split()
        assert cells[:2] == [row["key"], "3"]
        names = ("value", "gradient", "noise", "change", "curvature", "length")
        assert [float(cell) for cell in cells[2:]] == pytest.approx([row[name] for name in names], rel=6e-3)
    # an albedo of 0.5 and an intensity of 3e6: by their values alone, some 6e6
    assert 1e6 < measured["spread"]["change"] < 1e8
    assert measured["spread"]["change"] == pytest.approx(floor["change"] / lamp["change"])
    assert float(lines[-1].split()[4]) == pytest.approx(measured["spread"]["change"], rel=6e-3)
    # of l2 the curvature is that of the image: both go with the same mean square
    assert measured["spread"]["curvature"] == pytest.approx(measured["spread"]["change"] ** 2, rel=0.01)


def test_a_spread_needs_two():
    from reslrb_cli.measure.conditioning import Conditioning
    from reslrb_cli.optimization.sensitivity import Sensitivity

    rows = [Sensitivity("a", 1, 1.0, 2.0, 0.1, change=4.0), Sensitivity("b", 1, 1.0, 0.0, 0.1)]
    assert Conditioning(rows, 2, 1, 0).spread("change") is None
    assert Conditioning(rows, 2, 1, 0).spread("gradient") is None
    rows.append(Sensitivity("c", 1, 1.0, 1e-3, 0.1, change=8.0))
    assert Conditioning(rows, 2, 1, 0).spread("change") == 2.0
    assert Conditioning(rows, 2, 1, 0).spread("gradient") == pytest.approx(2e3)


def test_samples_belong_to_conditioning():
    result = CliRunner().invoke(main, ["inspect", str(STIFF), "--samples", "4"])
    assert result.exit_code == 2
    assert "--conditioning" in result.output
