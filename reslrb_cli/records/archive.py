"""Archives of arrays (`.npz`), read as if an enemy had made them.

An entry's data are read when they are asked for, and only if they are what the caller says they must be. Nothing is
allocated by what a head claims: entries are stored, not compressed, so that none is larger than the file itself, and an
array has to fill its entry to the byte. No entry's name is ever the name of a file.
"""

from __future__ import annotations

import math
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
from reslrb_cli.records.atomic import write_atomically

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
