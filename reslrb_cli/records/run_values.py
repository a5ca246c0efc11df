"""The values to which a run brought its parameters, whether it is finished, interrupted or still at work."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from reslrb_cli.errors import ConfigError
from reslrb_cli.records.archive import Archive, Array
from reslrb_cli.records.checkpoint import FILE_NAME, newest_checkpoint
from reslrb_cli.records.manifest import read_manifest

#: Keys that an error names.
_SHOWN = 3


def read_value(run: Path, key: str) -> Array:
    """The value of `key` in the newest checkpoint of the run folder `run`.

    Shapes as in `parameters.npz`: a texture (H, W, C), a colour (C,), a buffer (N,), a number (). It may hold
    values that are not finite: who uses it says where. Raises ConfigError, located in the folder or a file of it, where
    it is no run's, damaged, or the run did not recover `key`.
    """
    path = checkpoint_of(run)
    with Archive(path, whole=False) as archive:
        known = archive.names("parameter/")
        if key in known:
            return archive.array(f"parameter/{key}", kind="f", values="any")
    near = difflib.get_close_matches(key, known, n=_SHOWN, cutoff=0.5) or known[:_SHOWN]
    has = " and ".join(f"`{name}`" for name in near) or "nothing"
    more = f" and {len(known) - len(near)} more" if len(known) > len(near) else ""
    raise ConfigError(run, "", f"did not recover `{key}`; it has {has}{more}")


def checkpoint_of(run: Path) -> Path:
    """The file of the newest checkpoint of the run folder `run`. Raises ConfigError where there is none."""
    if not run.is_dir():
        what = "is a file, not the folder of a run" if os.path.lexists(run) else "no such folder"
        raise ConfigError(run, "", what)
    if read_manifest(run) is None:
        raise ConfigError(run, "", "is no run's folder: it has no manifest.json that a run wrote")
    path = newest_checkpoint(run / "checkpoint")
    if path is None:
        raise ConfigError(run, "", f"has no checkpoint/{FILE_NAME}: the run ended before it kept anything")
    return path
