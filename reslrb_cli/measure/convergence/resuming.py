"""Going on from the steps that an earlier session of a `convergence` has taken, with the same dL/dI."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config import dump
from reslrb_cli.measure import earlier
from reslrb_cli.measure.convergence.members import Member
from reslrb_cli.measure.convergence.plan import Plan
from reslrb_cli.measure.earlier import Earlier
from reslrb_cli.measure.processes import Ended
from reslrb_cli.records.samples import Kept

#: What is kept says that it is of this.
KIND = "convergence"


def settings(plan: Plan, device: str = "") -> dict[str, Any]:
    """What has to be the same in all sessions."""
    return earlier.settings(
        plan.config,
        plan.variant,
        device,
        objective=plan.objective,
        integrators=[case.label for case in plan.cases],
        reference=plan.reference.label,
        spp=list(plan.spps),
        **{"memory limit": plan.memory_limit},
    )


def check(plan: Plan, before: Earlier, device: str = "") -> None:
    """Raise ConfigError where a session cannot go on from an earlier one, or has nothing to add to it."""
    before.check(settings(plan, device))
    if plan.rounds is not None and before.head["rounds"] >= plan.rounds:
        rounds = before.head["rounds"]
        raise before.complete(f"{rounds} rounds", "more with --rounds")


def restore_facts(before: Earlier, arrays_file: Path) -> dict[str, Any]:
    """The survey's facts; its arrays are written to `arrays_file`."""
    found = {name.removeprefix("survey/"): a for name, a in before.arrays.items() if name.startswith("survey/")}
    np.savez(arrays_file, **found)  # type: ignore[arg-type]
    facts: dict[str, Any] = before.head["facts"]
    return facts


def restore(before: Earlier, members: list[Member]) -> int:
    """Hand the members their steps; returns the number of rounds. Raises ConfigError where they are others.

    One whose process has ended, or refused, is not asked again.
    """
    entries = before.head["members"]
    if [name_of(member) for member in members] != [entry["name"] for entry in entries]:
        raise before.other("its methods are others: " + ", ".join(entry["name"] for entry in entries))
    for number, (member, entry) in enumerate(zip(members, entries, strict=True)):
        if entry["config"] != dump(member.config):
            raise before.other(f"its settings are not those of {member.label} here")
        member.taken, member.turns, member.seconds = entry["taken"], entry["turns"], entry["seconds"]
        member.message, member.cold = entry["message"], entry["cold"]
        member.rows = list(before.arrays[f"rows/{number}"])
        member.end = Ended.restored(entry["end"])
        if member.end is not None:
            member.process.close()
    rounds: int = before.head["rounds"]
    return rounds


def name_of(member: Member) -> str:
    """A member's role and label."""
    return f"{member.role.value} {member.label}"


def kept(
    settings: Mapping[str, Any], facts: dict[str, Any], arrays_file: Path, members: list[Member], rounds: int
) -> Kept:
    """What a later session needs to go on: a head that JSON can hold, and arrays."""
    with np.load(arrays_file) as survey:
        arrays = {f"survey/{name}": survey[name] for name in survey.files}
    entries = []
    for number, member in enumerate(members):
        # A round that was broken off is not: the next session begins it anew, with other seeds.
        turns = [turn for turn in member.turns if turn < rounds]
        entries.append({"name": name_of(member), "config": dump(member.config), "taken": member.taken,
                        "turns": turns, "seconds": member.seconds[: len(set(turns))], "message": member.message,
                        "cold": member.cold, "end": member.end and member.end.kept()})  # fmt: skip
        arrays[f"rows/{number}"] = np.array(member.rows[: len(turns)], np.float32)
    return earlier.head(KIND, settings, facts=facts, rounds=rounds, members=entries), arrays
