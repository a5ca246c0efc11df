"""The members of a `convergence`: the compared methods, the reference, and the tests for bias.

All members take turns (`Engine`). Each member has separate seeds, so no two members share noise. With a file of draws,
only turns that are not on file are taken.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from reslrb_cli.config.schema import Config
from reslrb_cli.errors import ExitCode
from reslrb_cli.measure.draws import StoredResults, situation
from reslrb_cli.measure.engine import NO_TIME, Engine, Member, Role
from reslrb_cli.measure.methods import ROUNDS, MeasurementPlan, NamedIntegrator
from reslrb_cli.measure.processes import CannotStart, Ended, Stopped
from reslrb_cli.records.decisions import key_of
from reslrb_cli.records.measurements import BenchStatus

#: Maximum memory for the draws of all methods, in bytes.
MEMORY = 2**30

#: Light paths of a step of an independent reference, which has its own sample count: naive AD keeps all paths.
INDEPENDENT_PATHS = 2**18

#: Fewer turns, or rows of a reference, give no useful standard error.
FEWEST = 3

#: Steps of a turn. The first one refills the caches.
TURN: dict[Role, int] = {"case": 2, "reference": 8, "independent": 4}


class Session(Engine):
    """Members and their draws (see `Engine`).

    `judges` maps names of independent stock integrators to their members. `facts` and `arrays` are those of `survey`,
    which an additional process finds before the members start, unless they are on file. If this process fails, nothing
    is measured.
    """

    def __init__(
        self, plan: MeasurementPlan, stop: Callable[[], bool], say: Callable[[str], None], **given: Any
    ) -> None:
        super().__init__(plan, stop, say, ROUNDS, **given)
        self.rounds = 0
        self.judges: dict[str, Member] = {}
        self.facts: Mapping[str, Any] = {}
        self._arrays: Mapping[str, np.ndarray] = {}
        self._survey_about: dict[str, Any] = {}

    def of(self, role: Role) -> list[Member]:
        """Return the members of one role."""
        return [member for member in self.members if member.role == role]

    def measure(self) -> Iterator[int]:
        """Measure. Yields the number of completed rounds after each round."""
        if self._survey():
            self._add_members()
            yield from self._take_turns()
            if self.unmeasured:
                self.say(f"not measured: {', '.join(self.unmeasured)}: {NO_TIME}")
            elif self.is_late() and self.rounds < FEWEST:
                self.say(f"results need {FEWEST} rounds: {NO_TIME}")

    # --- before the rounds --------------------------------------------------------------------------------------------

    def _about(self, config: Config, **others: Any) -> dict[str, Any]:
        """Return the situation of draws. Without a file, `others` identify the draws of a session."""
        return others if self.file.path is None else situation(config, self.plan.variant, **others)

    def _survey(self) -> bool:
        """Find the references, and make dL/dI. Returns false if time is up."""
        plan, objective = self.plan, self.plan.quantity
        assert plan.reference is not None, "this is no bench"
        config = plan.of_reference(plan.reference)
        self._survey_about = self._about(config, objective=objective, spp=plan.config.run.spp)
        stored = self.file.stored(self._survey_about)
        if stored is None:
            process = self.launch(config, quantity="survey", objective=objective)
            try:
                stored = StoredResults(**self.hear(process))
            except Ended as end:
                memory = end.status is BenchStatus.OUT_OF_MEMORY
                code = ExitCode.OUT_OF_MEMORY if memory else ExitCode.CHECK_FAILED
                raise CannotStart(f"--reference {plan.reference.label}: {end.reason}", code) from None
            except Stopped:
                if self.is_late():
                    self.say(f"dL/dI was not computed: {NO_TIME}")
                return False
            finally:
                process.close()
            self.file.store(self._survey_about, stored)
        self.facts, self._arrays = stored.facts, stored.arrays
        return True

    def _add_members(self) -> None:
        plan, facts = self.plan, self.facts
        for case in plan.cases:
            reason = facts["without"].get(case.type)
            if facts["paths"] == "light" and case.options.get("paths", "light") != "light":
                reason = "this scene has only light paths"
            if reason is not None and plan.default:
                self.say(f"left out: {case.label}: {reason}")
                continue
            for spp in plan.values:
                self._add("case", case, plan.at(case, spp))
        reference = plan.settled_reference(facts["paths"])
        self._add("reference", reference, plan.of_reference(reference))
        for name in dict.fromkeys(name for name in facts["independent"].values() if name is not None):
            judge = plan.independent_reference(name)
            config = plan.of_reference(judge)
            same = [] if plan.quantity == "loss" else [m for m in self.of("case") if m.config == config]
            self.judges[name] = same[0] if same else self._add("independent", judge, config)
        for key, reason in facts["why"].items():
            if facts["independent"][key] is None:
                self.say(f"{key}: no independent reference ({reason}); biases are judged by {reference.label}")

    def _add(self, role: Role, case: NamedIntegrator, config: Config) -> Member:
        plan, spp, count = self.plan, config.run.spp, TURN[role]
        if role == "independent" and config.integrator.options().get("samples_per_pass") is None:
            spp = min(spp, max(INDEPENDENT_PATHS // self.facts["pixels"], 1))
        quantity = plan.quantity if role == "case" or plan.quantity == "image" else "fixed"
        several = role == "case" and list(plan.values) != [plan.config.run.spp]
        purpose = f"convergence, {role} {case.label}, {spp} spp"
        about = self._about(
            config, quantity=quantity, purpose=purpose, count=count, dL_dI=key_of(self._survey_about)
        )  # fmt: skip
        member = Member(
            case=case, config=config, label=f"{case.label}, {spp} spp" if several else case.label, quantity=quantity,
            spp=spp, purpose=purpose, about=about, file=self.file, count=count,
            may_refuse=role == "independent" or (role == "case" and plan.default), role=role,
        )  # fmt: skip
        self.members.append(member)
        return member

    # --- the rounds ---------------------------------------------------------------------------------------------------

    def _take_turns(self) -> Iterator[int]:
        self.rounds = max((len(member.kept) for member in self.members), default=0)
        lacking = [m for m in self.members if self._is_possible(m) and not m.kept.issuperset(range(self.most))]
        for member in lacking:
            if changed := self.file.differences(member.about):
                self.say(f"{member.label}: draws on file are of other {', '.join(changed)}, so they are not used")
        for member in self.begin(lacking, self._arrays):
            self._say_start(member)
        usable = {member.role for member in self.members if member.process is not None or member.kept}
        if not usable.issuperset(("case", "reference")):
            return
        size = sum(int(np.prod(shape, dtype=int)) for shape in self.facts["shapes"].values())
        fitting = MEMORY // (4 * size * sum(member.count for member in self.members))
        if fitting < self.most:
            self.most = max(fitting, FEWEST + 1)
            self.say(f"the memory for draws ends after {self.most} rounds")
        for done in self.take_rounds():
            self.rounds = max(self.rounds, done)
            yield done

    def _is_possible(self, member: Member) -> bool:
        """Return False if an earlier session found that the method does not support the scene."""
        stored = self.file.stored(member.about)
        if stored is not None and member.may_refuse:
            member.status, member.reason = BenchStatus.REFUSED, stored.facts["refusal"]
            self._say_start(member)
        return member.status is BenchStatus.OK

    def _say_start(self, member: Member) -> None:
        """Print how a member started, or how it ended."""
        if member.status is BenchStatus.REFUSED:
            self.say(f"left out: {member.label}: {member.reason}")
        elif member.status is not BenchStatus.OK:
            self.say(f"{member.label}: {member.status.value}: {member.reason}")
        elif member.process is not None:
            what, draws = "" if member.role == "case" else f" ({member.role})", member.draws
            took = f"first step {(draws.cold_ms or 0) / 1e3:.1f} s, then {member.step_s:.3g} s"
            self.say(f"{member.label}{what}: {took}, {draws.peak_mib or 0:.0f} MiB")
