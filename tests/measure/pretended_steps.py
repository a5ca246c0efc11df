"""Methods of known cost, noise and bias that replace measuring processes."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.loader import loads
from reslrb_cli.measure.convergence import Session
from reslrb_cli.measure.draws import DrawsFile
from reslrb_cli.measure.judgement import ConvergenceResults, Judgement
from reslrb_cli.measure.methods import MeasurementPlan, parse_cases
from reslrb_cli.measure.processes import CannotStart, Ended, Stopped
from reslrb_cli.records.measurements import BenchStatus, MethodRecord

# Processes that only pretend to measure, for tests of sweeps.


class Pretended:
    """A process that logs all questions. It ends at the question that `ends` gives for (type, depth)."""

    log: list[tuple[int, str, Any]] = []  # noqa: RUF012 (shared by all, as the machine is)
    ends: dict[tuple[str, int], int] = {}  # noqa: RUF012
    refusing: set[str] = set()  # noqa: RUF012
    alive = 0

    def __init__(self, first: dict[str, Any]) -> None:
        assert first["quantity"] == "step"
        config = loads(first["config"], "x.yaml")
        self.type, self.depth = config.integrator.type, config.integrator.max_depth
        self.asked, self.closed = 0, False
        self.question: dict[str, Any] | None = None
        Pretended.alive += 1

    def ask(self, question: dict[str, Any]) -> None:
        self.asked, self.question = self.asked + 1, question
        Pretended.log.append((self.depth, self.type, question["numbers"]))

    def answer(self, stop: Callable[[], bool]) -> dict[str, Any]:
        if stop():
            raise Stopped
        if self.type in self.refusing:
            raise CannotStart("no derivatives of moving light", 2)
        if self.ends.get((self.type, self.depth)) == self.asked:
            raise Ended(BenchStatus.OUT_OF_MEMORY, "ended by SIGSEGV")
        if self.question is None:
            return {"width": 6, "height": 5, "texels": 9}
        numbers, speed = self.question["numbers"], {"ptracer": 4, "reslrb": 2, "walk_ad": 5}[self.type]
        # Only the last step of a turn counts. The first one refills caches.
        ms = np.array([float(self.depth * (2 + number) * speed) for number in numbers])
        ms[:-1] += 100.0
        ms /= 1 + self.question["cold"]
        parts = {"step_ms": ms, "kernel_ms": ms / 2, "codegen_ms": ms / 8}
        answer = {"values": np.zeros((len(ms), 0)), "new_kernels": 2 if self.asked < 3 else 0}
        answer |= {name: part.tolist() for name, part in parts.items()}
        return answer | ({"peak_mib": 1.5, "scratch_bytes": 60} if self.question["cold"] else {})

    def close(self) -> None:
        Pretended.alive -= not self.closed
        self.closed = True


# Methods of known cost, noise and bias replace processes in tests of `convergence`.

#: Shapes and true values of two parameters, which all unbiased methods estimate. One parameter has colours.
SHAPES = {"a": [4, 5, 3], "b": [3]}
TRUTH = np.concatenate([np.random.default_rng(3).uniform(0.5, 1.5, 60), [2.0, -1.0, 0.5]])


@dataclass
class Pretence:
    """One method with its cost and errors. `step_s` and `cold_s` are the seconds of a warm step and of a cold step.
    `noise` and `bias` are the standard deviation and bias of each entry, relative to the entry.

    All steps with one dL/dI share `image_noise`. The first step of a turn takes `late_s` longer. The method ends at
    question number `ends`, if given.
    """

    step_s: float = 0.1
    noise: float = 1.0
    bias: float = 0.0
    cold_s: float = 1.0
    image_noise: float = 0.0
    late_s: float = 0.0
    ends: int | None = None
    refuses: bool = False
    nan_at: int | None = None
    #: Noisier steps, and the factor by which their noise exceeds the noise of the others.
    outliers: tuple[int, ...] = ()
    outlier: float = 100.0
    steps: list[int] = field(default_factory=list)

    def sample(self, purpose: str, number: int, image: int) -> np.ndarray:
        """Return one step's gradient (63,) as float32."""
        random = np.random.default_rng([zlib.crc32(purpose.encode()), number])
        shared = np.random.default_rng([7, image]).standard_normal(len(TRUTH)) * self.image_noise
        noise = self.noise * (self.outlier if number in self.outliers else 1.0)
        row = TRUTH * (1 + self.bias + shared + noise * random.standard_normal(len(TRUTH)))
        return row.astype(np.float32)


