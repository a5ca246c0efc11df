"""What the commands about one experiment share: their arguments, and the way from a file to a variant."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from reslrb_cli.config import Config, load
from reslrb_cli.errors import ConfigError

logger = logging.getLogger(__name__)


def experiment_arguments(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add CONFIG (`config_file`) and `--set` (`overrides`) to a command."""
    return _arguments(function, required=True)


def optional_experiment_arguments(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same for a command that has a scene of its own: `config_file` is None where CONFIG is left out."""
    return _arguments(function, required=False)


def overrides_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--set` (`overrides`) to a command."""
    return click.option(
        "--set",
        "overrides",
        multiple=True,
        metavar="KEY=VALUE",
        help="Override a setting, e.g. --set run.spp=32; the value is YAML. May be repeated.",
    )(function)


def _arguments(function: Callable[..., Any], required: bool) -> Callable[..., Any]:
    metavar = "CONFIG" if required else "[CONFIG]"
    argument = click.argument("config_file", metavar=metavar, required=required, type=click.Path(path_type=Path))
    return argument(overrides_option(function))


def read_config(config_file: Path, overrides: tuple[str, ...]) -> Config:
    """Load and check the configuration. Raises ConfigError."""
    return load(config_file, list(overrides))


def start_variant(config: Config) -> str:
    """Set the Mitsuba variant that `config` asks for; return its name. Raises BackendError."""
    from reslrb_cli.backend.variant import set_variant

    return set_variant(config.variant)


def check_writable(option: str, path: Path | None) -> None:
    """Raise ConfigError, located by the option, where the file `path` cannot be written; it is left as it was."""
    if path is None:
        return
    existed = path.exists()
    try:
        with path.open("ab"):
            pass
    except OSError as error:
        raise ConfigError(option, "", f"cannot write {path}: {error.strerror}") from None
    if not existed:
        path.unlink()
