"""Mitsuba's plugins: which there are, and that they are loaded from Mitsuba's own folder alone.

A plugin is a shared library, and loading it runs its code. Mitsuba looks for `plugins/NAME.so` in the folder of the
scene and in the working folder before its own, and takes any NAME that a scene file says.
"""

from __future__ import annotations

import difflib
import functools
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import mitsuba as mi


#: Takes addresses in the memory of a running Blender from its parameters.
_UNSAFE = frozenset({"blender"})


#: Names that Mitsuba knows without a library.
_BUILT_IN = frozenset({"scene", "rgb", "spectrum"})


def package_folder() -> Path:
    """The folder of Mitsuba's package, with `plugins/` and `data/` in it."""
    import mitsuba as mi

    return Path(mi.__file__).parent


@functools.cache
def shipped_plugins() -> frozenset[str]:
    """Names of the plugins that came with Mitsuba and that a scene file may say."""
    libraries = (path for path in (package_folder() / "plugins").iterdir() if path.suffix in (".so", ".dylib", ".dll"))
    return frozenset(path.stem for path in libraries) - _UNSAFE | _BUILT_IN


def is_known(name: str) -> bool:
    """Whether `name` is a plugin of Mitsuba's or one that this process has registered; loads none from elsewhere."""
    return name in shipped_plugins() or _is_registered(name)


def _is_registered(name: str) -> bool:
    """Whether Python has registered a plugin of that name for the variant that is set."""
    import mitsuba as mi

    # Mitsuba can be asked only in a way that makes it load a library of that name where it finds one. A new resolver
    # looks in the working folder alone.
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
    """Words in the library of a shipped plugin that can be names of its parameters, among others; for suggestions."""
    for library in (package_folder() / "plugins").glob(f"{name}.*"):
        words = re.findall(rb"(?<=\0)[a-z][a-z0-9_]{2,40}(?=\0)", library.read_bytes())
        return sorted({word.decode("ascii") for word in words})
    return []


def nearest_plugin(name: str, type: mi.ObjectType) -> str | None:
    """The plugin of that type whose name is most like `name`, if any is."""
    near = difflib.get_close_matches(name.lower(), sorted(shipped_plugins()), n=5)
    return next((candidate for candidate in near if plugin_type(candidate) == type), None)


@functools.cache
def plugin_type(name: str) -> mi.ObjectType:
    """What a plugin makes; `Unknown` for one that has not been shipped."""
    import mitsuba as mi

    if name not in shipped_plugins() - _BUILT_IN:
        return mi.ObjectType.Unknown
    with looking_in([]):  # Mitsuba loads it to learn that
        return mi.PluginManager.instance().plugin_type(name)


def prefer_own_plugins() -> None:
    """Have Mitsuba look for plugins in its own folder first, for the rest of the process."""
    import mitsuba as mi

    resolver = mi.file_resolver()
    if len(resolver) == 0 or Path(str(resolver[0])) != package_folder():
        resolver.prepend(str(package_folder()))


@contextmanager
def looking_in(folders: Iterable[Path]) -> Iterator[None]:
    """Have Mitsuba look for files in `folders`, first to last, but for plugins in its own folder before."""
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
