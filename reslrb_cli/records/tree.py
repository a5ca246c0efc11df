"""Serialisation of dataclass trees as named arrays and JSON.

A tree's fields are plain values, whose types are checked. Fields with the metadata `entry` map names to arrays.
`entries` converts a tree to the entries of an archive, and `Stored` reads them back.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import Field, fields, replace
from functools import cache
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
#: Type of a field with the metadata `entry`.
Arrays = dict[str, Any]
T = TypeVar("T")

_ENTRY = "entry"

#: Metadata of a field that is not saved.
PASSING = {_ENTRY: None}


def entry(name: str) -> dict[str, Any]:
    """Return the metadata of a field that maps names to arrays or nested mappings. Entries are saved as
    `<name>/...`.
    """
    return {_ENTRY: name}


def to_array(value: Any) -> Array:
    """Convert a Dr.Jit value of any type, or a number, to an array without derivatives."""
    return np.array(dr.detach(value) if dr.is_array_v(value) else value)


def like(value: Any, array: Array) -> Any:
    """Convert `array` to the type of `value`, in Dr.Jit's own memory.

    `value` and `array` must have the same shape (`to_array`). A literal, such as Adam's step count, is part of the
    kernel code. If `value` is a literal, the result is a literal, too, so the kernel does not change.
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
    """Return an array of zeros that takes no memory. The array states the shape that an array in a file must have."""
    return np.broadcast_to(np.zeros(()), shape)


def entries(*trees: Any) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return the arrays of all trees by name, and all other fields as one mapping for JSON."""
    found: dict[str, Array] = {}
    values: dict[str, Any] = {}
    for tree in trees:
        for each in _array_fields(tree):
            leaves = _leaves(each.metadata[_ENTRY], getattr(tree, each.name))
            found |= {place: to_array(leaf) for place, leaf in leaves}
        beside = {each.name for each in fields(tree) if _ENTRY in each.metadata}
        adapter = _adapter(type(tree))  # type: ignore[arg-type]  # types are hashable
        values |= adapter.dump_python(tree, mode="json", exclude=beside)
    return found, finite(values)


@cache
def _adapter(kind: type[T]) -> TypeAdapter[T]:
    """Return the reader and writer of a class. Pydantic needs milliseconds to make one."""
    return TypeAdapter(kind)


def _array_fields(tree: Any) -> list[Field[Any]]:
    return [each for each in fields(tree) if each.metadata.get(_ENTRY) is not None]


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, Mapping):
        yield name, value
    else:
        for key, each in value.items():
            yield from _leaves(f"{name}/{key}", each)


class Stored:
    """Arrays and JSON values of a state file.

    Methods raise a ConfigError that names file and value if a value is missing or does not fit.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.arrays, self._values = read_state(path)

    def wrong(self, name: str, message: str) -> ConfigError:
        """Return the error for a wrong value."""
        return ConfigError(self.path, name, f"{message}: not as a run writes it")

    def read(self, kind: type[T]) -> T:
        """Read a tree of class `kind`, and check the values by the types of the class's fields. The tree's mappings of
        arrays are still empty.
        """
        names = [each.name for each in fields(kind) if _ENTRY not in each.metadata]  # type: ignore[arg-type]
        plain = {name: self._values[name] for name in names if name in self._values}
        try:  # as JSON, because strict validation of Python values rejects a mapping for a dataclass
            return _adapter(kind).validate_json(json.dumps(plain), strict=True)  # type: ignore[arg-type]
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            raise self.wrong(".".join(map(str, first["loc"])), first["msg"]) from None

    def fill(self, tree: T) -> T:
        """Return the tree with its arrays read from the file.

        Each array must have the type and shape of the array that it replaces. None accepts any shape.
        """

        def filled(name: str, other: Any) -> Any:
            if isinstance(other, Mapping):
                return {key: filled(f"{name}/{key}", each) for key, each in other.items()}
            return self.take(name, other)

        found = {each.name: filled(each.metadata[_ENTRY], getattr(tree, each.name)) for each in _array_fields(tree)}
        return replace(tree, **found)  # type: ignore[type-var]  # a dataclass

    def take(self, name: str, other: Any) -> Any:
        """Return the array `name`, converted to the type of `other`. The shapes must be equal. If `other` is None, any
        array is accepted.
        """
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
