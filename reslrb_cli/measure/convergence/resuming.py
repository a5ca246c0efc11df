"""Going on from the steps that an earlier session has taken: the same experiment, the same methods, the same dL/dI."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config import dump
from reslrb_cli.errors import ConfigError
from reslrb_cli.measure.convergence.members import Member

#: Of what is kept; another one is not gone on from.
VERSION = 1


class Earlier:
    """What an earlier session has kept, by `head` and `arrays` as `kept` returned them; `source` is the file's name."""

    def __init__(self, source: Path, head: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        self.source, self.head, self.arrays = source, head, arrays
        if head.get("version") != VERSION:
            raise ConfigError("--resume", "", f"{source} was written by another version")

    def facts(self, objective: str, arrays_file: Path) -> dict[str, Any]:
        """The survey's facts; its arrays are written to `arrays_file`. Raises ConfigError for another objective."""
        if self.head["objective"] != objective:
            raise self._other(f"its objective is {self.head['objective']}")
        found = {name.removeprefix("survey/"): a for name, a in self.arrays.items() if name.startswith("survey/")}
        np.savez(arrays_file, **found)  # type: ignore[arg-type]
        facts: dict[str, Any] = self.head["facts"]
        return facts

    def restore(self, members: list[Member]) -> int:
        """Hand the members their steps; returns the number of rounds. Raises ConfigError where they are others."""
        if [name_of(member) for member in members] != [entry["name"] for entry in self.head["members"]]:
            raise self._other("its methods are others: " + ", ".join(e["name"] for e in self.head["members"]))
        for number, (member, entry) in enumerate(zip(members, self.head["members"], strict=True)):
            if entry["config"] != dump(member.config):
                raise self._other(f"its settings are not those of {member.label} here")
            member.taken, member.turns, member.seconds = entry["taken"], entry["turns"], entry["seconds"]
            member.rows = list(self.arrays[f"rows/{number}"])
        rounds: int = self.head["rounds"]
        return rounds

    def _other(self, reason: str) -> ConfigError:
        return ConfigError("--resume", "", f"{self.source} is of another measurement: {reason}")


def name_of(member: Member) -> str:
    """A member's role and label."""
    return f"{member.role.value} {member.label}"


def kept(
    objective: str, facts: dict[str, Any], arrays_file: Path, members: list[Member], rounds: int
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """What a later session needs to go on: a head that JSON can hold, and arrays."""
    with np.load(arrays_file) as survey:
        arrays = {f"survey/{name}": survey[name] for name in survey.files}
    entries = []
    for number, member in enumerate(members):
        entries.append({"name": name_of(member), "config": dump(member.config), "taken": member.taken,
                        "turns": member.turns, "seconds": member.seconds})  # fmt: skip
        arrays[f"rows/{number}"] = np.array(member.rows, np.float32)
    head = {"version": VERSION, "objective": objective, "facts": facts, "rounds": rounds, "members": entries}
    return head, arrays
