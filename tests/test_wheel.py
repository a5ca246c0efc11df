"""The content of a wheel, and its use without this repository. An example is copied and run, and the notebooks run."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from typing import Any

import pytest
import setuptools
from cli.tiny import reslrb
from compilation import search_path

from reslrb_cli.cli.example import examples
from reslrb_cli.config.loader import load
from reslrb_cli.runs.prepare import flat

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "reslrb_cli"

#: The requirements and sources of a wheel.
LEAST_SETUPTOOLS = 77  # as pyproject.toml says
SOURCES = ("pyproject.toml", "README.md", "LICENSE", "reslrb_cli", "configs", "scenes")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel of this repository, built from a copy without the network."""
    if int(setuptools.__version__.partition(".")[0]) < LEAST_SETUPTOOLS:
        pytest.skip(
            f"setuptools {setuptools.__version__} makes none of this project; scripts/setup --test has a newer one"
        )
    folder = tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, folder / name)
    script = "import sys; from setuptools import build_meta; print(build_meta.build_wheel(sys.argv[1]))"
    made = subprocess.run(
        [sys.executable, "-c", script, "out"], cwd=folder, capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr[-2000:]
    return folder / "out" / made.stdout.splitlines()[-1]


def installed(wheel: Path, folder: Path) -> Path:
    """Return a Python that has the wheel and its requirements from this environment, but not this repository."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    (site,) = folder.glob("lib/python*/site-packages")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", site, wheel]
    subprocess.run(install, check=True)
    needed = Path(sysconfig.get_path("purelib"))
    # The packages of this environment are found, but not the repository, because Python does not read `.pth` files in
    # such a folder
    (site / "needed.pth").write_text(f"{needed}\n")
    return folder / "bin/python"


@pytest.fixture(scope="module")
def python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python with the wheel."""
    return installed(wheel, tmp_path_factory.mktemp("installed") / "environment")


def test_the_wheel_contains_all_data_files(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    wanted = {path.relative_to(ROOT).as_posix() for path in PACKAGE.rglob("*.j2")}
    wanted |= {path.relative_to(ROOT).as_posix() for kind in ("*.js", "*.py") for path in PACKAGE.rglob(kind)}
    wanted.add("reslrb_cli/py.typed")  # without it, a user's type checker sees every public name as Any
    for name in ("configs", "scenes"):
        wanted |= {f"reslrb_cli/examples/{path.relative_to(ROOT).as_posix()}"
                   for path in (ROOT / name).rglob("*") if path.is_file()}  # fmt: skip
    assert wanted <= names
    others = {name for name in names - wanted if ".dist-info/" not in name}
    assert others == set()
    assert wheel.stat().st_size < 3e6


def test_examples_are_unchanged_copies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each example can be copied. The copy loads as the same experiment, with its own copies of all files."""
    monkeypatch.chdir(tmp_path)
    assert {ROOT / "configs" / f"{name}.yaml" for name in examples()} == set((ROOT / "configs").rglob("*.yaml"))
    listed = reslrb("example").stdout.splitlines()
    assert [line.split()[0] for line in listed] == list(examples())
    for name, path in examples().items():
        result = reslrb("example", name, "-o", f"of {name.replace('/', ' ')}")
        assert result.exit_code == 0, result.output
        copied = Path(f"of {name.replace('/', ' ')}") / path.name
        own, shipped = flat(load(copied)), flat(load(path))
        assert own.keys() == shipped.keys()
        for key, value in shipped.items():
            for mine, theirs in [] if own[key] == value else zip(*map(paths, (own[key], value)), strict=True):
                assert mine.read_bytes() == theirs.read_bytes()
                assert mine.resolve().is_relative_to(tmp_path.resolve())


def test_an_example_replaces_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A broken link also counts as an existing file."""
    monkeypatch.chdir(tmp_path)
    name, path = next(iter(examples().items()))
    Path("of").mkdir()
    Path("of", path.name).symlink_to(tmp_path / "nowhere")
    result = reslrb("example", name, "-o", "of")
    assert (result.exit_code, list(Path("of").iterdir())) == (2, [Path("of", path.name)])
    assert f"of/{path.name}: exists; give another folder with -o, or remove it" in result.output


def paths(value: str | list[str]) -> list[Path]:
    """Return the paths in a setting that names one file or several files."""
    return [Path(each) for each in (value if isinstance(value, list) else [value])]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["cornel_floor"], "NAME: no example is called `cornel_floor`; did you mean `cornell_floor`?"),
        (["furnace", "-o", "taken"], "taken/furnace.yaml: exists; give another folder with -o, or remove it"),
        (["furnace", "-o", "file/below"], "-o: cannot write to file/below: Not a directory"),
    ],
)
def test_existing_files_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], line: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    for name in ("furnace.yaml", "scenes/stiff/wall.xml"):
        (Path("taken") / name).parent.mkdir(parents=True, exist_ok=True)
        (Path("taken") / name).write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    result = reslrb("example", *words)
    assert (result.exit_code, result.output[: len(line)]) == (2, line)
    assert len(result.output.strip().splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.long
def test_an_example_runs_from_another_folder(python: Path, tmp_path: Path, llvm: str) -> None:
    """The run also writes its page, whose templates are in the package. A second command runs by `reslrb` itself."""
    program, elsewhere = python.with_name("reslrb"), tmp_path / "elsewhere"
    elsewhere.mkdir()
    # With `--target`, pip puts the script beside the packages
    (script,) = python.parents[1].rglob("site-packages/bin/reslrb")
    if script != program:
        program.write_text(f"#!{python}\n" + script.read_text().partition("\n")[2])
        program.chmod(0o755)
    environment = {**os.environ, "PYTHONPATH": search_path(), "RESLRB_CACHE": str(tmp_path / "cache")}

    def call(*words: str) -> str:
        told = subprocess.run([program, *words], cwd=elsewhere, env=environment, capture_output=True, text=True,
                              check=False)  # fmt: skip
        assert told.returncode == 0, told.stderr
        return told.stdout

    where = subprocess.run([python, "-c", "import reslrb_cli; print(reslrb_cli.__file__)"], cwd=elsewhere,
                           env=environment, capture_output=True, text=True, check=True).stdout  # fmt: skip
    assert Path(where.strip()).is_relative_to(python.parents[1])
    assert "furnace/furnace.yaml" in call("example", "furnace")
    settings = ("scene.size=[8, 8]", "run.iterations=2", "run.spp=4", "run.measuring=0", "run.final_spp=4",
                "target.render.spp=16", "integrator.estimator=stack", "run.certainty=false")  # fmt: skip
    said = call("optimize", "furnace/furnace.yaml", *(word for each in settings for word in ("--set", each)))
    assert "finished after 2 iterations" in said
    assert "</html>" in (elsewhere / "runs/furnace/report.html").read_text()


# --- notebooks --------------------------------------------------------------------------------------------------------

NOTEBOOKS = sorted((ROOT / "docs/notebooks").glob("*.ipynb"))


def execute(notebook: Any, python: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Execute a notebook in a kernel of `python`, in `folder`. An example is copied to the place that it has in the
    repository.
    """
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    kernel = folder / "jupyter/kernels/wheel/kernel.json"
    kernel.parent.mkdir(parents=True)
    words = [str(python), "-m", "ipykernel_launcher", "-f", "{connection_file}"]
    kernel.write_text(json.dumps({"argv": words, "display_name": "wheel", "language": "python"}))
    monkeypatch.setenv("JUPYTER_PATH", str(folder / "jupyter"))
    environment = {**os.environ, "PYTHONPATH": search_path(), "RESLRB_CACHE": str(folder / "cache")}
    words = [str(python), "-m", "reslrb_cli", "example", "cornell_floor", "-o", "configs"]
    subprocess.run(words, cwd=folder, env=environment, check=True, capture_output=True)
    where = "import reslrb_cli\nprint(reslrb_cli.__file__)"
    notebook.cells.insert(0, nbformat.v4.new_code_cell(where))
    resources = {"metadata": {"path": str(folder)}}
    client = nbclient.NotebookClient(notebook, timeout=300, kernel_name="wheel", resources=resources)
    client.execute(env=environment)
    first = notebook.cells.pop(0)
    assert Path(first.outputs[0].text.strip()).is_relative_to(python.parents[1])


@pytest.mark.long  # tests/api run the calls of the notebooks
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(
    path: Path, python: Path, tmp_path: Path, llvm: str, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    nbformat = pytest.importorskip("nbformat")
    if path.stem == "network":
        pytest.importorskip("torch")
    notebook = nbformat.read(path, as_version=4)
    execute(notebook, python, tmp_path, monkeypatch)
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert any(output.get("text", "").startswith("finished ") for output in outputs)
