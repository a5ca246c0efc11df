"""The Python of README and docs/python.md runs as it stands, the reference is that of the docstrings, notebooks run."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

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


# --- notebooks --------------------------------------------------------------------------------------------------------


def execute(path: Path, folder: Path) -> Any:
    """The notebook, executed in `folder`."""
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}})
    client.execute(env=environment(folder))
    return notebook


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path: Path, checkout: Path) -> None:
    notebook = execute(path, checkout)
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_valid_and_has_no_outputs(path: Path) -> None:
    nbformat = pytest.importorskip("nbformat")
    content = json.loads(path.read_text(encoding="utf-8"))
    nbformat.validate(content)
    assert content["nbformat"] == 4
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in content["cells"])
    assert path.read_text(encoding="utf-8").endswith("}\n")


#: Cells of a notebook whose stop button is pressed in the midst of the first loop.
CELLS = [
    'import reslrb_cli as rl\nconfig = rl.load("configs/cornell_floor.yaml", {"run.iterations": 100000, '
    '"scene.options": {"resx": 16, "resy": 16}, "run.final_spp": 16, "run.measuring": 0})\n'
    'run = rl.optimize(config, folder="runs/stopped")',
    "import threading, os, signal\nfor record in run.live():\n    if record.iteration == 3:\n"
    "        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()",
    'print(run.status, run.iteration > 3, sorted(run.parameters), (run.folder / "report.html").exists())\n'
    "again = iter(run)\nprint(next(again).iteration == run.iteration - 1)\nagain.close()",
]


def test_a_notebooks_stop_button_keeps_the_result(checkout: Path) -> None:
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    cells = [nbformat.v4.new_code_cell(source) for source in CELLS]
    cells[1].metadata["tags"] = ["raises-exception"]
    notebook = nbformat.v4.new_notebook(cells=cells)
    client = nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(checkout)}})
    client.execute(env=environment(checkout))
    [error] = [output for output in cells[1].outputs if output.output_type == "error"]
    assert error.ename == "KeyboardInterrupt"
    assert any("image/png" in output.get("data", {}) for output in cells[1].outputs)
    text = "".join(output.text for output in cells[2].outputs if output.get("name") == "stdout")
    assert text == "interrupted True ['floor.reflectance.data'] True\nTrue\n"


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
