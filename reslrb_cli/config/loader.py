"""Reader of configurations from files, `--set` and scripts. It also writes resolved configurations.

`--set a.b=value` sets the value at a location of the configuration. The value is typed as in YAML.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from reslrb_cli.config.base import code_file
from reslrb_cli.config.errors import SettingError, problems
from reslrb_cli.config.files import read_file
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import UNFIT, Location, format_location, parse, write
from reslrb_cli.errors import ConfigError, one_line

#: Mappings with keys of the user that may contain dots: the text after their name is one key.
FREE_MAPPINGS: tuple[Location, ...] = (("scene", "options"), ("target", "render", "parameters"))
#: Source in error messages about an override from a script.
OVERRIDDEN = "overrides"
_PART = re.compile(r"\[(\d+)\]|(?:^|\.)([^.\[\]]+)")


@dataclass(frozen=True)
class Override:
    """One `--set`: its `label` in errors, its location, and its value."""

    label: str
    location: Location
    value: Any


def parse_override(text: str, option: str = "--set", example: str = "KEY=VALUE, such as run.spp=32") -> Override:
    """Parse `a.b=value`, an argument of `option`. Raises ConfigError for other text."""
    label = f"{option} {one_line(text, 100)}"
    path, equals, value = text.partition("=")
    path = path.strip()
    if not equals or not path:
        raise ConfigError(label, "", f"must be {example}")
    location = _parse_location(path, label)

    def in_shell(mended: str) -> str:
        return f"{option} {shlex.quote(f'{path}={mended}')}"

    return Override(label, location, parse(value, label, in_shell))


def _parse_location(path: str, label: str) -> Location:
    if UNFIT.search(path):
        raise ConfigError(label, "", "a key must not hold control characters, or bytes that are not UTF-8")
    location: list[str | int] = []
    position = 0
    while position < len(path):
        match = _PART.match(path, position)
        if match is None:
            raise ConfigError(label, "", f"`{one_line(path, 100)}` is not a key; write e.g. parameters[0].bounds")
        index, name = match.groups()
        location.append(int(index[:9]) if index else name)
        position = match.end()
        if tuple(location) in FREE_MAPPINGS and path[position : position + 1] == "." and path[position + 1 :]:
            return (*location, path[position + 1 :])
    return tuple(location)


def apply(data: dict[str, Any], override: Override) -> dict[str, Any]:
    """Return a copy of `data` with the override's value. Missing sections on the way are created.

    Other parts are shared with `data`. Raises ConfigError if the location is impossible: an index out of range, or a
    key below a plain value.
    """
    result: dict[str, Any] = _put(data, override, 0)
    return result


def _put(at: Any, override: Override, depth: int) -> Any:
    """Apply an override to `at`, the value at the first `depth` parts of the override's location."""
    if depth == len(override.location):
        return override.value
    part, name = override.location[depth], format_location(override.location[:depth])
    if at is None:
        at = [] if isinstance(part, int) else {}
    if isinstance(at, list):
        if isinstance(part, str) and part.isdecimal():
            part = int(part[:9])
        if not isinstance(part, int):
            raise ConfigError(override.label, name, f"is a list; give an entry, such as {name}[0]")
        if part > len(at):
            has = "1 entry" if len(at) == 1 else f"{len(at)} entries"
            raise ConfigError(override.label, name, f"has {has}; there is no [{part}]")
        return [*at[:part], _put(at[part] if part < len(at) else None, override, depth + 1), *at[part + 1 :]]
    if not isinstance(at, dict):
        raise ConfigError(override.label, name, "is a single value; replace it as a whole")
    if isinstance(part, int):
        raise ConfigError(override.label, name, "is not a list; give a key, not an index")
    return {**at, part: _put(at.get(part), override, depth + 1)}


def load(path: Path | str, overrides: Sequence[str | Override] = ()) -> Config:
    """Return the configuration in the YAML file `path`, with `overrides` such as "run.spp=32" applied in their order.

    Raises ConfigError. The error names the key, and either the file or the wrong override.
    """
    return loads(read_text(Path(path)), path, overrides)


def loads(text: str, path: Path | str, overrides: Sequence[str | Override] = ()) -> Config:
    """Return the configuration in a text. `path` names the text's origin. Relative paths in the text start at the
    folder of `path`.
    """
    parsed = [parse_override(each) if isinstance(each, str) else each for each in overrides]
    return resolve(parse(text, str(path)), path, parsed)


def replaces(location: Location, earlier: Mapping[str, Location]) -> str | None:
    """Return an error message if an override at `location` replaces one of the `earlier` overrides, otherwise None."""
    name = next((name for name, other in earlier.items() if other[: len(location)] == location), None)
    return None if name is None else f"replaces what {name} sets; give it first, or remove one of them"


def overrides_of(given: Mapping[str, object] | None) -> list[Override]:
    """Return the overrides of a script. Keys are as for `--set`, and values are Python values.

    Raises ConfigError for invalid overrides. An override that replaces an earlier override is invalid, too.
    """
    if given is not None and not isinstance(given, Mapping):
        reason = f'is {one_line(repr(given), 60)}, not a mapping such as {{"run.iterations": 5}}'
        raise ConfigError(OVERRIDDEN, "", reason)
    found: dict[str, Override] = {}
    for key, value in (given or {}).items():
        if not isinstance(key, str) or not key:
            raise ConfigError(OVERRIDDEN, "", f"has the key {one_line(repr(key), 40)}; keys are text, e.g. run.spp")
        location = _parse_location(key, OVERRIDDEN)
        if reason := replaces(location, {name: other.location for name, other in found.items()}):
            raise ConfigError(OVERRIDDEN, key, reason)
        found[key] = Override(OVERRIDDEN, location, plain(value, OVERRIDDEN, key))
    return list(found.values())


