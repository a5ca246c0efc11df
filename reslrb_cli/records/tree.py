"""Trees of plain dataclasses, kept as arrays by name with JSON beside them, and read back strictly.

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
from reslrb_cli.records.checkpoint import Archive, Values
from reslrb_cli.records.metrics import finite

Array = np.ndarray[Any, Any]
#: The type of a field whose metadata is `entry`.
Arrays = dict[str, Any]
T = TypeVar("T")

_ENTRY = "entry"
_TYPES = {dr.VarType.Float32: "float32", dr.VarType.Float64: "float64", dr.VarType.UInt32: "uint32"}

#: Metadata of a field that no file has.
PASSING = {_ENTRY: None}


def entry(name: str, values: Values = "no NaN") -> dict[str, Any]:
    """The metadata of a field that maps names to arrays, or to more such mappings: the entries `<name>/...` of an
    archive, with such `values`."""
    return {_ENTRY: (name, values)}


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


def expected(shape: tuple[int, ...], dtype: Any = np.float32) -> Array:
    """An array of zeros that takes no memory, for one of a file that is to be like it."""
    return np.broadcast_to(np.zeros((), dtype), shape)


def entries(*trees: Any) -> tuple[dict[str, Array], dict[str, Any]]:
    """The arrays of all of them by their names, and all else of them as one mapping for JSON."""
    found: dict[str, Array] = {}
    values: dict[str, Any] = {}
    for tree in trees:
        for each, (name, _) in _array_fields(tree):
            found |= {place: to_array(leaf) for place, leaf in _leaves(name, getattr(tree, each.name))}
        beside = {each.name for each in fields(tree) if _ENTRY in each.metadata}
        values |= TypeAdapter(type(tree)).dump_python(tree, mode="json", exclude=beside)
    return found, finite(values)


def _array_fields(tree: Any) -> Iterator[tuple[Field[Any], tuple[str, Values]]]:
    return ((each, each.metadata[_ENTRY]) for each in fields(tree) if each.metadata.get(_ENTRY) is not None)


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if not isinstance(value, Mapping):
        yield name, value
    else:
        for key, each in value.items():
            yield from _leaves(f"{name}/{key}", each)


class Stored:
    """The arrays of an archive and the JSON beside them. Whatever asks for what is not so raises ConfigError, located
    in the file and by the name of the value."""

    def __init__(self, archive: Archive, values: Mapping[str, Any]) -> None:
        self.archive, self._values = archive, values

    @property
    def path(self) -> Path:
        """The file."""
        return self.archive.path

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
        """The same tree with each of its arrays as the archive has it, of the type and shape of the one before.

        In place of None stands an array of floats of any shape.
        """

        def filled(name: str, other: Any, values: Values) -> Any:
            if isinstance(other, Mapping):
                return {key: filled(f"{name}/{key}", each, values) for key, each in other.items()}
            return self.take(name, other, values)

        found = {each.name: filled(name, getattr(tree, each.name), kind) for each, (name, kind) in _array_fields(tree)}
        return replace(tree, **found)  # type: ignore[type-var]  # a dataclass

    def take(self, name: str, other: Any, values: Values = "no NaN") -> Any:
        """The array of a name, of the type and shape of `other`; what is added up may be infinite, never NaN."""
        if other is None:
            return self.archive.array(name, kind="f")
        is_own = dr.is_array_v(other)
        wanted = np.dtype(_TYPES[dr.type_v(other)]) if is_own else other.dtype
        head = self.archive.heads.get(name)
        if head is not None and head.dtype != wanted:
            raise self.wrong(name, f"is {head.dtype} in place of {wanted}")
        array = self.archive.array(name, tuple(dr.shape(other)) if is_own else other.shape, values=values)
        return like(other, array) if is_own else array
