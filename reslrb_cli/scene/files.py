"""Files that an experiment reads, and digests of their contents.

Stored results, such as decisions, measurements or a run's state, are valid only for these file contents. Each digest
reads its whole file, because times and sizes could hide a change.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

from reslrb_cli.config.files import open_file
from reslrb_cli.config.schema import Config
from reslrb_cli.records.run_folder import checkpoint_of
from reslrb_cli.scene.cameras import read_cameras
from reslrb_cli.scene.xml.read import read_description

#: Bytes read at once.
_PART = 2**20


def files_of(config: Config) -> dict[str, Path]:
    """Return every file that an experiment reads. The keys are the settings that lead to the files.

    A setting may lead to several files, with keys such as `scene.file (images/wood.png)`. Missing files are left out.
    Loading the experiment reports missing files. Raises ConfigError if a scene, cameras or a run cannot be read.
    """
    found = {key: path for key, path in config.paths.items() if path.exists()}
    for key, path in list(found.items()):
        if path.is_dir():  # of a run whose values are used
            found[key] = checkpoint_of(path)
    beside: list[tuple[str, Path]] = []
    if config.scene.file.is_file():
        description = read_description(config.scene.file, config.scene.options)
        beside += [("scene.file", path) for path in description.files]
        named = (description.find_file(name) for _, name in description.named_files())
        beside += [("scene.file", path) for path in named if path is not None]
    cameras = config.scene.cameras
    if cameras is not None and cameras.is_file():
        beside += [("scene.cameras", camera.image) for camera in read_cameras(cameras)]
        beside += [("scene.cameras", cameras.with_name("cameras.txt"))]  # of COLMAP
    for key, path in beside:
        if path not in (config.scene.file, cameras):
            folder = found[key].parent
            found[f"{key} ({os.path.relpath(path, folder)})"] = path
    return {key: path for key, path in found.items() if path.is_file()}


def file_digests(files: Mapping[str, Path]) -> dict[str, str]:
    """Return a digest of the contents of each file, with the keys of `files`. Raises ConfigError."""
    return {key: digest_of(path) for key, path in files.items()}


def digest_of(path: Path) -> str:
    """Return a digest of the contents of a file. Raises ConfigError, located by the file."""
    found = hashlib.blake2b(digest_size=16)
    with open_file(path) as file:
        while part := file.read(_PART):
            found.update(part)
    return found.hexdigest()
