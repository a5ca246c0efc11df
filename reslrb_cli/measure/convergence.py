"""The members of a `convergence`: the compared methods, the reference, and the tests for bias.

All members take turns (`Engine`). Each member has separate seeds, so no two members share noise. With a file of draws,
only turns that are not on file are taken.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.draws import StoredResults, mixed_sessions, situation
from reslrb_cli.measure.engine import NO_TIME, Engine, Member, Request, Role
from reslrb_cli.measure.gradients import places
from reslrb_cli.measure.methods import ConvergencePlan, NamedIntegrator
from reslrb_cli.measure.processes import CannotStart
from reslrb_cli.records.decisions import key_of
from reslrb_cli.records.measurements import BenchStatus

#: Maximum memory for the draws of all methods, in bytes.
MEMORY = 2**30

#: Light paths of a step of an independent reference, which has its own sample count: naive AD keeps all paths.
INDEPENDENT_PATHS = 2**18

#: Fewer turns, or rows of a reference, give no useful standard error.
FEWEST = 3

#: Steps of a turn. The first one refills the caches.
TURN = {Role.CASE: 2, Role.REFERENCE: 8, Role.INDEPENDENT: 4}


class Session(Engine):
    """Members and their draws (see `Engine`).

    `judges` maps names of independent stock integrators to their members. `facts` and `arrays` are those of `survey`,
    which an additional process finds before the members start, unless they are on file. If this process fails, nothing
    is measured.
    """

    def __init__(
        self, plan: ConvergencePlan, stop: Callable[[], bool], say: Callable[[str], None], **given: Any
    ) -> None:
        super().__init__(plan, stop, say, **given)
        self.plan, self.rounds = plan, 0
        self.judges: dict[str, Member] = {}
        self.facts: Mapping[str, Any] = {}
        self._arrays: Mapping[str, np.ndarray] = {}
        self._survey_about: dict[str, Any] = {}

    def slices(self) -> dict[str, slice]:
        """Return the place of each parameter (or of the image) in a sample."""
        return places({key: int(np.prod(shape, dtype=int)) for key, shape in self.facts["shapes"].items()})

    def of(self, role: Role) -> list[Member]:
        """Return the members of one role."""
        return [member for member in self.members if member.request.role is role]

    def mixed_sessions(self) -> str:
        """Return a warning if efficiencies compare times of several sessions, or an empty text."""
        return mixed_sessions(member.draws for member in self.of(Role.CASE))

    def measure(self) -> Iterator[int]:
        """Measure. Yields the number of completed rounds after each round."""
        if self._survey():
            self._add_members()
            yield from self._take_turns()
        self._say_what_lacks()

    # --- before the rounds --------------------------------------------------------------------------------------------

    def _about(self, config: Config, **others: Any) -> dict[str, Any]:
        """Return the situation of draws. Without a file, `others` identify the draws of a session."""
        return others if self.file.path is None else situation(config, self.plan.variant, **others)

    def _survey(self) -> bool:
        """Find the references, and make dL/dI. Returns false if time is up."""
        plan, objective = self.plan, self.plan.objective
        self._survey_about = self._about(plan.reference_config, objective=objective, spp=plan.config.run.spp)
        stored = self.file.stored(self._survey_about)
        if stored is None:
            referee = Member(file=self.file, request=Request(
                case=plan.reference, config=plan.reference_config, label="survey", quantity=objective, spp=0,
                purpose="", about=self._survey_about,
            ))  # fmt: skip
            referee.process = self.launch(plan.reference_config, "begin_survey", objective=objective)
            with contextlib.closing(referee):
                found = self.open(referee)
            if referee.failure is not None:
                memory = referee.status is BenchStatus.OUT_OF_MEMORY
                code = ExitCode.OUT_OF_MEMORY if memory else ExitCode.CHECK_FAILED
                raise CannotStart(f"--reference {plan.reference.label}: {referee.failure.reason}", code)
            if found is None:
                self.say(f"dL/dI was not computed: {NO_TIME}")
                return False
            stored = StoredResults(**found)
            self.file.store(self._survey_about, stored)
        self.facts, self._arrays = stored.facts, stored.arrays
        return True

    def _why_not(self, case: NamedIntegrator) -> str | None:
        """Return why a method of the default list is left out, or None if it takes part."""
        if not self.plan.default:
            return None
        if self.facts["paths"] == "light" and case.options.get("paths", "light") != "light":
            return "this scene has only light paths"
        reason: str | None = self.facts["without"].get(case.type)
        return reason

    def _add_members(self) -> None:
        plan, facts = self.plan, self.facts
        left_out = {case.label: reason for case in plan.cases if (reason := self._why_not(case)) is not None}
        for label, reason in left_out.items():
            self.say(f"left out: {label}: {reason}")
        for case, spp in plan.entries:
            if case.label not in left_out:
                self._add(Role.CASE, case, plan.config_of(case, spp), plan.objective)
        reference = plan.settled_reference(facts["paths"])
        known = reference.at(plan.config, plan.config.integrator.max_depth, True)
        noise_free = "image" if plan.objective == "image" else "fixed"
        self._add(Role.REFERENCE, reference, known, noise_free)
        for name in dict.fromkeys(name for name in facts["independent"].values() if name is not None):
            config = plan.independent_config(name)
            same = [] if plan.objective == "loss" else [m for m in self.of(Role.CASE) if m.request.config == config]
            case = NamedIntegrator(name, name, {})
            self.judges[name] = same[0] if same else self._add(Role.INDEPENDENT, case, config, noise_free)
        for key, reason in facts["why"].items():
            if facts["independent"][key] is None:
                self.say(f"{key}: no independent reference ({reason}); biases are judged by {reference.label}")

    def _add(self, role: Role, case: NamedIntegrator, config: Config, quantity: str) -> Member:
        plan, spp = self.plan, config.run.spp
        if role is Role.INDEPENDENT and config.integrator.options().get("samples_per_pass") is None:
            spp = min(spp, max(INDEPENDENT_PATHS // self.facts["pixels"], 1))
        method = plan.method(case, config, spp, quantity != "loss", role is not Role.CASE)
        purpose = f"convergence, {role.value} {case.label}, {spp} spp"
        request = Request(
            case=case,
            config=config,
            label=method.label,
            quantity=quantity,
            spp=spp,
            purpose=purpose,
            about=self._about(
                config, quantity=quantity, purpose=purpose, count=TURN[role], dL_dI=key_of(self._survey_about)
            ),
            count=TURN[role],
            may_refuse=role is Role.INDEPENDENT or (role is Role.CASE and plan.default),
            role=role,
            method=method,
        )
        member = Member(request=request, file=self.file)
        self.members.append(member)
        return member

    # --- the rounds ---------------------------------------------------------------------------------------------------

    def _take_turns(self) -> Iterator[int]:
        self.rounds = max((len(member.kept) for member in self.members), default=0)
        if self.plan.rounds is None and self.rounds:
            self.pace.most = self.rounds  # a method without draws gets as many as the others have
            self.say(f"{self.file.path} has {self.rounds} rounds; --rounds adds more")
        lacking = [m for m in self.members if self._is_possible(m) and not m.kept.issuperset(range(self.pace.most))]
        for member in lacking:
            own = member.request
            if changed := self.file.differences(own.about):
                self.say(f"{own.label}: draws on file are of other {', '.join(changed)}, so they are not used")
        for member in self.begin(lacking, self._arrays):
            self._say_start(member)
        if not self._is_worthwhile(lacking):
            return
        size = sum(int(np.prod(shape, dtype=int)) for shape in self.facts["shapes"].values())
        fitting = MEMORY // (4 * size * sum(member.request.count for member in self.members))
        if fitting < self.pace.most:
            self.pace.most = max(fitting, FEWEST + 1)
            self.say(f"the memory for draws ends after {self.pace.most} rounds")
        for done in self.take_rounds():
            self.rounds = max(self.rounds, done)
            yield done

    def _is_possible(self, member: Member) -> bool:
        """Return False if an earlier session found that the method does not support the scene."""
        stored = self.file.stored(member.request.about)
        if stored is not None and member.request.may_refuse:
            member.end = CannotStart(stored.facts["refusal"], ExitCode.USAGE)
            self.say(f"left out: {member.request.label}: {member.end}")
        return member.end is None

    def _is_worthwhile(self, started: list[Member]) -> bool:
        """Return True if a case and the reference have draws or a process, and the time suffices for results."""
        usable = {member.request.role for member in self.members if member.alive or member.kept}
        round_s = sum(member.request.count * member.step_s for member in started if member.alive)
        return {Role.CASE, Role.REFERENCE} <= usable and self.pace.fits(FEWEST * round_s)

    def _say_start(self, member: Member) -> None:
        """Print how a member started, or how it ended."""
        own, draws = member.request, member.draws
        if member.refusal is not None:
            self.say(f"left out: {own.label}: {member.refusal}")
            if member.refusal.exit_code == ExitCode.USAGE:
                self.file.store(own.about, StoredResults({"refusal": str(member.refusal)}, {}))
        elif member.failure is not None:
            self.say(f"{own.label}: {member.status.value}: {member.failure.reason}")
        elif member.alive:
            what = "" if own.role is Role.CASE else f" ({own.role.value})"
            took = f"first step {(draws.cold_ms or 0) / 1e3:.1f} s, then {member.step_s:.3g} s"
            self.say(f"{own.label}{what}: {took}, {draws.peak_mib or 0:.0f} MiB")

    def _say_what_lacks(self) -> None:
        """Print which results need more time than the budget allowed."""
        late = [member.request.label for member in self.members if member.late]
        if late:
            self.say(f"not measured: {', '.join(late)}: {NO_TIME}")
        elif self.plan.rounds is None and self.rounds < FEWEST:
            self.say(f"results need {FEWEST} rounds: {NO_TIME}")
