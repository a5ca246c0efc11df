"""The folder of one run: where it is made, what may be replaced, and who works in it."""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import shutil
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType

from reslrb_cli.errors import ConfigError, MachineError, is_machine_fault
from reslrb_cli.records import manifest as manifests
from reslrb_cli.records import metrics
from reslrb_cli.records.atomic import FOLDER_PREFIX, remove_parts, unfinished_folder
from reslrb_cli.records.lock import READER_WAIT_SECONDS, FolderLock, Holder, InUse
from reslrb_cli.records.manifest import Manifest, Status

SUBFOLDERS = ("images", "parameters", "checkpoint")
OWN_ENTRIES = ("config.yaml", manifests.FILE_NAME, metrics.FILE_NAME, "report.html", *SUBFOLDERS)
#: An unfinished folder without a process is removed when it is so old: nobody is just about to lock it.
LEFT_SECONDS = 60.0


def check_output(source: object, output: Path, name: str, force: bool) -> None:
    """Raise a ConfigError (key `run.output` or `run.name`) where a run folder cannot be made in `output`.

    Tried, not asked: for root, permissions say nothing. Leaves nothing behind. Raises MachineError for a full disk.
    """
    if not name or name in (".", "..") or "/" in name or "\\" in name or "\0" in name:
        raise ConfigError(source, "run.name", f"{name!r} cannot name a folder; give a name without slashes")
    ancestor = next(path for path in (output, *output.absolute().parents) if os.path.lexists(path))
    if not ancestor.is_dir():
        raise ConfigError(source, "run.output", f"{ancestor} is not a folder; give a folder that can be written to")
    try:
        with unfinished_folder(ancestor) as folder:
            (folder / "file").write_text("is there room?")
            _try_name(source, folder, name)
    except OSError as error:
        raise _output_error(source, ancestor, error) from None
    if force:
        _check_replaceable(source, output / name)
        with contextlib.suppress(OSError):  # such as: there is none
            try:
                FolderLock(output / name, READER_WAIT_SECONDS, shared=True).release()
            except InUse:
                raise _in_use(source, output / name) from None


