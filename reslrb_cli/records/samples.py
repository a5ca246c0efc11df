"""`NAME.samples.npz` beside the JSON file of a measurement: what its figures were made of, to go on from."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.files import open_file
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.atomic import write_atomically

#: Bytes of samples that are kept; more are not.
MOST_BYTES = 2**28
#: A head, which JSON can hold, and arrays by name.
Kept = tuple[dict[str, Any], dict[str, np.ndarray]]
_HEAD = "head"


def samples_file(json_file: Path) -> Path:
    """Where the samples behind a JSON file are."""
    return json_file.with_suffix(".samples.npz")


def are_kept(arrays: Mapping[str, np.ndarray]) -> bool:
    """Whether samples are few enough to be kept."""
    return sum(array.nbytes for array in arrays.values()) <= MOST_BYTES


def write_samples(path: Path, head: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Write the file atomically: `head`, which JSON can hold, and the arrays. Raises OSError."""
    content: dict[str, Any] = {_HEAD: np.array(json.dumps(head)), **arrays}
    write_atomically(path, lambda file: np.savez(file, **content))


def read_samples(path: Path) -> Kept:
    """What `write_samples` wrote. Raises ConfigError, located in the file, where it is none of that."""
    try:
        with open_file(path) as file, np.load(file, allow_pickle=False) as arrays:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in arrays.zip.infolist()):
                raise ValueError("compressed, so that a small file may stand for large arrays")
            head = json.loads(str(arrays[_HEAD]))
            if not isinstance(head, dict):
                raise ValueError("its head is no object")
            return head, {name: arrays[name] for name in arrays.files if name != _HEAD}
    except ConfigError:
        raise
    except Exception as error:  # of many kinds, from the readers of archives, arrays and their heads
        reason = str(error) or type(error).__name__
        raise ConfigError(path, "", f"is damaged, cut off, or not written beside --json ({reason})") from None
