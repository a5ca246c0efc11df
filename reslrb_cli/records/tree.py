"""Trees of plain dataclasses, kept as arrays by name with JSON beside them, and read back.

A tree's fields are plain values, checked by their types, or, by the metadata `entry`, mappings of names to arrays. Its
`entries` are those of an archive; `Stored` reads them back, as what a tree of the same kind expects.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import Field, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import drjit as dr
import numpy as np
from pydantic import TypeAdapter, ValidationError

from reslrb_cli.backend.memory import own_memory
from reslrb_cli.errors import ConfigError
from reslrb_cli.records.checkpoint import read_state
from reslrb_cli.records.metrics import finite

Array = np.ndarray[Any, Any]
#: The type of a field whose metadata is `entry`.
Arrays = dict[str, Any]
T = TypeVar("T")

_ENTRY = "entry"

#: Metadata of a field that no file has.
PASSING = {_ENTRY: None}


def entry(name: str) -> dict[str, Any]:
    """Return the metadata of a field that maps names to arrays, or to more such mappings: the entries `<name>/...`."""
    return {_ENTRY: name}


def to_array(value: Any) -> Array:
    """A Dr.Jit value, of any type, without derivatives; a number for one that is one."""
    return np.array(dr.detach(value) if dr.is_array_v(value) else value)


def like(value: Any, array: Array) -> Any:
    """`array` as a value of the type of `value`, in Dr.Jit's own memory.

    `value` and `array` have one shape (`to_array`). A number that was part of a kernel's code (a literal, as Adam's
    count of steps) is so again, so that the same kernel results.
    """
    kind = type(value)
    if not dr.is_array_v(value):
        return kind(array)
    if dr.depth_v(kind) == 1 and not dr.is_tensor_v(kind):
        if value.state == dr.VarState.Literal:
            return kind(array.ravel()[0].item())
        return own_memory(kind, array)
    if dr.is_tensor_v(kind):
        return kind(own_memory(dr.array_t(kind), array.ravel()), tuple(array.shape))
    parts = [like(part, np.ascontiguousarray(each)) for part, each in zip(value, array, strict=True)]
    return kind(*parts)


def expected(shape: tuple[int, ...]) -> Array:
    """An array of zeros that takes no memory, for one of a file that is to have its shape."""
    return np.broadcast_to(np.zeros(()), shape)


def entries(*trees: Any) -> tuple[dict[str, Array], dict[str, Any]]:
    """The arrays of all of them by their names, and all else of them as one mapping for JSON."""
    found: dict[str, Array] = {}
    values: dict[str, Any] = {}
    for tree in trees:
        for each in _array_fields(tree):
            leaves = _leaves(each.metadata[_ENTRY], getattr(tree, each.name))
            found |= {place: to_array(leaf) for place, leaf in leaves}
        beside = {each.name for each in fields(tree) if _ENTRY in each.metadata}
        values |= TypeAdapter(type(tree)).dump_python(tree, mode="json", exclude=beside)
    return found, finite(values)


def _array_fields(tree: Any) -> list[Field[Any]]:
    return [each for each in fields(tree) if each.metadata.get(_ENTRY) is not None]


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, Mapping):
        yield name, value
    else:
        for key, each in value.items():
            yield from _leaves(f"{name}/{key}", each)


class Stored:
    """The arrays of a state's file and the JSON beside them.

    Raises ConfigError, located in the file and by the name of the value, for a value that is missing or does not fit.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.arrays, self._values = read_state(path)

    def wrong(self, name: str, message: str) -> ConfigError:
        """The error for a value."""
        return ConfigError(self.path, name, f"{message}: not as a run writes it")

    def read(self, kind: type[T]) -> T:
        """A tree of this kind, by the types of its fields; its mappings of arrays are empty still."""
        names = [each.name for each in fields(kind) if _ENTRY not in each.metadata]  # type: ignore[arg-type]
        plain = {name: self._values[name] for name in names if name in self._values}
        try:  # as JSON: strict of Python's values, it would take no mapping for a dataclass
            return TypeAdapter(kind).validate_json(json.dumps(plain), strict=True)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise self.wrong(".".join(map(str, first["loc"])), first["msg"]) from None

    def fill(self, tree: T) -> T:
        """The same tree with each of its arrays as the file has it, of the type and shape of the one before.

        In place of None stands an array of any shape.
        """

        def filled(name: str, other: Any) -> Any:
            if isinstance(other, Mapping):
                return {key: filled(f"{name}/{key}", each) for key, each in other.items()}
            return self.take(name, other)

        found = {each.name: filled(each.metadata[_ENTRY], getattr(tree, each.name)) for each in _array_fields(tree)}
        return replace(tree, **found)  # type: ignore[type-var]  # a dataclass

    def take(self, name: str, other: Any) -> Any:
        """Return the array of a name, as a value of the type of `other`, whose shape it must have; None for any."""
        array = self.arrays.get(name)
        if array is None:
            raise self.wrong(name, "is missing")
        if other is None:
            return array
        is_own = dr.is_array_v(other)
        shape = tuple(dr.shape(other)) if is_own else other.shape
        if array.shape != shape:
            raise self.wrong(name, f"has shape {array.shape}, not {shape}")
        return like(other, array) if is_own else array