def plain(value: Any, source: object, key: str = "") -> Any:
    """Convert a Python value to plain data as from YAML: paths to text, tuples to lists, NumPy values to Python's.

    Raises ConfigError, located by `source` and `key`, for objects that plain data cannot express.
    """
    if isinstance(value, Mapping):
        for name in value:
            if not isinstance(name, str):
                raise ConfigError(source, key, f"has the key {one_line(repr(name), 40)}; keys are text")
        places = {name: f"{key}.{name}" if key else name for name in value}
        return {name: plain(each, source, places[name]) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each, source, f"{key}[{place}]") for place, each in enumerate(value)]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # types of NumPy, which is not imported here
        return plain(value.tolist(), source, key)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise ConfigError(source, key, f"is {one_line(repr(value), 60)}; YAML has no such value")


def changed(config: Config, overrides: Sequence[str | Override]) -> Config:
    """Return the experiment with overrides applied. The returned experiment keeps the loss function of `config`, its
    scene in memory, and the permission to run code.

    Raises ConfigError.
    """
    if not overrides:
        return config
    parsed = [parse_override(each) if isinstance(each, str) else each for each in overrides]
    return resolve(config.model_dump(mode="json", exclude_none=True), config.source, parsed).with_own_of(config)


def resolve(data: Any, path: Path | str, parsed: Sequence[Override] = ()) -> Config:
    """Validate settings with overrides applied. `path` names their origin.

    Raises ConfigError. The error names the key, and either the file or the wrong override.
    """
    source = str(path)
    if data is None and not parsed:
        raise ConfigError(source, "", "is empty; it needs at least scene, target and parameters")
    if not isinstance(data, dict) and data is not None:
        raise ConfigError(source, "", "must hold sections (scene: ...) at its top level, not a list or a single value")
    stages: list[dict[str, Any]] = [data or {}]
    try:
        for override in parsed:
            stages.append(apply(stages[-1], override))
        config, found = _validate(stages[-1], Path(path))
    except RecursionError:
        raise ConfigError(parsed[-1].label if parsed else source, "", "is nested too deeply") from None
    if config is not None:
        return config
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    raise ConfigError(_blame(stages, parsed, found[0], Path(path)), found[0].key, found[0].explain() + more)


def told(first: Mapping[str, Any]) -> Config:
    """Return the configuration in a process's first message (`Measurement.first`). The sender has validated it."""
    return loads(first["config"], first["source"]).with_code(first.get("allow_code") is True)


def check_code(config: Config, places: Mapping[str, str | None] | None = None) -> None:
    """Raise ConfigError, located by the key, if users' code must not run. Loads nothing.

    `places` maps keys to FILE.py:NAME, or to None for a function in memory. If `places` is None, check the losses and
    integrators of the experiment.
    """
    for key, place in ({key: one.file for key, one in config.codes.items()} if places is None else places).items():
        if place is None and config.own_loss is None:
            reason = "missing; give FILE.py:NAME, or in Python the same function as at the start of the run"
            raise ConfigError(config.source, key, reason)
        if place is not None and not config.allows_code:
            reason = f"would run the code of {code_file(place)} with all your rights; --allow-code permits it"
            raise ConfigError(config.source, key, reason)


def _blame(stages: list[dict[str, Any]], overrides: Sequence[Override], problem: SettingError, path: Path) -> str:
    """Return the origin of `problem`: the override that causes it, or the file.

    `stages` holds several versions of the settings: first the settings of the file, then the settings after each
    override.
    """
    origins = [str(path), *(override.label for override in overrides)]
    found = (origin for origin, stage in zip(origins, stages, strict=True) if problem in _validate(stage, path)[1])
    return next(found, origins[-1])


def with_integrator(config: Config, values: dict[str, Any], blame: str, adjoint: dict[str, Any]) -> Config:
    """Return the experiment with the integrator in `values`, and with other settings of `run.adjoint`.

    `adjoint` has the key `adjoint` and its related settings. An empty `adjoint` changes nothing. Raises ConfigError
    that names `blame`.
    """
    data = config.model_dump(mode="json", exclude_none=True) | {"integrator": values}
    if "adjoint" in adjoint:
        data["run"] = {key: value for key, value in data["run"].items() if key != "batches"}
    data["run"] |= adjoint
    changed, found = _validate(data, config.source)
    if changed is None:
        raise ConfigError(blame, found[0].key, found[0].explain())
    return changed.with_own_of(config)


def dump(config: Config) -> str:
    """Return the configuration as YAML, with all defaults and absolute paths. `load` reads it back as an equal one."""
    return write(config.model_dump(mode="json", exclude_none=True))


def read_text(path: Path) -> str:
    """Return the text of a configuration file. Raises ConfigError if it is not text."""
    try:
        return read_file(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise ConfigError(path, "", "is not UTF-8 text; a configuration is a YAML file") from None


def _validate(raw: dict[str, Any], path: Path) -> tuple[Config | None, list[SettingError]]:
    """Return the configuration, or the errors in `raw`."""
    # a section whose lines are all commented out reads as null
    data = {key: value for key, value in raw.items() if value is not None or key not in Config.model_fields}
    run = data.setdefault("run", {})
    if isinstance(run, dict) and run.get("name") is None:
        data["run"] = {**run, "name": path.stem.encode(errors="replace").decode()}  # invalid UTF-8 as `?`
    try:
        config = Config.model_validate(data, context={"folder": path.absolute().parent})
    except ValidationError as error:
        return None, problems(error, data)
    config._source = path
    return config, []
