"""The folder of one run: where it is made, and what may be replaced."""

from __future__ import annotations

import itertools
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

from reslrb_cli.errors import ConfigError
from reslrb_cli.records import manifest as manifests
from reslrb_cli.records import metrics
from reslrb_cli.records.manifest import Manifest

SUBFOLDERS = ("images", "parameters", "checkpoint")
OWN_ENTRIES = ("config.yaml", manifests.FILE_NAME, metrics.FILE_NAME, "report.html", *SUBFOLDERS)


def check_output(source: object, output: Path, name: str, force: bool) -> None:
    """Raise a ConfigError (key `run.output` or `run.name`) where a run folder cannot be made in `output`.

    Tried, not asked: for root, permissions say nothing. Leaves nothing behind.
    """
    if not name or name in (".", "..") or "/" in name or "\\" in name or "\0" in name:
        raise ConfigError(source, "run.name", f"{name!r} cannot name a folder; give a name without slashes")
    ancestor = next(path for path in (output, *output.absolute().parents) if os.path.lexists(path))
    if not ancestor.is_dir():
        raise ConfigError(source, "run.output", f"{ancestor} is not a folder; give a folder that can be written to")
    try:
        with tempfile.TemporaryDirectory(prefix=".reslrb-", dir=ancestor):
            pass
    except OSError as error:
        reason = f"cannot write to {ancestor} ({error.strerror}); give a folder that can be written to"
        raise ConfigError(source, "run.output", reason) from None
    if force:
        _check_replaceable(source, output / name)


@dataclass(frozen=True)
class RunFolder:
    """A run folder on disk; the paths of what it holds."""

    path: Path

    @classmethod
    def create(cls, source: object, output: Path, name: str, force: bool, config: str, manifest: Manifest) -> RunFolder:
        """Make `<output>/<name>/` with its configuration, manifest and empty subfolders.

        Where the name is taken, `<name>-2/` and so on. With `force` the run of that name is replaced: of its folder
        only what a run writes is removed, and a folder that is no run's is refused. The folder appears under its
        name only once it is whole.
        """
        try:
            output.mkdir(parents=True, exist_ok=True)
            part = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=output))
            try:
                for entry in SUBFOLDERS:
                    (part / entry).mkdir()
                (part / "config.yaml").write_text(config, encoding="utf-8")
                manifest.write(part)
                part.chmod(0o777 & ~_umask())
                path = cls._replace(source, part, output / name) if force else cls._place(part, output / name)
            finally:
                shutil.rmtree(part, ignore_errors=True)
        except OSError as error:
            raise ConfigError(source, "run.output", f"cannot write to {output} ({error.strerror})") from None
        return cls(path)

    @staticmethod
    def _place(part: Path, wanted: Path) -> Path:
        """Rename `part` to the first free of `wanted`, `wanted-2`, ..."""
        for number in itertools.count(1):
            path = wanted if number == 1 else wanted.with_name(f"{wanted.name}-{number}")
            if os.path.lexists(path):
                continue
            try:
                os.rename(part, path)
            except OSError:
                if not os.path.lexists(path):  # else another run took the name first
                    raise
            else:
                return path
        raise AssertionError("unreachable: count() does not end")

    @staticmethod
    def _replace(source: object, part: Path, path: Path) -> Path:
        """Move what is in `part` over the run folder at `path`."""
        if not os.path.lexists(path):
            os.rename(part, path)
            return path
        _check_replaceable(source, path)
        # The manifest goes last and comes first, so that whatever happens in between it stays a run folder.
        for name in (*(entry for entry in OWN_ENTRIES if entry != manifests.FILE_NAME), manifests.FILE_NAME):
            entry = path / name
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry)
            elif name != manifests.FILE_NAME:
                entry.unlink(missing_ok=True)
        for name in (manifests.FILE_NAME, "config.yaml", *SUBFOLDERS):
            os.replace(part / name, path / name)
        return path

    @property
    def images(self) -> Path:
        return self.path / "images"

    @property
    def parameters(self) -> Path:
        return self.path / "parameters"

    @property
    def checkpoint(self) -> Path:
        return self.path / "checkpoint"


def _check_replaceable(source: object, path: Path) -> None:
    if not os.path.lexists(path):
        return
    if path.is_symlink() or not path.is_dir() or manifests.read_manifest(path) is None:
        reason = f"{path} exists and is not a run folder, so --force does not replace it; give another name"
        raise ConfigError(source, "run.name", reason)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
