"""The folder of a run: creating, replacing, locking, resuming and reading it.

- `read_value`: read a recovered parameter value of a run that is finished, interrupted or in progress.
- `recovered`: make the experiment that starts from the recovered values.
- `RunFolder`: create folders.
- `opened`: lock the folder of a run to resume it.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.loader import Override, changed, load, parse_override
from reslrb_cli.config.parameters import RunValue
from reslrb_cli.config.schema import Config
from reslrb_cli.config.views import recovered_exposure
from reslrb_cli.config.yaml_text import format_location
from reslrb_cli.errors import ConfigError, MachineError, is_machine_fault, similar
from reslrb_cli.records import metrics
from reslrb_cli.records.atomic import remove_parts, unfinished_folder, write_atomically
from reslrb_cli.records.checkpoint import PARAMETERS_FILE, STATE_FILE, newest_checkpoint, open_archive
from reslrb_cli.records.lock import FolderLock, Holder, InUse
from reslrb_cli.records.manifest import Manifest, Status, read_manifest

Array = np.ndarray[Any, Any]

#: Maximum number of keys that an error names.
_SHOWN = 3

#: Name of the link to the newest run folder.
LATEST = "latest"

#: Settings with the exposure of all views.
_OF_EXPOSURES = (("target",), ("target", "exposure"))

#: Fabrication data of the solid of a run.
FABRICATION_FILE = "fabrication.json"


def workshop_file(name: str) -> str:
    """Return a picture's file name, without suffix, for the workshop sheet. The picture is in `images`."""
    return "sheet-" + re.sub(r"[^a-z0-9.+-]+", "-", name.lower())


def read_value(run: Path, key: str) -> Array:
    """Return the newest value of `key` in the run folder `run`.

    Shapes are as in `parameters.npz`: texture (H, W, C), colour (C,), buffer (N,), number (). The caller must check for
    values that are not finite. Raises a ConfigError that names the folder or file if the folder is damaged or not a run
    folder. Raises the same error if the run did not recover `key`.
    """
    path = checkpoint_of(run)
    with open_archive(path) as archive:
        prefix = "" if path.name == PARAMETERS_FILE else "parameter/"
        known = [name.removeprefix(prefix) for name in archive if name.startswith(prefix)]
        if key in known:
            return archive[f"{prefix}{key}"].astype(np.float32)
    near = similar(key, known, _SHOWN, 0)
    has = " and ".join(f"`{name}`" for name in near) or "nothing"
    more = f" and {len(known) - len(near)} more" if len(known) > len(near) else ""
    raise ConfigError(run, "", f"did not recover `{key}`; it has {has}{more}")


def recovered(run: Path, overrides: Sequence[str | Override]) -> Config:
    """Return the configuration of the run in the folder `run`, with its recovered values as initial values.

    Raises a ConfigError that names the folder if the folder is not a run folder or holds no values, or that names an
    override of an initial value.
    """
    checkpoint_of(run)
    parsed = [each if isinstance(each, Override) else parse_override(each) for each in overrides]
    for each in parsed:
        if _sets_initial(each):
            reason = "has no effect, because the run's recovered value replaces it"
            raise ConfigError(each.label, format_location(each.location), f"{reason}; use `render --value KEY=VALUE`")
    config = read_config(run, parsed)
    start = RunValue(run=Path(os.path.realpath(run)))  # `latest` may lead to another run later
    specs = [spec.model_copy(update={"initial": start}) for spec in config.parameters]
    config = config.model_copy(update={"parameters": specs})
    given = any(each.location[:1] == ("views",) or each.location[:2] in _OF_EXPOSURES for each in parsed)
    return config if given else _from_exposures(config, run)


def _from_exposures(config: Config, run: Path) -> Config:
    """Return the configuration with recovered exposures that start at the values of the run in the folder `run`. If a
    response is recovered, they keep their own start, because the response starts anew too.
    """
    target, specs = config.target, list(config.views or ())
    responses = target.response, *(spec.response for spec in specs)
    if any(response is not None and response.recovered for response in responses):
        return config
    for number, view in enumerate(_manifest_of(run).get("views") or ()):
        own = number < len(specs) and specs[number].exposure is not None
        word, start = recovered_exposure(specs[number].exposure if own else target.exposure)
        if not word or not isinstance(view.get("exposure"), str):
            continue
        found = np.ravel(read_value(run, view["exposure"])).astype(float)
        if found.size not in (1, len(start)) or not np.all(np.isfinite(found) & (found > 0)):
            continue  # an image of one channel has one factor
        update = {"exposure": {word: np.broadcast_to(found, len(start)).tolist() if len(start) > 1 else found[0]}}
        if own:
            specs[number] = specs[number].model_copy(update=update)
        else:
            target = target.model_copy(update=update)
    return config.model_copy(update={"target": target, "views": specs or config.views})


