"""What `bench --sweep` varies: samples, and sizes of film and textures; with processes that only pretend."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from measure.pretended import Pretended
from measure.test_bench_sweep import CONFIG, LIST

from reslrb_cli.cli import main
from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.bench import Result, bench
from reslrb_cli.measure.methods import Sweep, choose_baseline, parse_cases, usual_values
from reslrb_cli.records.measurements import BenchStatus
from reslrb_cli.report.plots import plot_bench
from reslrb_cli.report.tables import table_head, table_line


class Sized(Pretended):
    """Costs as many milliseconds as it has samples, pixels and texels; at the first depth that is asked for."""

    firsts: list[dict[str, Any]] = []  # noqa: RUF012 (shared by all)

    def __init__(self, first: dict[str, Any]) -> None:
        super().__init__(first)
        self.first, self.spp = first, loads(first["config"], "x.yaml").run.spp
        Sized.firsts.append(first)

    def answer(self, stop: Any) -> dict[str, Any]:
        answer = super().answer(stop)
        width, texture = self.first.get("film_width", 6), self.first.get("texture_width", 3)
        if "width" in answer:
            return {"width": width, "height": width - 1, "texels": texture**2}
        return answer | {"step_ms": float(self.spp * width * texture)}


@pytest.fixture(autouse=True)
def _clean() -> None:
    Pretended.log, Pretended.ends, Pretended.refusing, Pretended.alive, Sized.firsts = [], {}, set(), 0, []


def run(swept: str, values: list[int], **changes: Any) -> tuple[list[Result], list[str]]:
    cases, said = parse_cases(LIST, deep=False), list[str]()
    settings: dict[str, Any] = {
        "config": loads(CONFIG, Path("x.yaml"), ["integrator.max_depth=5"]), "variant": "llvm_ad_rgb", "cases": cases,
        "baseline": choose_baseline(cases, None), "values": values, "objective": "fixed", "memory_limit": None,
        "memory": 2**40, "budget_s": 0.0, "rounds": 3, "swept": swept,
    }  # fmt: skip
    what = Sweep(**(settings | changes))
    what.check()
    rows = [row for some in bench(what, lambda: False, said.append, Sized) for row in some]
    assert Pretended.alive == 0
    return rows, said


@pytest.mark.parametrize(
    ("swept", "expected"),
    [
        ("spp", [(2, 5, 6, 9, 36.0), (8, 5, 6, 9, 144.0)]),
        ("film", [(4, 5, 2, 9, 24.0), (4, 5, 8, 9, 96.0)]),
        ("texture", [(4, 5, 6, 4, 48.0), (4, 5, 6, 64, 192.0)]),
    ],
)
def test_one_thing_is_varied_and_all_else_is_as_it_was(swept: str, expected: list[tuple[Any, ...]]) -> None:
    rows, said = run(swept, [2, 8])
    assert said == []
    assert [row.value for row in rows] == [2] * 3 + [8] * 3
    of_one = [row.record for row in rows if row.case.type == "walk_ad"]
    assert [(r.spp, r.max_depth, r.width, r.texels, r.step_ms and r.step_ms.median) for r in of_one] == expected
    names = {"spp": set(), "film": {"film_width"}, "texture": {"texture_width"}}[swept]
    assert all({name for name in first if name.endswith("_width")} == names for first in Sized.firsts)


def test_the_table_begins_with_what_is_swept_and_the_picture_is_drawn(tmp_path: Path) -> None:
    Pretended.ends = {("walk_ad", 5): 2}
    rows, _ = run("film", [16, 128])
    labels = LIST.split(",")
    assert table_head(labels, "film").split()[:2] == ["film", "step"]
    lines = [table_line(row.case.label, row.value, row.record, None, None, labels) for row in rows]
    assert [line.split()[:2] for line in lines] == [[str(width), name] for width in (16, 128) for name in labels]
    assert lines[2].endswith("out_of_memory")
    series = [(label, [(row.value, row.record) for row in rows if row.case.label == label]) for label in labels]
    plot_bench(series, tmp_path / "x.png", "x", "film width")
    assert {row.record.status for row in rows} == {BenchStatus.OK, BenchStatus.OUT_OF_MEMORY}
    assert (tmp_path / "x.png").read_bytes().startswith(b"\x89PNG")


def test_what_there_was_no_time_for_is_named_by_what_is_swept() -> None:
    assert run("texture", [8, 64], rounds=None)[1] == [
        "not measured: texture width 8, 64: the budget was spent; allow more with --budget"
    ]


def test_samples_that_cannot_be_are_located() -> None:
    with pytest.raises(ConfigError, match=r"--integrators ptracer: integrator.samples_per_pass: 2 does not divide"):
        run("spp", [4, 3])


def test_usual_values() -> None:
    config = loads(CONFIG, Path("x.yaml"))
    assert usual_values("spp", config) == [1, 2, 4, 8, 16]
    assert usual_values("spp", loads(CONFIG, Path("x.yaml"), ["run.spp=2"])) == [1, 2, 4, 8]
    assert usual_values("film", config) == [32, 64, 128, 256]


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (("--sweep", "film", "--max-depth", "4"), "--max-depth: goes with --sweep depth; take --set integrator.max"),
        (("--values", "2", "--max-depth", "4"), "--max-depth: does not go with --values"),
        (("--sweep", "size"), "'size' is not one of 'depth', 'spp', 'film', 'texture'"),
        (("--sweep", "spp", "--values", "4,4"), "`4,4` names a number twice"),
        (("--sweep", "spp", "--integrators", "ptracer(max_depth=3)"), "all share one max_depth"),
    ],
)
def test_bad_input_is_one_located_line(args: tuple[str, ...], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["bench", *args], prog_name="reslrb")
    assert ended.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert line in printed.err
    assert len(printed.err.splitlines()) == 1