class Stage:
    """All methods by `role label` or `label`. Only the methods advance the clock. `start` starts their processes."""

    def __init__(self, facts: dict[str, Any] | None = None, **methods: Pretence) -> None:
        self.now, self.alive, self.survey_s, self.surveys = 0.0, 0, 2.0, 0
        self.methods = methods
        self.turns: list[str] = []
        self.purposes: list[str] = []
        self.asked: list[dict[str, Any]] = []
        keys = list(SHAPES)
        self.facts = {
            "paths": "both", "shapes": SHAPES, "independent": dict.fromkeys(keys, "ptracer"),
            "why": dict.fromkeys(keys, ""), "without": {}, "masked": False, "pixels": 64, "pictures": "",
        } | (facts or {})  # fmt: skip

    def clock(self) -> float:
        return self.now

    def start(self, first: dict[str, Any]) -> Player:
        self.alive += 1
        self.surveys += first["quantity"] == "survey"
        self.purposes += [first["purpose"]] if "purpose" in first else []
        return Player(self, first)

    def pretence(self, name: str) -> Pretence:
        """Return the method of a name such as `case reslrb:stack, 4 spp`. The key may lack the role and the sample
        count. The default is a plain method.
        """
        without = name.rpartition(", ")[0]
        keys = [_plain(key.partition(" ")[2] if short else key) for key in (name, without) for short in (False, True)]
        found = next((self.methods[key] for key in keys if key in self.methods), None)
        return found or self.methods.setdefault(_plain(without), Pretence())


def _plain(name: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in name)


class Player:
    """Replacement for a `Process`."""

    def __init__(self, stage: Stage, first: dict[str, Any]) -> None:
        self.stage, self.first, self.closed, self.questions = stage, first, False, 0
        self.question: dict[str, Any] | None = None
        self.name = first.get("purpose", "").removeprefix("convergence, ")
        self.played = None if first["quantity"] == "survey" else stage.pretence(self.name)

    def ask(self, question: dict[str, Any]) -> None:
        self.question, self.questions = question, self.questions + 1
        self.stage.asked.append({"of": self.name} | question)

    def answer(self, stop: Callable[[], bool]) -> dict[str, Any]:
        if stop():
            raise Stopped
        if self.played is None:
            self._wait(self.stage.survey_s, stop)
            arrays = {"mask": np.ones((2, 2, 1), np.float32)}
            return {"facts": self.stage.facts, "arrays": arrays, "warnings": ["old"]}
        if self.question is None:
            if self.played.refuses:
                raise CannotStart("cannot be done here", 2)
            return {"warnings": ["old"]}
        if self.played.ends == self.questions:
            raise Ended(BenchStatus.OUT_OF_MEMORY, "ended by SIGKILL")
        return self._steps(self.played, self.question, stop)

    def _steps(self, played: Pretence, question: dict[str, Any], stop: Callable[[], bool]) -> dict[str, Any]:
        cold, numbers = question["cold"], question["numbers"]
        self._wait(played.cold_s if cold else len(numbers) * played.step_s, stop)
        if len(numbers) > 1:
            played.steps += numbers
            self.stage.turns.append(self.name)
        rows = np.stack([played.sample(self.first["purpose"], n, question["image"] % 8) for n in numbers])
        if played.nan_at in numbers:
            rows[0, 1] = np.nan
        ms = 1e3 * (played.cold_s if cold else played.step_s)
        times = [ms + 1e3 * played.late_s * (len(numbers) > 1), *[ms] * (len(numbers) - 1)]
        answer = {"values": rows, "step_ms": times, "kernel_ms": times, "codegen_ms": times, "new_kernels": int(cold)}
        return answer | ({"peak_mib": 2.0, "scratch_bytes": 8} if cold else {})

    def _wait(self, seconds: float, stop: Callable[[], bool]) -> None:
        for _ in range(max(round(seconds / 0.05), 1)):
            self.stage.now += seconds / max(round(seconds / 0.05), 1)
            if stop():
                raise Stopped

    def close(self) -> None:
        self.stage.alive -= not self.closed
        self.closed = True


CONFIG = """\
scene: {file: scene.xml}
target: {render: {}}
parameters: [{key: a}, {key: b}]
integrator: {max_depth: 4, rr_depth: 9}
run: {spp: 4}
"""
LIST = "ptracer,reslrb:stack,reslrb:event"
SIGNAL = float(TRUTH @ TRUTH)


def plan(cases: str = LIST, **changes: Any) -> MeasurementPlan:
    values: dict[str, Any] = {
        "config": loads(CONFIG, Path("x.yaml")), "variant": "llvm_ad_rgb", "cases": parse_cases(cases), "values": [4],
        "reference": parse_cases("reslrb:stack")[0], "quantity": "fixed", "memory_limit": None,
        "budget_s": 0.0, "rounds": 32,
    }  # fmt: skip
    return MeasurementPlan(**(values | changes))


def play(
    stage: Stage, what: MeasurementPlan, stop: Callable[[], bool] = lambda: False, file: Path | None = None
) -> tuple[Session, ConvergenceResults, list[str]]:
    said: list[str] = []
    session = Session(what, stop, said.append, start=stage.start, now=stage.clock, file=DrawsFile(file))
    for _ in session.run():
        pass
    assert stage.alive == 0
    return session, Judgement(session).results(), said


def of(results: ConvergenceResults, label: str, parameter: str = "all") -> MethodRecord:
    return next(r for r in results.methods if (r.method.label, r.parameter) == (label, parameter))
