"""Stored samples. A sample is not taken again if an earlier call with the same experiment and settings has taken the
sample.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reslrb_cli.config.loader import dump
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import parse
from reslrb_cli.errors import ConfigError, one_line
from reslrb_cli.records.manifest import versions
from reslrb_cli.records.measurement_files import Kept, read_samples, samples_file

if TYPE_CHECKING:
    import numpy as np

#: Name of samples: an integrator, a parameter.
Name = tuple[str, ...]

#: Version of the file of samples; other versions are not continued.
VERSION = 4

#: Settings that contain digests of files.
FILES = "files"

#: Text for a setting that one side lacks.
_ABSENT = "not given"

#: Maximum number of shown characters of a setting.
_SHOWN = 60


@functools.cache
def program() -> dict[str, str]:
    """Return the versions that results depend on, and a digest of this program's code."""
    code = hashlib.blake2b(digest_size=16)
    for path in sorted(Path(__file__).parent.parent.rglob("*.py")):
        code.update(path.read_bytes())
    return {**versions(), "code": code.hexdigest()}


def settings(config: Config, codes: Mapping[str, Path], variant: str, device: str, **options: Any) -> dict[str, Any]:
    """Return the settings that must be the same in all sessions of a measurement, as JSON.

    `codes` are the files of integrators that the command names. `options` are the command's options. Files are compared
    by their contents. The variant and the device are included, because times of all sessions are compared.
    """
    from reslrb_cli.scene.files import file_digests, files_of  # which loads Mitsuba

    return {
        "config": parse(dump(config), str(config.source)),
        **options,
        "variant": variant,
        "device": device,
        "versions": program(),
        FILES: file_digests({**files_of(config), **codes}),
    }


class Earlier:
    """Samples stored beside `source`, the file of `--json`. The samples consist of a `head` as JSON, and `arrays`.

    Raises ConfigError if the samples belong to another `kind` of measurement, or if another version wrote the samples.
    """

    def __init__(self, kind: str, source: Path, head: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        self.source, self.head, self.arrays = source, head, arrays
        if head.get("version") != VERSION:
            raise self.other("it was written by another version")
        if head.get("kind") != kind:
            raise self.other(f"it belongs to `{head.get('kind')}`, this is `{kind}`")

    def check(self, now: Mapping[str, Any]) -> None:
        """Raise ConfigError if the `settings` differ from the settings of this session. The error names the first
        difference.
        """
        found = first_difference(self.head["settings"], now)
        if found is not None:
            raise self.other(found)

    @classmethod
    def read(cls, kind: str, json_file: Path | None, now: Mapping[str, Any] | None = None) -> Earlier | None:
        """Return the stored samples beside a JSON file, or None if there are none.

        Raises ConfigError if samples are unreadable or have settings other than `now`. If `now` is None, settings are
        not compared.
        """
        if json_file is None or not json_file.is_file() or not samples_file(json_file).exists():
            return None
        earlier = cls(kind, json_file, *read_samples(samples_file(json_file)))
        if now is not None:
            earlier.check(now)
        return earlier

    @property
    def samples(self) -> dict[Name, np.ndarray]:
        """The samples by name, (N, ...), in the order of their seeds."""
        return {tuple(name): self.arrays[f"samples/{number}"] for number, name in enumerate(self.head["samples"])}

    def other(self, reason: str) -> ConfigError:
        """Return the error for stored samples of another measurement. The samples of another measurement must not be
        overwritten.
        """
        advice = "remove the file, or use another one"
        return ConfigError("--json", "", f"{self.source} belongs to another measurement: {reason}; {advice}")


def kept(
    kind: str, settings: Mapping[str, Any], samples: Mapping[Any, Sequence[np.ndarray]] | None, **content: Any
) -> Kept | None:
    """Return the data to store, or None if `samples` is empty. `samples` maps each `Name` to samples in the order of
    their seeds, or is None if the `content` has all results.
    """
    import numpy as np  # the help of a command does not need it

    taken = {name: rows for name, rows in (samples or {}).items() if len(rows)}
    if samples is not None and not taken:
        return None
    head = {"version": VERSION, "kind": kind, "settings": settings, "samples": list(taken), **content}
    return head, {f"samples/{number}": np.stack(rows) for number, rows in enumerate(taken.values())}


def first_difference(there: Any, here: Any, place: str = "") -> str | None:
    """Describe the first difference between two nested mappings, or return None if they are equal."""
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
    return f"{place} is {one_line(there, _SHOWN)} there, {one_line(here, _SHOWN)} here"
