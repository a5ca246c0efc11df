"""A `bench` that goes on from another one: what counts, what is measured again, and what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from measure.pretended import Pretended
from measure.test_bench_sweep import CONFIG, sweep

from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.bench import KIND, Book, bench
from reslrb_cli.measure.methods import Sweep, parse_cases
from reslrb_cli.measure.resume_store import Earlier
from reslrb_cli.records.measurements import BenchStatus


@pytest.fixture(autouse=True)
def _clean() -> None:
    Pretended.log, Pretended.ends, Pretended.refusing, Pretended.alive = [], {}, set(), 0


def measure(what: Sweep, before: Earlier | None = None, stop: Callable[[], bool] = lambda: False) -> Book:
    book = Book(what, "", before)
    list(bench(what, stop, lambda line: None, Pretended, book))
    assert Pretended.alive == 0
    return book


def again(book: Book) -> Earlier:
    """What a book keeps, as it comes back from the disk."""
    kept = book.kept()
    assert kept is not None
    head, arrays = kept
    return Earlier(KIND, Path("b.jsonl"), json.loads(json.dumps(head)), arrays)


def test_rounds_go_on_and_the_records_are_those_of_one_session() -> None:
    """The pretended steps take longer from round to round, so that every figure shows which rounds it is of."""
    short = measure(sweep(rounds=3))
    Pretended.log.clear()
    whole = measure(sweep(rounds=7), again(short))
    asked = [round for depth, name, round in Pretended.log if (depth, name) == (2, "ptracer") and round > 0]
    assert asked == [4, 5, 6, 7]  # whose seeds are new
    expected = measure(sweep(rounds=7)).results()
    assert [result.record for result in whole.results()] == [result.record for result in expected]
    assert [result.step_ratio for result in whole.results()] == [result.step_ratio for result in expected]
    assert {result.record.repeats for result in whole.results()} == {7}


@pytest.mark.parametrize("after", [5, 14, 20, 33, 40])
def test_what_a_stop_has_left_is_measured(after: int) -> None:
    answers = iter(range(1000))
    stopped = measure(sweep(), stop=lambda: next(answers) > after)
    if stopped.kept() is None:
        assert not any(result.record.repeats for result in stopped.results())
        return
    whole = measure(sweep(), again(stopped))
    labels = [case.label for case in sweep().cases]
    assert [(result.value, result.case.label) for result in whole.results()] == [(v, c) for v in (2, 4) for c in labels]
    assert all(result.record.repeats >= 3 for result in whole.results())


def test_depths_that_are_done_are_not_begun_again() -> None:
    Pretended.ends = {("walk_ad", 2): 4}
    first = measure(sweep(values=[2, 4], rounds=3), stop=lambda: len(Pretended.log) > 31)
    assert {result.value for result in first.results()} == {2, 4}
    Pretended.log.clear()
    Pretended.ends = {}
    whole = measure(sweep(values=[2, 4], rounds=3), again(first))
    assert {depth for depth, _, _ in Pretended.log} == {4}
    ended = whole.results()[2]
    assert (ended.record.status, ended.reason) == (BenchStatus.OUT_OF_MEMORY, "ended by SIGSEGV")


def test_what_refused_stays_left_out() -> None:
    Pretended.refusing = {"reslrb"}
    first = measure(sweep(default=True))
    Pretended.log.clear()
    whole = measure(sweep(default=True, rounds=5), again(first))
    assert {name for _, name, _ in Pretended.log} == {"ptracer", "walk_ad"}
    assert {result.record.repeats for result in whole.results()} == {5}


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"config": loads(CONFIG, Path("x.yaml"), ["run.spp=8"])}, "run.spp is 4 there, 8 here"),
        ({"cases": parse_cases("ptracer,walk_ad")}, "integrators is ['ptracer', 'reslrb:stack', 'walk_ad'] there"),
        ({"values": [2, 8]}, "values is [2, 4] there, [2, 8] here"),
        ({"objective": "l2"}, "objective is fixed there, l2 here"),
        ({"swept": "spp"}, "sweep is depth there, spp here"),
        ({"memory_limit": 2**30}, "memory limit is None there, 1073741824 here"),
        ({"variant": "cuda_ad_rgb"}, "variant is llvm_ad_rgb there, cuda_ad_rgb here"),
    ],
)
def test_only_the_same_is_gone_on_from(change: dict[str, Any], line: str) -> None:
    first = measure(sweep())
    with pytest.raises(ConfigError, match=re.escape(f"--resume: b.jsonl is of another measurement: {line}")):
        Book(sweep(**({"rounds": 5} | change)), "", again(first))
    with pytest.raises(ConfigError, match=r"b\.jsonl has all of it, 3 rounds each; more are measured with a larger"):
        Book(sweep(), "", again(first))


def test_a_scene_that_has_changed_is_another_one(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text("<scene/>")
    what = sweep(config=loads(CONFIG, tmp_path / "x.yaml"))
    first = again(measure(what))
    (tmp_path / "scene.xml").write_text("<scene></scene>")
    with pytest.raises(ConfigError, match=r"the content of scene\.file has changed"):
        Book(what, "", first)


def test_what_is_under_way_is_in_the_book_between_rounds() -> None:
    """So that a process that is killed in the midst of a depth leaves all rounds but the last."""
    book, seen = Book(sweep(values=[2])), []

    def between() -> None:
        kept = book.kept()
        assert kept is not None
        seen.append([len(run["steps"]) for run in kept[0]["values"][0][1]])

    list(bench(book.sweep, lambda: False, lambda line: None, Pretended, book, between))
    assert seen == [[1] * 3, [2] * 3, [3] * 3]
