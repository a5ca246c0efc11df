"""`reslrb gradcheck` from the command line, on a scene of 24x24 pixels."""

from __future__ import annotations

import itertools
import os
import re
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from cli.tiny import ended, measured

from reslrb_cli.cli import gradcheck, terminal
from reslrb_cli.records.measurements import GradcheckRecord, Kind, Reference, Verdict

pytestmark = pytest.mark.usefixtures("llvm")

SMALL = [
    argument
    for setting in ("scene.options.size=24", "scene.options.texture=4", "run.spp=4", "integrator.max_depth=3")
    for argument in ("--set", setting)
]
KEY = "white.reflectance.data"
KEYS = ["case", "parameter", "label", "options", "reference", "kind", "seeds", "verdict", "relative_l2",
        "relative_l2_limit", "z_rms", "z_rms_limit", "z_max", "z_max_limit", "cosine", "variance_ratio", "detectable",
        "message", "holds"]  # fmt: skip


call = partial(ended, "gradcheck")


@pytest.mark.long
def test_a_table_and_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    json_file = tmp_path / "a.jsonl"
    both = "reslrb:stack,reslrb:event(capacity=2)"
    assert call(*SMALL, "--seeds", "8", "--integrators", both, "--json", str(json_file)) == 0
    rows = measured(json_file)
    assert [list(row) for row in rows] == [KEYS] * 9
    assert [(row["parameter"], row["label"], row["reference"], row["kind"]) for row in rows] == [
        (None, "reslrb", "ptracer", "image"),
        *(
            (KEY, *pair, "equal_seeds" if pair == ("reslrb:stack", "walk_ad") else "expectation")
            for group in (("finite_difference", "forward_mode"), ("walk_ad", "ptracer"))
            for pair in itertools.product(both.split(","), group)
        ),
    ]
    assert all(row["holds"] is True and row["seeds"] == 8 for row in rows)
    lines = capsys.readouterr().out.splitlines()
    assert lines[1] == "the built-in Cornell box, film 24x24, 4 spp (2304 paths a seed), max_depth 3, no roulette"
    head = next(line for line in lines[2:] if " seeds, " not in line)
    assert head.split()[:3] == ["parameter", "integrator", "reference"]
    assert lines[-1] == "9 of 9 comparisons hold, 0 fail"


def test_failures_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from reslrb_cli.estimators import stack

    right = stack.pass_vertex
    monkeypatch.setattr(stack, "pass_vertex", lambda *arguments: right(*arguments[:-1], arguments[-1] * 1.5))
    json_file = tmp_path / "a.jsonl"
    assert call(*SMALL, "--seeds", "8", "--integrators", "reslrb:stack,reslrb:gather", "--json", str(json_file)) == 1
    rows = measured(json_file)
    assert all(list(row) == KEYS for row in rows)
    assert {row["label"] for row in rows if row["holds"] is False} == {"reslrb:stack"}
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAILS: ")]
    assert len(lines) == 4
    where = "FAILS: the built-in Cornell box: white.reflectance.data: reslrb:stack against walk_ad, equal seeds: "
    assert re.fullmatch(where + r"relative L2 0\.\d+, limit 0\.0001", lines[2])


@pytest.mark.long
def test_a_case_of_the_suite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    json_file = tmp_path / "a.jsonl"
    words = ["--integrators", "reslrb:stack", "--json", str(json_file)]
    assert call("--suite", "extreme:furnace", *words) == 0
    rows = measured(json_file)
    assert {(row["case"], row["label"], row["holds"]) for row in rows} == {("furnace", "reslrb:stack", True)}
    assert "analytic" in {row["reference"] for row in rows}
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("furnace ")
    assert lines[1].endswith("holds")
    assert lines[-1] == f"{len(rows)} of {len(rows)} comparisons hold, 0 fail"
    assert call("--suite", "extreme:furnac") == 2
    assert "there is no case `furnac`; did you mean `furnace`?" in capsys.readouterr().err


def test_a_stopped_suite_keeps_finished_cases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from reslrb_cli.measure import extreme

    row = {"parameter": None, "label": "reslrb:stack", "options": {}, "reference": Reference.ANALYTIC,
           "kind": Kind.EXPECTATION, "seeds": 3, "verdict": Verdict.HOLDS}  # fmt: skip

    def pretended(name: str, *_others: object) -> Iterator[GradcheckRecord]:
        yield GradcheckRecord(case=name, **row)
        if name == "stopped":
            os.kill(os.getpid(), signal.SIGINT)
        yield GradcheckRecord(case=name, **row)

    monkeypatch.setattr(extreme, "run_case", pretended)
    monkeypatch.setattr(extreme, "CASES", {name: name for name in ("first", "stopped", "last")})
    file = tmp_path / "a.jsonl"
    assert call("--suite", "extreme", "--json", str(file)) == 130
    assert [row["case"] for row in measured(file)] == ["first"] * 2


def test_a_tag_selects_its_cases(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from reslrb_cli.measure import extreme
    from reslrb_cli.measure.scenes.catalogue import TAGGED

    taken: list[str] = []
    monkeypatch.setattr(extreme, "run_case", lambda case, *_: taken.append(case.name) or iter(()))
    assert gradcheck.SUITES == ("extreme", *TAGGED)
    names = [case.name for case in TAGGED["glass"]]
    assert call("--suite", "glass") == call("--suite", f"glass:{names[2]},{names[0]}") == 0
    assert taken == [*names, names[2], names[0]]
    assert call("--suite", "glass:furnace") == 2
    assert "there is no case `furnace`" in capsys.readouterr().err


def test_ctrl_c_prints_finished_comparisons(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(line: object) -> None:
        if str(line).startswith("1 of 8 seeds"):
            os.kill(os.getpid(), signal.SIGINT)
        terminal.echo(line)

    monkeypatch.setattr("reslrb_cli.cli.gradcheck.echo", interrupt)
    assert call(*SMALL, "--seeds", "8", "--integrators", "reslrb:stack") == 130
    *_, last = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"open: .* 1 of 8 seeds are too few .*", last)
