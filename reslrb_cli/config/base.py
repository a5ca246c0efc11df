"""The basis of all sections of the configuration: strictness, paths, unions told apart by their `type`, numbers."""

from __future__ import annotations

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
    Tag,
    ValidationInfo,
    WithJsonSchema,
)
from pydantic_core import CoreSchema, PydanticCustomError

from reslrb_cli.config.files import PIXELS

#: Largest seed plus one: Mitsuba's seeds are uint32.
SEED_END = 2**32


class Section(BaseModel):
    """A mapping of the file: unknown keys are errors, values are not converted, NaN and infinity are refused.

    What a setting means is its `description`, or the docstring below it.
    """

    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


def located(key: str, message: str) -> PydanticCustomError:
    """An error to raise in a validator of a whole section, located at `key` below that section."""
    return PydanticCustomError("located", "{message}", {"key": key, "message": message})


def wrong(message: str) -> PydanticCustomError:
    """An error to raise in a validator of one value: `message` says what the value must be."""
    return PydanticCustomError("wrong", "{message}", {"message": message})


def must(hold: Callable[[Any], bool], message: Callable[[Any], str]) -> AfterValidator:
    """The check of a value that has its type already; `message` says of one that does not hold what it must be."""

    def check(value: Any) -> Any:
        if not hold(value):
            raise wrong(message(value))
        return value

    return AfterValidator(check)


# --- sections that are chosen by their `type` -----------------------------------------------------------------------


#: For JSON Schema: `type` may be left out only for the first member of a union.
NEEDS_TYPE: dict[str, Any] = {"required": ["type"]}


class Choice(Section):
    """A section whose `type` says which options it has."""

    def options(self) -> dict[str, Any]:
        """The options of this type by name, without `type` and without those that are None."""
        return self.model_dump(exclude={"type"}, exclude_none=True)


# --- paths ------------------------------------------------------------------------------------------------------------


def _folder(info: ValidationInfo) -> Path:
    """The folder of the config file, where one is known."""
    return Path((info.context or {}).get("folder", "")).absolute()


def _path(folder: Path, value: Any) -> Path:
    """The path `value`, relative to `folder`. Joined, not resolved: `..` after a symbolic link is the system's."""
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

#: A path relative to the folder of the config file.
ConfigPath = Annotated[Path, BeforeValidator(lambda value, info: config_path(value, info)), _PATH_SCHEMA]


def config_path(value: Any, info: ValidationInfo) -> Path:
    """A path relative to the folder of the config file, absolute. Raises an error to be raised in a validator."""
    return _path(_folder(info), value)


def code_place(value: Any, info: ValidationInfo) -> str:
    """FILE.py:NAME with the path joined to the folder of the configuration; raises as `config_path`."""
    path, colon, name = str(value).rpartition(":") if isinstance(value, str) else ("", "", "")
    if not (colon and path.endswith(".py") and name.isidentifier()):
        raise wrong("must be FILE.py:NAME, a file of Python code and the name of what is meant in it")
    return f"{config_path(path, info)}:{name}"


#: FILE.py:NAME, of a user's own code.
CodePlace = Annotated[str, BeforeValidator(code_place)]


def code_file(place: str) -> Path:
    """The file of a `CodePlace`."""
    return Path(place.rpartition(":")[0])


#: A path relative to the working directory.
WorkPath = Annotated[Path, BeforeValidator(lambda value: _path(Path.cwd(), value)), _PATH_SCHEMA]

# --- unions -----------------------------------------------------------------------------------------------------------


#: What the tags of unions' members begin with. pydantic puts tags among the keys of an error's location; no key of a
#: file or a command line can hold this character.
MARK = "\0"


def mark(name: str) -> Tag:
    """The tag of a union's member."""
    return Tag(MARK + name)


class ByType(Discriminator):
    """Tells the members of a union apart by their key `type`, `default` where it is left out."""

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
    """Tells the members of a union apart by the kind of the value; `expected` says in an error what is right.

    Tags: `mapping`, `list`, `number`, and `text` for `word`, the only text that the union knows.
    """
    return Discriminator(
        lambda value: kind_tag(value, word), custom_error_type="wrong", custom_error_message=f"must be {expected}"
    )


def kind_tag(value: Any, word: str | None = None) -> str | None:
    """The tag of `by_kind` for a value."""
    if isinstance(value, (dict, Section)):
        return MARK + "mapping"
    if isinstance(value, (list, tuple)):
        return MARK + "list"
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return MARK + "number"
    return MARK + "text" if word is not None and value == word else None


# --- lists ------------------------------------------------------------------------------------------------------------


def list_of_one(value: Any) -> Any:
    """A name or a path as a list of it; what is none stays."""
    return [value] if isinstance(value, (str, Path)) else value


def each_once(value: list[Any]) -> bool:
    """Whether nothing stands twice in a list."""
    return len(set(value)) == len(value)


# --- numbers ----------------------------------------------------------------------------------------------------------

Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1, lt=2**31)]
Seed = Annotated[int, Field(ge=0, lt=SEED_END)]

#: [width, height].
Size = Annotated[tuple[Count, Count], Field(strict=False)]


def few(what: str, reason: str = "") -> AfterValidator:
    """The check of a size that has a bounded number of pixels, or `what` they are called there."""
    return must(
        lambda size: size[0] * size[1] <= PIXELS,
        lambda size: f"must have at most {PIXELS} {what}, not {size[0] * size[1]}{reason}",
    )
