"""Imports go in one direction, and the package can be imported without Mitsuba."""

from __future__ import annotations

import ast
import functools
import os
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import reslrb_cli

ROOT = Path(reslrb_cli.__file__).parent
# A module may import from its own row and from the rows above it.
ROWS = [
    "version",
    "errors",
    "seeds",
    "statistics",
    "glasses",
    "colorimetry",
    "config",
    "backend",
    "records",
    "lens",
    "scene",
    "transport",
    "estimators",
    "guiding",
    "integrators",
    "optimization",
    "measure",
    "report",
    "runs",
    "cluster",
    "api",
    "cli",
    "__main__",
]
# Packages that a row must not import at all.
FOREIGN = {
    "errors": {"mitsuba", "drjit"},
    "config": {"mitsuba", "drjit"},
    "seeds": {"mitsuba", "drjit"},
    "statistics": {"mitsuba", "drjit"},
    "glasses": {"mitsuba", "drjit"},
    "colorimetry": {"mitsuba", "drjit"},
    "records": {"matplotlib"},
    "lens": {"mitsuba", "drjit", "matplotlib"},
}


def violations(root: Path) -> list[str]:
    """Return one line for each import under `root` that goes in the wrong direction. The folder `root` is laid out as
    the package.
    """
    found = []
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        if parts == ("__init__",):
            continue  # the package's public names, which load on demand
        row = parts[0]
        if row not in ROWS:
            found.append(f"{path.relative_to(root)}: {row} is in no row")
            continue
        for line, name in _imports(path, parts):
            package, _, rest = name.partition(".")
            target = rest.partition(".")[0]
            if package in FOREIGN.get(row, set()):
                found.append(f"{path.relative_to(root)}:{line}: {row} must not know {package}")
            elif package == "reslrb_cli" and target in ROWS and ROWS.index(target) > ROWS.index(row):
                found.append(f"{path.relative_to(root)}:{line}: {row} must not import {target}")
    return found


@functools.cache
def _nodes(path: Path) -> list[ast.AST]:
    """Return all nodes of a module's syntax tree, which are cached because they take most of the time."""
    return list(ast.walk(ast.parse(path.read_text())))


def _imports(path: Path, parts: tuple[str, ...]) -> list[tuple[int, str]]:
    """Return (line, absolute dotted name) for each import of a module, including imports inside functions."""
    names = []
    for node in _nodes(path):
        if isinstance(node, ast.Import):
            names += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = [*(["reslrb_cli", *parts][: -node.level] if node.level else []), *filter(None, [node.module])]
            names += [(node.lineno, ".".join([*base, alias.name])) for alias in node.names]
    return names


def circles(root: Path, package: str = "reslrb_cli") -> list[list[str]]:
    """Return the files under `root` that form an import circle, at most one circle. The folder `root` is laid out as
    the package.

    All imports count, including those under TYPE_CHECKING and inside functions. Dotted names in text also count,
    because a module that is imported by its name is also needed.
    """
    paths = {_module(package, path.relative_to(root)): path for path in root.rglob("*.py")}
    needs: dict[str, set[str]] = {}
    for name, path in paths.items():
        parts = path.relative_to(root).with_suffix("").parts
        found = {other for _, other in _imports(path, parts)} | set(_names_in_text(path, package))
        modules = {other if other in paths else other.rpartition(".")[0] for other in found}
        needs[name] = {other for other in modules if other in paths and other not in (name, package)}
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as error:
        return [sorted(set(error.args[1]))]
    return []


def _module(package: str, path: Path) -> str:
    return ".".join([package, *(part for part in path.with_suffix("").parts if part != "__init__")])


