"""Constants of modules and defaults of functions, compared with those of an earlier time (`said.check`). New ones are
compared once RESLRB_GOLDEN=write has stored them.
"""

from __future__ import annotations

import ast
import dataclasses
import enum
import importlib
import inspect
import os
import pkgutil
import re
from types import ModuleType
from typing import Any

import pytest
from golden import said

from reslrb_cli.version import __version__

FOLDERS = ("runs", "records", "cli", "cluster", "scene")
#: Click's commands, whose help is compared elsewhere, and types.
_LEFT_OUT = re.compile(r"logger|command|main|__\w+__|Array|Say|Change")


def simple(value: Any) -> Any:
    """Return a constant for JSON. Other objects, such as functions, become the name of their type."""
    if isinstance(value, dict):
        return {str(simple(key)): simple(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [simple(round(each, 12) if isinstance(each, float) else each) for each in value]
    if isinstance(value, enum.Enum):
        return value.value
    if isinstance(value, (set, frozenset)):
        return sorted(map(str, value))
    if isinstance(value, re.Pattern):
        return f"{value.pattern!r} {value.flags}"
    if isinstance(value, bytes):
        return repr(value)
    if isinstance(value, float) and value:  # `check` has an absolute tolerance for decimals
        return value if abs(value) >= 1e-2 else f"{value:.6e}".split("e")
    if isinstance(value, (str, int, float)) or value is None:
        return "the version" if value == __version__ else value
    return type(value).__name__


def defaults(function: Any) -> dict[str, Any]:
    """Return the defaults of a function's parameters."""
    if isinstance(function, enum.EnumMeta):
        return {}
    try:
        found = inspect.signature(function).parameters
    except (TypeError, ValueError):
        return {}
    return {name: simple(each.default) for name, each in found.items() if each.default is not each.empty}


def assigned_in(module: ModuleType) -> set[str]:
    """Return the names to which the lines of a module assign a value."""
    lines = ast.parse(inspect.getsource(module)).body
    targets = [*(each for line in lines for each in getattr(line, "targets", ())),
               *(line.target for line in lines if isinstance(line, ast.AnnAssign))]  # fmt: skip
    names = [each for target in targets for each in getattr(target, "elts", [target])]
    return {name.id for name in names if isinstance(name, ast.Name)}


def written_in(module: ModuleType) -> dict[str, Any]:
    """Return the constants of a module and of its classes, and the defaults of its functions."""
    found: dict[str, Any] = {}
    assigned = assigned_in(module)
    for name, value in vars(module).items():
        if _LEFT_OUT.fullmatch(name):
            continue
        if name in assigned:
            found[name] = simple(value) if name.isupper() else {}
        elif getattr(value, "__module__", None) == module.__name__:
            found[name] = defaults(value)
            if dataclasses.is_dataclass(value):
                made = value.__dataclass_params__  # type: ignore[attr-defined]
                found[name] |= {"is frozen": made.frozen, "compares": made.eq, "is ordered": made.order}
            for key, each in vars(value).items() if inspect.isclass(value) else ():
                if key.startswith("__"):
                    continue
                if callable(each) or isinstance(each, (classmethod, staticmethod)):
                    found[f"{name}.{key}"] = defaults(getattr(value, key))
                elif not key.startswith("_") and not hasattr(each, "__get__"):
                    found[f"{name}.{key}"] = simple(each)
    return {name: value for name, value in found.items() if value != {}}


def known_part(found: Any, known: Any) -> Any:
    """Return the entries of mappings that are known."""
    if isinstance(found, dict) and isinstance(known, dict):
        return {key: known_part(found.get(key), value) for key, value in known.items()}
    return found


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("folder", FOLDERS)
def test_constants_and_defaults(folder: str) -> None:
    package = importlib.import_module(f"reslrb_cli.{folder}")
    for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        name, found = f"constants of {info.name}", written_in(importlib.import_module(info.name))
        known = found if "RESLRB_GOLDEN" in os.environ else said.stored().get(name)
        if known:
            said.check(name, known_part(found, known))
