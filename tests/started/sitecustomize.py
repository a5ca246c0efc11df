"""Python reads this as it starts, where PYTHONPATH has this folder: that process compiles kernels quickly too."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType


class BeforeDrJit:
    """Finds no module: it waits until Dr.Jit is imported, for which `reslrb_cli` has then chosen the libLLVM."""

    def find_spec(self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> None:
        """Have optimisations left out before the first of Dr.Jit is looked for."""
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
