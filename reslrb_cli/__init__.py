"""Gradients through light paths: reservoir light replay backpropagation on Mitsuba 3.

`import reslrb_cli` needs no variant and loads no Mitsuba. Import it before Mitsuba: it chooses the libLLVM that Dr.Jit
will load. `register()` makes the plugins known to Mitsuba, `step(...)` is one gradient step.
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
    from reslrb_cli.integrators import gradient_step as step
    from reslrb_cli.integrators import register

__version__ = "0.1.0"
__all__ = ["__version__", "register", "step"]

# Dr.Jit loads libLLVM on a thread of its own while it is being imported: later is too late.
_llvm.prepare()

_LAZY = {"register": "register", "step": "gradient_step"}


def __getattr__(name: str) -> Any:
    """Loads a public name that needs Mitsuba when it is first asked for."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module("reslrb_cli.integrators"), _LAZY[name])
    globals()[name] = value
    return value
