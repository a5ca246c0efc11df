"""The files of an experiment, for processes on machines that lack the files: the configuration, the scene, and all
other files.

The scene is one file, without includes.

    folder/config.yaml     resolved, with the paths below
    folder/scene.xml       all includes and variables resolved
    folder/initial.npz     initial values of the parameters
    folder/files/N-NAME    all other files: meshes, textures, spectra, cameras, images, code
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from reslrb_cli.config.base import code_file
from reslrb_cli.config.loader import loads
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import write
from reslrb_cli.errors import ConfigError, MachineError
from reslrb_cli.records.atomic import unfinished_folder
from reslrb_cli.scene.xml.read import read_description, tag_lines

CONFIG_FILE, SCENE_FILE, INITIAL_FILE, FILES = "config.yaml", "scene.xml", "initial.npz", "files"

Values = Mapping[str, np.ndarray[Any, Any]]


@dataclass
class Bundle:
    """The contents of files by path. Paths start at the folder to which the files are written, and use `/`."""

    files: dict[str, bytes] = field(default_factory=dict)
    _names: dict[Path, str] = field(default_factory=dict)

    def add(self, path: Path) -> str:
        """Add a file once, and return the file's path in the bundle. The suffix stays the same. Raises ConfigError if
        it cannot be read.
        """
        path = path.absolute()
        if path not in self._names:
            name = self._names[path] = f"{FILES}/{len(self._names)}-{path.name}"
            try:
                self.files[name] = path.read_bytes()
            except OSError as error:
                raise ConfigError(path, "", f"cannot be sent to workers: {error.strerror}") from None
        return self._names[path]


def bundle_of(config: Config, values: Values) -> Bundle:
    """Return all files that a process needs to load `config`, except targets, which are sent as arrays.

    `values` are the initial values of the parameters (`Selection.array`). Raises ConfigError.
    """
    bundle, file = Bundle(), io.BytesIO()
    np.savez(file, **dict[str, Any](values))
    bundle.files[INITIAL_FILE] = file.getvalue()
    data = config.model_dump(exclude_none=True, exclude={"fabrication"})
    scene, cameras = data["scene"], config.scene.cameras
    if cameras is not None and cameras.suffix.lower() != ".json":  # COLMAP's files, which are read in pairs
        beside = cameras.with_name("cameras.txt")
        for name, path in ((cameras.name, cameras), (beside.name, beside)):
            bundle.files[f"{FILES}/colmap/{name}"] = path.read_bytes()
        scene["cameras"] = f"{FILES}/colmap/{cameras.name}"
    bundle.files[SCENE_FILE] = _scene_text(bundle, config).encode()
    scene |= {"file": SCENE_FILE, "options": {}}
    data["run"] |= {"output": "runs", "callbacks": []}
    for parameter in data["parameters"]:
        parameter.pop("initial", None)
    shown = {name: data.pop(name) for name in ("target", "views") if name in data}
    data = _packed(bundle, data) | _packed(None, shown)
    for key, code in config.codes.items():
        if code.path is not None and code.file is not None:
            _put(data, key, f"{bundle.add(code_file(code.file))}:{code.file.rpartition(':')[2]}")
    bundle.files[CONFIG_FILE] = write(data).encode()
    return bundle


def _scene_text(bundle: Bundle, config: Config) -> str:
    """Return the scene description as one file. Paths in the file are replaced by the bundle's paths."""
    description = read_description(config.scene.file, config.scene.options)
    for element, name in list(description.named_files()):
        path = description.find_file(name)
        if path is not None and path.is_file():
            if element.file_attribute:
                element.attributes[element.file_attribute] = bundle.add(path)
            else:  # a table of a metal, which Mitsuba finds by its name
                bundle.files[name] = path.read_bytes()
    return "".join(f"{line}\n" for line, _ in tag_lines(description.root))


def _packed(bundle: Bundle | None, value: Any) -> Any:
    """Return the settings with file paths replaced by the bundle's paths. Without a bundle, file paths become text."""
    if isinstance(value, Mapping):
        return {key: _packed(bundle, each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_packed(bundle, each) for each in value]
    if isinstance(value, Path):
        return bundle.add(value) if bundle is not None and value.is_file() else f"{FILES}/{value.name}"
    return value


def _put(data: dict[str, Any], key: str, value: str) -> None:
    """Set the value of a key such as `views[0].loss.file`."""
    *way, last = key.replace("[", ".").replace("]", "").split(".")
    at: Any = data
    for part in way:
        at = at[int(part)] if isinstance(at, list) else at[part]
    at[last] = value


def unpack(files: Mapping[str, bytes], folder: Path) -> None:
    """Write files to `folder`. The folder appears only when all files are written. If the folder exists already,
    nothing is written. Raises MachineError.
    """
    if folder.is_dir():
        return
    try:
        with unfinished_folder(folder.parent) as unfinished:
            for name, data in files.items():
                path = unfinished / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
            unfinished.rename(folder)
    except OSError as error:
        raise MachineError(f"{folder}: cannot write the experiment: {error.strerror}") from None


def read_bundle(folder: Path) -> tuple[Config, Values]:
    """Return the experiment in `folder`, and the initial values of its parameters. Raises ConfigError."""
    text = (folder / CONFIG_FILE).read_text(encoding="utf-8")
    with np.load(folder / INITIAL_FILE) as values:
        return loads(text, folder / CONFIG_FILE), dict(values)
