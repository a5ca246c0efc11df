"""Every plugin of Mitsuba in a separate scene. The plugin works or is refused in one line, as every_plugin.py
states.
"""

from __future__ import annotations

import gc
import re
from pathlib import Path

import mitsuba as mi
import pytest
import yaml
from cli.every_plugin import FEW, PAGE, ROWS, Row, page, write_files
from cli.tiny import reslrb, settings
from turns import a_few

from reslrb_cli.backend.installation import package_folder, shipped_plugins
from reslrb_cli.scene.dispersion import GLASS, ILLUMINANT, SENSITIVITY

pytestmark = pytest.mark.usefixtures("llvm")

#: Settings for three iterations that are as short as possible.
SHORT = settings("target={render: {spp: 64}}", "run.iterations=3", "run.spp=4",
                 "run.certainty=false", "integrator.max_depth=4")  # fmt: skip
#: Decisions that a run would otherwise measure first.
DECIDED = settings("integrator.estimator=stack", "integrator.guiding=off", "integrator.sequence=independent")
#: All integrator types of a configuration.
TYPES = ("reslrb", "ptracer", "walk_ad", "trajectory", "prb")
BY_HAND = """
variant: llvm_ad_rgb
scene: {file: scene.xml}
target: {render: {spp: 4}}
parameters: [{key: floor.bsdf.reflectance.value, initial: 0.3}]
integrator: {max_depth: 3}
run: {iterations: 1, spp: 4}
"""


@pytest.fixture(scope="module")
def files(llvm: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the files that scenes name."""
    folder = tmp_path_factory.mktemp("files")
    write_files(folder)
    return folder


@pytest.fixture
def folder(files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working directory with links to all files that the scenes name."""
    for file in files.iterdir():
        (tmp_path / file.name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("reslrb_cli.runs.recorder.write_report", lambda folder, *now: None)
    return tmp_path


def said(*arguments: object, code: int = 0) -> str:
    """Run a command, check its exit code, and return its output as one line."""
    result = reslrb(*arguments)
    text = " ".join(result.output.split())
    ended, error = result.exit_code, repr(result.exception)
    del result
    gc.collect()  # Mitsuba also asks the emitters of unused scenes until the garbage collector removes the scenes
    assert ended == code, f"{' '.join(map(str, arguments))}: {text} {error}"
    assert "Traceback" not in text
    return text


def check(row: Row, folder: Path, to_the_end: bool) -> None:
    """Run the commands on the row's scene, and check that each prints what the row states."""
    (folder / "scene.xml").write_text(row.xml())
    if row.loading:
        for command in ("inspect", "init"):
            assert row.loading in said(command, "scene.xml", code=2)
        return
    inspected = said("inspect", "scene.xml")
    assert (row.mended or "scene.xml") in inspected
    if row.refused:
        assert "cannot be rendered: " in inspected
        assert row.light in inspected
        assert "change the scene so that it can be rendered" in inspected
        assert row.light in said("init", "scene.xml", "-o", "c.yaml", code=2)
        assert not (folder / "c.yaml").exists()
        return
    assert "cannot be rendered" not in inspected
    assert ("no light tracing: " in inspected, "no prb: " in inspected) == (bool(row.light), bool(row.camera))
    assert row.light in inspected
    assert row.camera in inspected
    said("init", "scene.xml", "-o", "c.yaml")
    written = (folder / "c.yaml").read_text()
    integrator = yaml.safe_load(written)["integrator"]
    assert (integrator["type"], integrator.get("paths")) == ("reslrb", "camera" if row.light else None)
    if to_the_end:
        said("optimize", "c.yaml", *SHORT, *DECIDED)
        said("export", "runs/c", "-o", "out")
        mi.load_file(str(folder / "out" / "scene.xml"))


@pytest.mark.parametrize("row", a_few(ROWS, {*FEW, "homogeneous", "timed_sunsky"}))
def test_it_works_or_is_refused_in_one_line(row: Row, folder: Path) -> None:
    check(row, folder, to_the_end=True)


def test_every_plugin_is_covered() -> None:
    registered = {
        name
        for file in (package_folder() / "python").rglob("*.py")
        for name in re.findall(r"mi\.register_\w+\(\s*[\"'](\w+)[\"']", file.read_text(encoding="utf-8"))
    }
    listed = {row.plugin for row in ROWS}
    assert registered >= {"prb", "flat_sensor"}
    assert (shipped_plugins() | registered | {"blender", GLASS, ILLUMINANT, SENSITIVITY}) - {"scene"} == listed
    assert len({row.name for row in ROWS}) == len(ROWS)


def test_the_page_matches_the_table() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "`python tests/cli/every_plugin.py` writes it anew"


def test_unknown_plugins_are_refused_by_every_command_and_integrator(folder: Path) -> None:
    [row] = [row for row in ROWS if row.name == "homogeneous"]
    (folder / "scene.xml").write_text(row.xml())
    (folder / "c.yaml").write_text(BY_HAND)
    for type in TYPES:
        assert row.light in said("optimize", "c.yaml", *settings(f"integrator.type={type}"), code=2)
    # Cases of `bench` are refused in processes of their own (test_wrong_calls_are_one_located_line).
    for command, *words in (("render", "-o", "image.exr"), ("render", "--scene", "-o", "image.exr"), ("gradcheck",)):
        assert row.light in said(command, "c.yaml", *words, code=2)
    assert not (folder / "image.exr").exists()
