"""Members of a `convergence`: the compared methods, the reference, and the tests for bias.

All members take turns (`Arena`). Each member has separate seeds, so no two members share noise.
"""

from __future__ import annotations

import contextlib
import enum
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.arena import NO_TIME, Arena, Contestant
from reslrb_cli.measure.gradients import places
from reslrb_cli.measure.methods import ConvergencePlan, NamedIntegrator
from reslrb_cli.measure.processes import CannotStart
from reslrb_cli.records.measurements import BenchStatus, Method

#: The module of the functions that processes run.
STEPS = "reslrb_cli.measure.steps"

#: Maximum memory for the samples of all methods, in bytes.
MEMORY = 2**30

#: Light paths of a step of an independent reference, which has its own sample count: naive AD keeps all paths.
INDEPENDENT_PATHS = 2**18

#: Fewer turns, or rows of a reference, give no useful standard error.
FEWEST = 3


class Role(str, enum.Enum):
    """Role of a member."""

    CASE = "case"
    REFERENCE = "reference"
    INDEPENDENT = "independent"


#: Steps of a turn. The first one refills the caches.
TURN = {Role.CASE: 2, Role.REFERENCE: 8, Role.INDEPENDENT: 4}


@dataclass(kw_only=True)
class Member(Contestant):
    """Process of one member, with its steps so far.

    `rows` are samples (P,), `turns` are their rounds, and `seconds` has the time of one step in each turn. `taken` is
    the number of all requested steps, which determines the seeds.
    """

    role: Role
    method: Method
    config: Config
    spp: int
    out: Path
    taken: int = 0
    step_s: float = 0.0
    rows: list[np.ndarray] = field(default_factory=list)
    turns: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    message: str = ""

    @property
    def count(self) -> int:
        """The number of steps in a turn."""
        return TURN[self.role]

    @property
    def label(self) -> str:
        """Name of the method."""
        return self.method.label

    @property
    def cold_s(self) -> float | None:
        """Seconds of the first step, which includes compilation."""
        return None if self.cold is None else self.cold["step_ms"][0] / 1e3

    @property
    def name(self) -> str:
        """Role and label."""
        return f"{self.role.value} {self.label}"

    def question(self, round: int | None) -> dict[str, Any]:
        """Return the request for the steps of a turn, with the round's dL/dI. During warm-up, a turn has one step."""
        start, count = self.taken, 1 if round is None else self.count
        self.taken += count
        return {"start": start, "count": count, "spp": self.spp, "image": round or 0, "out": str(self.out)}

    def keep(self, round: int, answer: dict[str, Any]) -> None:
        """Record a turn's steps."""
        rows = np.load(self.out)
        if not np.isfinite(rows).all() and not self.message:
            self.message = f"{np.count_nonzero(~np.isfinite(rows))} entries of step {len(self.rows) + 1} are not finite"
        self.rows += list(rows)
        self.turns += [round] * len(rows)
        times = answer["step_ms"]
        self.seconds.append(float(np.mean(times[1:] if len(times) > 1 else times)) / 1e3)


