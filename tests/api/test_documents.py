"""The Python blocks of the README and of docs run unchanged, and the reference has all public names."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cli import tiny
from cli.tiny import ROOT
from compilation import search_path
from kit import work_in
from make_reference import DOCS

import reslrb_cli
from reslrb_cli import errors

PAGE = DOCS / "python.md"
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def test_errors_in_the_reference_are_public() -> None:
    """A script can catch each error that a docstring names, by its name in `rl`."""
    import builtins

    text = PAGE.read_text(encoding="utf-8")
    kinds = {name for name, kind in vars(errors).items() if isinstance(kind, type) and issubclass(kind, Exception)}
    classes = {name for name in kinds if re.search(rf"\b{name}\b", text)}
    assert {"ConfigError", "NonFinite", "OutOfMemory", "MachineError"} <= classes
    assert [name for name in classes if getattr(reslrb_cli, name, None) is not getattr(errors, name)] == []
    raised = set(re.findall(r"\b[A-Z][A-Za-z]+(?:Error|Interrupt)\b", text))
    assert [name for name in raised if not hasattr(reslrb_cli, name) and not hasattr(builtins, name)] == []
    places = [*DOCS.glob("*.md"), ROOT / "README.md"]
    used = {name for page in places for name in re.findall(r"\brl\.([A-Za-z]\w*)", page.read_text(encoding="utf-8"))}
    assert [name for name in used if not hasattr(reslrb_cli, name)] == []


@pytest.fixture
def checkout(llvm: str, tmp_path: Path) -> Path:
    """Folder with the repository's experiments and scenes, into which scripts may write."""
    for name in ("configs", "scenes"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def environment(folder: Path) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": search_path(ROOT), "RESLRB_CACHE": str(folder / "cache")}


def script_of(text: str) -> str:
    """Return the Python blocks of `text`, joined in their order."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL))


def run(script: str, folder: Path) -> list[str]:
    """Run a script and return the lines it prints."""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=folder, env=environment(folder))
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.fixture
def quick_checkout(llvm: str, tmp_path: Path) -> Path:
    """Folder with the repository's scenes and a small version of the page's only experiment. The experiment measures
    nothing and chooses no paths, and its target has few samples.
    """
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    (tmp_path / "configs").mkdir()
    text = (ROOT / "configs/cornell_floor.yaml").read_text(encoding="utf-8")
    assert text.count("\nrun:\n") == text.count("{spp: 1024}") == 1
    text = text.replace("\nrun:\n", "\nrun:\n  measuring: 0\n").replace("{spp: 1024}", "{spp: 16}")
    text = text.replace("{resx: 256, resy: 256}", "{resx: 16, resy: 16}")
    text = text.replace("max_depth: 6", "max_depth: 3\n  paths: light")
    (tmp_path / "configs/cornell_floor.yaml").write_text(text, encoding="utf-8")
    return tmp_path


def run_here(script: str, folder: Path) -> list[str]:
    """Run a script in this process and return the lines it prints."""
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as said:
        work_in(folder, patch)
        exec(compile(script, "script.py", "exec"), {"__name__": "__main__"})
    return said.getvalue().splitlines()


@pytest.mark.long
def test_scripts_of_the_docs_run(quick_checkout: Path) -> None:
    folder = quick_checkout
    lines = run_here(script_of(PAGE.read_text(encoding="utf-8")), folder)
    assert [line.split()[0] for line in lines[:6]] == ["0", "1", "2", "3", "4", "5"]
    assert lines[6].startswith("finished ")
    assert lines[7] == "interrupted 3"
    assert [line.split()[0] for line in lines[8:13]] == ["3", "4", "5", "6", "7"]
    assert "overrides: run.iteration: unknown key; did you mean `iterations`?" in lines
    assert any(re.fullmatch(r".*/cache/scenes/[0-9a-f]{32}/scene.xml", line) for line in lines)
    assert "watched: finished" in lines
    assert "made/scene.xml" in lines
    assert {path.name for path in (folder / "runs").iterdir()} == {"carpet", "stopped"}


@pytest.mark.long  # the target has many samples
def test_scripts_of_the_readme_run(checkout: Path) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = run(block, checkout)
    assert [line.split()[0] for line in lines] == [str(number) for number in range(len(lines))]
    assert len(lines) >= 5


def blocks(name: str) -> list[str]:
    """Return the Python blocks of a page."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / name).read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


#: Pages with Python blocks, and the number of blocks of each page. A test runs each block: this file,
#: tests/conformance/test_plugin.py, tests/api/test_torch.py, tests/runs/test_callbacks.py or
#: tests/measure/test_own_estimators.py.
PYTHON = {"README.md": 1, "docs/python.md": 10, "docs/integrator.md": 4, "docs/steps.md": 1, "docs/losses.md": 1,
          "docs/benchmarks.md": 1, "docs/benchmarks/page.md": 1, "docs/your_integrator.md": 1,
          "docs/pytorch.md": 1, "docs/tensorboard.md": 2, "docs/your_estimator.md": 2}  # fmt: skip


def test_every_python_block_of_the_docs_is_run() -> None:
    pages = [ROOT / "README.md", *DOCS.rglob("*.md")]
    counts = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8").count("```python") for page in pages}
    assert {name: count for name, count in counts.items() if count} == PYTHON
    assert {name: len(blocks(name)) for name in PYTHON} == PYTHON


def test_statements_of_the_docs_about_a_run_hold(checkout: Path) -> None:
    """The docs' scripts work on a run: the slope of recovered values, the median step, and a custom loss."""
    (slope,), (edges,) = blocks("docs/steps.md"), blocks("docs/losses.md")
    (steps,) = blocks("docs/benchmarks.md")
    (checkout / "my_loss.py").write_text(edges, encoding="utf-8")
    settings = ("scene.options={resx: 32, resy: 32}", "run.iterations=8", "run.final_spp=8", "target.render.spp=16",
                "run.measuring=0", f"loss={{type: custom, file: {checkout / 'my_loss.py'}:edges}}",
                f"run.output={checkout / 'runs'}")  # fmt: skip
    tiny.done("optimize", checkout / "configs/cornell_floor.yaml", "--allow-code", *tiny.settings(*settings))
    (checkout / "runs/ours").symlink_to("cornell_floor")
    (found,) = run_here(slope, checkout)
    assert np.isfinite(float(found))
    step_ms, peak = map(float, run_here(steps, checkout)[0].split())
    records = [json.loads(line) for line in (checkout / "runs/ours/metrics.jsonl").read_text().splitlines()]
    assert step_ms == sorted(record["step_ms"] for record in records[5:])[1]
    assert peak > 0


def test_the_reference_has_all_public_names() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for name in {*reslrb_cli.__all__, "torch.render"} - {"__version__", "torch"}:
        assert f"### `{name}`\n" in text


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
def test_the_wrong_integrator_of_the_docs_is_found(checkout: Path) -> None:
    """The program prints what the page shows. With two lines exchanged, the integrator is correct."""
    page = (DOCS / "your_integrator.md").read_text(encoding="utf-8")
    code, (said,) = script_of(page), re.findall(r"^    (\d of 6 comparisons hold, \d fail)$", page, re.MULTILINE)
    first, second = (line for line in code.splitlines() if "behind = " in line or "L = L + Le" in line)
    (checkout / "mine.py").write_text(code, encoding="utf-8")
    (checkout / "right.py").write_text(code.replace(f"{first}\n{second}", f"{second}\n{first}"), encoding="utf-8")
    (words,) = re.findall(r"^    reslrb (gradcheck --integrators.*?)\n\n", page, re.MULTILINE | re.DOTALL)
    for name, code_of in (("mine", 1), ("right", 0)):
        command = words.replace("\\\n", " ").replace("mine.py", f"{name}.py").split()
        done = subprocess.run([sys.executable, "-m", "reslrb_cli", *command], capture_output=True, text=True,
                              timeout=300, cwd=checkout, env=environment(checkout))  # fmt: skip
        assert done.returncode == code_of, done.stderr
        assert (said if code_of else "6 of 6 comparisons hold, 0 fail") in done.stdout.splitlines()
