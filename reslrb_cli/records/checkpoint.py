"""Archives of arrays (`.npz`), read as if an enemy had made them, and `checkpoint/`, a run's folder of them.

An entry's data are read when they are asked for, and only if they are what the caller says they must be. Nothing is
allocated by what a head claims: entries are stored, not compressed, so that none is larger than the file itself, and an
array has to fill its entry to the byte. No entry's name is ever the name of a file.

`checkpoint/` holds the state of a run after some iteration, and what it met that was not finite:

`state.npz`      the newest state; `iteration`, `parameter/<key>`, what else the iterations carry on as arrays, and
                 `state`, the rest of it as JSON
`previous.npz`   the state before that
`nonfinite.npz`  the state with which the first iteration began that met a value that was not finite
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal

import numpy as np
from numpy.lib import format as npy

from reslrb_cli.config.files import in_words, open_file
from reslrb_cli.errors import ConfigError, is_machine_fault, is_out_of_memory
from reslrb_cli.records.atomic import unfinished, write_atomically

Array = np.ndarray[Any, Any]

#: Bytes of an archive: a state of a dozen arrays for each of a few hundred million numbers. They are all looked at.
MOST_BYTES = 2**34

#: Entries of an archive, some twenty for each parameter.
MOST_ENTRIES = 100_000
_DAMAGED = "an entry has another checksum than was written"

#: Kinds of numbers that a run writes: floats, integers, truth values.
_KINDS = "fiub"

#: What the values of an array have to be: what is added up may be infinite, and some callers say themselves, and where,
#: what is wrong with a value.
Values = Literal["finite", "no NaN", "any"]


def write_archive(path: Path, arrays: Mapping[str, Array], durable: bool = False) -> None:
    """Write arrays to `path`, in place of what is there, atomically. Raises OSError, with what was there as it was."""
    entries: dict[str, Any] = dict(arrays)
    write_atomically(path, lambda file: np.savez(file, **entries), durable)


@dataclass(frozen=True)
class Head:
    """What an entry says of its array."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]


@dataclass
class Archive:
    """The arrays of a file; as a context manager it closes that at the end.

    Opening it reads every byte once, in pieces, so that damage is seen before anything is made of it; without `whole`,
    for who takes one array of many, those of an array are looked at when it is asked for. Raises ConfigError, located
    in the file, where it cannot be read, is damaged, or is nothing that a run wrote.
    """

    path: Path
    whole: bool = True
    heads: dict[str, Head] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._file = open_file(self.path, MOST_BYTES)
        try:
            with self._located():
                self._zip = zipfile.ZipFile(self._file)
                self._look()
        except BaseException:
            self._file.close()
            raise

    def _look(self) -> None:
        entries = self._zip.infolist()
        if len(entries) > MOST_ENTRIES:
            raise ValueError(f"it has {len(entries)} entries")
        if len({entry.filename for entry in entries}) < len(entries):
            raise ValueError("it has two entries of one name")
        for entry in entries:
            if entry.compress_type != zipfile.ZIP_STORED or not entry.filename.endswith(".npy"):
                raise ValueError("compressed, or no arrays, neither of which a run writes")
            with self._zip.open(entry) as stream:
                self.heads[entry.filename[: -len(".npy")]] = _read_head(stream, entry.file_size)
        if self.whole and self._zip.testzip() is not None:
            raise ValueError(_DAMAGED)

    def array(
        self, name: str, shape: tuple[int, ...] | None = None, kind: str | None = None, values: Values = "finite"
    ) -> Array:
        """The array of an entry, with such `values`, and where they are given of this shape and kind of number (`f`,
        `u`, ...).

        Raises ConfigError, located in the file, where it is not so, or there is none.
        """
        head = self.heads.get(name)
        if head is None:
            raise ConfigError(self.path, "", f"lacks `{name}`")
        if shape is not None and head.shape != shape:
            has, wanted = ("x".join(map(str, each)) or "one number" for each in (head.shape, shape))
            raise ConfigError(self.path, "", f"has `{name}` of shape {has}; it must be {wanted}")
        if kind is not None and head.dtype.kind != kind:
            raise ConfigError(self.path, "", f"`{name}` is no array of numbers, as a run writes it ({head.dtype})")
        with self._located(), self._zip.open(f"{name}.npy") as stream:
            _read_head(stream, None)
            data = stream.read()
            array: Array = np.frombuffer(bytearray(data), dtype=head.dtype).reshape(head.shape)
        if values != "any" and (np.isnan(array) if values == "no NaN" else ~np.isfinite(array)).any():
            raise ConfigError(self.path, "", f"`{name}` holds a value that is not finite")
        return array

    def names(self, prefix: str) -> list[str]:
        """What stands behind `prefix` in the names of entries that begin with it."""
        return [name.removeprefix(prefix) for name in self.heads if name.startswith(prefix)]

    @contextmanager
    def _located(self) -> Iterator[None]:
        try:
            yield
        except ConfigError:
            raise
        except Exception as error:  # of many kinds, from the readers of archives and of arrays' heads
            if is_out_of_memory(error) or is_machine_fault(error):
                raise
            reason = _DAMAGED if "CRC" in str(error) else str(error) or type(error).__name__
            raise ConfigError(self.path, "", f"is damaged, cut off, or not written by a run ({reason})") from None

    def close(self) -> None:
        """Close the file."""
        self._zip.close()
        self._file.close()

    def __enter__(self) -> Archive:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _read_head(stream: IO[bytes], size: int | None) -> Head:
    """The head of an array, of which `stream` stands behind it then; checked where the entry has `size` bytes."""
    version = npy.read_magic(stream)
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"an array of version {version}")
    shape, by_columns, dtype = read(stream)
    if dtype.kind not in _KINDS or dtype.hasobject or dtype.names or (by_columns and len(shape) > 1):
        raise ValueError(f"an array of {dtype}, which no run writes")
    if size is not None:
        claimed = math.prod(shape) * dtype.itemsize
        if min(shape, default=1) < 0 or claimed != size - stream.tell():
            raise ValueError(f"an array of {in_words(abs(claimed))} in {in_words(size)}")
    return Head(tuple(shape), dtype)


