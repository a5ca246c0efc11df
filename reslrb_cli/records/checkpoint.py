"""`checkpoint/`: the state of a run after some iteration, and what it met that was not finite.

`state.npz`      the newest state; `iteration`, `parameter/<key>`, what else the iterations carry on as arrays, and
                 `state`, the rest of it as JSON
`previous.npz`   the state before that
`nonfinite.npz`  parameters in the first iteration with a value that was not finite, and what guided emission knew then
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.errors import ConfigError
from reslrb_cli.records.archive import Archive, Array, write_archive
from reslrb_cli.records.atomic import unfinished

FILE_NAME, PREVIOUS_FILE_NAME = "state.npz", "previous.npz"
NONFINITE_FILE_NAME = "nonfinite.npz"
#: What the JSON of a state says that it is. Another number where the same words mean something else.
FORMAT = 1
#: What file systems say that have no second names of files.
_NO_LINKS = {errno.EPERM, errno.EMLINK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EXDEV, errno.EACCES}
#: Bytes of that JSON; the largest part is a configuration, or a pilot's table.
_MOST_JSON = 2**24


def save_checkpoint(
    folder: Path,
    iteration: int,
    parameters: Mapping[str, Array],
    others: Mapping[str, Array],
    values: Mapping[str, Any] | None = None,
) -> None:
    """Write the state after `iteration` updates into `folder`, atomically and durably.

    Its entries are `iteration`, `parameter/<key>`, `others` by their names, and, as JSON, `values`, what there is
    besides. The state before is kept as `previous.npz`; should the disk have no room for three, until the new one is
    there. Raises OSError, and then the state before is still there.
    """
    entries: dict[str, Array] = {"iteration": np.array(iteration)}
    entries |= {f"parameter/{key}": value for key, value in parameters.items()}
    entries |= others
    if values is not None:
        text = json.dumps({"format": FORMAT, "iteration": iteration, **values}, allow_nan=False)
        entries["state"] = np.frombuffer(text.encode(), np.uint8)
    path, previous = folder / FILE_NAME, folder / PREVIOUS_FILE_NAME
    _keep(path, previous)
    try:
        write_archive(path, entries, durable=True)
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT) or not (path.exists() and previous.exists()):
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
    return next((path for name in (FILE_NAME, PREVIOUS_FILE_NAME) if (path := folder / name).exists()), None)


@dataclass(frozen=True)
class NonFiniteStep:
    """A step that met a value that is not finite: its `iteration`, from 0, and the parameters' values, finite or not.

    `calls` is, of each sensor that guided emission had learned of, by its number, how many gradients that had had, and
    `learned` what it knew, by `<sensor>/<what>`; None of a run that is not guided.
    """

    iteration: int
    parameters: Mapping[str, Array]
    calls: Mapping[str, int] | None = None
    learned: Mapping[str, Array] = field(default_factory=dict)


def save_nonfinite(folder: Path, step: NonFiniteStep) -> None:
    """Write it into `folder`: `iteration`, `parameter/<key>`, and `calls` (N, 2) with `guiding/<sensor>/<what>`."""
    arrays: dict[str, Any] = {"iteration": np.array(step.iteration)}
    arrays |= {f"parameter/{key}": value for key, value in step.parameters.items()}
    if step.calls is not None:
        arrays["calls"] = np.array([[int(name), count] for name, count in step.calls.items()]).reshape(-1, 2)
        arrays["calls"] = arrays["calls"].astype(np.int64)
        arrays |= {f"guiding/{name}": value for name, value in step.learned.items()}
    write_archive(folder / NONFINITE_FILE_NAME, arrays)


def load_nonfinite(folder: Path) -> NonFiniteStep | None:
    """What `save_nonfinite` wrote into `folder`; None where there is nothing.

    Raises ConfigError, located in the file, where it cannot be read, is damaged, or is nothing that a run wrote.
    """
    path = folder / NONFINITE_FILE_NAME
    if not os.path.lexists(path):
        return None
    with Archive(path, whole=False) as archive:
        keys = archive.names("parameter/")
        iteration = int(archive.array("iteration", (), "i"))
        parameters = {key: archive.array(f"parameter/{key}", values="any") for key in keys}
        if "calls" not in archive.heads:
            return NonFiniteStep(iteration, parameters)
        calls = archive.array("calls", kind="i")
        if calls.ndim != 2 or calls.shape[1] != 2 or (calls < 0).any():
            raise ConfigError(path, "calls", "is not the gradients of sensors by their numbers, as a run writes it")
        learned = {name: archive.array(f"guiding/{name}", kind="f") for name in archive.names("guiding/")}
        return NonFiniteStep(iteration, parameters, {str(number): int(count) for number, count in calls}, learned)
