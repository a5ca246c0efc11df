"""Optimisations of known cost and loss in place of processes, for tests of what `convergence --runs` makes of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.loader import loads
from reslrb_cli.measure.methods import RunsPlan, parse_cases
from reslrb_cli.measure.optimization_benchmark.evaluate import Advance, load, save
from reslrb_cli.measure.optimization_benchmark.session import RunsSession
from reslrb_cli.measure.processes import Ended, Refused, Stopped
from reslrb_cli.records.measurements import BenchStatus, RunPointRecord
from reslrb_cli.records.metrics import Record

#: Seconds that a process takes until it loads the scene.
STARTUP_S = 1.0


@dataclass
class Pretence:
    """One method: the value of its only parameter after i iterations is `gain` ** i (of seed s: times 1 + s / 100).

    Loading takes `loading_s`, an iteration `step_s`, the first one `first_s` more; judging one image `judge_s`. It ends
    once it is asked for a time after `ends_s`.
    """

    gain: float = 0.9
    step_s: float = 0.1
    first_s: float = 0.5
    loading_s: float = 0.2
    iterations: int = 100_000
    ends_s: float = float("inf")
    refuses: bool = False
    chose: tuple[str, ...] = ()


class Stage:
    """Methods by label, or by type, and a clock that only they move; `start` starts their processes."""

    def __init__(self, judge_s: float = 0.02, target_s: float = 1.0, without: Any = None, **methods: Pretence) -> None:
        self.now, self.alive, self.judged = 0.0, 0, 0
        self.judge_s, self.target_s, self.without, self.methods = judge_s, target_s, without or {}, methods
        self.turns: list[tuple[str, int]] = []
        self.most_alive = 0
        self.prepared: dict[str, Any] = {}

    def clock(self) -> float:
        return self.now

    def start(self, first: dict[str, Any], does: str) -> Player:
        self.alive += 1
        self.most_alive = max(self.most_alive, self.alive)
        return Player(self, first, does)

    def wait(self, seconds: float, stop: Callable[[], bool]) -> None:
        for _ in range(max(round(seconds / 0.05), 1)):
            self.now += seconds / max(round(seconds / 0.05), 1)
            if stop():
                raise Stopped


class Player:
    """Stands in for a `Process`."""

    def __init__(self, stage: Stage, first: dict[str, Any], does: str) -> None:
        self.stage, self.does, self.closed = stage, does, False
        config = loads(first["config"], "x.yaml")
        options = config.integrator.options()
        name = "_".join(str(part) for part in (config.integrator.type, options.get("estimator")) if part)
        self.name, self.seed = name, config.run.seed
        self.played = stage.methods.get(name) or stage.methods.get(config.integrator.type) or Pretence()
        self.question: dict[str, Any] | None = None
        self.done = 0
        self.advance = Advance(self._iterations(), self._value, self.played.loading_s, stage.clock)

    def ask(self, question: dict[str, Any]) -> None:
        self.question = question

    def answer(self, stop: Callable[[], bool]) -> dict[str, Any]:
        if stop():
            raise Stopped
        question, self.stop = self.question, stop
        if self.does == "judged_runs":
            return self._judge(question, stop)
        if question is None:
            self.stage.wait(STARTUP_S + self.played.loading_s, stop)
            if self.played.refuses:
                raise Refused("cannot be done here", 2)
            return {"loading_s": self.played.loading_s, "chose": self.played.chose, "warnings": ["old"]}
        if question["until_s"] > self.played.ends_s:
            raise Ended(BenchStatus.OUT_OF_MEMORY, "ended by SIGKILL")
        self.stage.turns.append((self.name, self.seed))
        state = self.advance.until(question["until_s"], question["limit_s"])
        save(question["out"], state.values)
        finished = self.advance.now.elapsed_s if self.advance.finished else None
        return {"iteration": state.iteration, "first_s": self.advance.first_s, "finished_s": finished, "peak_mib": 2.0}

    def _judge(self, question: dict[str, Any] | None, stop: Callable[[], bool]) -> dict[str, Any]:
        if question is None:
            self.stage.wait(STARTUP_S + 0.3, stop)
            return {"loading_s": 0.3, "warnings": ["old"]}
        if "prepare" in question:
            self.stage.prepared = question["prepare"]
            self.stage.wait(self.stage.target_s, stop)
            np.savez(question["out"], **{"target-0": np.full((2, 2, 3), 0.25, np.float32)})
            return {"without": self.stage.without, "loss": 1.0, "error": 1.0, "judge_s": self.stage.judge_s,
                    "error_of": "RMSE", "pictures": "", "spp": 64, "masked": False}  # fmt: skip
        if "restore" in question:
            assert question["restore"] == {"spp": 64, "masked": False}
            with np.load(question["targets"]) as targets:
                np.testing.assert_array_equal(targets["target-0"], 0.25)
            return {"loss": 1.0, "error": 1.0, "judge_s": self.stage.judge_s}
        self.stage.wait(self.stage.judge_s, stop)
        self.stage.judged += 1
        value = float(load(question["values"], ["a"])["a"][0])
        return {"loss": value**2, "error": value}

    def _iterations(self) -> Any:
        for iteration in range(self.played.iterations):
            step_s = self.played.step_s + (self.played.first_s if iteration == 0 else 0)
            self.stage.wait(step_s, self.stop)
            self.done = iteration + 1
            yield Record(iteration, 0.0, 0.0, None, None, 0.0, 0.0, 2.0, 4, 0.1, 0.0, 0, None)

    def _value(self) -> dict[str, np.ndarray]:
        return {"a": np.array([self.played.gain**self.done * (1 + self.seed / 100 * (self.done > 0))])}

    def close(self) -> None:
        self.stage.alive -= not self.closed
        self.closed = True


# --- playing ----------------------------------------------------------------------------------------------------------

CONFIG = """\
scene: {file: scene.xml}
target: {render: {}}
parameters: [{key: a}]
integrator: {max_depth: 4, rr_depth: 9}
run: {spp: 4}
"""
LIST = "ptracer,reslrb:stack"


def plan(cases: str = LIST, **changes: Any) -> RunsPlan:
    values: dict[str, Any] = {
        "config": loads(CONFIG, Path("x.yaml")), "variant": "llvm_ad_rgb", "cases": parse_cases(cases, deep=False),
        "reference": parse_cases("reslrb:stack")[0], "objective": "loss", "memory_limit": None, "memory": 2**40,
        "budget_s": 100.0, "runs": 3,
    }  # fmt: skip
    return RunsPlan(**(values | changes))


def play(
    folder: Path, stage: Stage, what: RunsPlan, stop: Callable[[], bool] = lambda: False
) -> tuple[RunsSession, list[RunPointRecord], list[str]]:
    said: list[str] = []
    session = RunsSession(what, folder, stop, said.append, stage.start, stage.clock)
    points = list(session.run())
    assert stage.alive == 0
    return session, points, said