def _names_in_text(path: Path, package: str) -> list[str]:
    """Return the dotted names of the package in the text of a module, except in docstrings."""
    has_docstring = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {id(node.body[0].value) for node in _nodes(path)
                  if isinstance(node, has_docstring) and node.body and isinstance(node.body[0], ast.Expr)}  # fmt: skip
    texts = [node for node in _nodes(path) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    said = [str(node.value) for node in texts if id(node) not in docstrings]
    return [name for text in said for name in re.findall(rf"\b{package}(?:\.\w+)+", text)]


def test_there_are_no_import_circles() -> None:
    assert circles(ROOT) == []


@pytest.mark.parametrize(
    ("one", "other", "seen"),
    [
        ("from reslrb_cli.two import b", "from reslrb_cli import one", True),
        ("if TYPE_CHECKING:\n    from reslrb_cli.two import B", "from .one import a", True),
        ("import reslrb_cli.two", "def f():\n    from reslrb_cli.one import a", True),
        ("import reslrb_cli.two", "command = 'from reslrb_cli.one import a'", True),
        ("import reslrb_cli.two", "'''As reslrb_cli.one has it.'''", False),
        ("import reslrb_cli.two", "import os", False),
    ],
)
def test_a_planted_circle_is_found(tmp_path: Path, one: str, other: str, seen: bool) -> None:
    (tmp_path / "one.py").write_text(one)
    (tmp_path / "two.py").write_text(other)
    assert bool(circles(tmp_path)) is seen


def test_imports_follow_the_layers() -> None:
    assert violations(ROOT) == []


@pytest.mark.parametrize(
    ("file", "source", "seen"),
    [
        ("transport/walk.py", "from reslrb_cli.estimators import base", True),
        ("transport/walk.py", "def f():\n    import reslrb_cli.cli.optimize", True),
        ("transport/walk.py", "from reslrb_cli import integrators", True),
        ("transport/walk.py", "from ..estimators.base import Estimator", True),
        ("transport/walk.py", "from .. import estimators", True),
        ("config/schema.py", "import mitsuba as mi", True),
        ("records/page.py", "from matplotlib import pyplot", True),
        ("lens/surface.py", "import mitsuba as mi", True),
        ("lens/surface.py", "from reslrb_cli.scene import images", True),
        ("errors.py", "from reslrb_cli.config import load", True),
        ("helpers.py", "import os", True),
        ("transport/walk.py", "from . import emission\nfrom ..seeds import seed\nimport mitsuba as mi", False),
        ("cli/optimize.py", "from reslrb_cli import __version__\nfrom reslrb_cli.optimization import loop", False),
        ("estimators/base.py", "from reslrb_cli.transport import types", False),
    ],
)
def test_a_planted_violation_is_found(tmp_path: Path, file: str, source: str, seen: bool) -> None:
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text(source)
    assert bool(violations(tmp_path)) is seen


def test_packages_are_imported_where_they_are_needed() -> None:
    heavy = "{'mitsuba', 'drjit', 'matplotlib', 'numpy'}"
    script = f"import sys, reslrb_cli\nassert not ({heavy} | {{'click', 'pydantic'}}) & set(sys.modules)\n"
    script += f"import reslrb_cli.config.loader\nassert not {heavy} & set(sys.modules)"
    script += "\nimport reslrb_cli.runs.recorder\nassert not {'matplotlib', 'scipy.special'} & set(sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_commands_load_numpy_and_scipy_without_idle_threads() -> None:
    script = "import os, reslrb_cli.cli, numpy, scipy.linalg; print(len(os.listdir('/proc/self/task')))"
    environment = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment)
    assert int(done.stdout) == 1
    environment["OPENBLAS_NUM_THREADS"] = "3"  # the user's choice counts
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment)
    assert int(done.stdout) > 1 or len(os.sched_getaffinity(0)) == 1


#: A module whose class derives from a class of the current variant, as in Mitsuba's own integrators. Only its plugin
#: loads it.
OF_A_VARIANT = "reslrb_cli.integrators.reslrb_basic"


def test_every_module_can_be_imported_without_a_variant() -> None:
    parts = [path.relative_to(ROOT.parent).with_suffix("").parts for path in ROOT.rglob("*.py")]
    names = sorted({".".join(part for part in module if part != "__init__") for module in parts})
    names.remove(OF_A_VARIANT)
    script = (
        f"import importlib\nfor name in {names!r}: importlib.import_module(name)\n"
        "import mitsuba as mi; assert mi.variant() is None, mi.variant()"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_an_unknown_public_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        reslrb_cli.nothing  # noqa: B018
