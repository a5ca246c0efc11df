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
