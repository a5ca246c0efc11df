"""Mitsuba and Dr.Jit as they are installed: the real ones, of a version that is known to work, and loadable.

Also the command line of a Python process of our own, which has to find the same packages.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from types import ModuleType

from reslrb_cli.backend.shared_library import missing_library
from reslrb_cli.errors import BackendError


def python_command(code: str) -> list[str]:
    """The command line of a Python that runs `code` and imports modules from where this process does.

    Left to itself Python looks in the working folder first, where a scene may bring a `numpy.py` along.
    """
    path = [entry or os.getcwd() for entry in sys.path]
    return [sys.executable, "-c", f"import sys\nsys.path[:] = {path!r}\n{code}"]


MISSING_LIBRARY = "run scripts/setup, or install the package that holds it"


#: Of each package the versions that pyproject.toml has, the first of them and the first that is too new, and functions
#: by which it is told from another package of its name.
_WANTED = {
    "drjit": ((1, 5), (1, 6), ("has_backend", "eval")),
    "mitsuba": ((3, 9), (3, 10), ("set_variant", "variants")),
}


def load_packages() -> tuple[ModuleType, ModuleType]:
    """Import Dr.Jit and Mitsuba; return both. Raises BackendError, which says what was found where, if it cannot be."""
    drjit, mitsuba = (_load(name) for name in _WANTED)
    return drjit, mitsuba


def _load(name: str) -> ModuleType:
    first, end, functions = _WANTED[name]
    mend = f"install it with `pip install '{name}>={_dotted(first)},<{_dotted(end)}'`"
    try:
        package = importlib.import_module(name)
    except (Exception, SystemExit) as error:  # what stands there may be anything
        cause = error.__context__ or error  # a NameError in Dr.Jit's own handler covers the ImportError
        if isinstance(cause, ModuleNotFoundError) and cause.name == name:
            raise BackendError(f"Mitsuba cannot be loaded: the package {name} is missing; {mend}") from error
        mend = MISSING_LIBRARY if missing_library(str(cause)) else mend
        reason = f"{type(cause).__name__}: {cause}"
        raise BackendError(f"Mitsuba cannot be loaded: {name}, found at {_place(name)}: {reason}; {mend}") from error
    version = getattr(package, "__version__", None)
    if not all(callable(getattr(package, function, None)) for function in functions):
        raise BackendError(
            f"the package {name} at {_place(name)} is not the one that is wanted (it has no {functions[0]}); "
            f"take it off the path (PYTHONPATH, or the folder that Python was started in), or {mend}"
        )
    if not isinstance(version, str) or not first <= _numbers(version) < end:
        raise BackendError(f"{name} {version} was found at {_place(name)}; {_dotted(first)} is needed: {mend}")
    return package


def _place(name: str) -> str:
    """Where the package `name` lies, without importing it."""
    try:
        found = importlib.util.find_spec(name)
    except (ImportError, ValueError):  # a module that is there has no specification
        found = None
    return (found.origin if found is not None else None) or "an unknown place"


def _numbers(version: str) -> tuple[int, ...]:
    """The first two numbers of a version."""
    parts = version.split(".")[:2]
    return tuple(int(part) if part.isdecimal() else -1 for part in parts)


def _dotted(version: tuple[int, ...]) -> str:
    return ".".join(map(str, version))
