"""Installation of Mitsuba and Dr.Jit: completeness, supported versions, and plugins.

`python_command` is the command line of a new Python process that finds the same packages.

Plugins are loaded only from Mitsuba's own folder. A plugin is a shared library, and loading it runs its code. A scene
file can name any plugin. Mitsuba looks for `plugins/NAME.so` first in the scene's folder and in the working folder,
then in its own folder.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from reslrb_cli.backend.shared_library import missing_library
from reslrb_cli.errors import BackendError, did_you_mean, similar

if TYPE_CHECKING:
    import mitsuba as mi


#: Takes addresses in the memory of a running Blender from its parameters.
_UNSAFE = frozenset({"blender"})

#: Names that Mitsuba knows without a library.
_BUILT_IN = frozenset({"scene", "rgb", "spectrum"})


def package_folder() -> Path:
    """Return the folder of Mitsuba's package, which contains `plugins/` and `data/`."""
    import mitsuba as mi

    return Path(mi.__file__).parent


@functools.cache
def shipped_plugins() -> frozenset[str]:
    """Return the names of Mitsuba's plugins that a scene file may use."""
    libraries = (path for path in (package_folder() / "plugins").iterdir() if path.suffix in (".so", ".dylib"))
    return frozenset(path.stem for path in libraries) - _UNSAFE | _BUILT_IN


def is_known(name: str) -> bool:
    """True if `name` is a Mitsuba plugin, or a plugin registered in this process. The function loads no other
    plugin.
    """
    return name in shipped_plugins() or _is_registered(name)


def _is_registered(name: str) -> bool:
    """True if Python has registered a plugin `name` for the current variant."""
    import mitsuba as mi

    # Mitsuba must be asked in a way that makes it load a library of that name where it finds one. A new resolver
    # searches only the working folder.
    if re.fullmatch(r"[\w-]+", name) is None or any(Path("plugins").glob(f"{name}.*")):
        return False
    before = mi.file_resolver()
    mi.set_file_resolver(mi.FileResolver())
    try:
        mi.PluginManager.instance().create_object(mi.Properties(name))
    except Exception as error:
        return f'Plugin "{name}" not found' not in str(error)
    finally:
        mi.set_file_resolver(before)
    return True


@functools.cache
def likely_parameters(name: str) -> list[str]:
    """Return words from a shipped plugin's library file that may be parameter names. Error messages suggest these
    words.
    """
    for library in (package_folder() / "plugins").glob(f"{name}.*"):
        words = re.findall(rb"(?<=\0)[a-z][a-z0-9_]{2,40}(?=\0)", library.read_bytes())
        return sorted({word.decode("ascii") for word in words})
    return []


def propose_plugin(name: str, *types: mi.ObjectType) -> str:
    """Return a question with the plugin of these types whose name is most similar to `name`. If there is none, return
    the rule.
    """
    known = [near for near in similar(name, sorted(shipped_plugins()), 5) if plugin_type(near) in types]
    return did_you_mean(name, known, otherwise="only Mitsuba's own plugins are loaded")


@functools.cache
def plugin_type(name: str) -> mi.ObjectType:
    """Return the type of a plugin's objects; `Unknown` for a plugin that is not shipped."""
    import mitsuba as mi

    if name not in shipped_plugins() - _BUILT_IN:
        return mi.ObjectType.Unknown
    with looking_in([]):  # Mitsuba loads the library to answer
        return mi.PluginManager.instance().plugin_type(name)


def prefer_own_plugins() -> None:
    """Make Mitsuba look for plugins in its own folder first, for the rest of the process."""
    import mitsuba as mi

    resolver = mi.file_resolver()
    if len(resolver) == 0 or Path(str(resolver[0])) != package_folder():
        resolver.prepend(str(package_folder()))


@contextmanager
def looking_in(folders: Iterable[Path]) -> Iterator[None]:
    """Make Mitsuba look for files in `folders`, in the given order. Mitsuba still looks in its own folder first to find
    its plugins.
    """
    import mitsuba as mi

    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    for folder in [*reversed(list(folders)), package_folder()]:
        resolver.prepend(str(folder))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


def python_command(code: str) -> list[str]:
    """Return the command line of a Python that runs `code` with the same modules as this process.

    By default, Python looks for modules in the working folder first. A scene there may contain a `numpy.py`.
    """
    path = [entry or os.getcwd() for entry in sys.path]
    return [sys.executable, "-c", f"import sys\nsys.path[:] = {path!r}\n{code}"]


MISSING_LIBRARY = "run scripts/setup, or install the package that contains it"

#: The versions that pyproject.toml allows: the first one, and the first that is too new.
_WANTED = {"drjit": ("1.5", "1.6"), "mitsuba": ("3.9", "3.10")}


def load_packages() -> tuple[ModuleType, ModuleType]:
    """Import Dr.Jit and Mitsuba, and return both. If this fails, raises a BackendError that lists the packages
    found.
    """
    drjit, mitsuba = (_load(name) for name in _WANTED)
    return drjit, mitsuba


def _load(name: str) -> ModuleType:
    first, end = _WANTED[name]
    mend = f"install it with `pip install '{name}>={first},<{end}'`"
    try:
        package = importlib.import_module(name)
    except (Exception, SystemExit) as error:  # the import may run any code
        cause = error.__context__ or error  # a NameError in Dr.Jit's own handler covers the ImportError
        if isinstance(cause, ModuleNotFoundError) and cause.name == name:
            raise BackendError(f"Mitsuba cannot be loaded: the package {name} is missing; {mend}") from error
        mend = MISSING_LIBRARY if missing_library(str(cause)) else mend
        reason = f"{type(cause).__name__}: {cause}"
        raise BackendError(f"Mitsuba cannot be loaded: {name}, found at {_place(name)}: {reason}; {mend}") from error
    version = str(getattr(package, "__version__", "without a version"))
    if not _numbers(first) <= _numbers(version) < _numbers(end):
        raise BackendError(f"found {name} {version} at {_place(name)}, but {first} is needed: {mend}")
    return package


def _place(name: str) -> str:
    """Return the location of the package `name`, without importing it."""
    try:
        found = importlib.util.find_spec(name)
    except (ImportError, ValueError):  # an imported module has no specification
        found = None
    return (found.origin if found is not None else None) or "an unknown place"


def _numbers(version: str) -> tuple[int, ...]:
    """Return the first two numbers of a version."""
    parts = version.split(".")[:2]
    return tuple(int(part) if part.isdecimal() else -1 for part in parts)