def read_config(run: Path, overrides: Sequence[str | Override] = ()) -> Config:
    """Return the configuration of the run in the folder `run`, with `overrides`. Raises ConfigError.

    If the run was moved together with the files of its experiment, the settings name the files' new places.
    """
    config = load(run / "config.yaml", overrides)
    here, moved = Path(os.path.abspath(run)).parent, []
    for key, path in config.paths.items():
        place = Path(os.path.normpath(here / os.path.relpath(path, config.run.output)))
        if not path.exists() and place.exists():
            name = str(config.codes[key].file).rpartition(":")[2] if key in config.codes else ""
            moved.append(replace(parse_override(f"{key}=null"), value=f"{place}:{name}" if name else str(place)))
    return changed(config, moved)


def _sets_initial(override: Override) -> bool:
    """Whether an override sets the initial value of a parameter, alone or with other settings."""
    section, *place = override.location
    if section != "parameters":
        return False
    given = [override.value] if place else override.value
    specs = [each for each in given if isinstance(each, dict)] if isinstance(given, list) else []
    return place[1:2] == ["initial"] or (len(place) < 2 and any("initial" in spec for spec in specs))


def exposures(run: Path) -> dict[int, Array]:
    """Return the recovered or given exposure of each sensor of a run: one number, or one per channel.

    Raises ConfigError as `read_value`.
    """
    found: dict[int, Array] = {}
    for view in _manifest_of(run).get("views") or ():
        exposure = view.get("exposure", 1.0)
        found[view["sensor"]] = read_value(run, exposure) if isinstance(exposure, str) else np.float32(exposure)
    return found


def exposed(image: Array, exposure: Array | float, colours: int) -> Array:
    """Return an image (H, W, C) whose first `colours` channels are multiplied by an exposure. Alpha is unchanged."""
    return np.concatenate([image[:, :, :colours] * np.float32(exposure), image[:, :, colours:]], axis=2)


def checkpoint_of(run: Path) -> Path:
    """Return the file with the newest values in the run folder `run`: the newest checkpoint, or the parameters of a run
    that has ended, if its checkpoints have been removed. Raises ConfigError if there is none.
    """
    _manifest_of(run)
    path, final = newest_checkpoint(run / "checkpoint"), run / "parameters" / PARAMETERS_FILE
    if path is None and final.exists():
        return final
    if path is None:
        raise ConfigError(run, "", f"has no checkpoint/{STATE_FILE}: the run ended before it kept anything")
    return path


def _manifest_of(run: Path) -> dict[str, Any]:
    """Return the manifest of the run folder `run`, corrected if the run was killed. Raises ConfigError."""
    if not run.is_dir():
        what = "is a file, not the folder of a run" if os.path.lexists(run) else "no such file or folder"
        raise ConfigError(run, "", what)
    content = read_manifest(run)
    if content is None:
        raise ConfigError(run, "", "is no run's folder: it has no manifest.json that a run wrote")
    return content


SUBFOLDERS = ("images", "parameters", "checkpoint")


def check_output(source: object, output: Path) -> None:
    """Raise a ConfigError (key `run.output`) if a run folder cannot be made in `output`.

    The check tries to make a folder, because permissions do not apply to root. The folder is then removed. Raises
    MachineError for a full disk.
    """
    ancestor = next(path for path in (output, *output.absolute().parents) if os.path.lexists(path))
    if not ancestor.is_dir():
        raise ConfigError(source, "run.output", f"{ancestor} is not a folder; give a folder that can be written to")
    try:
        with unfinished_folder(ancestor) as folder:
            (folder / "file").write_text("is there room?")
    except OSError as error:
        raise _output_error(source, ancestor, error) from None


