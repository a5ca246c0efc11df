"""PyYAML as configurations want it: the rules of YAML 1.2, plain data alone, bounded before anything is built.

PyYAML alone reads YAML 1.1, where `1e-3` is text, `no` is false, `010` is 8 and `1:30` is 90.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import yaml

from ..errors import ConfigError
from .limits import DEPTH, INTEGER_END, NODES

#: Text, lists, mappings, null: what PyYAML builds of its own that is plain data in YAML 1.2 too.
_KEPT = ("str", "seq", "map", "null", "bool")
_TAG = "tag:yaml.org,2002:"
#: Tags that a key may have: it is text, or `<<`.
TEXT_TAGS = (f"{_TAG}str", f"{_TAG}merge")
FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$")
INTEGER = re.compile(r"[-+]?[0-9]+$|0o[0-7]+$|0x[0-9a-fA-F]+$")
DIGITS = list("-+.0123456789")


class Loader(yaml.SafeLoader):
    """One text being read; `at` names a line of it in errors."""

    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012 (PyYAML's own convention)
    yaml_constructors = {  # noqa: RUF012
        tag: function
        for tag, function in yaml.SafeLoader.yaml_constructors.items()
        if str(tag).removeprefix(_TAG) in _KEPT
    }

    def __init__(self, text: str, at: Callable[[int], str]) -> None:
        super().__init__(text)
        self._at = at
        self._nodes = self._depth = 0
        #: Of each node that is complete, by its identity, the number of nodes that it stands for.
        self._sizes: dict[int, int] = {}

    def fail(self, mark: yaml.Mark | None, message: str) -> ConfigError:
        """The error for what stands at `mark`."""
        return ConfigError(self._at(0 if mark is None else mark.line + 1), "", message)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """The next node, as PyYAML makes it, unless it is too deep or one too many."""
        mark, before, is_alias = self.peek_event().start_mark, self._nodes, self.check_event(yaml.AliasEvent)
        self._depth += 1
        if self._depth > DEPTH:
            raise self.fail(mark, f"nested too deeply: more than {DEPTH} lists and mappings within each other")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if not is_alias:
            self._nodes += 1
            self._sizes[id(node)] = self._nodes - before
        elif id(node) not in self._sizes:
            raise self.fail(mark, "an alias (*name) of a list or mapping that it stands in itself")
        else:
            self._nodes += self._sizes[id(node)]
        if self._nodes > NODES:
            raise self.fail(mark, f"holds more than {NODES} values, aliases (*name) spelt out")
        return node


def _construct_text(loader: Loader, node: yaml.ScalarNode) -> str:
    text: str = loader.construct_scalar(node)
    if any("\ud800" <= c <= "\udfff" for c in text):
        raise loader.fail(node.start_mark, f"{text!r} holds half of a surrogate pair, which is no character")
    return text


def _construct_integer(loader: Loader, node: yaml.ScalarNode) -> int:
    text = loader.construct_scalar(node)
    try:
        value = int(text, {"0o": 8, "0x": 16}.get(text[:2], 10))
    except ValueError:
        if not INTEGER.match(text):
            raise loader.fail(node.start_mark, f"{text} is no integer, as its tag !!int has it") from None
        value = INTEGER_END  # more digits than Python converts
    if abs(value) >= INTEGER_END:
        raise loader.fail(node.start_mark, f"the integer {text[:20]}... has more than 64 bits; write it as in 1e30")
    return value


def _construct_float(loader: Loader, node: yaml.ScalarNode) -> float:
    text = loader.construct_scalar(node)
    try:
        return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    except ValueError:
        raise loader.fail(node.start_mark, f"{text} is no number, as its tag !!float has it") from None


def _refuse(loader: Loader, node: yaml.Node) -> None:
    tag = node.tag.replace(_TAG, "!!")
    raise loader.fail(node.start_mark, f"not valid YAML: the tag {tag} stands for nothing that a configuration holds")


Loader.add_implicit_resolver(f"{_TAG}null", re.compile(r"(~|null|Null|NULL)?$"), ["~", "n", "N", ""])
Loader.add_implicit_resolver(f"{_TAG}bool", re.compile(r"(true|True|TRUE|false|False|FALSE)$"), list("tTfF"))
Loader.add_implicit_resolver(f"{_TAG}int", INTEGER, DIGITS)
Loader.add_implicit_resolver(f"{_TAG}float", FLOAT, DIGITS)
Loader.add_implicit_resolver(f"{_TAG}merge", re.compile(r"<<$"), ["<"])
Loader.add_constructor(f"{_TAG}str", _construct_text)
Loader.add_constructor(f"{_TAG}int", _construct_integer)
Loader.add_constructor(f"{_TAG}float", _construct_float)
Loader.add_constructor(None, _refuse)
