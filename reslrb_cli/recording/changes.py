"""What of an experiment may change while its run goes on, and what may not."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from reslrb_cli.config import Config
from reslrb_cli.errors import ConfigError

#: Settings that decide nothing of what the iterations until then were. All others would make it another run.
MAY_CHANGE = re.compile(
    r"run\.(iterations|name|output|checkpoint_every|images_every|certainty|on_nonfinite)(\..*)?"
    r"|optimizer\.learning_rate|parameters\[\d+\]\.learning_rate(\..*)?"
)
#: Those that say where a run is written, which its folder says itself.
_PLACE = ("run.name", "run.output")
#: Differing settings that an error names.
_SHOWN = 3

Change = tuple[Any, Any]


def changes(before: Config, now: Config) -> dict[str, Change]:
    """The settings that differ, by key, as they were and as they are; None where there was or is none."""
    first, second = flat(before), flat(now)
    return {
        key: (first.get(key), second.get(key))
        for key in dict.fromkeys((*first, *second))
        if first.get(key) != second.get(key)
    }


def check_changes(found: Mapping[str, Change], blame: Callable[[str], object], run: Path) -> dict[str, Change]:
    """Of the settings that differ those that may, where the run is written left out.

    Raises ConfigError, located by the first key that must not and by who is to `blame` for it, with the first few of
    them.
    """
    wrong = [key for key in found if not MAY_CHANGE.fullmatch(key)]
    if wrong:
        first, *others = [f"{_shown(found[key][1])}, {_shown(found[key][0])} in the run" for key in wrong[:_SHOWN]]
        more = [f"{key} is {what}" for key, what in zip(wrong[1:], others, strict=False)]
        more += [f"{len(wrong) - _SHOWN} more"] if len(wrong) > _SHOWN else []
        also = f"; also {'; '.join(more)}" if more else ""
        raise ConfigError(
            blame(wrong[0]),
            wrong[0],
            f"is {first}{also}; {run} goes on as it began, but for iterations and learning rates",
        )
    return {key: change for key, change in found.items() if key not in _PLACE}


def flat(config: Config) -> dict[str, Any]:
    """All settings by their keys, as `--set` names them; those of None left out."""
    found: dict[str, Any] = {}

    def add(key: str, value: Any) -> None:
        if isinstance(value, dict):
            for name, each in value.items():
                add(f"{key}.{name}" if key else str(name), each)
        elif isinstance(value, (list, tuple)) and any(isinstance(each, dict) for each in value):
            for place, each in enumerate(value):
                add(f"{key}[{place}]", each)
        elif value is not None:
            found[key] = value

    add("", config.model_dump(mode="json", exclude_none=True))
    return found


def _shown(value: Any) -> str:
    text = "not set" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
