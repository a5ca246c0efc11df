"""The Python of README and docs/python.md runs as it stands, the reference is that of the docstrings, notebooks run."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from cli.tiny import ROOT
from compilation import search_path
from make_reference import DOCS, python_page

import reslrb_cli

PAGE = DOCS / "python.md"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


@pytest.fixture
def checkout(llvm: str, tmp_path: Path) -> Path:
    """A folder with the experiments and scenes of this one, into which scripts may write."""
    for name in ("configs", "scenes"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": search_path(ROOT), "RESLRB_CACHE": str(folder / "cache")}


def script_of(text: str) -> str:
    """The Python blocks, one after the other."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL))


def run(script: str, folder: Path) -> list[str]:
    """The lines that a script prints."""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=folder, env=environment(folder))
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_pages_script_runs(checkout: Path) -> None:
    lines = run(script_of(PAGE.read_text(encoding="utf-8")), checkout)
    assert [line.split()[0] for line in lines[:6]] == ["0", "1", "2", "3", "4", "5"]
    assert lines[6].startswith("finished ")
    assert lines[7] == "interrupted 3"
    assert [line.split()[0] for line in lines[8:13]] == ["3", "4", "5", "6", "7"]
    assert "overrides: run.iteration: unknown key; did you mean `iterations`?" in lines
    assert lines[-1] == "made/scene.xml"
    assert {path.name for path in (checkout / "runs").iterdir()} == {"carpet", "stopped"}


def test_the_readmes_first_script_runs(checkout: Path) -> None:
    """The others: tests/conformance/test_plugin.py."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    section = text[text.index("## In a script") : text.index("## Scenes")]
    block = re.findall(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)[0]
    lines = run(block, checkout)
    assert [line.split()[0] for line in lines] == [str(number) for number in range(len(lines))]
    assert len(lines) >= 5


def test_the_reference_is_that_of_the_docstrings() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert text == python_page(text), "run `python scripts/make_reference.py`"
    for name in set(reslrb_cli.__all__) - {"__version__"}:
        assert f"### `{name}`\n" in text


def test_what_the_page_links_to_is_there() -> None:
    for name in re.findall(r"\]\(([^)#:]+)[^)]*\)", PAGE.read_text(encoding="utf-8")):
        assert (DOCS / name).exists(), name


# --- notebooks: tests/test_wheel.py runs them -------------------------------------------------------------------------


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_valid_and_has_no_outputs(path: Path) -> None:
    nbformat = pytest.importorskip("nbformat")
    content = json.loads(path.read_text(encoding="utf-8"))
    nbformat.validate(content)
    assert content["nbformat"] == 4
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in content["cells"])
    assert path.read_text(encoding="utf-8").endswith("}\n")


@pytest.mark.long
def test_the_integrator_of_the_page_is_found_to_be_wrong(checkout: Path) -> None:
    """And what the program says of it is what the page says; with two lines exchanged it is right."""
    page = (DOCS / "your_integrator.md").read_text(encoding="utf-8")
    code, (said,) = script_of(page), re.findall(r"^    mine.py:Replay: (its image holds.*)$", page, re.MULTILINE)
    first, second = (line for line in code.splitlines() if "behind = " in line or "L = L + Le" in line)
    (checkout / "mine.py").write_text(code, encoding="utf-8")
    (checkout / "right.py").write_text(code.replace(f"{first}\n{second}", f"{second}\n{first}"), encoding="utf-8")
    (words,) = re.findall(r"^    reslrb (gradcheck --integrators.*?)\n\n", page, re.MULTILINE | re.DOTALL)
    for name, code_of in (("mine", 1), ("right", 0)):
        command = words.replace("\\\n", " ").replace("mine.py", f"{name}.py").split()
        done = subprocess.run([sys.executable, "-m", "reslrb_cli", *command], capture_output=True, text=True,
                              timeout=300, cwd=checkout, env=environment(checkout))  # fmt: skip
        assert done.returncode == code_of, done.stderr
        (sentence,) = [line for line in done.stdout.splitlines() if "its image holds" in line] or [""]
        assert re.sub(r"[0-9.]+ \+- [0-9.]+", "R", sentence) == (
            f"mine.py:Replay: {re.sub(r'[0-9.]+ [+]- [0-9.]+', 'R', said)}" if code_of else ""
        )
