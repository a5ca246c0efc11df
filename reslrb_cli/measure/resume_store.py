"""Going on from what an earlier session has measured: the same experiment, measured in the same way."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reslrb_cli.config.loader import dump
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import parse
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.manifest import versions
from reslrb_cli.records.measurement_files import read_samples, samples_file

if TYPE_CHECKING:
    import numpy as np

#: Of what is kept; another one is not gone on from.
VERSION = 3

#: Where the settings have digests of files.
FILES = "files"

#: What a setting is called that one side does not have.
_ABSENT = "not given"

#: Characters that are shown of a setting.
_SHOWN = 60


def settings(config: Config, codes: Mapping[str, Path], variant: str, device: str, **options: Any) -> dict[str, Any]:
    """Return what has to be the same in all sessions of a measurement, as JSON has it.

    `codes` are the files of integrators that the command names, `options` those of the command. Files count by their
    contents. What computes counts too, since times of all sessions stand beside each other.
    """
    from reslrb_cli.scene.files import file_digests, files_of  # which loads Mitsuba

    return {
        "config": parse(dump(config), str(config.source)),
        **options,
        "variant": variant,
        "device": device,
        "versions": versions(),
        FILES: file_digests({**files_of(config), **codes}),
    }


class Earlier:
    """What an earlier session has kept: a `head`, which JSON can hold, and `arrays`; `source` is the file's name.

    `kind` says what was measured. Raises ConfigError where that, or the version of what is kept, is another.
    """

    def __init__(self, kind: str, source: Path, head: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        self.source, self.head, self.arrays = source, head, arrays
        if head.get("version") != VERSION:
            raise ConfigError("--resume", "", f"{source} was written by another version")
        if head.get("kind") != kind:
            raise self.other(f"it is of `{head.get('kind')}`, this is `{kind}`")

    def check(self, now: Mapping[str, Any]) -> None:
        """Raise ConfigError, which names the first difference, where the `settings` are not those of this session."""
        found = first_difference(self.head["settings"], now)
        if found is not None:
            raise self.other(found)

    @classmethod
    def read(cls, kind: str, json_file: Path | None, now: Mapping[str, Any] | None = None) -> Earlier | None:
        """What lies beside a JSON file that another call has written; None for no file.

        Raises ConfigError, also where its settings are not those of `now`, if these are known yet.
        """
        if json_file is None:
            return None
        earlier = cls(kind, json_file, *read_samples(samples_file(json_file)))
        if now is not None:
            earlier.check(now)
        return earlier

    def error(self, reason: str) -> ConfigError:
        """What is raised where it cannot be gone on from."""
        return ConfigError("--resume", "", f"{self.source} {reason}")

    def other(self, reason: str) -> ConfigError:
        """The same where it is of another measurement."""
        return self.error(f"is of another measurement: {reason}")

    def complete(self, what: str, advice: str) -> ConfigError:
        """The same where it has `what` is asked for; `advice` says how to ask for more."""
        return self.error(f"has {what} already; name {advice}")


def head(kind: str, settings: Mapping[str, Any], **content: Any) -> dict[str, Any]:
    """The head of what is kept."""
    return {"version": VERSION, "kind": kind, "settings": settings, **content}


def first_difference(there: Any, here: Any, place: str = "") -> str | None:
    """The first entry in which two nested mappings differ, in words; None where they are equal."""
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        for key in dict.fromkeys([*there, *here]):
            inner = str(key) if place in ("", "config") else f"{place}.{key}"
            found = first_difference(there.get(key, _ABSENT), here.get(key, _ABSENT), inner)
            if found is not None:
                return found
        return None
    if there == here:
        return None
    if place.startswith(f"{FILES}."):
        what = "is new" if there == _ABSENT else "has gone" if here == _ABSENT else "has changed"
        return f"{place.removeprefix(f'{FILES}.')} {what}"
    return f"{place} is {_short(there)} there, {_short(here)} here"


def _short(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= _SHOWN else text[:_SHOWN] + "..."
