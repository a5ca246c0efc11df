"""The basis of all sections of the configuration: strictness, paths, unions told apart by their `type`, shared values.

The values that several sections share are names of runs, which are names of folders too; amounts of memory as a user
writes them; and how often a run keeps its state.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    SerializerFunctionWrapHandler,
    Tag,
    ValidationInfo,
    WithJsonSchema,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError
from typing_extensions import Self

from reslrb_cli.config.files import NAME_BYTES, PART_BYTES, PATH_BYTES, PIXELS

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
NEEDS_TYPE = ConfigDict(json_schema_extra={"required": ["type"]})


class Choice(Section):
    """A section whose `type` says which options it has."""

    def options(self) -> dict[str, Any]:
        """The options of this type by name, without `type` and without those that are None."""
        return self.model_dump(exclude={"type"}, exclude_none=True)


# --- paths ------------------------------------------------------------------------------------------------------------


def _path(folder: Path, value: Any) -> Path:
    """The path `value`, relative to `folder`. Joined, not resolved: `..` after a symbolic link is the system's."""
    if not isinstance(value, (str, Path)) or not str(value).strip() or "\0" in str(value):
        raise wrong("must be a path")
    try:
        path = folder / Path(value).expanduser()
    except RuntimeError:
        raise wrong("must be a path: there is no such user") from None
    try:
        sizes = [len(part.encode()) for part in (str(path), *path.parts)]
    except UnicodeEncodeError:
        raise wrong("names a file or a folder whose name is not UTF-8; rename it, since Mitsuba opens none") from None
    if max(sizes[1:]) > PART_BYTES or sizes[0] > PATH_BYTES:
        raise wrong(f"must be a path of at most {PATH_BYTES} bytes, and each name in it of at most {PART_BYTES}")
    return path


def _below_config(value: Any, info: ValidationInfo) -> Path:
    return _path(Path((info.context or {}).get("folder", "")).absolute(), value)


def _below_working_directory(value: Any) -> Path:
    return _path(Path.cwd(), value)


_PATH_SCHEMA = WithJsonSchema({"type": "string", "format": "path"})

#: A path relative to the folder of the config file.
ConfigPath = Annotated[Path, BeforeValidator(_below_config), _PATH_SCHEMA]

#: A path relative to the working directory.
WorkPath = Annotated[Path, BeforeValidator(_below_working_directory), _PATH_SCHEMA]

# --- unions -----------------------------------------------------------------------------------------------------------


#: What the tags of unions' members begin with. pydantic puts tags among the keys of an error's location; no key of a
#: file or a command line can hold this character.
MARK = "\0"


def mark(name: str) -> Tag:
    """The tag of a union's member."""
    return Tag(MARK + name)


def by_type(default: str) -> Discriminator:
    """Tells the members of a union apart by their key `type`, `default` where it is left out."""

    def tag(value: Any) -> str | None:
        if isinstance(value, Section):
            return f"{MARK}{getattr(value, 'type', '')}"
        return f"{MARK}{value.get('type', default)}" if isinstance(value, dict) else None

    return Discriminator(tag)


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


#: Names that Windows takes for devices, whatever suffix they have: a folder that is called so cannot be copied there.
_RESERVED = re.compile(r"(con|prn|aux|nul|(com|lpt)[0-9])(\..*)?", re.IGNORECASE)

#: What begins at a root or at a home, or has `.` or `..` for a part. A slash between words is none of that.
_PATH = re.compile(r"^([/\\~]|[A-Za-z]:[/\\])|(^|[/\\])\.\.?($|[/\\])")


def folder_name(name: str) -> str:
    """A run's name as the name of a folder: what is no letter, digit, `.`, `_`, `+`, `=` becomes `-`."""
    return re.sub(r"[^\w.+=]+", "-", name).strip("-.")


def check_name(name: str) -> str:
    """`name`, where it can name a run; else raises an error that says what is wrong with it."""
    folder = folder_name(name)
    if _PATH.search(name.strip()):
        raise wrong("must be a name and not a path; run.output says where the run's folder is")
    if not folder:
        raise wrong("must hold a letter or a digit")
    if _RESERVED.fullmatch(folder):
        raise wrong(f"must be another name: {folder} is a device on Windows, and not a folder's name there")
    if len(folder.encode()) > NAME_BYTES:
        raise wrong(f"must have at most {NAME_BYTES} bytes in UTF-8, not {len(folder.encode())}")
    return name


MIB = 2**20

_UNITS = {"b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": MIB, "gib": 2**30}

_SIZE = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*([A-Za-z]+)")


def memory_bytes(value: int | float | str) -> int:
    """Bytes of a number of MiB, or of text such as "512 MiB", "2GiB", "500 MB".

    Raises ValueError where it is neither, or less than one byte.
    """
    number, unit = float("nan"), "mib"
    if isinstance(value, str):
        match = _SIZE.fullmatch(value.strip())
        if match:
            number, unit = float(match[1]), match[2].lower()
    elif not isinstance(value, bool):
        number = float(value) if abs(value) < 2**63 else float("inf")  # longer integers fit into no float
    if unit not in _UNITS or not 1 <= number * _UNITS[unit] < 2**63:
        raise ValueError(f"{value!r} is no amount of memory")
    return int(number * _UNITS[unit])


def _check(value: Any) -> Any:
    try:
        if not isinstance(value, (int, float, str)):
            raise ValueError
        memory_bytes(value)
    except ValueError:
        raise wrong("must be a number of MiB, or text such as 512 MiB or 2GiB, and more than 0") from None
    return value


#: A number of MiB, or text with a unit (B, kB, KiB, MB, MiB, GB, GiB); kept as it was written.
Memory = Annotated[
    int | float | str,
    BeforeValidator(_check),
    WithJsonSchema({"anyOf": [{"type": "number", "exclusiveMinimum": 0}, {"type": "string"}]}),
]


class CheckpointEvery(Section):
    """Exactly one of `iterations` and `seconds`."""

    iterations: Count | None = Field(default=None, description="Iterations between two checkpoints.")
    seconds: Positive | None = Field(default=None, description="Seconds between two checkpoints, at least.")

    @model_validator(mode="after")
    def _check_one(self) -> Self:
        if (self.iterations is None) == (self.seconds is None):
            has = "none" if self.seconds is None else "both"
            raise located("", f"must have exactly one of `iterations` and `seconds`, and has {has}")
        return self

    @model_serializer(mode="wrap")
    def _without_unused(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {key: value for key, value in handler(self).items() if value is not None}

    def is_due(self, iterations: int, seconds: float) -> bool:
        """Whether it is time for one, so many iterations and seconds after the last."""
        return iterations >= self.iterations if self.iterations is not None else seconds > (self.seconds or 0.0)
