"""Conversion of pydantic's errors to one located line that also describes a correct value or key."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from reslrb_cli.config.base import MARK, Section
from reslrb_cli.config.schema import Config
from reslrb_cli.config.yaml_text import Location, format_location
from reslrb_cli.errors import did_you_mean

_EXPECTED = {
    "int_type": "an integer",
    "int_from_float": "an integer",
    "float_type": "a number",
    "string_type": "text",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "model_type": "a mapping (key: value)",
    "dict_type": "a mapping (key: value)",
    "finite_number": "a finite number",
    "greater_than": "above {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "below {lt}",
    "less_than_equal": "at most {le}",
    "string_too_short": "nonempty text",
    "string_too_long": "text of at most {max_length} characters",
}


@dataclass(frozen=True)
class SettingError:
    """One error: its location in the notation of `--set`, and its description. `explain` says what would be right.

    `unknown` is pydantic's location of an unknown key. Only `explain` searches for the nearest known key, because the
    search takes time.
    """

    key: str
    message: str
    unknown: tuple[int | str, ...] | None = None

    def explain(self) -> str:
        """Describe the error, and describe a correct value or key."""
        return self.message if self.unknown is None else _unknown_key(self.unknown)


def problems(error: ValidationError, data: Any) -> list[SettingError]:
    """Return the errors that `error` reports for `data`, each once. Unknown keys come first, because unknown keys
    explain missing keys.
    """
    found = dict.fromkeys(_problem(detail, data) for detail in error.errors(include_url=False))
    return sorted(found, key=lambda problem: problem.unknown is None)


def _problem(detail: ErrorDetails, data: Any) -> SettingError:
    kind, value, context = detail["type"], detail["input"], detail.get("ctx", {})
    location = _location(detail["loc"], data)
    key = format_location(location)
    if kind == "extra_forbidden":
        return SettingError(key, "unknown key", unknown=detail["loc"])
    if kind == "located":
        return SettingError(_join(key, context["key"]), context["message"])
    if kind.startswith("union_tag"):
        if not isinstance(value, dict):
            return SettingError(key, _but_is("must be a mapping such as {type: NAME}", value))
        given, known = value.get("type"), [str(_type_name(section)) for section in _candidates(detail["loc"])[0]]
        return SettingError(_join(key, "type"), _but_is("must be " + _one_of(known, given), given))
    if kind == "missing" and isinstance(location[-1], str):
        return SettingError(key, "missing; it has no default")
    if kind == "missing":  # an entry of a pair
        return SettingError(format_location(location[:-1]), "must be a list of two: it has too few entries")
    if kind == "too_long":
        most = {1: "one", 2: "two"}.get(context["max_length"], str(context["max_length"]))
        return SettingError(key, f"must be a list of {most}: it has too many entries")
    if kind == "too_short":
        return SettingError(key, "must have at least one entry")
    if kind == "wrong":
        return SettingError(key, _but_is(context.get("message") or detail["msg"], value))
    if kind == "literal_error":
        return SettingError(
            key, _but_is("must be " + _one_of(re.findall(r"'([^']*)'", context["expected"]), value), value)
        )
    if kind in _EXPECTED:
        return SettingError(key, _but_is("must be " + _EXPECTED[kind].format(**context), value))
    return SettingError(key, detail["msg"])


# --- where ------------------------------------------------------------------------------------------------------------


def _location(loc: tuple[int | str, ...], data: Any) -> Location:
    """Return pydantic's location without the parts that do not exist in the file, such as tags of unions."""
    location: list[str | int] = []
    for part in loc:
        if _is_tag(part) or (isinstance(part, int) and isinstance(data, str)):
            continue
        location.append(str(part) if isinstance(data, dict) else part)
        try:
            data = data[part]
        except (LookupError, TypeError):
            data = None
    return tuple(location)


def _is_tag(part: int | str) -> bool:
    return isinstance(part, str) and part.startswith(MARK)


def _join(key: str, below: str) -> str:
    return f"{key}{'' if below.startswith('[') else '.'}{below}" if key and below else key or below


# --- unknown keys -----------------------------------------------------------------------------------------------------


def _sections(annotation: Any) -> list[type[Section]]:
    """Return the section classes in an annotation, at any depth."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [section for argument in get_args(annotation) for section in _sections(argument)]


def _candidates(loc: tuple[int | str, ...]) -> tuple[list[type[Section]], type[Section]]:
    """Return all sections that are possible at `loc`, and the section that was chosen."""
    union: list[type[Section]] = [Config]
    chosen: type[Section] = Config
    for part in loc:
        if _is_tag(part):
            chosen = next((s for s in union if _tag(s) == str(part)[len(MARK) :]), chosen)
        elif part in chosen.model_fields:
            union = _sections(chosen.model_fields[str(part)].annotation)
            chosen = union[0] if union else chosen
    return union, chosen


def _type_name(section: type[Section]) -> str | None:
    return section.model_fields["type"].default if "type" in section.model_fields else None


def _tag(section: type[Section]) -> str | None:
    """Return the tag by which a union identifies a section."""
    return getattr(section, "TAG", None) or _type_name(section)


def _unknown_key(loc: tuple[int | str, ...]) -> str:
    key = str(loc[-1])
    union, chosen = _candidates(loc[:-1])
    owners = list(dict.fromkeys(str(_type_name(each)) for each in union if key in each.model_fields))
    if owners:
        return f"not an option of {_type_name(chosen)} but of {', '.join(owners)}; remove it, or change the type"
    here = format_location(tuple(part for part in loc[:-1] if not _is_tag(part)))
    below = [*_below(chosen, here, key), *_below(Config, "", key)]
    otherwise = f"did you mean `{below[0]}`?" if below else f"known here: {', '.join(chosen.model_fields)}"
    return f"unknown key; {did_you_mean(key, chosen.model_fields, otherwise=otherwise)}"


def _below(section: type[Section], name: str, key: str) -> list[str]:
    """Return the places one level below `section` where `key` is valid. `name` is the name of the section."""
    return [
        _join(name, f"{child}.{key}")
        for child, field in section.model_fields.items()
        if any(key in candidate.model_fields for candidate in _sections(field.annotation))
    ]


# --- values -----------------------------------------------------------------------------------------------------------


def _one_of(known: list[str], value: Any) -> str:
    known = list(dict.fromkeys(known))  # a union within a union names its members twice
    hint = did_you_mean(value, known) if isinstance(value, str) else ""
    choices = " or ".join(known) if len(known) < 3 else "one of " + ", ".join(known)
    return choices + (f" ({hint})" if hint else "")


def _but_is(message: str, value: Any) -> str:
    """Add the actual value to `message`, unless the message names it."""
    if isinstance(value, bool):
        shown = str(value).lower()
    elif value is None:
        shown = "null (empty)"
    elif isinstance(value, float) and not math.isfinite(value):
        shown = ".nan" if math.isnan(value) else ".inf"
    elif isinstance(value, (int, float)):
        shown = repr(value) if abs(value) < 1e300 else "a number that large"
    elif isinstance(value, str):
        shown = f"the text {value[:60]!r}" + ("..." if len(value) > 60 else "")
    elif isinstance(value, list):
        shown = "a list"
    elif isinstance(value, dict):
        shown = "a mapping"
    else:
        shown = f"a {type(value).__name__}"
    return message if " not " in message or message.endswith("?") else f"{message}, not {shown}"