@dataclass(frozen=True)
class RunFolder:
    """Run folder on the disk: the paths of its content, and its lock.

    As a context manager, a run folder releases its lock at the end.
    """

    path: Path
    lock: FolderLock | None = field(default=None, compare=False, repr=False)

    @classmethod
    def create(cls, source: object, output: Path, name: str, config: str, manifest: Manifest) -> RunFolder:
        """Create `<output>/<name>/` with its configuration, manifest and empty subfolders, and lock it.

        If the name is taken, the folder is `<name>-2/` and so on. The folder appears under its name only when it is
        complete. Raises ConfigError if it cannot be made, and MachineError for a full disk.
        """
        try:
            output.mkdir(parents=True, exist_ok=True)
            with unfinished_folder(output) as part, contextlib.ExitStack() as stack:
                lock = stack.enter_context(FolderLock(part))
                for entry in SUBFOLDERS:
                    (part / entry).mkdir()
                (part / "config.yaml").write_text(config, encoding="utf-8")
                manifest.process = Holder.here(locked=lock.real)
                manifest.write(part)
                folder = cls(part, lock)._place(output / name)
                stack.pop_all()
                return folder
        except OSError as error:
            raise _output_error(source, output, error) from None

    def _place(self, wanted: Path) -> RunFolder:
        """Rename the folder to the first free name of `wanted`, `wanted-2`, ..."""
        names = itertools.chain([wanted], (wanted.with_name(f"{wanted.name}-{n}") for n in itertools.count(2)))
        return replace(self, path=next(path for path in names if self._take_name(path)))

    def _take_name(self, path: Path) -> bool:
        """Rename the folder to `path` unless `path` exists. Return whether the folder was renamed."""
        if os.path.lexists(path):
            return False
        try:
            os.rename(self.path, path)
        except OSError:
            if not os.path.lexists(path):  # otherwise another run took the name first
                raise
            return False
        return True

    @property
    def is_there(self) -> bool:
        """True if the folder still exists under its name. A different folder of the same name, such as that of a later
        run, does not count.
        """
        if self.lock is None:
            return self.path.is_dir()
        return self.lock.is_of(Path(os.path.realpath(self.path)))

    @property
    def fault(self) -> OSError | None:
        """The error if the folder is no longer there (`is_there`). None if the folder is there."""
        if self.is_there:
            return None
        return FileNotFoundError(errno.ENOENT, "has gone while the run went on", str(self.path))

    @property
    def images(self) -> Path:
        return self.path / "images"

    @property
    def parameters(self) -> Path:
        return self.path / "parameters"

    @property
    def checkpoint(self) -> Path:
        return self.path / "checkpoint"

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        if self.lock is not None:
            self.lock.release()


def link_latest(folder: Path) -> None:
    """Let the link `latest` beside a run folder lead to the folder.

    Does nothing if the name belongs to a file or a folder, or if the file system has no links. If two runs start at the
    same time, the link leads to one of them.
    """
    link = folder.with_name(LATEST)
    if os.path.lexists(link) and not link.is_symlink():
        return
    with contextlib.suppress(OSError), unfinished_folder(folder.parent) as part:
        (part / LATEST).symlink_to(folder.name)
        os.replace(part / LATEST, link)


def _who_works(content: Mapping[str, Any]) -> str:
    """Return the process that uses a folder, from the content of its manifest."""
    holder = Holder.from_json(content.get("process"))
    if holder is not None and replace(holder, locked=False) == Holder.here(locked=False):
        return "a loop of this process; leave it, or call `close()` of its Run"
    return f"{holder}, since {content.get('started')}" if holder is not None else "another process"


def _output_error(source: object, folder: Path, error: OSError) -> ConfigError | MachineError:
    if is_machine_fault(error):
        return MachineError(f"{folder}: {error.strerror}; no run folder was made")
    reason = f"cannot write to {folder} ({error.strerror}); give a folder that can be written to"
    return ConfigError(source, "run.output", reason)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[RunFolder, dict[str, Any]]]:
    """Yield the run folder `path` and its manifest. The folder is locked while the block runs.

    Raises a ConfigError that names the folder if the folder is not a run folder or is in use.
    """
    content = _manifest_of(path)
    if path.is_symlink():  # `latest` may lead to another folder soon
        path = Path(os.path.realpath(path))
    in_use = ConfigError(path, "", f"is in use by a run ({_who_works(content)}); end that first")
    try:
        lock = FolderLock(Path(os.path.realpath(path)))
    except InUse:
        raise in_use from None
    except OSError as error:
        raise ConfigError(path, "", f"cannot be opened: {error.strerror}") from None
    with RunFolder(Path(os.path.abspath(path)), lock) as folder:  # a script may change its working directory
        if not lock.real and content.get("status") == Status.RUNNING:
            raise in_use
        yield folder, read_manifest(path) or content


def check_writable(folder: RunFolder) -> None:
    """Raise a ConfigError that names the folder if the folder cannot be written to, and MachineError for a full disk.

    Also removes unfinished files of earlier processes.
    """
    try:
        for name in SUBFOLDERS:
            (folder.path / name).mkdir(exist_ok=True)
        for place in (folder.path, *(folder.path / name for name in SUBFOLDERS)):
            tempfile.TemporaryFile(dir=place).close()
        metrics.mend(folder.path)
        remove_parts(folder.path)
    except OSError as error:
        if is_machine_fault(error):
            raise MachineError(f"{folder.path}: {error.strerror}; nothing of the run was changed") from None
        reason = f"cannot be written to ({error.strerror}); copy it to another place, and resume the copy"
        raise ConfigError(folder.path, "", reason) from None


def write_beginning(folder: RunFolder, config: str, manifest: Manifest) -> None:
    """Write the configuration and the manifest of a run resumed in `folder`. Raises OSError."""
    write_atomically(folder.path / "config.yaml", lambda file: file.write(config.encode()))
    manifest.process = Holder.here(locked=folder.lock is not None and folder.lock.real)
    manifest.write(folder.path)
