"""Packages on the path that are not Mitsuba and Dr.Jit, or have the wrong version. Each gives one line and exit
code 3.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import reslrb_cli
from reslrb_cli.backend import installation

ROOT = Path(reslrb_cli.__file__).parents[1]
PIP = "install it with `pip install '{}'`"
MITSUBA, DRJIT = PIP.format("mitsuba>=3.9,<3.10"), PIP.format("drjit>=1.5,<1.6")

#: The file of a package, its text, and the message about it. {place} is the file.
PACKAGES = {
    "another mitsuba": (
        "mitsuba.py",
        "",
        "found mitsuba without a version at {place}, but 3.9 is needed: " + MITSUBA,
    ),
    "an older mitsuba": (
        "mitsuba/__init__.py",
        "__version__ = '3.5.2'",
        "found mitsuba 3.5.2 at {place}, but 3.9 is needed: " + MITSUBA,
    ),
    "a newer drjit": (
        "drjit.py",
        "__version__ = '2.0'",
        "found drjit 2.0 at {place}, but 1.5 is needed: " + DRJIT,
    ),
    "one that fails": (
        "drjit/__init__.py",
        "raise RuntimeError('no\\n\\x1b[31mdriver')",
        "Mitsuba cannot be loaded: drjit, found at {place}: RuntimeError: no \\x1b[31mdriver; " + DRJIT,
    ),
    "one that ends the process": (
        "mitsuba.py",
        "import sys; sys.exit('bye')",
        "found at {place}: SystemExit: bye; " + MITSUBA,
    ),
    "a missing library": (
        "drjit.py",
        "raise ImportError('libatomic.so.1: cannot open shared object file: No such file')",
        "run scripts/setup, or install the package that contains it",
    ),
}


#: Loads the packages as a command does, without the imports of a command.
LOADING = """import sys
from reslrb_cli.backend.installation import load_packages
from reslrb_cli.errors import BackendError
try:
    load_packages()
except BackendError as error:
    print(error, file=sys.stderr)
    sys.exit(error.exit_code)
"""


@pytest.mark.parametrize("case", PACKAGES)
def test_found_packages_are_reported(case: str, tmp_path: Path, llvm: str) -> None:
    name, text, what = PACKAGES[case]
    place = tmp_path / "path" / name
    place.parent.mkdir(parents=True)
    place.write_text(text)
    found = {"PYTHONPATH": f"{tmp_path / 'path'}{os.pathsep}{ROOT}"}
    # All commands check this before they do anything else.
    script = "from reslrb_cli.cli import main; main()" if case == "another mitsuba" else LOADING
    command = [sys.executable, "-c", script, "gradcheck"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=os.environ | found)
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    assert what.format(place=place) in done.stderr.splitlines()[-1]


def test_installed_packages_are_the_required_ones(llvm: str) -> None:
    assert [package.__name__ for package in installation.load_packages()] == ["drjit", "mitsuba"]


def test_versions_match_pyproject() -> None:
    text = (ROOT / "pyproject.toml").read_text()
    for name, (first, end) in installation._WANTED.items():
        found = re.search(rf'"{name}>=([\d.]+),<([\d.]+)"', text)
        assert found is not None
        assert found.groups() == (first, end)
