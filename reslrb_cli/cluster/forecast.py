"""What a step in shards would take on so many workers: a model (`step_time`, of `Parts`), and the measurement of its
parts on workers that are there (`measure_parts`).

A step is so many rounds of S shards. On W workers, each with a machine like that of those measured,

    computing   ceil(S / W) shards of each round, one after the other, and before them stand_s, to bring the scene there
    sending     (W * stand + S * (call + answer)) bytes of each round, at byte_s each, and through one link
    waiting     round_s + (S + W) * call_s for each round: whatever is handed out has its turn at the scheduler
    here        what the process that was started does beside

which add up: nothing of one is hidden behind another, so that it is rather too long than too short. Efficiency is the
time of one worker without any of the rest but `here`, over W times the step's.

Imports dask where something is measured.
"""

from __future__ import annotations

import math
import pickle
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from reslrb_cli.config.schema import Config
from reslrb_cli.optimization.assemble import assemble
from reslrb_cli.optimization.forecast import trial, with_short_target
from reslrb_cli.optimization.loop import iterate
from reslrb_cli.optimization.problem import Problem
from reslrb_cli.records.cache import PilotCache
from reslrb_cli.runs.prepare import Course

if TYPE_CHECKING:
    from reslrb_cli.cluster.connection import Place
    from reslrb_cli.cluster.crew import Crew
    from reslrb_cli.cluster.engine import Engine

#: Workers, and bits per second of a link, that a forecast is made for.
WORKERS, LINKS = (1, 2, 4, 8, 16), {"1 Gbit/s": 1e9, "10 Gbit/s": 1e10, "100 Gbit/s": 1e11}

#: Twice as many workers are worth it where a step is so many times as fast with them.
GAIN = 1.25

#: How many workers are to have which efficiency where a batch counts as large enough.
ENOUGH_WORKERS, ENOUGH = 8, 0.85

#: Steps until all is compiled; steps that are timed, at least, at most, and for so many seconds.
WARM_UP, LEAST, MOST, SECONDS = 3, 4, 12, 6.0

#: Rounds of nothing, and calls of each worker in the larger ones; bytes of an array that is sent to and fro.
ROUNDS, CALLS, PAYLOAD = 15, 8, 2**22


@dataclass(frozen=True)
class Round:
    """Of one round of a step: seconds of computing a shard, and of bringing the scene to where it is to stand before;
    and bytes: what each worker is told for that (`stand`), and of a shard what is sent (`call`) and what comes back
    (`answer`)."""

    shard_s: float
    stand_s: float
    stand: int
    call: int
    answer: int


@dataclass(frozen=True)
class Parts:
    """What a step of `paths` light paths in `shards` shards is made of (the head of this file)."""

    shards: int
    paths: int
    rounds: tuple[Round, ...]
    here_s: float
    round_s: float
    call_s: float
    byte_s: float

    @property
    def shard_s(self) -> float:
        """Seconds of computing a shard, in all rounds."""
        return sum(each.shard_s for each in self.rounds)

    @property
    def stand_s(self) -> float:
        """Seconds of bringing the scene to where it is to stand, in all rounds."""
        return sum(each.stand_s for each in self.rounds)


@dataclass(frozen=True)
class StepTime:
    """Seconds of a step, by part."""

    computing: float
    sending: float
    waiting: float
    here: float

    @property
    def whole(self) -> float:
        """All of them."""
        return self.computing + self.sending + self.waiting + self.here


def step_time(parts: Parts, workers: int, bits_per_s: float = math.inf) -> StepTime:
    """A step on so many workers, with a link of so many bits per second beside what a byte takes anyhow."""
    sent = sum(workers * each.stand + parts.shards * (each.call + each.answer) for each in parts.rounds)
    turns = parts.round_s + (parts.shards + workers) * parts.call_s
    return StepTime(
        math.ceil(parts.shards / workers) * parts.shard_s + parts.stand_s,
        sent * (parts.byte_s + 8 / bits_per_s),
        len(parts.rounds) * turns,
        parts.here_s,
    )