class Session(Arena[ConvergencePlan, Member, int]):
    """Running processes and their samples (see `Arena`).

    `judges` maps names of independent stock integrators to their members. `facts` are those of `survey`, which an
    additional process, the referee, finds before the members start. If the referee fails, nothing is measured.
    """

    def _set_up(self) -> int:
        self.rounds = 0
        self.judges: dict[str, Member] = {}
        self.facts: dict[str, Any] = {}
        return 1

    def slices(self) -> dict[str, slice]:
        """Return the place of each parameter (or of the image) in a sample."""
        return places({key: int(np.prod(shape, dtype=int)) for key, shape in self.facts["shapes"].items()})

    def of(self, role: Role) -> list[Member]:
        """Return the members of one role."""
        return [member for member in self.members if member.role is role]

    def _course(self) -> Iterator[int]:
        """Measure. Yields the number of completed rounds after each round."""
        if self._survey():
            self._begin()
            self._warm_up_all()
            yield from self._take_turns()
        self._say_what_lacks()

    @property
    def _arrays(self) -> Path:
        """File of the survey's arrays."""
        return self.folder / "arrays.npz"

    # --- before the rounds --------------------------------------------------------------------------------------------

    def _survey(self) -> bool:
        """Find the references, and make dL/dI. Returns false if time is up."""
        plan = self.plan
        first = plan.first(plan.reference_config) | {"arrays": str(self._arrays), "objective": plan.objective}
        referee = Contestant(process=self._start(first, f"{STEPS}:begin_survey"), may_refuse=False)
        with contextlib.closing(referee):
            facts = self._open(referee)
        if referee.end is not None:
            memory = referee.end.status is BenchStatus.OUT_OF_MEMORY
            code = ExitCode.OUT_OF_MEMORY if memory else ExitCode.CHECK_FAILED
            raise CannotStart(f"--reference {plan.reference.label}: {referee.end.reason}", code)
        self.facts = facts or {}
        if facts is None:
            self._say(f"dL/dI was not computed: {NO_TIME}")
        return facts is not None

    def _why_not(self, case: NamedIntegrator) -> str | None:
        """Return why a method of the default list is left out, or None if it takes part."""
        if not self.plan.default:
            return None
        if self.facts["paths"] == "light" and case.options.get("paths", "light") != "light":
            return "this scene has only light paths"
        reason: str | None = self.facts["without"].get(case.type)
        return reason

    def _begin(self) -> None:
        plan, facts = self.plan, self.facts
        left_out = {case.label: reason for case in plan.cases if (reason := self._why_not(case)) is not None}
        for label, reason in left_out.items():
            self._say(f"left out: {label}: {reason}")
        for case, spp in plan.entries:
            if case.label not in left_out:
                self._add(Role.CASE, case, plan.config_of(case, spp), plan.objective)
        reference = plan.settled_reference(facts["paths"])
        known = reference.at(plan.config, plan.config.integrator.max_depth, True)
        self._add(Role.REFERENCE, reference, known, self._noise_free)
        for name in dict.fromkeys(name for name in facts["independent"].values() if name is not None):
            config = plan.independent_config(name)
            same = [] if plan.objective == "loss" else [m for m in self.of(Role.CASE) if m.config == config]
            self.judges[name] = (
                same[0]
                if same
                else self._add(Role.INDEPENDENT, NamedIntegrator(name, name, {}), config, self._noise_free)
            )
        for key, reason in facts["why"].items():
            if facts["independent"][key] is None:
                self._say(f"{key}: no independent reference ({reason}); biases are judged by {reference.label}")

    @property
    def _noise_free(self) -> str:
        return "image" if self.plan.objective == "image" else "fixed"

    def _add(self, role: Role, case: NamedIntegrator, config: Config, objective: str) -> Member:
        plan, number, spp = self.plan, len(self.members), config.run.spp
        if role is Role.INDEPENDENT and config.integrator.options().get("samples_per_pass") is None:
            spp = min(spp, max(INDEPENDENT_PATHS // self.facts["pixels"], 1))
        method = plan.method(case, config, spp, objective != "loss", role is not Role.CASE)
        first = plan.first(config) | {
            "arrays": str(self._arrays),
            "mode": objective,
            "purpose": f"convergence, {role.value} {method.label}",
        }
        member = Member(
            process=self._start(first, f"{STEPS}:begin_sampling"),
            may_refuse=role is Role.INDEPENDENT or (role is Role.CASE and plan.default),
            role=role,
            method=method,
            config=config,
            spp=spp,
            out=self.folder / f"steps-{number}.npy",
        )
        self.members.append(member)
        return member

    def _warm_up_all(self) -> None:
        for member in self.members:
            if member.alive:
                self._open(member)
        for member in self.members:
            answer = self._warm_up(member) if member.alive else None
            self._say_end(member, member.label)
            if answer is not None and member.cold is not None:
                member.step_s = answer["step_ms"][0] / 1e3
                what = "" if member.role is Role.CASE else f" ({member.role.value})"
                took = (
                    f"first step {member.cold_s:.1f} s, then {member.step_s:.3g} s, {member.cold['peak_mib']:.0f} MiB"
                )
                self._say(f"{member.label}{what}: {took}")

    # --- the rounds ---------------------------------------------------------------------------------------------------

    def _take_turns(self) -> Iterator[int]:
        alive = self._alive()
        if not {Role.CASE, Role.REFERENCE} <= {member.role for member in alive}:
            return
        round_s = sum(member.count * member.step_s for member in alive)
        if not self._pace.fits(FEWEST * round_s):
            return
        size = sum(int(np.prod(shape, dtype=int)) for shape in self.facts["shapes"].values())
        most = max(MEMORY // (4 * size * sum(member.count for member in alive)), FEWEST + 1)
        rounds = self._take_rounds()
        while self.rounds < most and (now := next(rounds, None)) is not None:
            self.rounds = now
            yield now

    def _say_what_lacks(self) -> None:
        """Print which results need more time than the budget allowed."""
        late = [member.label for member in self.members if member.late]
        if late:
            self._say(f"not measured: {', '.join(late)}: {NO_TIME}")
        elif self.plan.rounds is None and self.rounds < FEWEST:
            self._say(f"results need {FEWEST} rounds: {NO_TIME}")
