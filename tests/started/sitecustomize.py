"""Python reads this file at its start if PYTHONPATH contains this folder. Processes started by tests then also compile
kernels quickly.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType


class BeforeDrJit:
    """Finder that never finds a module. It waits for the import of Dr.Jit, before which `reslrb_cli` chooses the
    libLLVM.
    """

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> None:
        """Turn optimisations off before the first module of Dr.Jit is searched for."""
        if name == "drjit":
            sys.meta_path.remove(self)
            file = Path(__file__).resolve().parents[1] / "compilation.py"
            spec = importlib.util.spec_from_file_location("compilation", file)
            assert spec is not None
            assert spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            module.leave_out_optimisations()


sys.meta_path.insert(0, BeforeDrJit())
