"""Files of measurements, JSON with one object a line: written as they come, and read as far as they are whole.

`LineFile` is current while measurements are made, and whole at every moment, however the process ends. Its first line,
before what was measured, is an `Origin`: where the file comes from. `read_lines` reads any such file that someone
names. `NAME.samples.npz` beside it is what its figures were made of, to go on from.
"""

from __future__ import annotations

import gc
import json
import logging
import math
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, ClassVar

from reslrb_cli.config.files import open_file
from reslrb_cli.errors import ConfigError, printable
from reslrb_cli.records.atomic import remove_parts_of, write_atomically
from reslrb_cli.records.manifest import now, versions
from reslrb_cli.records.metrics import Line

if TYPE_CHECKING:
    import numpy as np

logger = logging.getLogger(__name__)

#: Lines after which it is told how far reading has come.
_LINES = 4096

#: What is told of a file that is being read: it, the bytes that are done, and those that it has.
Tell = Callable[[Path, int, int], None]


@dataclass(frozen=True)
class Lines:
    """The objects in a file, oldest first, and the numbers of the lines, from 1, that are none.

    What is not finite, which JSON does not have and Python writes all the same, is None.
    """

    objects: list[dict[str, Any]] = field(default_factory=list)
    damaged: list[int] = field(default_factory=list)


def read_lines(path: Path, tell: Tell | None = None) -> Lines:
    """Read a file of JSON lines. Raises ConfigError, located in it, where it cannot be read at all.

    A last line that lacks its end is one that a process did not come to finish, or is about to: it is left out, and not
    counted as damaged.
    """
    found, done = Lines(), 0
    # Numbers that are not finite are found as they are parsed: to go through all that was parsed takes twice as long.
    decoder = json.JSONDecoder(parse_float=_finite, parse_constant=lambda name: None)
    with open_file(path) as file, _without_collecting():
        size = os.fstat(file.fileno()).st_size
        try:
            for number, line in enumerate(file, 1):
                done += len(line)
                if tell is not None and number % _LINES == 0:
                    tell(path, done, max(done, size))
                if not line.strip():
                    continue
                try:
                    value = decoder.decode(line.decode("utf-8-sig" if number == 1 else "utf-8", "surrogatepass"))
                except (ValueError, RecursionError):
                    value = None
                if isinstance(value, dict):
                    found.objects.append(value)
                elif line.endswith(b"\n"):
                    found.damaged.append(number)
        except OSError as error:
            raise ConfigError(path, "", f"cannot be read: {error.strerror}") from None
    return found


def _finite(text: str) -> float | None:
    value = float(text)
    return value if math.isfinite(value) else None


@contextmanager
def _without_collecting() -> Iterator[None]:
    """Python's search for cycles left out: it would go through millions of objects that have none, again and again."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


class LineFile:
    """JSON with one object a line, written anew as a whole each time; what another process wrote stays until then.

    A pipe, or whatever else is no regular file, has each line once: those that are final, as they come.
    """

    def __init__(self, path: Path) -> None:
        # What a link points to is replaced, not the link.
        self._path = Path(os.path.realpath(path))
        self.is_stream = os.path.lexists(path) and not self._path.is_file()
        self._stream: IO[str] | None = None
        self._sent: set[str] = set()
        if not self.is_stream:
            remove_parts_of(self._path)

    def write(self, final: Sequence[Line], provisional: Sequence[Line] = ()) -> None:
        """Write all lines so far: those that are final, which a later call has too, and the others.

        Raises OSError, and then the file is as it was.
        """
        if not self.is_stream:
            text = "".join(line.to_json() + "\n" for line in [*final, *provisional])
            write_atomically(self._path, lambda file: file.write(text.encode()))
            return
        if self._stream is None:
            self._stream = self._path.open("w", encoding="utf-8")
        for text in [line.to_json() for line in final]:
            if text not in self._sent:
                self._sent.add(text)
                self._stream.write(text + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Close what is open."""
        if self._stream is not None:
            self._stream.close()


def _command() -> list[str]:
    """The command line of this process, as it can be typed anywhere: the program without its folder."""
    return ["reslrb", *(printable(word) for word in sys.argv[1:])]


@dataclass(frozen=True)
class Origin(Line):
    """What measured, on what, and the command that does it again.

    `command` are its words, `versions` those of `manifest.json`; `written` is when the file was begun. What a damaged
    or foreign line does not tell is empty.
    """

    KIND: ClassVar[str] = "origin"

    device: str
    variant: str
    command: Sequence[str] = field(default_factory=_command)
    versions: Mapping[str, str] = field(default_factory=versions)
    platform: str = field(default_factory=platform.platform)
    written: str = field(default_factory=now)


def read_origin(entry: Mapping[str, Any]) -> Origin | None:
    """The record that a line holds; None where it holds another one. Members of other types than theirs are empty."""
    if entry.get("kind") != Origin.KIND:
        return None
    words, named = entry.get("command"), entry.get("versions")
    texts = {name: entry.get(name) for name in ("device", "variant", "platform", "written")}
    return Origin(
        command=[str(word) for word in words] if isinstance(words, list) else [],
        versions={str(name): str(value) for name, value in named.items()} if isinstance(named, dict) else {},
        **{name: value if isinstance(value, str) else "" for name, value in texts.items()},
    )


#: Bytes of samples that are kept; more are not.
MOST_SAMPLES_BYTES = 2**28

#: A head, which JSON can hold, and arrays by name.
Kept = tuple[dict[str, Any], dict[str, "np.ndarray"]]
_HEAD = "head"


def samples_file(json_file: Path) -> Path:
    """Where the samples behind a JSON file are."""
    return json_file.with_suffix(".samples.npz")


def are_kept(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether samples are few enough to be kept."""
    return sum(array.nbytes for array in arrays.values()) <= MOST_SAMPLES_BYTES


def write_samples(path: Path, head: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write the file atomically: `head`, which JSON can hold, and the arrays. Raises OSError."""
    import numpy as np  # whoever asks for help of a command has no need of it

    content: dict[str, Any] = {_HEAD: np.array(json.dumps(head)), **arrays}
    write_atomically(path, lambda file: np.savez(file, **content))


def read_samples(path: Path) -> Kept:
    """What `write_samples` wrote. Raises ConfigError, located in the file, where it is none of that."""
    from reslrb_cli.records.checkpoint import open_archive

    with open_archive(path) as archive:
        arrays = dict(archive)
        head: dict[str, Any] = json.loads(str(arrays.pop(_HEAD)))
        return head, arrays


#: Seconds between two pages, at least; and the times as long as the last page took: pages take a twentieth of a run,
#: where nothing else is said.
PAGE_SECONDS, PAGE_SHARE = 5.0, 20.0


class LivePage:
    """Has `write` write the page, or `what` else, anew, at once and then now and then; called outside of iterations.

    A page that cannot be written ends no run, and is not tried again: the last one, at the run's end, says why.
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
