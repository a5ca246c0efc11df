"""Base classes and validators of the configuration's sections: strict types, paths, unions by `type`, and numbers."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Union, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    GetCoreSchemaHandler,
    SerializerFunctionWrapHandler,
    Tag,
    ValidationInfo,
    WithJsonSchema,
    model_serializer,
)
from pydantic_core import CoreSchema, PydanticCustomError

from reslrb_cli.config.files import PIXELS

#: Number of seeds: Mitsuba's seeds are uint32.
SEED_END = 2**32


class Section(BaseModel):
    """A mapping of the file. Unknown keys are errors, values are not converted, and NaN and infinity are refused.

    A setting's `description`, or the docstring below the setting, explains the meaning. `scripts/make_reference.py`
    reads the docstrings.
    """

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, allow_inf_nan=False, ser_json_inf_nan="constants"
    )

    def idle(self) -> set[str]:
        """Return the settings that have no effect beside the others. They are not written, so that the configuration
        can be read again.
        """
        return set()

    @model_serializer(mode="wrap")
    def _without_idle(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        idle = self.idle()
        return {name: value for name, value in handler(self).items() if name not in idle}


def located(key: str, message: str) -> PydanticCustomError:
    """Return an error for a validator of a section, located at `key` below this section."""
    return PydanticCustomError("located", "{message}", {"key": key, "message": message})


def wrong(message: str) -> PydanticCustomError:
    """Return an error for a validator of one value. `message` says what the value must be."""
    return PydanticCustomError("wrong", "{message}", {"message": message})


def must(hold: Callable[[Any], bool], message: Callable[[Any], str]) -> AfterValidator:
    """Return a validator for a value of the right type. `message` says what the value must be."""

    def check(value: Any) -> Any:
        if not hold(value):
            raise wrong(message(value))
        return value

    return AfterValidator(check)


# --- sections that are chosen by their `type` -----------------------------------------------------------------------


#: For JSON Schema: `type` may be left out only for the first member of a union.
NEEDS_TYPE: dict[str, Any] = {"required": ["type"]}


class Choice(Section):
    """A section whose `type` determines its options."""

    def options(self) -> dict[str, Any]:
        """Return the options of this type by name, without `type` and without options that are None."""
        return self.model_dump(exclude={"type"}, exclude_none=True)


# --- paths ------------------------------------------------------------------------------------------------------------


def _path(folder: Path, value: Any) -> Path:
    """Return the path `value` relative to `folder`. `..` is kept, because it may follow a symbolic link."""
    if not isinstance(value, (str, Path)) or not str(value).strip() or "\0" in str(value):
        raise wrong("must be a path")
    try:
        path = folder / Path(value).expanduser()
    except RuntimeError:
        raise wrong("must be a path: there is no such user") from None
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise wrong("names a file or a folder whose name is not UTF-8; rename it, since Mitsuba opens none") from None
    return path


_PATH_SCHEMA = WithJsonSchema({"type": "string", "format": "path"})


def config_path(value: Any, info: ValidationInfo) -> Path:
    """Return an absolute path from a path relative to the configuration file's folder, or to the working directory
    without a file. Raises a validator's error.
    """
    return _path(Path((info.context or {}).get("folder", "")).absolute(), value)


#: A path relative to the folder of the config file.
ConfigPath = Annotated[Path, BeforeValidator(config_path), _PATH_SCHEMA]


def code_place(value: Any, info: ValidationInfo) -> str:
    """Return FILE.py:NAME with an absolute path. Raises as `config_path` does."""
    path, colon, name = str(value).rpartition(":") if isinstance(value, str) else ("", "", "")
    if not (colon and path.endswith(".py") and name.isidentifier()):
        raise wrong("must be FILE.py:NAME, a file of Python code and the name of what is meant in it")
    return f"{config_path(path, info)}:{name}"


#: FILE.py:NAME of a user's own code.
CodePlace = Annotated[str, BeforeValidator(code_place)]


def named_or_code(value: Any, info: ValidationInfo) -> str:
    """Return a name unchanged, and FILE.py:NAME with an absolute path. Raises as `config_path` does."""
    if not isinstance(value, str) or not value.strip():
        raise wrong("must be a name, or FILE.py:NAME")
    return code_place(value, info) if is_code(value) else value


#: A name, or FILE.py:NAME of a user's own code.
NamedOrCode = Annotated[str, BeforeValidator(named_or_code)]


def is_code(name: str) -> bool:
    """Return whether a `NamedOrCode` is code of the user."""
    return ":" in name or name.endswith(".py")


def code_file(place: str) -> Path:
    """Return the file of a `CodePlace`."""
    return Path(place.rpartition(":")[0])


#: A path relative to the working directory.
WorkPath = Annotated[Path, BeforeValidator(lambda value: _path(Path.cwd(), value)), _PATH_SCHEMA]

# --- unions -----------------------------------------------------------------------------------------------------------


#: Prefix of the tags of unions' members. pydantic inserts tags into the location of an error; no key of a file or a
#: command line can contain this character.
MARK = "\0"


def mark(name: str) -> Tag:
    """Return the tag of a union's member."""
    return Tag(MARK + name)


class ByType(Discriminator):
    """Selects the union member by the key `type` of a mapping. `default` applies if the key `type` is missing."""

    def __init__(self, default: str) -> None:
        def tag(value: Any) -> str | None:
            if isinstance(value, Section):
                return f"{MARK}{getattr(value, 'type', '')}"
            return f"{MARK}{value.get('type', default)}" if isinstance(value, dict) else None

        super().__init__(tag)

    def __get_pydantic_core_schema__(self, source_type: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        tagged = [Annotated[kind, mark(kind.model_fields["type"].default)] for kind in get_args(source_type)]
        return super().__get_pydantic_core_schema__(Union[tuple(tagged)], handler)  # noqa: UP007 (made of a list)


def by_kind(expected: str, word: str | None = None) -> Discriminator:
    """Select the member of a union by the kind of the value. `expected` describes valid values in errors.

    The tags are `mapping`, `list`, `number`, and `text`. The tag `text` applies only to the value `word`, which is the
    only text in the union.
    """
    return Discriminator(
        lambda value: kind_tag(value, word), custom_error_type="wrong", custom_error_message=f"must be {expected}"
    )


def kind_tag(value: Any, word: str | None = None) -> str | None:
    """Return the tag of `by_kind` for a value."""
    if isinstance(value, (dict, Section)):
        return MARK + "mapping"
    if isinstance(value, (list, tuple)):
        return MARK + "list"
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return MARK + "number"
    return MARK + "text" if word is not None and value == word else None


# --- lists ------------------------------------------------------------------------------------------------------------


def list_of_one(value: Any) -> Any:
    """Return a name or a path as a list with one entry; other values are unchanged."""
    return [value] if isinstance(value, (str, Path)) else value


def each_once(value: list[Any]) -> bool:
    """Whether no value occurs twice in a list."""
    return len(set(value)) == len(value)


# --- numbers ----------------------------------------------------------------------------------------------------------

Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1, lt=2**31)]
Seed = Annotated[int, Field(ge=0, lt=SEED_END)]

#: [width, height].
Size = Annotated[tuple[Count, Count], Field(strict=False)]


def few(what: str, least: int = 1) -> AfterValidator:
    """Return a validator that limits the product of the two numbers in a size, and each number to at least `least`.
    `what` names the unit in errors.
    """
    start = "must have" if least == 1 else f"must be at least {least}, and have"
    return must(
        lambda size: min(size) >= least and math.prod(size) <= PIXELS,
        lambda size: f"{start} at most {PIXELS} {what}, not {math.prod(size)}",
    )
