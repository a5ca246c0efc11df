"""Gradients through light paths: reservoir light replay backpropagation on Mitsuba 3.

`import reslrb_cli` needs no variant and does not load Mitsuba. Import `reslrb_cli` before Mitsuba, because `reslrb_cli`
chooses the libLLVM that Dr.Jit loads.

- `load` reads an experiment.
- `optimize` recovers parameters in your own loop.
- `render`, `gradient`, `gradcheck`, `convergence`, `bench` and `export` run the commands of the same name on an
  experiment.
- `write_report` writes a page, a figure or a table about runs and measurements, and `table` returns their arrays.
- `ReslrbError` is the base class of the errors that these raise.
- `Callback` receives the progress of a run; `TensorBoard`, `MLflow` and `WandB` log it.
- `register` registers the plugins with Mitsuba.
- `register_estimator` adds an estimator of your own to the integrator `reslrb`, and `check_estimator` checks it.
- `load_scene` loads a scene whose parameters have the same names as on the command line.
- `step` computes one gradient step.
- `torch.render` renders an image that PyTorch differentiates.

`__all__` lists the public names.
"""

from __future__ import annotations

import os
import signal
import sys

_is_program = bool(sys.argv) and os.path.basename(sys.argv[0]) == "reslrb"
if _is_program and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Ctrl-C during the imports below must end the program without a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import importlib  # noqa: E402
from typing import TYPE_CHECKING, Any  # noqa: E402

from reslrb_cli.backend import llvm as _llvm  # noqa: E402
from reslrb_cli.version import __version__  # noqa: E402

if TYPE_CHECKING:
    from reslrb_cli.api import torch
    from reslrb_cli.api.experiment import (
        bench,
        check_estimator,
        convergence,
        export,
        gradcheck,
        gradient,
        load,
        render,
        write_report,
    )
    from reslrb_cli.api.run import Run, optimize
    from reslrb_cli.config.schema import Config
    from reslrb_cli.errors import (
        BackendError,
        ConfigError,
        MachineError,
        NonFinite,
        OutOfMemory,
        ReslrbError,
        UnsupportedScene,
    )
    from reslrb_cli.estimators import register_estimator
    from reslrb_cli.integrators.plugin import register
    from reslrb_cli.integrators.step import gradient_step as step
    from reslrb_cli.records.metrics import Record
    from reslrb_cli.report.publish import table
    from reslrb_cli.runs.callbacks import Callback, RunInfo
    from reslrb_cli.runs.loggers import MLflow, TensorBoard, WandB
    from reslrb_cli.scene.load import load_for_script as load_scene

__all__ = [
    "BackendError",
    "Callback",
    "Config",
    "ConfigError",
    "MLflow",
    "MachineError",
    "NonFinite",
    "OutOfMemory",
    "Record",
    "ReslrbError",
    "Run",
    "RunInfo",
    "TensorBoard",
    "UnsupportedScene",
    "WandB",
    "__version__",
    "bench",
    "check_estimator",
    "convergence",
    "export",
    "gradcheck",
    "gradient",
    "load",
    "load_scene",
    "optimize",
    "register",
    "register_estimator",
    "render",
    "step",
    "table",
    "torch",
    "write_report",
]

# Dr.Jit loads libLLVM on another thread during its import, so the choice must be made before.
_llvm.prepare()

_LAZY = {
    **{name: ("reslrb_cli.api.experiment", name)
       for name in ("bench", "check_estimator", "convergence", "export", "gradcheck", "gradient", "load", "render",
                    "write_report")},
    **{name: ("reslrb_cli.runs.loggers", name) for name in ("MLflow", "TensorBoard", "WandB")},
    **{name: ("reslrb_cli.runs.callbacks", name) for name in ("Callback", "RunInfo")},
    "Config": ("reslrb_cli.config.schema", "Config"),
    **{name: ("reslrb_cli.errors", name)
       for name in ("BackendError", "ConfigError", "MachineError", "NonFinite", "OutOfMemory", "UnsupportedScene")},
    "Record": ("reslrb_cli.records.metrics", "Record"),
    "ReslrbError": ("reslrb_cli.errors", "ReslrbError"),
    "Run": ("reslrb_cli.api.run", "Run"),
    "load_scene": ("reslrb_cli.scene.load", "load_for_script"),
    "optimize": ("reslrb_cli.api.run", "optimize"),
    "register": ("reslrb_cli.integrators.plugin", "register"),
    "register_estimator": ("reslrb_cli.estimators", "register_estimator"),
    "step": ("reslrb_cli.integrators.step", "gradient_step"),
    "table": ("reslrb_cli.report.publish", "table"),
    "torch": ("reslrb_cli.api.torch", ""),  # the module
}  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import a public name on first access, because most of them need Mitsuba."""
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, its_name = _LAZY[name]
    found = importlib.import_module(module)
    value = getattr(found, its_name) if its_name else found
    globals()[name] = value
    return value
