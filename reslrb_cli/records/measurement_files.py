"""Files of measurements, JSON with one object per line.

`write_lines` writes a file that is complete at every moment, no matter how the process ends. The first line is an
`Origin`, which says where the file comes from. `read_lines` reads such files. The file `NAME.samples.npz` holds the
samples behind the figures. A sample is not taken again if an earlier call with the same experiment and settings has
taken the sample (`Earlier`).
"""

from __future__ import annotations

import functools
import hashlib
import json
import logging
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError, one_line, printable
from reslrb_cli.records.atomic import write_atomically
from reslrb_cli.records.manifest import now, versions
from reslrb_cli.records.metrics import Line

if TYPE_CHECKING:
    import numpy as np

logger = logging.getLogger(__name__)


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects in a file of JSON lines, oldest first. Numbers that are not finite become None.

    A last line without a line end is left out, because it is still being written or was interrupted. Raises a
    ConfigError that names the file, and the line if it is damaged.
    """
    # Numbers that are not finite are replaced during parsing, because a second pass takes twice as long.
    decoder, found = json.JSONDecoder(parse_float=_finite, parse_constant=lambda name: None), []
    for number, line in enumerate(read_file(path).splitlines(keepends=True), 1):
        if not line.strip() or not line.endswith(b"\n"):
            continue
        try:
            value = decoder.decode(line.decode())
        except (ValueError, RecursionError):
            value = None
        if not isinstance(value, dict):
            raise ConfigError(path, f"line {number}", "is damaged, or no line that reslrb wrote")
        found.append(value)
    return found


def _finite(text: str) -> float | None:
    value = float(text)
    return value if math.isfinite(value) else None


def is_stream(path: Path) -> bool:
    """Whether `path` is a pipe or another file that is not regular."""
    return os.path.lexists(path) and not path.is_file()


def write_lines(path: Path, lines: Sequence[Line]) -> None:
    """Write a file with one object per line, atomically. A stream is written in place. Raises OSError."""
    text = "".join(line.to_json() + "\n" for line in lines).encode()
    if is_stream(path):
        path.write_bytes(text)
    else:  # the target of a link is replaced, not the link
        write_atomically(Path(os.path.realpath(path)), lambda file: file.write(text))


def _command() -> list[str]:
    """Return the command line of this process, with the program's name instead of its path."""
    return ["reslrb", *(printable(word) for word in sys.argv[1:])]


@dataclass(frozen=True)
class Origin(Line):
    """Origin of a file of measurements: the machine, the software, and the command that repeats the measurement.

    `command` is a list of words, `versions` is as in `manifest.json`, and `written` is the time when the file was
    started. Missing entries are empty.
    """

    KIND: ClassVar[str] = "origin"

    device: str
    variant: str
    command: Sequence[str] = field(default_factory=_command)
    versions: Mapping[str, str] = field(default_factory=versions)
    platform: str = field(default_factory=platform.platform)
    written: str = field(default_factory=now)


#: Maximum size of saved samples in bytes; larger ones are not saved.
MOST_SAMPLES_BYTES = 2**28

#: A header of JSON values, and arrays by name.
Kept = tuple[dict[str, Any], dict[str, "np.ndarray"]]
_HEAD = "head"


def samples_file(json_file: Path) -> Path:
    """Return the path of the sample file that belongs to a JSON file."""
    return json_file.with_suffix(".samples.npz")


def are_kept(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether samples are small enough to be saved."""
    return sum(array.nbytes for array in arrays.values()) <= MOST_SAMPLES_BYTES


def write_samples(path: Path, head: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write the JSON values `head` and the arrays into one file, atomically. Raises OSError."""
    import numpy as np  # imported late, because the help of a command does not need it

    content: dict[str, Any] = {_HEAD: np.array(json.dumps(head)), **arrays}
    write_atomically(path, lambda file: np.savez(file, **content))


def read_samples(path: Path) -> Kept:
    """Read the result of `write_samples`. Raises a ConfigError that names the file if `write_samples` did not write the
    file.
    """
    from reslrb_cli.records.checkpoint import open_archive

    with open_archive(path) as archive:
        arrays = dict(archive)
        head: dict[str, Any] = json.loads(str(arrays.pop(_HEAD)))
        return head, arrays


# --- samples of earlier sessions --------------------------------------------------------------------------------------

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
    import numpy as np  # imported late, because the help of a command does not need it

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


# --- files that are rewritten while a command runs -----------------------------------------------------------------

#: Minimum seconds between two pages, and minimum interval as a multiple of the time of the last page. By default, pages
#: take at most a twentieth of a run.
PAGE_SECONDS, PAGE_SHARE = 5.0, 20.0


class LivePage:
    """Page that is rewritten from time to time, between iterations. `what` names the page or another file.

    If the page cannot be written, the run continues without it. The final write at the end of the run reports the
    reason of the failure.
    """

    def __init__(
        self, write: Callable[[], object], what: str = "the page of the run", share: float | None = None
    ) -> None:
        self._write, self._what, self._share = write, what, share
        self._next: float | None = 0.0

    def refresh(self) -> None:
        """Write the page if it is time to."""
        start = time.monotonic()
        if self._next is None or start < self._next:
            return
        try:
            self._write()
        except Exception as error:
            logger.debug("%s is not kept current: %s", self._what, error)
            self._next = None
        else:
            end = time.monotonic()
            share = PAGE_SHARE if self._share is None else self._share
            self._next = end + max(PAGE_SECONDS, share * (end - start))
