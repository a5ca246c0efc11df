"""`checkpoint/state.npz`: parameters and optimiser state after some iteration.

`checkpoint/nonfinite.npz`: parameters in the first iteration with a value that was not finite.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

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
    """What `save_nonfinite` wrote into `folder`, iteration and parameters; None where there is nothing."""
    try:
        with np.load(folder / NONFINITE_FILE_NAME) as arrays:
            names = [name for name in arrays.files if name.startswith("parameter/")]
            parameters = {name.removeprefix("parameter/"): arrays[name] for name in names}
            return int(arrays["iteration"]), parameters
    except FileNotFoundError:
        return None