STATE_FILE, PREVIOUS_FILE_NAME = "state.npz", "previous.npz"
NONFINITE_FILE_NAME = "nonfinite.npz"

#: What the JSON of a state says that it is. Another number where the same words mean something else.
FORMAT = 2

#: What file systems say that have no second names of files.
_NO_LINKS = {errno.EPERM, errno.EMLINK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EXDEV, errno.EACCES}

#: Bytes of that JSON; the largest part is the configuration.
_MOST_JSON = 2**24


def save_checkpoint(
    folder: Path,
    iteration: int,
    parameters: Mapping[str, Array],
    others: Mapping[str, Array],
    values: Mapping[str, Any] | None = None,
    name: str = STATE_FILE,
) -> None:
    """Write the state after `iteration` updates into `folder`, atomically and durably.

    Its entries are `iteration`, `parameter/<key>`, `others` by their names, and, as JSON, `values`, what there is
    besides. The state before is kept as `previous.npz`; should the disk have no room for three, until the new one is
    there. A file of another `name` is written beside both. Raises OSError, and then the state before is still there.
    """
    entries: dict[str, Array] = {"iteration": np.array(iteration)}
    entries |= {f"parameter/{key}": value for key, value in parameters.items()}
    entries |= others
    if values is not None:
        text = json.dumps({"format": FORMAT, "iteration": iteration, **values}, allow_nan=False)
        entries["state"] = np.frombuffer(text.encode(), np.uint8)
    path, previous = folder / name, folder / PREVIOUS_FILE_NAME
    if name == STATE_FILE:
        _keep(path, previous)
    try:
        write_archive(path, entries, durable=True)
    except OSError as error:
        full = name == STATE_FILE and error.errno in (errno.ENOSPC, errno.EDQUOT)
        if not (full and path.exists() and previous.exists()):
            raise
        previous.unlink()
        write_archive(path, entries, durable=True)


def _keep(path: Path, previous: Path) -> None:
    """Give the state at `path` the name `previous` as well, so that there is one under its own name all the time."""
    second = previous.with_name(f".{previous.name}.{os.getpid()}.part")
    unfinished.add(second)
    try:
        os.link(path, second)
        os.replace(second, previous)
    except FileNotFoundError:  # the first one
        pass
    except OSError as error:
        if error.errno not in _NO_LINKS:
            raise OSError(error.errno, error.strerror, str(path)) from None
        with contextlib.suppress(FileNotFoundError):
            os.replace(path, previous)  # for a moment there is that one alone, which readers know
    finally:
        with contextlib.suppress(OSError):
            second.unlink(missing_ok=True)
        unfinished.discard(second)


def open_state(path: Path) -> tuple[Archive, dict[str, Any]]:
    """The arrays of a state, to be closed, and its other values. Raises ConfigError, located in the file."""
    archive = Archive(path)
    try:
        head = archive.heads.get("state")
        if head is None:
            raise ConfigError(path, "", "holds values alone, not the state of a run; use it as `initial: {run: ...}`")
        if head.dtype != np.uint8 or len(head.shape) != 1 or head.shape[0] > _MOST_JSON:
            raise ConfigError(path, "state", f"is {head.dtype} of shape {head.shape}, not as a run writes it")
        try:
            values = json.loads(archive.array("state").tobytes(), parse_constant=_refuse)
        except (ValueError, RecursionError) as error:
            raise ConfigError(path, "state", f"is no JSON, as a run writes it ({error})") from None
        if not isinstance(values, dict) or values.get("format") != FORMAT:
            raise ConfigError(path, "state", "is of another version of reslrb; go on with that one")
        return archive, values
    except BaseException:
        archive.close()
        raise


def _refuse(word: str) -> Any:
    raise ValueError(f"{word} is no number")


def newest_checkpoint(folder: Path) -> Path | None:
    """The newest state in `folder`, which may be damaged; None where there is none."""
    return next((path for name in (STATE_FILE, PREVIOUS_FILE_NAME) if (path := folder / name).exists()), None)
