"""A state that was stored, read strictly: each value is of the kind, the shape and the range that a run can have."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import drjit as dr
import numpy as np

from reslrb_cli.errors import ConfigError
from reslrb_cli.optimization.arrays import like, to_array
from reslrb_cli.optimization.sensitivity import Sensitivity
from reslrb_cli.records.archive import Archive

if TYPE_CHECKING:
    from reslrb_cli.optimization.problem import Problem

Array = np.ndarray[Any, Any]
T = TypeVar("T")

_TYPES = {dr.VarType.Float32: "float32", dr.VarType.Float64: "float64", dr.VarType.UInt32: "uint32"}


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

    # --- arrays -------------------------------------------------------------------------------------------------------

    def take(self, name: str, other: T) -> T:
        """The array of a name, of the type and shape of `other`; what is added up may be infinite, never NaN."""
        wanted = np.dtype(_TYPES[dr.type_v(other)])
        head = self.archive.heads.get(name)
        if head is not None and head.dtype != wanted:
            raise self.wrong(name, f"is {head.dtype} in place of {wanted}")
        result: T = like(other, self.archive.array(name, tuple(dr.shape(other)), values="no NaN"))
        return result

    def scene_value(self, problem: Problem, prefix: str, key: str) -> Any:
        """The value of the parameter `key` that is stored as `<prefix>/<key>`, finite and within its bounds, as the
        optimiser has it."""
        now = dr.detach(problem.optimizer[key])
        name, shape = f"{prefix}/{key}", problem.selection.array(key).shape
        if math.prod(shape) != math.prod(dr.shape(now)):  # an environment map, whose halo the value does not show
            name, shape = f"{prefix} with halo/{key}", tuple(dr.shape(now))
        array = self.archive.array(name, shape, "f")
        if array.dtype != np.float32:
            raise self.wrong(name, f"is {array.dtype} in place of float32")
        self.check_bounds(problem, name, key, array)
        return like(now, array.reshape(dr.shape(now)))

    def check_bounds(self, problem: Problem, name: str, key: str, array: Array) -> None:
        """Raise ConfigError where an entry of the value `name` of the parameter `key` is none that a run comes to.

        A run goes on with the bounds that it began with, and each of its updates ends within them: what lies outside
        was not written by it. (Bounds cannot change: `recording.changes`.)
        """
        spec = problem.selection.spec(key)
        low, high = spec.bounds or (-math.inf, math.inf)
        if spec.transform in ("log", "softplus"):
            low = max(low, np.finfo(np.float32).tiny)  # these yield nothing else
        outside = (array < np.float32(low)) | (array > np.float32(high))
        if outside.any():
            raise self.wrong(name, f"holds {array[outside].flat[0]:g}, outside of {low:g} to {high:g}, its bounds")

    # --- plain values -------------------------------------------------------------------------------------------------

    def value(self, *path: str) -> Any:
        """What stands at a place of the JSON; None where nothing does."""
        at: Any = self._values
        for part in path:
            at = at.get(part) if isinstance(at, dict) else None
        return at

    def keys_of(self, name: str, known: Mapping[str, Any]) -> list[str]:
        """The keys of a mapping, all of which are known."""
        found = self.value(name)
        if not isinstance(found, dict):
            raise self.wrong(name, "is no mapping")
        for key in found:
            if key not in known:
                raise self.wrong(f"{name}.{key}", "is of a parameter that the run does not have")
        return list(found)

    def count(self, *path: str, least: int = 1) -> int:
        """An integer of 31 bits, at least `least`."""
        value = self.value(*path)
        if type(value) is not int or not least <= value < 2**31:
            raise self.wrong(".".join(path), "is no count")
        return value

    def number(self, *path: str) -> float:
        """A number that is finite and not negative."""
        value = self.value(*path)
        if not is_number(value) or value < 0:
            raise self.wrong(".".join(path), "is no number")
        return float(value)

    def numbers(self, *path: str) -> list[float]:
        """A list of numbers; NaN in place of null, as which JSON has what was not finite."""
        value = self.value(*path)
        if not isinstance(value, list) or not all(each is None or is_number(each) for each in value):
            raise self.wrong(".".join(path), "is no list of numbers")
        return [math.nan if each is None else float(each) for each in value]

    def pair(self, *path: str) -> tuple[float, float]:
        """Two positive numbers."""
        found = self.numbers(*path)
        if len(found) != 2 or not min(found) > 0:
            raise self.wrong(".".join(path), "is no pair of positive numbers")
        return found[0], found[1]

    def text(self, *path: str) -> str:
        """Text."""
        value = self.value(*path)
        if not isinstance(value, str):
            raise self.wrong(".".join(path), "is no text")
        return value

    def texts(self, *path: str) -> list[str]:
        """A list of texts."""
        value = self.value(*path)
        if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
            raise self.wrong(".".join(path), "is no list of texts")
        return value

    def scaling(self, keys: Sequence[str]) -> list[dict[str, Any]] | None:
        """What `scale: auto` measured of each parameter; None where it has not."""
        rows = self.value("scaling")
        if rows is None:
            return None
        names = {field.name for field in fields(Sensitivity)} | {"own_length", "first_step"}
        if not isinstance(rows, list) or [isinstance(row, dict) and row.get("key") for row in rows] != list(keys):
            raise self.wrong("scaling", "does not have the run's parameters")
        for row in rows:
            others = [value for name, value in row.items() if name != "key"]
            if set(row) != names or not all(value is None or is_number(value) for value in others):
                raise self.wrong("scaling", f"of {row['key']} is not what is measured")
        return rows


def is_number(value: Any) -> bool:
    """Whether a value of JSON is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def stored_value(problem: Problem, prefix: str, key: str, value: Any) -> dict[str, Array]:
    """The arrays that `scene_value` reads, of a value as the optimiser has it."""
    shown: Array = problem.selection.shown(key, value)
    own = to_array(value)
    arrays = {f"{prefix}/{key}": shown}
    return arrays if own.size == shown.size else arrays | {f"{prefix} with halo/{key}": own}