def efficiency(parts: Parts, workers: int, bits_per_s: float = math.inf) -> float:
    """The share of the workers' time in which something is done that one of them would do by itself."""
    alone = parts.shards * parts.shard_s + parts.here_s
    return alone / (workers * step_time(parts, workers, bits_per_s).whole)


def not_worth(parts: Parts, bits_per_s: float) -> int | None:
    """The first number of `WORKERS` that makes a step less than `GAIN` times as fast as half of them do, if any."""
    times = {workers: step_time(parts, workers, bits_per_s).whole for workers in WORKERS}
    return next((more for few, more in pairwise(WORKERS) if times[few] < GAIN * times[more]), None)


def enough_paths(parts: Parts, workers: int, wanted: float, bits_per_s: float) -> float | None:
    """How many light paths a step needs for so many workers to have the `wanted` efficiency, where a shard takes as
    much longer as it has more of them; None: no number suffices, for there are too few shards to share out."""
    own_s = math.ceil(parts.shards / workers) * parts.shard_s
    gained = parts.shards * parts.shard_s - wanted * workers * own_s
    if gained <= 0:
        return None
    lost = wanted * workers * (step_time(parts, workers, bits_per_s).whole - own_s) - parts.here_s
    return parts.paths * max(lost / gained, 0.0)


def verdicts(parts: Parts) -> list[tuple[list[str], int | None, float | None]]:
    """By links of which it is all the same: `not_worth`, and `enough_paths` for `ENOUGH_WORKERS`, to two digits."""
    found: dict[tuple[int | None, float | None], list[str]] = {}
    for link, bits_per_s in LINKS.items():
        paths = enough_paths(parts, ENOUGH_WORKERS, ENOUGH, bits_per_s)
        told = None if paths is None else float(f"{paths:.2g}")
        found.setdefault((not_worth(parts, bits_per_s), told), []).append(link)
    return [(links, first, paths) for (first, paths), links in found.items()]


# --- measured ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measured:
    """Parts that were measured on so many `workers`, and seconds of their steps, median."""

    parts: Parts
    workers: int
    step_s: float

    @property
    def expected_s(self) -> float:
        """What the model says of these steps."""
        return step_time(self.parts, self.workers).whole


def measure(config: Config, variant: str, place: Place, say: Callable[[str], None]) -> Measured:
    """Start workers, or ask those of a scheduler, for a few steps of the run that `config` describes.

    Raises as a run does, and MachineError where no worker can be used.
    """
    from reslrb_cli.cluster.engine import engine_at

    problem = replace(assemble(with_short_target(config), say, PilotCache()), truth={})
    with trial(problem, config.run.spp) as tried:
        course = Course(tried, variant)
        with engine_at(course, place) as engine:
            say("measuring a few steps on workers")
            return measure_parts(course, engine)


def measure_parts(course: Course, engine: Engine) -> Measured:
    """Take a few steps of a course, and rounds of nothing, on an engine's workers."""
    watched = _Watched(engine)
    course.compute_with(watched)
    ends, walls, begin = [time.perf_counter()], [0.0], 0.0
    for number, _ in enumerate(islice(iterate(course.stages, course.state), WARM_UP + MOST), 1):
        ends.append(time.perf_counter())
        walls.append(engine.crew.spent.wall)
        watched.weighs = number == WARM_UP - 1
        if number == WARM_UP:
            watched.seconds.clear()
            begin = ends[-1]
        if number >= WARM_UP + LEAST and ends[-1] - begin > SECONDS:
            break
    steps = [end - start for start, end in pairwise(ends)][WARM_UP:]
    rounds_s = [end - start for start, end in pairwise(walls)][WARM_UP:]
    config, workers = course.problem.config, len(engine.crew.ready)
    width, height = course.problem.views[0].target.shape[1], course.problem.views[0].target.shape[0]
    drawn = len(course.problem.drawn(0))
    round_s, call_s, byte_s = measure_rounds(engine.crew)
    parts = Parts(
        shards=config.shards,
        paths=width * height * config.run.spp * drawn,
        rounds=watched.rounds(),
        here_s=statistics.median(step - rounds for step, rounds in zip(steps, rounds_s, strict=True)),
        round_s=round_s,
        call_s=call_s,
        byte_s=byte_s,
    )
    return Measured(parts, workers, statistics.median(steps))


