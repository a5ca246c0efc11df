"""YAML to plain data and back, by the rules of YAML 1.2."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import yaml

from ..errors import ConfigError
from .yaml_loader import DIGITS, FLOAT, INTEGER, TEXT_TAGS, Loader

Location = tuple["str | int", ...]

#: What no key holds: control characters, and halves of surrogate pairs.
UNFIT = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
#: What an alias begins with, up to where YAML or a reader would take it to end.
_ALIAS = re.compile(r"\*[^\s,\]}]*")


def format_location(location: Location) -> str:
    """A place in the file as it is written in messages and in `--set`: `parameters[0].bounds`."""
    text = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            text += ("." if text else "") + (part if part.isprintable() else repr(part))
    return text


def parse(text: str, source: str, name_line: bool = True, example: Callable[[str], str] | None = None) -> Any:
    """Plain data from YAML `text`; `source` names it in errors, with the line where `name_line` says so.

    The keys of all mappings are text without control characters. `example` shows how a mended text is to be written
    where it came from. Raises ConfigError where the text is not YAML, holds a tag that is not plain data, a key twice,
    or one that is no text; where it is too deep, and where it holds more than NODES values.
    """

    def at(line: int) -> str:
        return f"{source}:{line}" if name_line and line else source

    try:
        loader = Loader(text, at)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _check_keys(node, at, (), set())
            return loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = source if mark is None else at(mark.line + 1)
        raise ConfigError(place, "", _problem(error, text, example)) from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        reason = "holds a control character, or bytes that are not UTF-8"
        raise ConfigError(at(line), "", f"not valid YAML: {reason}") from None
    except (ValueError, KeyError, AttributeError, TypeError):  # PyYAML on `!!bool x`
        raise ConfigError(source, "", "not valid YAML: a value contradicts its explicit !! tag") from None


def _problem(error: yaml.MarkedYAMLError, text: str, example: Callable[[str], str] | None) -> str:
    """What is wrong, in a line; where it is text that wants quotes, with the quotes."""
    problem = ", ".join(part for part in (error.context, error.problem) if part)
    mark = error.context_mark or error.problem_mark
    word = None if mark is None else _ALIAS.match(text, mark.index)
    if word is not None and "alias" in problem:
        quoted = f'"{word[0]}"'
        mended = quoted if example is None else example(text[: word.start()] + quoted + text[word.end() :])
        return f"{word[0]} is an alias in YAML, and names nothing here; text that begins with * wants quotes: {mended}"
    hint = "; put text that begins with it in quotes" if "cannot start any token" in problem else ""
    return f"not valid YAML: {problem}{hint}"


def count_values(data: Any, most: int) -> int:
    """How many values and keys plain `data` holds, where the same list stands twice counted twice; at most `most`."""
    count, waiting = 0, [data]
    while waiting and count < most:
        value = waiting.pop()
        count += 1
        if isinstance(value, dict):
            count += len(value)
            waiting += value.values()
        elif isinstance(value, list):
            waiting += value
    return min(count, most)


def _check_keys(node: yaml.Node, at: Callable[[int], str], location: Location, seen: set[int]) -> None:
    """Raise where a key is no text, or stands twice in its mapping."""
    if id(node) in seen:  # an alias
        return
    seen.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        for i, child in enumerate(node.value):
            _check_keys(child, at, (*location, i), seen)
    elif isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, child in node.value:
            source = at(key.start_mark.line + 1)
            if not isinstance(key, yaml.ScalarNode):
                raise ConfigError(source, format_location(location), "has a key that is a list or a mapping, not text")
            here = (*location, key.value)
            if key.tag not in TEXT_TAGS:
                raise ConfigError(source, format_location(here), "a key must be text; put it in quotes")
            if UNFIT.search(key.value):
                raise ConfigError(source, format_location(here), "a key must not hold control characters")
            if key.value in lines:
                raise ConfigError(source, format_location(here), f"given twice, first in line {lines[key.value]}")
            lines[key.value] = key.start_mark.line + 1
            _check_keys(child, at, here, seen)


class _Dumper(yaml.SafeDumper):
    """Quotes what any reader of YAML 1.1 or 1.2 would take for something else than text."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: _Dumper, data: list[Any]) -> yaml.SequenceNode:
    short = not any(isinstance(item, (dict, list)) for item in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=short)


_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", FLOAT, DIGITS)
_Dumper.add_implicit_resolver("tag:yaml.org,2002:int", INTEGER, DIGITS)
_Dumper.add_representer(list, _represent_list)


def write(data: Any) -> str:
    """YAML of plain `data`, mappings in block style in their own order, lists of scalars on one line."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=False)
