"""What every section of the configuration shares: strictness, paths, and unions that are told apart by their `type`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, ValidationInfo, WithJsonSchema
from pydantic_core import PydanticCustomError

#: Largest seed plus one: Mitsuba's seeds are uint32.
SEED_END = 2**32


class Section(BaseModel):
    """A mapping of the file: unknown keys are errors, values are not converted, NaN and infinity are refused."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


def located(key: str, message: str) -> PydanticCustomError:
    """An error to raise in a validator of a whole section, located at `key` below that section."""
    return PydanticCustomError("located", "{message}", {"key": key, "message": message})


def wrong(message: str) -> PydanticCustomError:
    """An error to raise in a validator of one value: `message` says what the value must be."""
    return PydanticCustomError("wrong", "{message}", {"message": message})


# --- paths ------------------------------------------------------------------------------------------------------------


def _path(base_key: str) -> Callable[[Any, ValidationInfo], Path]:
    def convert(value: Any, info: ValidationInfo) -> Path:
        if not isinstance(value, (str, Path)) or not str(value).strip() or "\0" in str(value):
            raise wrong("must be a path")
        try:
            path = Path(value).expanduser()
        except RuntimeError as error:  # ~nobody
            raise wrong(f"must be a path: {error}") from None
        base = (info.context or {}).get(base_key, Path.cwd())
        # normpath would also resolve `a/../b` where `a` is a symbolic link, to the wrong file: leave `..` to the system
        return Path(base).absolute() / path

    return convert


_PATH_SCHEMA = WithJsonSchema({"type": "string", "format": "path"})

#: A path relative to the folder of the config file.
ConfigPath = Annotated[Path, BeforeValidator(_path("folder")), _PATH_SCHEMA]
#: A path relative to the working directory.
WorkPath = Annotated[Path, BeforeValidator(_path("working_directory")), _PATH_SCHEMA]


# --- unions -----------------------------------------------------------------------------------------------------------


def by_type(default: str) -> Discriminator:
    """Tells the members of a union apart by their key `type`, `default` where it is left out.

    The members' tags are `<name>`: unlike those of pydantic's own way they cannot be mistaken for keys in a location.
    """

    def tag(value: Any) -> str | None:
        if isinstance(value, Section):
            return f"<{getattr(value, 'type', '')}>"
        return f"<{value.get('type', default)}>" if isinstance(value, dict) else None

    return Discriminator(tag)


def _kind(value: Any) -> str:
    if isinstance(value, (dict, Section)):
        return "<mapping>"
    if isinstance(value, list):
        return "<list>"
    return "<text>" if isinstance(value, str) else "<number>"


#: Tells the members of a union apart by the kind of the value: Tag("<mapping>" | "<list>" | "<text>" | "<number>").
BY_KIND = Discriminator(_kind)

# --- numbers ----------------------------------------------------------------------------------------------------------

Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, lt=SEED_END)]
