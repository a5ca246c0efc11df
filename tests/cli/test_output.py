"""Names from scenes, files and arguments reach the terminal and the log as text, never as commands."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

import numpy as np
import pytest
from cli.test_nonfinite import CONFIG, SCENE, reslrb

ESC, TURNED = "\x1b[31m", "\u202e"


@pytest.fixture
def experiment(llvm, tmp_path, monkeypatch):
    """An experiment of which folder, file, surface and material have escape sequences in their names."""
    import mitsuba as mi

    folder = tmp_path / f"f{ESC}"
    folder.mkdir()
    mi.Bitmap(np.full((8, 8, 3), 0.5, np.float32)).write(str(folder / "wall.exr"))
    mi.Bitmap(np.full((8, 8, 3), 0.2, np.float32)).write(str(folder / "target.exr"))
    scene = SCENE.replace("REFLECTANCE", '<rgb name="reflectance" value="0.6, 0.5, 0.4"/>')
    # XML holds no control characters; a mark that turns the direction of writing does as much harm in a key.
    (folder / "scene.xml").write_text(scene.replace('"poster"', f'"pos{TURNED}ter"'))
    (folder / "c.yaml").write_text(CONFIG.replace("poster.", "Diffuse_1."))
    monkeypatch.chdir(tmp_path)
    return folder


def test_inspect(experiment, capsys):
    code, out, err = reslrb(capsys, "inspect", experiment / "c.yaml", "--no-counts")
    assert code == 0
    assert not {"\x1b", TURNED} & set(out + err)
    assert "id `pos\\u202eter` cannot stand in a key: named Diffuse_1" in err
    assert "Diffuse_1.reflectance.value" in out
    code, out, _ = reslrb(capsys, "inspect", experiment / "c.yaml", "--no-counts", "--json")
    assert not {"\x1b", TURNED} & set(out)
    assert "Diffuse_1.reflectance.value" in [entry["key"] for entry in json.loads(out)["parameters"]]


def test_a_run_and_its_errors(experiment, capsys):
    arguments = ("--set", "run.iterations=1", "--set", 'run.output="o\\e[31m"', "--set", "run.name=n")
    code, out, err = reslrb(capsys, "optimize", experiment / "c.yaml", *arguments)
    assert code == 0
    assert "\x1b" not in out + err
    assert "look at o\\x1b[31m/n/report.html" in out
    assert "\x1b" not in Path(f"o{ESC}/n/report.html").read_text().partition("</title>")[0]
    manifest = json.loads(Path(f"o{ESC}/n/manifest.json").read_text())
    assert "\x1b" not in manifest["config"] + "".join(manifest["command_line"])
    for wrong in ("c.yaml", "none.yaml"):
        code, out, err = reslrb(capsys, "optimize", experiment / wrong, "--set", 'parameters[0].key="x\\e[31m"')
        assert code == 2
        assert "\x1b" not in out + err


def test_a_run_whose_configuration_is_called_by_bytes_that_are_not_utf8(experiment, capsys, monkeypatch):
    path = experiment.parent / "c\udcff.yaml"
    monkeypatch.setattr("sys.argv", ["reslrb", "optimize", str(path), ESC])
    path.write_text((experiment / "c.yaml").read_text().replace("file: ", f"file: {experiment}/".replace(ESC, "*")))
    os.rename(experiment, str(experiment).replace(ESC, "*"))
    code, _, err = reslrb(capsys, "optimize", path, "--set", "run.iterations=1")
    assert code == 0, err
    assert Path("runs/c/report.html").exists()
    manifest = json.loads(Path("runs/c/manifest.json").read_text())
    assert "c\\udcff.yaml" in manifest["config"]
    assert manifest["command_line"][2:] == [manifest["config"], "\\x1b[31m"]


def test_usage(capsys):
    code, out, err = reslrb(capsys, "optimize", f"--{ESC}")
    assert code == 2
    assert "\x1b" not in out + err
    assert "No such option" in err


def test_the_log(capsys):
    reslrb(capsys, "optimize", "none.yaml")
    logging.getLogger("reslrb_cli.x").warning("%s: %s", f"a{ESC}", "b\nc")
    assert capsys.readouterr().err == "a\\x1b[31m: b\\nc\n"


def test_long_keys_make_files(experiment, capsys):
    long = "k" * 120  # longer ids are replaced
    scene = (experiment / "scene.xml").read_text()
    (experiment / "scene.xml").write_text(scene.replace('id="wall"', f'id="{long}"'))
    key = f"parameters=[{{key: {long}.reflectance.data, initial: 0.4}}]"
    code, _, err = reslrb(capsys, "optimize", experiment / "c.yaml", "--set", key, "--set", "run.iterations=1")
    assert code == 0, err
    entries = json.loads(Path("runs/c/parameters/parameters.json").read_text())
    assert (Path("runs/c/parameters") / entries[f"{long}.reflectance.data"]["file"]).exists()


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (("render", "c.yaml", "-o", "pipe.png"), "--output: pipe.png is not a regular file"),
        (("render", "c.yaml", "-o", "x.bmp"), "--output: x.bmp has no known image format"),
        (("render", "c.yaml", "-o", "\udcff.png"), "--output: \\udcff.png is not UTF-8"),
        (("render", "c.yaml", "-o", "x.png", "--spp", "99999999999999"), "is not in the range 1<=x<=2147483647."),
        (("gradcheck", "c.yaml", "--json", "pipe.png"), "--json: cannot write pipe.png: nobody reads from that pipe"),
        (("bench", "c.yaml", "--memory-limit", "9" * 400 + "GiB"), "is no size; write it as in 2GiB or 500MB."),
        (("bench", "c.yaml", "--max-depth", "99999999999999"), "is not in the range 2<=x<=2147483647."),
    ],
)
def test_outputs_and_counts(experiment, capsys, monkeypatch, arguments, what):
    monkeypatch.chdir(experiment)
    os.mkfifo("pipe.png")
    code, out, err = reslrb(capsys, *arguments)
    assert (code, out) == (2, "")
    assert what in err
    assert not Path("x.png").exists()


def test_a_working_directory_that_is_gone(experiment, capsys, monkeypatch):
    gone = experiment / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    code, _, err = reslrb(capsys, "inspect", experiment / "c.yaml")
    assert code in (2, 6)
    assert err == "the working directory: No such file or directory\n"
