"""`checkpoint/state.npz`: parameters and optimiser state after some iteration.

`checkpoint/nonfinite.npz`: parameters in the first iteration with a value that was not finite.
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile

from reslrb_cli.config.files import open_file
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import write_atomically

FILE_NAME = "state.npz"
NONFINITE_FILE_NAME = "nonfinite.npz"


def save_checkpoint(
    folder: Path,
    iteration: int,
    parameters: Mapping[str, np.ndarray[Any, Any]],
    optimizer: Mapping[str, np.ndarray[Any, Any]],
) -> None:
    """Write the state after `iteration` updates into `folder`, in place of the one before, atomically and durably.

    The archive's entries are `iteration`, `parameter/<key>` and `optimizer/<key>/<name>`. Raises OSError, and then the
    state before is still there.
    """
    arrays: dict[str, Any] = {"iteration": np.array(iteration)}
    arrays |= {f"parameter/{key}": value for key, value in parameters.items()}
    arrays |= {f"optimizer/{key}": value for key, value in optimizer.items()}
    write_atomically(folder / FILE_NAME, lambda file: np.savez(file, **arrays), durable=True)


def save_nonfinite(folder: Path, iteration: int, parameters: Mapping[str, np.ndarray[Any, Any]]) -> None:
    """Write the parameters of the step of `iteration`, from 0, into `folder`: `iteration` and `parameter/<key>`."""
    arrays: dict[str, Any] = {"iteration": np.array(iteration)}
    arrays |= {f"parameter/{key}": value for key, value in parameters.items()}
    write_atomically(folder / NONFINITE_FILE_NAME, lambda file: np.savez(file, **arrays))


def load_nonfinite(folder: Path) -> tuple[int, dict[str, np.ndarray[Any, Any]]] | None:
    """What `save_nonfinite` wrote into `folder`, iteration and parameters; None where there is nothing.

    Raises ConfigError, located in the file, where it cannot be read, is damaged, or is nothing that a run wrote.
    """
    path = folder / NONFINITE_FILE_NAME
    if not os.path.lexists(path):
        return None
    with open_archive(path) as arrays:
        names = [name for name in arrays.files if name.startswith("parameter/")]
        parameters = {name.removeprefix("parameter/"): arrays[name] for name in names}
        return int(arrays["iteration"]), parameters


@contextmanager
def open_archive(path: Path) -> Iterator[NpzFile]:
    """The arrays of a file that a run wrote, each read when it is asked for.

    Raises ConfigError, located in the file, also for what the block raises of it: where it cannot be read, is damaged,
    or is nothing that a run wrote.
    """
    try:
        with open_file(path) as file, np.load(file, allow_pickle=False) as arrays:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in arrays.zip.infolist()):
                raise ValueError("compressed, which no run writes, and small files may so stand for large arrays")
            yield arrays
    except ConfigError:
        raise
    except Exception as error:  # of many kinds, from the readers of archives, arrays and their heads
        reason = str(error) or type(error).__name__
        raise ConfigError(path, "", f"is damaged, cut off, or not written by a run ({reason})") from None
