"""`checkpoint/state.npz`: parameters and optimiser state after some iteration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.records.atomic import write_atomically

FILE_NAME = "state.npz"


def save_checkpoint(
    folder: Path,
    iteration: int,
    parameters: Mapping[str, np.ndarray[Any, Any]],
    optimizer: Mapping[str, np.ndarray[Any, Any]],
) -> None:
    """Write the state after `iteration` updates into `folder`, in place of the one before, atomically.

    The archive's entries are `iteration`, `parameter/<key>` and `optimizer/<key>/<name>`.
    """
    arrays: dict[str, Any] = {"iteration": np.array(iteration)}
    arrays |= {f"parameter/{key}": value for key, value in parameters.items()}
    arrays |= {f"optimizer/{key}": value for key, value in optimizer.items()}
    write_atomically(folder / FILE_NAME, lambda file: np.savez(file, **arrays))
