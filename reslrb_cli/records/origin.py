"""Where a file of measurements comes from: its first line, before what was measured."""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from reslrb_cli.errors import printable
from reslrb_cli.records.manifest import now, versions

KIND = "origin"


def _command() -> list[str]:
    """The command line of this process, as it can be typed anywhere: the program without its folder."""
    return ["reslrb", *(printable(word) for word in sys.argv[1:])]


@dataclass(frozen=True)
class Origin:
    """What measured, on what, and the command that does it again.

    `command` are its words, `versions` those of `manifest.json`; `written` is when the file was begun. What a damaged
    or foreign line does not tell is empty.
    """

    device: str
    variant: str
    command: Sequence[str] = field(default_factory=_command)
    versions: Mapping[str, str] = field(default_factory=versions)
    platform: str = field(default_factory=platform.platform)
    written: str = field(default_factory=now)

    def to_json(self) -> str:
        """The record as one line of JSON."""
        return json.dumps({"kind": KIND, **asdict(self)}, allow_nan=False)


def read_origin(entry: Mapping[str, Any]) -> Origin | None:
    """The record that a line holds; None where it holds another one. Members of other types than theirs are empty."""
    if entry.get("kind") != KIND:
        return None
    words, named = entry.get("command"), entry.get("versions")
    texts = {name: entry.get(name) for name in ("device", "variant", "platform", "written")}
    return Origin(
        command=[str(word) for word in words] if isinstance(words, list) else [],
        versions={str(name): str(value) for name, value in named.items()} if isinstance(named, dict) else {},
        **{name: value if isinstance(value, str) else "" for name, value in texts.items()},
    )
