"""Gradients through light paths: reservoir light replay backpropagation on Mitsuba 3.

`import reslrb_cli` needs no variant and loads no Mitsuba. Import it before Mitsuba: it chooses the libLLVM that Dr.Jit
will load. `register()` makes the plugins known to Mitsuba, `load_scene(...)` gives a scene whose parameters are named
as on the command line, `step(...)` is one gradient step.
"""

from __future__ import annotations

import os
import signal
import sys

_is_program = bool(sys.argv) and os.path.basename(sys.argv[0]) == "reslrb"
if _is_program and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Until its command line can answer, Ctrl-C ends the program without a traceback: also during the imports below.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import importlib  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from reslrb_cli.backend import llvm as _llvm  # noqa: E402

if TYPE_CHECKING:
    from reslrb_cli.integrators.plugin import register
    from reslrb_cli.integrators.step import gradient_step as step
    from reslrb_cli.scene.load import load_for_script as load_scene

__version__ = "0.1.0"
__all__ = ["__version__", "load_scene", "register", "step"]

# Dr.Jit loads libLLVM on a thread of its own while it is being imported: later is too late.
_llvm.prepare()

_LAZY = {
    "load_scene": ("reslrb_cli.scene.load", "load_for_script"),
    "register": ("reslrb_cli.integrators.plugin", "register"),
    "step": ("reslrb_cli.integrators.step", "gradient_step"),
}


def __getattr__(name: str) -> Any:
    """Loads a public name that needs Mitsuba when it is first asked for."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, its_name = _LAZY[name]
    value = getattr(importlib.import_module(module), its_name)
    globals()[name] = value
    return value
