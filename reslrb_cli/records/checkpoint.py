"""Archives of arrays (`.npz`), and the checkpoints of a run.

The folder `checkpoint/` of a run holds:

`state.npz`      the newest state: `iteration`, `parameter/<key>`, the other arrays of the optimisation, and `state`,
                 the remaining values as JSON
`previous.npz`   the state saved before that
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.files import open_file
from reslrb_cli.errors import ConfigError, is_machine_fault, is_out_of_memory
from reslrb_cli.records.atomic import write_atomically

Array = np.ndarray[Any, Any]


def write_archive(path: Path, arrays: Mapping[str, Array], durable: bool = False) -> None:
    """Write arrays to `path` atomically, replacing the file. Raises OSError if writing fails. The old file is then
    unchanged.
    """
    entries: dict[str, Any] = dict(arrays)
    write_atomically(path, lambda file: np.savez(file, **entries), durable)


@contextmanager
def open_archive(path: Path) -> Iterator[Mapping[str, Array]]:
    """Open an archive. When the block accesses an array, the array is read and its checksum verified.

    Raises a ConfigError that names the file if reading fails inside the block.
    """
    try:
        with open_file(path) as file, np.load(file, allow_pickle=False) as arrays:
            yield arrays
    except ConfigError:
        raise
    except Exception as error:  # NumPy and zipfile raise many types of exceptions
        if is_out_of_memory(error) or is_machine_fault(error):
            raise
        reason = str(error) or type(error).__name__
        raise ConfigError(path, "", f"is damaged, cut off, or not written by reslrb ({reason})") from None


STATE_FILE, PREVIOUS_FILE_NAME, _NEXT_FILE = "state.npz", "previous.npz", "next.npz"

#: File with the values of all parameters, in the subfolder `parameters`.
PARAMETERS_FILE = "parameters.npz"

#: Format version in the JSON of a state. It changes when the meaning of an entry changes.
FORMAT = 5


def save_checkpoint(
    folder: Path,
    iteration: int,
    arrays: Mapping[str, Array],
    values: Mapping[str, Any] | None = None,
) -> None:
    """Write the state after `iteration` updates into `folder`, atomically and durably.

    The entries are `iteration`, the `arrays` under their names, and `values` as JSON. The earlier state becomes
    `previous.npz`. Raises OSError if writing fails. Both earlier states then still exist.
    """
    entries: dict[str, Array] = {"iteration": np.array(iteration), **arrays}
    if values is not None:
        text = json.dumps({"format": FORMAT, "iteration": iteration, **values})
        entries["state"] = np.frombuffer(text.encode(), np.uint8)
    path, new = folder / STATE_FILE, folder / _NEXT_FILE
    try:
        write_archive(new, entries, durable=True)
        with contextlib.suppress(FileNotFoundError):  # there is no earlier state yet
            os.replace(path, folder / PREVIOUS_FILE_NAME)
        os.replace(new, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def read_state(path: Path) -> tuple[dict[str, Array], dict[str, Any]]:
    """Read the arrays and the other values of a state. Raises ConfigError, located in the file."""
    with open_archive(path) as archive:
        arrays = dict(archive)
    if "state" not in arrays:
        raise ConfigError(path, "", "holds values alone, not the state of a run; use it as `initial: {run: ...}`")
    try:
        values = json.loads(arrays.pop("state").tobytes())
    except ValueError as error:
        raise ConfigError(path, "state", f"is no JSON, as a run writes it ({error})") from None
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise ConfigError(
            path, "state", "is of another version of reslrb; continue the run with that version, or start a new run"
        )
    return arrays, values


def newest_checkpoint(folder: Path) -> Path | None:
    """Return the file of the newest state in `folder`, or None if there is no state. The file may be damaged."""
    return next((path for name in (STATE_FILE, PREVIOUS_FILE_NAME) if (path := folder / name).exists()), None)


def entries_below(arrays: Mapping[str, Array], prefix: str) -> dict[str, Array]:
    """Return the arrays whose names start with `prefix`. The returned names lack `prefix`."""
    return {name.removeprefix(prefix): arrays[name] for name in arrays if name.startswith(prefix)}
