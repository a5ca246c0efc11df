"""The processes of whole optimisations: seed after seed, the methods of one seed take turns (`Arena`).

Each run starts from an empty cache of kernels, and has the same time as every other; where it stands at some times,
which all have in common, is judged by another process meanwhile, which makes the target too, or takes over an earlier
one's. That the others wait for this costs them nothing but what it does to the caches.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from reslrb_cli.config.schema import Config
from reslrb_cli.measure import resume_store
from reslrb_cli.measure.arena import Arena, in_turn
from reslrb_cli.measure.methods import RunsPlan, Side, with_run
from reslrb_cli.measure.optimization_benchmark.rank import POINTS, Run, times
from reslrb_cli.measure.processes import NO_TIME, Contestant
from reslrb_cli.measure.resume_store import Earlier
from reslrb_cli.records.measurement_files import Kept
from reslrb_cli.records.measurements import BenchStatus, Method, RunPointRecord

#: Losses of the same values on the same samples differ by rounding alone, relatively: far less than this.
ROUNDING = 1e-3

#: The share of the time that judging is to take, unless that leaves images with too few samples.
JUDGED = 0.15

#: No run has less time than this, in seconds.
LEAST_S = 0.5

#: What is left for a run's being late: a share of its time, and seconds beside it. One that has not come to its first
#: iteration by then is cut off.
GRACE, GRACE_S = 0.05, 0.5

#: The share of its time by which any other run may be late before it is cut off: it ends by itself, and copies of its
#: values, which take none of its time, take some of ours.
CUT = 0.5


class RunsSession(Arena[RunsPlan, Run]):
    """Runs under way, and where they stood; see `Arena`. The referee judges where they stand.

    `limit_s` is the time of each run, once it is known: that of an earlier session where there is one.
    """

    def _set_up(self, earlier: Earlier | None) -> int:
        self.limit_s = self._startup_s = self._wave_s = 0.0
        self._seeds = 0  # those of which all runs are over
        self._targets = self.folder / "targets.npz"
        if earlier is not None:
            self._restore(earlier)
        return 1

    def _restore(self, earlier: Earlier) -> None:
        head, sides = earlier.head, {self.plan.method_of(side).label: side for side in self.plan.sides}
        self.facts, self.limit_s, self._seeds = head["facts"], head["limit_s"], head["seeds"]
        if self._seeds >= self.plan.runs:
            plural = "" if self._seeds == 1 else "s"
            raise earlier.complete(f"{self._seeds} run{plural} of each", "more with --runs")
        for entry in head["runs"]:
            self._run(sides[entry["label"]], entry["seed"]).restore(entry)

    def kept(self) -> Kept | None:
        """What a later session needs to go on: the runs of seeds that are over, and the targets; None of no seed."""
        if self._earlier is None and not self._seeds:
            return None
        if self._earlier is not None and not self._targets.exists():
            return self._earlier.head, self._earlier.arrays
        with np.load(self._targets) as found:
            arrays = {name: found[name] for name in found.files}
        order = list(dict.fromkeys(run.seed for run in self.members))[: self._seeds]
        runs = [run.kept() for run in self.members if run.seed in order]
        content = {"facts": self.facts, "limit_s": self.limit_s, "seeds": self._seeds, "runs": runs}
        return resume_store.head(self.plan.KIND, self.settings, **content), arrays

    def run(self) -> Iterator[RunPointRecord]:
        """Measure; yield where runs stand as it is known. Ends early, with what is done, once `stop()`.

        Raises Refused where what may not be left out cannot begin.
        """
        return self._taking_turns(self._course())

    def _course(self) -> Iterator[RunPointRecord]:
        if self._prepare():
            self._say_left_out()
            sides = [side for side in self.plan.sides if self._takes_part(side.case)]
            if self._divide(len(sides)):
                yield from self._waves(sides)

    def run_of(self, point: RunPointRecord) -> Run:
        """The run that a point is of."""
        return next(run for run in self.members if (run.method, run.seed) == (point.method, point.seed))

    # --- before the runs ----------------------------------------------------------------------------------------------

    def _start_message(self, config: Config) -> dict[str, Any]:
        return self._first(config, "targets") | {"masked": self.facts.get("masked", False)}

    def _prepare(self) -> bool:
        """Start what judges, and have it make the target; False where time is up over it."""
        plan, began = self.plan, self._now()
        process, answer = self._start(self._start_message(plan.reference_config), "judged_runs"), None
        self._referee = Contestant(process=process, may_refuse=False)
        opening = self._ask_referee(plan)
        if opening is not None:
            self._startup_s = max(self._now() - began - opening["loading_s"], 0.0)
            image_s = JUDGED * self._budget_s / (len(plan.sides) * plan.runs * POINTS)
            ask = {"budget_s": self._budget_s, "image_s": image_s, **plan.camera}
            if self._earlier is not None:
                answer = self._take_over(self._earlier)
            else:
                answer = self._ask_referee(plan, {"prepare": ask, "out": str(self._targets)})
        if answer is None:
            self._say(f"the budget of {plan.budget_s:g} s was spent before there was a target; allow several times it")
            return False
        self.facts = self.facts | answer
        return True

    def _take_over(self, earlier: Earlier) -> dict[str, Any] | None:
        """What a judgement takes now, by an earlier session's targets; None where time was up.

        Raises ConfigError where the initial values have another loss.
        """
        np.savez(self._targets, **earlier.arrays)  # type: ignore[arg-type]
        ask = {name: self.facts[name] for name in ("spp", "masked")}
        found = self._ask_referee(self.plan, {"restore": ask, "targets": str(self._targets)})
        if found is None:
            return None
        loss, then = found["loss"], self.facts["loss"]
        if math.isfinite(loss) and math.isfinite(then) and not math.isclose(loss, then, rel_tol=ROUNDING):
            reason = f"the initial loss is {then:.4g} there, {loss:.4g} here: has a file of the scene changed?"
            raise earlier.other(reason)
        return {"judge_s": found["judge_s"]}

    def _divide(self, methods: int) -> bool:
        """Give each run its time; False where there is too little."""
        count = methods * self.plan.runs
        if count == 0:
            return False
        apart_s = POINTS * self.facts["judge_s"] + self._startup_s + GRACE_S  # what of its share a run cannot have
        if self._earlier is not None:
            return self._has_room(methods * ((1 + GRACE) * self.limit_s + apart_s))
        each = max(self._end - self._now(), 0.0) / count
        self.limit_s = (each - apart_s) / (1 + GRACE)
        if self.limit_s >= LEAST_S:
            return True
        needed = self._needed(count * (LEAST_S * (1 + GRACE) + apart_s))
        self._say(
            f"the budget of {self.plan.budget_s:g} s leaves no time for {count} runs: allow more than {needed:.0f} s "
            "with --budget, or fewer --runs or --integrators"
        )
        return False

    def _needed(self, seconds: float) -> float:
        """The budget that leaves so many seconds from now on."""
        return self._budget_for(self._now() - self._began + seconds)

    def _has_room(self, wave_s: float) -> bool:
        """Whether all runs of one seed, which have the time of those before them, are done within the budget."""
        self._wave_s = wave_s
        if self._pace.fits(wave_s):
            return True
        self._say(
            f"the budget of {self.plan.budget_s:g} s leaves no time for runs of {self.limit_s:.3g} s, as the earlier "
            f"ones: allow more than {self._needed(wave_s):.0f} s with --budget"
        )
        return False

    # --- the runs -----------------------------------------------------------------------------------------------------

    def _waves(self, sides: list[Side]) -> Iterator[RunPointRecord]:
        if self._earlier is not None:
            sides = [side for side in sides if self.plan.method_of(side) not in self._gone(self.members)]
        for number, seed in enumerate(self.plan.seeds):
            if number < self._seeds:
                continue
            if self._earlier is not None and not self._pace.fits(self._wave_s):
                self._say(f"not measured: runs from seed {seed} on: {NO_TIME}")
                return
            wave = []
            for side in sides:
                run = self._run(side, seed)
                config = with_run(self.plan.config_at(side), seed=seed)
                run.process = self._start(self._start_message(config), "whole_runs")
                wave.append(run)
                self._load(run)
            for turn, until_s in enumerate(times(self.limit_s)):
                for run in in_turn(wave, turn):
                    point = self._advance(run, until_s)
                    if point is not None:
                        run.points.append(point)
                        if all(other.complete(self.limit_s) or other.end or other.refusal for other in wave):
                            self._seeds = number + 1
                        yield point
            for run in wave:
                run.close()
            if self._pace.over() and any(not run.complete(self.limit_s) and run.end is None for run in wave):
                self._say(f"not measured: runs from seed {seed} on: {NO_TIME}")
                return
            if number == 0 and not any(run.state.iteration for run in wave):
                self._say(f"no method came to an iteration in the {self.limit_s:.3g} s of a run; allow several times "
                          "as much with --budget, or fewer --runs or --integrators")  # fmt: skip
                return
            sides = [side for side in sides if self.plan.method_of(side) not in self._gone(wave)]

    def _gone(self, runs: Sequence[Run]) -> set[Method]:
        """The methods that need not be tried with another seed: they refused, or need more memory than there is."""
        return {run.method for run in runs if run.refusal or (run.end and run.end.status is BenchStatus.OUT_OF_MEMORY)}

    def _run(self, side: Side, seed: int) -> Run:
        """One more of the members, not under way yet."""
        method = self.plan.method_of(side)
        state = RunPointRecord(method, seed, 0.0, 0, self.facts["loss"], self.facts["error"])
        out = self.folder / f"values-{len(self.members)}.npz"
        run = Run(process=None, may_refuse=self.plan.default, method=method, seed=seed, out=out, state=state)
        self.members.append(run)
        return run

    def _load(self, run: Run) -> None:
        """Have a run load its scene and take its decisions, before the next one starts: both are timed."""
        opening = run.answer(self._stop, self._late(2 * self._startup_s + self.limit_s))
        if opening is None:
            self._say_how(run)
            return
        self._warn(opening)
        run.counted_s = opening["loading_s"]
        for line in opening["chose"]:
            self._once(f"{run.method.label}: {line}")

    def _late(self, left_s: float, grace: float = GRACE) -> Callable[[], bool]:
        """Whether the whole is over, or a run has been waited for longer than what is left of its time."""
        allowed_s, began = left_s + grace * self.limit_s + GRACE_S, self._now()
        return lambda: self._pace.over() or self._now() - began > allowed_s

    def _advance(self, run: Run, until_s: float) -> RunPointRecord | None:
        """Where a run stands at some time; None where that cannot be known any more."""
        if run.alive:
            question = {"until_s": until_s, "limit_s": self.limit_s, "out": str(run.out), "release": self._tight()}
            left_s = max(self.limit_s - run.counted_s, 0.0)
            late = self._late(left_s, GRACE if run.first_s is None else CUT)
            answer = run.ask(question, self._stop, late)
            if answer is not None:
                run.counted_s = max(run.counted_s, until_s)
                taken = self._take(run, answer)
                return replace(run.state, elapsed_s=until_s) if taken else None
            self._say_how(run)
        if run.end is not None or run.refusal is not None or self._pace.over():
            return None
        # One that was cut off has not come any further: what it was at was not done by the end of its time.
        return replace(run.state, elapsed_s=until_s)

    def _take(self, run: Run, answer: dict[str, Any]) -> bool:
        """Keep an answer, and have new values judged; False where the budget was spent over that."""
        run.first_s, run.peak_mib = answer["first_s"], answer["peak_mib"]
        if answer["finished_s"] is not None:
            self._once(f"{run.method.label}: all iterations were done after {answer['finished_s']:.3g} s; "
                       "raise run.iterations to have it go on")  # fmt: skip
        if answer["iteration"] == run.state.iteration:
            return True
        judged = self._ask_referee(self.plan, {"values": str(run.out)})
        if judged is None:
            return False
        run.state = replace(
            run.state, iteration=answer["iteration"], loss=judged["loss"], parameter_error=judged["error"]
        )
        return True

    def _say_how(self, run: Run) -> None:
        self._say_end(run, run.method.label, f", seed {run.seed}")
        if run.late and not self._pace.over():
            self._say(f"{run.method.label}, seed {run.seed}: cut off in iteration {run.state.iteration + 1}")