@dataclass(frozen=True)
class RunFolder:
    """A run folder on disk: the paths of what it holds, and the lock of who works in it.

    As a context manager it lets go of the lock at the end.
    """

    path: Path
    lock: FolderLock | None = field(default=None, compare=False, repr=False)

    @classmethod
    def create(cls, source: object, output: Path, name: str, force: bool, config: str, manifest: Manifest) -> RunFolder:
        """Make `<output>/<name>/` with its configuration, manifest and empty subfolders, and lock it.

        Where the name is taken, `<name>-2/` and so on. With `force` the run of that name is replaced: of its folder
        only what a run writes is removed, and a folder that is no run's, or in which one is at work, is refused
        (ConfigError). The folder appears under its name only once it is whole. Raises MachineError for a full disk.
        """
        try:
            output.mkdir(parents=True, exist_ok=True)
            _remove_left(output)
            with unfinished_folder(output) as part, contextlib.ExitStack() as stack:
                lock = stack.enter_context(FolderLock(part))
                for entry in SUBFOLDERS:
                    (part / entry).mkdir()
                (part / "config.yaml").write_text(config, encoding="utf-8")
                manifest.process = Holder.here(locked=lock.real)
                manifest.write(part)
                part.chmod(0o777 & ~_umask())
                own = cls(part, lock)
                folder = own._replace(source, output / name, manifest) if force else own._place(output / name)
                if folder.lock is lock:
                    stack.pop_all()
                return folder
        except OSError as error:
            raise _output_error(source, output, error) from None

    def _place(self, wanted: Path) -> RunFolder:
        """Rename the folder to the first free of `wanted`, `wanted-2`, ..."""
        for number in itertools.count(1):
            path = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
            if self._take_name(path):
                return replace(self, path=path)
        raise AssertionError("unreachable: count() does not end")

    def _take_name(self, path: Path) -> bool:
        """Rename the folder to `path`, unless there is something already."""
        if os.path.lexists(path):
            return False
        try:
            os.rename(self.path, path)
        except OSError:
            if not os.path.lexists(path):  # else another run took the name first
                raise
            return False
        return True

    def _replace(self, source: object, path: Path, manifest: Manifest) -> RunFolder:
        """Move what is in the folder over the run folder at `path`, under the lock of that."""
        while not self._take_name(path):
            _check_replaceable(source, path)
            try:
                lock = FolderLock(path)
            except InUse:
                raise _in_use(source, path) from None
            except FileNotFoundError:  # it has just gone
                continue
            if not lock.is_of(path):  # it has been moved away, or removed and made anew
                lock.release()
                continue
            try:
                # The manifest comes first: whatever happens from here on, the folder says whose run it is.
                os.replace(self.path / manifests.FILE_NAME, path / manifests.FILE_NAME)
                self._replace_others(path, manifest)
            except BaseException:
                lock.release()
                raise
            return RunFolder(path, lock)
        return replace(self, path=path)

    def _replace_others(self, path: Path, manifest: Manifest) -> None:
        try:
            self._move_others(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                manifest.end(path, Status.FAILED, str(error))
            raise

    def _move_others(self, path: Path) -> None:
        remove_parts(path)
        for name in OWN_ENTRIES:
            entry = path / name
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            elif name != manifests.FILE_NAME:
                entry.unlink(missing_ok=True)
        for name in ("config.yaml", *SUBFOLDERS):
            os.replace(self.path / name, path / name)

    @property
    def is_there(self) -> bool:
        """Whether the folder is still under its name, and not another one, such as that of a later run."""
        if self.lock is None:
            return self.path.is_dir()
        return self.lock.is_of(Path(os.path.realpath(self.path)))

    @property
    def fault(self) -> OSError | None:
        """What is wrong where it is not."""
        if self.is_there:
            return None
        return FileNotFoundError(errno.ENOENT, "has gone while the run went on", str(self.path))

    def make_whole(self) -> None:
        """Make the subfolders anew that somebody has removed. Raises OSError."""
        for name in SUBFOLDERS:
            (self.path / name).mkdir(exist_ok=True)

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.lock is not None:
            self.lock.release()


def _try_name(source: object, folder: Path, name: str) -> None:
    try:
        (folder / f"{name}-2").mkdir()  # as a second run would be called
    except ValueError:  # characters that no file name can have
        raise ConfigError(source, "run.name", f"{name!r} cannot name a folder; give another name") from None
    except OSError as error:
        if is_machine_fault(error):
            raise
        reason = f"{name[:40]!r}{'...' * (len(name) > 40)} cannot name a folder ({error.strerror}); give another name"
        raise ConfigError(source, "run.name", reason) from None


def _check_replaceable(source: object, path: Path) -> None:
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not path.is_dir() or manifests.read_manifest(path) is None:
        reason = f"{path} exists and is not a run folder, so --force does not replace it; give another name"
        raise ConfigError(source, "run.name", reason)


def _in_use(source: object, path: Path) -> ConfigError:
    content = manifests.read_manifest(path) or {}
    holder = Holder.from_json(content.get("process"))
    who = f"{holder}, since {content.get('started')}" if holder is not None else "another process"
    reason = f"{path} is in use by a run ({who}), so --force does not replace it; end that run, or give another name"
    return ConfigError(source, "run.name", reason)


def _output_error(source: object, folder: Path, error: OSError) -> ConfigError | MachineError:
    if is_machine_fault(error):
        return MachineError(f"{folder}: {error.strerror}; no run folder was made")
    reason = f"cannot write to {folder} ({error.strerror}); give a folder that can be written to"
    return ConfigError(source, "run.output", reason)


def _remove_left(output: Path) -> None:
    """Remove folders that killed processes never came to finish."""
    for path in output.glob(f"{FOLDER_PREFIX}*"):
        with contextlib.suppress(OSError, InUse):
            if time.time() - path.stat().st_mtime > LEFT_SECONDS:
                with FolderLock(path, wait_s=0) as lock:
                    if lock.real:
                        shutil.rmtree(path, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
