"""Conversion between YAML 1.2 and plain data.

PyYAML by itself reads YAML 1.1, in which `1e-3` is text, `no` is false, `010` is 8 and `1:30` is 90. `Loader` applies
the rules of YAML 1.2, and creates only plain data. `parse` and `write` are the interface.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import yaml

from reslrb_cli.errors import ConfigError

#: Text, lists, mappings, null: types that PyYAML builds and that are plain data in YAML 1.2, too.
_KEPT = ("str", "seq", "map", "null", "bool")
_TAG = "tag:yaml.org,2002:"

#: Tags of valid keys: text, or `<<`.
TEXT_TAGS = (f"{_TAG}str", f"{_TAG}merge")
FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$")
INTEGER = re.compile(r"[-+]?[0-9]+$|0o[0-7]+$|0x[0-9a-fA-F]+$")
DIGITS = list("-+.0123456789")
#: Integers lie between this and its negative: no quantity in a file needs more than 64 bits.
INTEGER_END = 2**64


class Loader(yaml.SafeLoader):
    """Reader of one YAML text. `at` names a line of the text in errors."""

    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012 (PyYAML's own convention)
    yaml_constructors = {  # noqa: RUF012
        tag: function
        for tag, function in yaml.SafeLoader.yaml_constructors.items()
        if str(tag).removeprefix(_TAG) in _KEPT
    }

    def __init__(self, text: str, at: Callable[[int], str]) -> None:
        super().__init__(text)
        self._at = at

    def fail(self, mark: yaml.Mark | None, message: str) -> ConfigError:
        """Return the error at `mark`."""
        return ConfigError(self._at(0 if mark is None else mark.line + 1), "", message)


def _construct_text(loader: Loader, node: yaml.ScalarNode) -> str:
    text: str = loader.construct_scalar(node)
    if any("\ud800" <= c <= "\udfff" for c in text):
        raise loader.fail(node.start_mark, f"{text!r} contains half of a surrogate pair; remove it")
    return text


def _construct_integer(loader: Loader, node: yaml.ScalarNode) -> int:
    text = loader.construct_scalar(node)
    try:
        value = int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
    except ValueError:
        if not INTEGER.match(text):
            raise loader.fail(node.start_mark, f"{text} has the tag !!int but is not an integer") from None
        value = INTEGER_END  # more digits than Python converts
    if abs(value) >= INTEGER_END:
        raise loader.fail(node.start_mark, f"the integer {text[:20]}... has more than 64 bits; write it as in 1e30")
    return value


def _construct_float(loader: Loader, node: yaml.ScalarNode) -> float:
    text = loader.construct_scalar(node)
    try:
        return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    except ValueError:
        raise loader.fail(node.start_mark, f"{text} has the tag !!float but is not a number") from None


def _refuse(loader: Loader, node: yaml.Node) -> None:
    tag = node.tag.replace(_TAG, "!!")
    raise loader.fail(node.start_mark, f"not valid YAML: the tag {tag} is not allowed in a configuration")


Loader.add_implicit_resolver(f"{_TAG}null", re.compile(r"(~|null|Null|NULL)?$"), ["~", "n", "N", ""])
Loader.add_implicit_resolver(f"{_TAG}bool", re.compile(r"(true|True|TRUE|false|False|FALSE)$"), list("tTfF"))
Loader.add_implicit_resolver(f"{_TAG}int", INTEGER, DIGITS)
Loader.add_implicit_resolver(f"{_TAG}float", FLOAT, DIGITS)
Loader.add_implicit_resolver(f"{_TAG}merge", re.compile(r"<<$"), ["<"])
Loader.add_constructor(f"{_TAG}str", _construct_text)
Loader.add_constructor(f"{_TAG}int", _construct_integer)
Loader.add_constructor(f"{_TAG}float", _construct_float)
Loader.add_constructor(None, _refuse)

Location = tuple["str | int", ...]

#: Characters that no key contains: control characters and halves of surrogate pairs.
UNFIT = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")

#: Start of an alias, up to the character at which YAML or a reader would end it.
_ALIAS = re.compile(r"\*[^\s,\]}]*")


def format_location(location: Location) -> str:
    """Return a location as written in messages and in `--set`, for example `parameters[0].bounds`."""
    text = ""
    for part in location:
        if isinstance(part, int):
            text += f"[{part}]"
        else:
            text += ("." if text else "") + (part if part.isprintable() else repr(part))
    return text


def flattened(data: Any, key: str = "") -> dict[str, Any]:
    """Return the values of nested mappings, and of lists with mappings, by their keys as in `--set`."""
    if isinstance(data, dict):
        inner = {f"{key}.{name}" if key else str(name): each for name, each in data.items()}
    elif isinstance(data, (list, tuple)) and any(isinstance(each, dict) for each in data):
        inner = {f"{key}[{place}]": each for place, each in enumerate(data)}
    else:
        return {key: data}
    return {name: value for below, each in inner.items() for name, value in flattened(each, below).items()}


def parse(text: str, source: str, example: Callable[[str], str] | None = None) -> Any:
    """Return the plain data in YAML `text`. `source` names the text in error messages, with the line number.

    The keys of all mappings are text without control characters. If the text is not from a file, `example` shows how to
    write a corrected text in its original form, for example in a shell command. Messages then have no line number.

    Raises ConfigError if the text is not YAML or is nested too deeply. Tags other than plain data, duplicate keys and
    keys that are not text also raise ConfigError.
    """

    def at(line: int) -> str:
        return f"{source}:{line}" if example is None and line else source

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
    except RecursionError:
        raise ConfigError(source, "", "lists and mappings are nested too deeply") from None
    except (ValueError, KeyError, AttributeError, TypeError):  # PyYAML's message for `!!bool x`
        raise ConfigError(source, "", "not valid YAML: a value contradicts its explicit !! tag") from None


def _problem(error: yaml.MarkedYAMLError, text: str, example: Callable[[str], str] | None) -> str:
    """Describe the error in one line. If text must be quoted, show the quoted text."""
    problem = ", ".join(part for part in (error.context, error.problem) if part)
    mark = error.context_mark or error.problem_mark
    word = None if mark is None else _ALIAS.match(text, mark.index)
    if word is not None and "alias" in problem:
        quoted = f'"{word[0]}"'
        mended = quoted if example is None else example(text[: word.start()] + quoted + text[word.end() :])
        return f"{word[0]} is an alias in YAML, but undefined; put text that begins with * in quotes: {mended}"
    if "'\\t' that cannot start any token" in problem:
        return "not valid YAML: a tab; YAML allows only spaces for indentation and after a colon"
    hint = "; put text that begins with it in quotes" if "cannot start any token" in problem else ""
    return f"not valid YAML: {problem}{hint}"


def _check_keys(node: yaml.Node, at: Callable[[int], str], location: Location, seen: set[int]) -> None:
    """Raise an error if a key is not text, or occurs twice in its mapping."""
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
    """Quotes text that a reader of YAML 1.1 or 1.2 would take for another type."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_list(dumper: _Dumper, data: list[Any]) -> yaml.SequenceNode:
    short = not any(isinstance(item, (dict, list)) for item in data)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=short)


_Dumper.add_implicit_resolver("tag:yaml.org,2002:float", FLOAT, DIGITS)
_Dumper.add_implicit_resolver("tag:yaml.org,2002:int", INTEGER, DIGITS)
_Dumper.add_representer(list, _represent_list)


def write(data: Any) -> str:
    """Return YAML for plain `data`. Mappings keep their order in block style, and lists of scalars take one line."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=False)
