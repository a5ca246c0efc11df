"""YAML to plain data and back, by the rules of YAML 1.2.

PyYAML alone reads YAML 1.1, where `1e-3` is text, `no` is false, `010` is 8 and `1:30` is 90.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import yaml

from ..errors import ConfigError

Location = tuple["str | int", ...]


def format_location(location: Location) -> str:
    """A place in the file as it is written in messages and in `--set`: `parameters[0].bounds`."""
    text = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            text += ("." if text else "") + (part if part.isprintable() else repr(part))
    return text


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012 (PyYAML's own convention)


_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$")
_INT = re.compile(r"[-+]?[0-9]+$|0o[0-7]+$|0x[0-9a-fA-F]+$")
_DIGITS = list("-+.0123456789")
_Loader.add_implicit_resolver("tag:yaml.org,2002:null", re.compile(r"(~|null|Null|NULL)?$"), ["~", "n", "N", ""])
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:bool", re.compile(r"(true|True|TRUE|false|False|FALSE)$"), list("tTfF")
)
_Loader.add_implicit_resolver("tag:yaml.org,2002:int", _INT, _DIGITS)
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, _DIGITS)
_Loader.add_implicit_resolver("tag:yaml.org,2002:merge", re.compile(r"<<$"), ["<"])


def _construct_int(loader: _Loader, node: yaml.ScalarNode) -> int:
    text = loader.construct_scalar(node)
    try:
        return int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
    except ValueError:
        raise yaml.constructor.ConstructorError(None, None, "not an integer or too long", node.start_mark) from None


def _construct_float(loader: _Loader, node: yaml.ScalarNode) -> float:
    text = loader.construct_scalar(node).lower()
    try:
        return float(text.replace(".inf", "inf").replace(".nan", "nan"))
    except ValueError:
        raise yaml.constructor.ConstructorError(None, None, "not a number", node.start_mark) from None


_Loader.add_constructor("tag:yaml.org,2002:int", _construct_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _construct_float)


def parse(text: str, source: str, name_line: bool = True) -> Any:
    """Plain data from YAML `text`; `source` names it in errors, with the line where `name_line` says so.

    Raises ConfigError where the text is not YAML, holds a tag that is not plain data, or gives a key twice.
    """

    def at(line: int) -> str:
        return f"{source}:{line}" if name_line else source

    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _check_duplicates(node, at, (), set())
            return loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = source if mark is None else at(mark.line + 1)
        problem = ", ".join(part for part in (error.context, error.problem) if part)
        raise ConfigError(place, "", f"not valid YAML: {problem}") from None
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise ConfigError(at(line), "", "not valid YAML: holds a control character") from None
    except (ValueError, KeyError, AttributeError, TypeError):  # PyYAML on `!!bool x`, `!!timestamp x`
        raise ConfigError(source, "", "not valid YAML: a value contradicts its explicit !! tag") from None
    except RecursionError:
        raise ConfigError(source, "", "nested too deeply") from None


def _check_duplicates(node: yaml.Node, at: Callable[[int], str], location: Location, seen: set[int]) -> None:
    if id(node) in seen:  # an alias, which may point to where it stands
        return
    seen.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        for i, child in enumerate(node.value):
            _check_duplicates(child, at, (*location, i), seen)
    elif isinstance(node, yaml.MappingNode):
        lines: dict[tuple[str, str], int] = {}
        for key, child in node.value:
            line = key.start_mark.line + 1
            if isinstance(key, yaml.ScalarNode):
                here = (*location, str(key.value))
                first = lines.get((key.tag, key.value))
                if first is not None:
                    raise ConfigError(at(line), format_location(here), f"given twice, first in line {first}")
                lines[key.tag, key.value] = line
                _check_duplicates(child, at, here, seen)


class _Dumper(yaml.SafeDumper):
    """Quotes what any reader of YAML 1.1 or 1.2 would take for something else than text."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: _Dumper, data: list[Any]) -> yaml.SequenceNode:
    short = not any(isinstance(item, (dict, list)) for item in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=short)


_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, _DIGITS)
_Dumper.add_implicit_resolver("tag:yaml.org,2002:int", _INT, _DIGITS)
_Dumper.add_representer(list, _represent_list)


def write(data: Any) -> str:
    """YAML of plain `data`, mappings in block style in their own order, lists of scalars on one line."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=False)
