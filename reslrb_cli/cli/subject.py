"""What `inspect` is given: a scene file, a configuration (complete or not), or the folder of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reslrb_cli.config import Config, loads
from reslrb_cli.config.loader import read_text
from reslrb_cli.config.overrides import parse_override
from reslrb_cli.config.text import parse, write
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.manifest import read_manifest

#: What stands for sections that a configuration needs and the user has not written.
_STAND_INS = {"target": "{render: {spp: 1}}", "parameters": "[{key: '*'}]"}


@dataclass(frozen=True)
class Subject:
    """A configuration, with stand-ins for the sections in `missing`.

    `path` is what the user named, `run` the manifest of the run whose configuration it is, or None.
    """

    path: Path
    config: Config
    is_scene: bool
    missing: tuple[str, ...]
    run: dict[str, Any] | None


def read_subject(path: Path, overrides: tuple[str, ...]) -> Subject:
    """Read what `path` is, with `overrides` put in. Raises ConfigError."""
    manifest = read_manifest(path) if path.is_dir() else None
    if path.is_dir() and manifest is None:
        raise ConfigError(path, "", "is a folder without a run; name a scene file, a configuration or a run folder")
    file = path / "config.yaml" if manifest is not None else path
    if manifest is None and file.name == "config.yaml":
        manifest = read_manifest(file.parent)
    is_scene = _is_scene(file)
    text = write({"scene": {"file": str(file.absolute())}}) if is_scene else read_text(file, str(file))
    data = parse(text, str(file))
    given = {str(parse_override(override).location[0]) for override in overrides}
    sections = {key for key, value in data.items() if value is not None} if isinstance(data, dict) else set(_STAND_INS)
    if "views" in sections or "cameras" in _keys(data, "scene"):  # which bring targets along
        sections |= {"target"}
    missing = tuple(section for section in _STAND_INS if section not in sections | given)
    stand_ins = [f"{section}={_STAND_INS[section]}" for section in missing]
    config = loads(text, file, [*stand_ins, *overrides])
    return Subject(path, config, is_scene, missing, manifest)


def _keys(data: Any, section: str) -> set[str]:
    """The keys of a section, of which nothing is known yet."""
    inside = data.get(section) if isinstance(data, dict) else None
    return set(inside) if isinstance(inside, dict) else set()


def _is_scene(file: Path) -> bool:
    """Whether a file is a scene rather than a configuration."""
    if file.suffix.lower() == ".xml":
        return True
    try:
        return file.is_file() and file.open("rb").read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
    except OSError:  # said when it is read
        return False
