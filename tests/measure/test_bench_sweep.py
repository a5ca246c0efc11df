"""Sweeps of `bench`: their order, the varied quantities, and ended cases."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from measure.pretended_steps import Pretended

from reslrb_cli.config.loader import loads
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure import engine
from reslrb_cli.measure.bench import Bench
from reslrb_cli.measure.engine import NO_TIME
from reslrb_cli.measure.methods import BENCH_ROUNDS, MeasurementPlan, bench_plan, depths, parse_cases, sample_counts
from reslrb_cli.measure.processes import CannotStart, Stopped
from reslrb_cli.records.measurements import BenchRecord, BenchStatus

# The order of a sweep, and the handling of cases that end. The processes only pretend to measure.

CONFIG = """\
scene: {file: scene.xml}
target: {render: {}}
parameters: [{key: a}]
integrator: {rr_depth: 7, samples_per_pass: 2}
run: {spp: 4}
"""
LIST = "ptracer,reslrb:stack,walk_ad"


@pytest.fixture(autouse=True)
def _clean() -> None:
    Pretended.log, Pretended.ends, Pretended.refusing, Pretended.alive = [], {}, set(), 0


def sweep(list_of: str = LIST, **changes: Any) -> MeasurementPlan:
    values: dict[str, Any] = {
        "config": loads(CONFIG, Path("x.yaml")), "variant": "llvm_ad_rgb", "cases": parse_cases(list_of),
        "swept": "depth", "values": [2, 4], "memory_limit": None, "budget_s": 0.0, "rounds": 3,
    }  # fmt: skip
    return MeasurementPlan(**(values | changes))


def play(
    what: MeasurementPlan, kind: type[Pretended] = Pretended, stop: Callable[[], bool] = lambda: False, **options: Any
) -> tuple[list[BenchRecord], list[str]]:
    said: list[str] = []
    rows = [row for depth in Bench(what, stop, said.append, start=kind, **options).run() for row in depth]
    assert Pretended.alive == 0
    return rows, said


def run(what: MeasurementPlan, stop: Callable[[], bool] = lambda: False) -> list[BenchRecord]:
    return play(what, stop=stop)[0]


def test_steps_are_interleaved_in_rotating_order() -> None:
    run(sweep(values=[2]))
    types = ["ptracer", "reslrb", "walk_ad"]
    # One cold step, then two until no kernel is new. The first step of a turn refills caches.
    warm = [(2, name, [0]) for name in types for _ in range(3)]
    rounds = [(2, types[(r + k) % 3], [2 * r, 2 * r + 1]) for r in range(3) for k in range(3)]
    assert Pretended.log == warm + rounds


@pytest.mark.parametrize("ended", [["walk_ad"], ["ptracer"], ["ptracer", "reslrb", "walk_ad"]], ids=len)
@pytest.mark.parametrize("question", [0, 1, 2, 5], ids=["loading", "cold", "warming up", "in a round"])
def test_ended_cases_are_recorded_and_the_rest_continues(ended: list[str], question: int) -> None:
    """The cases are tried again at the next depth. Without a baseline, there are no ratios."""
    Pretended.ends = {(name, 2): question for name in ended}
    rows = run(sweep())
    assert [row.method.label for row in rows] == [*LIST.split(","), *LIST.split(",")]
    for row in rows:
        at_first = row.method.max_depth == 2
        has_ended = at_first and row.method.options["type"] in ended
        assert row.status is (BenchStatus.OUT_OF_MEMORY if has_ended else BenchStatus.OK)
        assert (row.message, row.repeats) == (("ended by SIGSEGV", 0) if has_ended else ("", 3))
        figures = (row.step_ms, row.kernel_ms, row.cold_ms, row.peak_mib, row.scratch_bytes)
        assert {figure is None for figure in figures} == {has_ended}
        assert (row.step_ratio is None) == (has_ended or (at_first and "ptracer" in ended))
        assert row.width == (None if at_first and len(ended) == 3 and question == 0 else 6)


@pytest.mark.parametrize("cases", ["reslrb:stack,reslrb:event", "reslrb:event,ptracer"])
def test_times_are_relative_to_ptracer_or_the_first_case(cases: str) -> None:
    assert sweep(cases).baseline.label == ("ptracer" if "ptracer" in cases else "reslrb:stack")


@pytest.mark.parametrize(("after", "kept"), [(5, []), (14, [1, 1, 1]), (13, [1, 1]), (33, [3, 3, 3, 1])])
def test_a_stop_keeps_finished_measurements(after: int, kept: list[int]) -> None:
    answers = iter(range(1000))
    rows = run(sweep(), stop=lambda: next(answers) > after)
    assert [row.repeats for row in rows] == kept
    assert all(row.status is BenchStatus.OK for row in rows)


def test_cases_that_need_shared_memory_release_it(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[bool] = []

    class Noting(Pretended):
        def ask(self, question: dict[str, Any]) -> None:
            asked.append(question["release"])
            super().ask(question)

    for mib in (5, 500):
        monkeypatch.setattr(engine, "memory_bytes", lambda variant, mib=mib: mib * 2**20)
        play(sweep(values=[2]), Noting)
        assert asked[-1] == (mib == 5)


def test_without_rounds_and_with_time_there_is_a_fixed_number_of_rounds() -> None:
    assert [row.repeats for row in run(sweep(rounds=None, budget_s=1e6))] == [BENCH_ROUNDS] * 6


@pytest.mark.parametrize(
    ("budget_s", "measured", "left"),
    [
        (1000.0, {2: LIST.split(","), 4: LIST.split(",")}, []),
        (130.0, {2: LIST.split(",")}, ["depth 4, ptracer, reslrb:stack, walk_ad"]),
        (10.0, {}, ["depth 2, ptracer, reslrb:stack, walk_ad", "depth 4"]),
    ],
)
def test_the_budget_covers_compilation(budget_s: float, measured: dict[int, list[str]], left: list[str]) -> None:
    """The first step of a method takes 30 s, and each later step takes 0.1 s. The step in progress ends when the budget
    is spent.
    """
    found, said, seconds = spent(budget_s)
    assert found == measured
    assert said == [f"not measured: {what}: {NO_TIME}" for what in left]
    assert seconds < budget_s + 0.5


def spent(budget_s: float) -> tuple[dict[int, list[str]], list[str], float]:
    """Return the measured methods for each depth, the messages, and the time of a session with this budget."""
    now = [0.0]

    class Slow(Pretended):
        def answer(self, stop: Callable[[], bool]) -> dict[str, Any]:
            for _ in range(300 if self.asked == 1 else 1):
                now[0] += 0.1
                if stop():
                    raise Stopped
            return super().answer(stop)

    rows, said = play(sweep(rounds=None, budget_s=budget_s), Slow, now=lambda: now[0])
    found: dict[int, list[str]] = {}
    for row in rows:
        found.setdefault(row.method.max_depth, []).append(row.method.label)
        assert row.status is BenchStatus.OK
    assert Pretended.alive == 0
    return found, said, now[0]


def test_a_warning_of_every_process_is_shown_once() -> None:
    class Warning(Pretended):
        def answer(self, stop: Callable[[], bool]) -> dict[str, Any]:
            answer = super().answer(stop)
            return answer | ({"warnings": ["scene.xml:3: old"]} if "width" in answer else {})

    _, said = play(sweep(), Warning)
    assert said == ["scene.xml:3: old"]


def test_values_of_sweeps() -> None:
    assert [depths(deepest) for deepest in (2, 16, 20)] == [[2], [2, 4, 8, 16], [2, 4, 8, 16, 20]]
    assert [sample_counts(spp) for spp in (4, 2)] == [[1, 2, 4, 8, 16], [1, 2, 4, 8]]


def test_options_of_cases() -> None:
    cases = parse_cases("reslrb:reservoir(capacity=4, weight=adjoint), ptracer(rr_depth=3),prb,reslrb")
    config = loads(CONFIG, "x.yaml")
    options = [case.at(config, 9, known=True).integrator.options() for case in cases]
    assert (options[0]["capacity"], options[0]["samples_per_pass"], options[0]["max_depth"]) == (4, 2, 9)
    assert [option["rr_depth"] for option in options] == [7, 3, 7, 7]
    assert "samples_per_pass" not in options[2]


def test_cases_may_have_their_own_adjoint() -> None:
    case, other, third = parse_cases("reslrb:stack(adjoint=batched,batches=2),ptracer(adjoint=correlated),prb")
    config = loads(CONFIG, "x.yaml", ["run.adjoint=batched"])
    runs = [c.at(config, 9, known=False).run for c in (case, other, third)]
    assert [run.adjoint for run in runs] == ["batched", "correlated", "batched"]
    assert [run.batches for run in runs] == [2, 4, 4]
    [guided] = parse_cases("reslrb:stack(guiding=on)")
    assert guided.at(config, 4, known=True).integrator.options()["guiding"] == "on"
    assert case.at(loads(CONFIG, "x.yaml"), 9, known=False).run.batches == 2


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("ptracer,", "`` is not an integrator"),
        ("ptracer,ptracer", "`ptracer` is given twice"),
        ("reslrb:stack(3)", "`3` must be OPTION=VALUE"),
        ("reslrb(max_depth=3)", "--set integrator.max_depth=3, or bench --max-depth"),
        ("path", "--integrators path: integrator.type: must be one of"),
        ("reslrb:gather(capacity=2)", "integrator.capacity: has no effect with estimator `gather`"),
        ("ptracer(capacity=2)", "integrator.capacity: not an option of ptracer but of reslrb"),
        ("ptracer(adjoint=batched)", "adjoint: has no effect if dL/dI is known"),
        ("ptracer(samples_per_pass=3)", "integrator.samples_per_pass: 3 does not divide run.spp"),
    ],
)
def test_wrong_lists_are_located(text: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        bench_plan(loads(CONFIG, "x.yaml"), "depth", [2], text, 2, budget_s=1.0)
    assert str(caught.value).startswith("--integrators")
    assert line in str(caught.value)
    with pytest.raises(ConfigError, match=r"--integrators ptracer: integrator.samples_per_pass: 2 does not divide"):
        bench_plan(loads(CONFIG, "x.yaml"), "spp", [4, 3], LIST, 2, budget_s=1.0)


def test_unnamed_cases_that_refuse_are_left_out():
    Pretended.refusing = {"reslrb"}
    results, lines = play(sweep(default=True))
    assert {result.method.label for result in results} == {"ptracer", "walk_ad"}
    assert {result.method.max_depth for result in results} == set(sweep().values)
    assert lines == ["left out: reslrb:stack: no derivatives of moving light"]


@pytest.mark.parametrize(("refusing", "default"), [("reslrb", False), ("ptracer", True)])
def test_named_cases_and_baselines_are_not_left_out(refusing: str, default: bool):
    Pretended.refusing = {refusing}
    with pytest.raises(CannotStart, match="moving light"):
        play(sweep(default=default))
    assert Pretended.alive == 0


# Sweeps of sample counts.


def run_swept(values: list[int], rounds: int | None = 3) -> tuple[list[BenchRecord], list[str]]:
    config = loads(CONFIG, Path("x.yaml"), ["integrator.max_depth=5"])
    return play(sweep(config=config, values=values, rounds=rounds, swept="spp"))


def test_the_sample_count_varies_and_the_depth_stays() -> None:
    rows, said = run_swept([2, 8])
    assert said == []
    assert [(row.method.spp, row.method.max_depth, row.width) for row in rows] == [(2, 5, 6)] * 3 + [(8, 5, 6)] * 3


def test_unmeasured_rows_are_named_by_the_varied_quantity() -> None:
    assert run_swept([8, 64], rounds=None)[1] == [
        "not measured: spp 8, 64: the budget was spent; allow more with --budget"
    ]


def test_results_grow_with_each_round() -> None:
    """The command writes its file after each round, so that a killed process loses only its last round."""
    made = Bench(sweep(values=[2]), lambda: False, lambda line: None, start=Pretended)
    seen = [[result.repeats for result in made.results()] for _ in made.run()]
    assert seen == [[1] * 3, [2] * 3, [3] * 3, [3] * 3]
