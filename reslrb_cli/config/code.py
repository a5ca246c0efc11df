"""A user's own Python code, given as FILE.py:NAME: a loss, or an integrator (`type: custom`).

The code runs with the user's rights and without inspection. The code runs only if needed, and only if the command line
or a Python caller allows the code (`Config.with_code`). A YAML file cannot allow code. Commands that read, show or
export a run do not need the user's code.
"""

from __future__ import annotations

import contextlib
import hashlib
import sys
import traceback
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from reslrb_cli.config.files import read_file
from reslrb_cli.errors import ConfigError, describe, is_machine_fault, is_out_of_memory


def load_named(file: Path, name: str, source: object, key: str) -> Callable[..., Any]:
    """Run a file and return the object `name`. The file can import modules from its own folder.

    Installed modules take precedence over modules in the folder. Raises ConfigError, located at `key` of `source`, if
    the file cannot be read or run, or has no callable `name`.
    """
    try:
        text = read_file(file)
    except ConfigError as error:
        raise ConfigError(source, key, f"{file}: {error.message}") from None
    module = types.ModuleType(f"reslrb_own_{hashlib.blake2b(str(file).encode(), digest_size=6).hexdigest()}")
    module.__file__ = str(file)
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))
    sys.modules[module.__name__] = module  # dataclasses and pickle look the module up there
    with guarded(source, key, file, "the file"):
        exec(compile(text, str(file), "exec"), module.__dict__)
    found = getattr(module, name, None)
    if not callable(found):
        what = "nothing" if not hasattr(module, name) else f"a {type(found).__name__}, not a function,"
        raise ConfigError(source, key, f"{file} has {what} of the name `{name}`")
    return found


@contextlib.contextmanager
def guarded(source: object, key: str, file: Path | None, what: str) -> Iterator[None]:
    """Convert errors of a user's code to one located line. Errors of the machine pass unchanged."""
    try:
        yield
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:
        if is_out_of_memory(error) or is_machine_fault(error):
            raise
        while isinstance(error.__cause__, Exception) and "encountered an exception (see above)" in str(error):
            error = error.__cause__  # the error in a loop or an indirect call of Dr.Jit
        trace = traceback.extract_tb(error.__traceback__)
        lines = [each.lineno for each in trace if file and each.filename == str(file)]
        if isinstance(error, SyntaxError) and error.filename == str(file):
            lines = [error.lineno]
        where = f" in line {lines[-1]}" if lines else ""
        said = f"{type(error).__name__}: {error}".rstrip(": ") if str(error) else describe(error)
        raise ConfigError(source, key, f"{what} raises{where} {said}") from error