class _Watched:
    """An engine whose rounds are looked at: by function, `seconds` of a shard and of a worker's standing in each, and,
    while it `weighs` what is sent, the sizes of that."""

    def __init__(self, engine: Engine) -> None:
        self.engine, self.weighs = engine, False
        self.seconds: dict[str, list[tuple[float, float]]] = {}
        self.sizes: dict[str, tuple[int, int, int]] = {}

    def __call__(
        self, problem: Problem, function: Callable[..., Any], work: Sequence[tuple[Any, ...]]
    ) -> Iterator[tuple[int, Any]]:
        before, answers = self._spent(), 0
        for place, found in self.engine(problem, function, work):
            answers += _size(found) if self.weighs else 0
            yield place, found
        name, count = function.__name__, len(work)
        computing, standing = (now - then for now, then in zip(self._spent(), before, strict=True))
        seconds = computing / count, standing / max(len(self.engine.crew.ready), 1)
        self.seconds.setdefault(name, []).append(seconds)
        if self.weighs:
            calls = sum(_size(given) for given in work)
            self.sizes[name] = _size(self.engine.standing(problem)), calls // count, answers // count

    def rounds(self) -> tuple[Round, ...]:
        """What was seen of each round of a step, in their order."""
        found = []
        for name, sizes in self.sizes.items():
            shard_s, stand_s = (statistics.median(each) for each in zip(*self.seconds[name], strict=True))
            found.append(Round(shard_s, stand_s, *sizes))
        return tuple(found)

    def _spent(self) -> tuple[float, float]:
        workers = self.engine.crew.by_worker.values()
        return sum(one.computing for one in workers), sum(one.standing for one in workers)


def _size(value: object) -> int:
    """Bytes of what is sent of a value."""
    return len(pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL))


def idle(folder: Path, threads: int) -> tuple[None, dict[str, float]]:
    """What workers open who have nothing to do."""
    return None, {}


def nothing(state: object) -> None:
    """The work of a call that has none."""


def echo(state: object, value: object) -> object:
    """What was sent."""
    return value


def measure_rounds(crew: Crew) -> tuple[float, float, float]:
    """Seconds of a round of nothing, of each call in it and each worker that is told where to stand, and of a byte."""
    workers = len(crew.ready)
    few, many = round_seconds(crew, [workers, CALLS * workers])
    call_s = max(many - few, 0.0) / ((CALLS - 1) * workers)
    payload = np.random.default_rng(0).bytes(PAYLOAD)
    sent = statistics.median(_seconds_of(crew, echo, [(payload,)] * workers) for _ in range(3))
    return max(few - 2 * workers * call_s, 0.0), call_s, max(sent - few, 0.0) / (2 * PAYLOAD * workers)


def round_seconds(crew: Crew, counts: Sequence[int], rounds: int = ROUNDS) -> list[float]:
    """Seconds of a round of so many calls with nothing to do: medians of rounds that are taken in turns."""
    _seconds_of(crew, nothing, [()] * max(counts))  # the first one is longer
    found = [[_seconds_of(crew, nothing, [()] * calls) for calls in counts] for _ in range(rounds)]
    return [statistics.median(each) for each in zip(*found, strict=True)]


def _seconds_of(crew: Crew, function: Callable[..., Any], work: Sequence[tuple[Any, ...]]) -> float:
    from reslrb_cli.cluster.worker import Anywhere

    begin = time.perf_counter()
    for _ in crew.run(function, work, Anywhere()):
        pass
    return time.perf_counter() - begin
