"""No scene brings its own code. Plugins come from Mitsuba's own folder, and Python modules from where the program's
modules come from.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import pytest

from reslrb_cli.backend import installation
from reslrb_cli.backend.installation import python_command
from reslrb_cli.errors import ConfigError
from reslrb_cli.scene.load import load_scene

pytestmark = pytest.mark.usefixtures("llvm")

SCENE = (
    '<scene version="3.0.0">\n<sensor type="perspective"/>\n<emitter type="constant"/>\n'
    '<shape type="sphere"><point name="center" x="0" y="0" z="3"/></shape>\n{}\n</scene>'
)
#: This library writes a file when it is loaded, as the constructor of any library could.
LIBRARY = """#include <stdio.h>
__attribute__((constructor)) static void run(void) { FILE *file = fopen("%s", "w"); if (file) fclose(file); }
"""
CONFIG = """
variant: llvm_ad_rgb
scene: {file: scene/scene.xml}
target: {render: {spp: 4}}
parameters: [{key: Sphere_1.bsdf.reflectance.value, initial: 0.3}]
integrator: {max_depth: 2}
run: {iterations: 1, spp: 4}
"""
SMALL = '<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>'


class Trap:
    """The folder of a scene and a working folder. Both contain libraries and Python modules that write a file when
    loaded.
    """

    def __init__(self, folder: Path) -> None:
        compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
        if compiler is None:
            pytest.skip("needs a C compiler")
        self.folder, self._ran, library = folder, folder / "ran", folder / "evil.so"
        (folder / "evil.c").write_text(LIBRARY % self._ran)
        subprocess.run([compiler, "-shared", "-fPIC", "-o", library, folder / "evil.c"], check=True)
        self.names = ["evil", "reslrb", "walk_ad", "trajectory", "prb", *sorted(installation.shipped_plugins())]
        for place in ("scene", "work"):
            (folder / place / "plugins").mkdir(parents=True)
            shutil.copy(library, folder / place)
            for name in self.names:
                shutil.copy(library, folder / place / "plugins" / f"{name}.so")
            for module in ("numpy", "yaml", "json", "mitsuba", "drjit", "reslrb_cli"):
                (folder / place / f"{module}.py").write_text(f"open({str(self._ran)!r}, 'w')")

    def write(self, objects: str) -> Path:
        file = self.folder / "scene" / "scene.xml"
        file.write_text(SCENE.format(objects))
        return file

    @property
    def is_sprung(self) -> bool:
        """True if any of this code ran since the last query."""
        ran = self._ran.exists()
        self._ran.unlink(missing_ok=True)
        return ran


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Trap:
    made = Trap(tmp_path)
    monkeypatch.chdir(tmp_path / "work")
    return made


def test_the_trap_works(trap):
    import ctypes

    with pytest.raises(AttributeError):
        _ = ctypes.CDLL(str(trap.folder / "scene" / "plugins" / "evil.so")).init_plugin
    assert trap.is_sprung


@pytest.mark.parametrize(
    "objects",
    [
        '<shape type="evil"/>',
        '<shape type="../evil"/>',
        '<shape type="{folder}/evil"/>',
        '<shape type="$kind"/>',
        '<default name="other" value="evil"/><shape type="$other"/>',
        '<include filename="part.xml"/>',
        '<shape type="cube"><bsdf type="twosided"><bsdf type="evil"/></bsdf></shape>',
        '<texture type="evil"/>',
        '<spectrum type="evil" name="x"/>',
        '<film type="evil"/>',
        '<rfilter type="evil"/>',
        '<volume type="evil"/>',
        '<shape type="EVIL"/>',
        '<shape type="evil.so"/>',
    ],
)
def test_a_plugin_from_the_folder_of_the_scene_is_refused(trap, objects):
    (trap.folder / "scene" / "part.xml").write_text('<scene version="3.0.0"><bsdf type="evil"/></scene>')
    file = trap.write(objects.format(folder=trap.folder))
    options = {"kind": "evil"} if "$kind" in objects else {}
    with pytest.raises(ConfigError) as error:
        load_scene(file, options)
    part = "include" in objects
    assert str(error.value).startswith(f"{file.with_name('part.xml')}:1: " if part else f"{file}:5: ")
    assert "there is no " in str(error.value)
    assert not trap.is_sprung


def test_the_plugin_of_mitsuba_wins_over_one_of_the_scene(trap):
    kinds = [
        '<shape type="ellipsoids"/>',
        '<sampler type="evil"/>',
        '<integrator type="evil"/>',
    ]
    for objects in ('<shape type="disk"><bsdf type="principledthin"/></shape>', '<emitter type="spot"/>', *kinds[1:]):
        load_scene(trap.write(objects))
    with pytest.raises(ConfigError):  # the plugin needs a file
        load_scene(trap.write(kinds[0]))
    assert not trap.is_sprung


def run(trap: Trap, script: str, *args: str) -> subprocess.CompletedProcess[str]:
    """Run `script` in a separate Python in the working folder. Python does not search this folder for modules."""
    command = [*python_command(script), *args]
    return subprocess.run(command, cwd=trap.folder / "work", capture_output=True, text=True, check=False)


CONFIG_FILE = "../c.yaml"


@pytest.mark.parametrize(
    "commands",
    [
        pytest.param(
            [
                ["inspect", CONFIG_FILE],
                ["render", CONFIG_FILE, "-o", "image.exr", "--set", "integrator={type: ptracer, max_depth: 2}"],
            ],
            id="short",
        ),
        pytest.param(
            [
                ["inspect", "../scene/scene.xml"],
                ["optimize", CONFIG_FILE],
                ["optimize", CONFIG_FILE, "--set", "integrator={type: prb, max_depth: 2}"],
                ["gradcheck", CONFIG_FILE, "--seeds", "3"],
                ["bench", CONFIG_FILE, "--max-depth", "2", "--rounds", "1", "--integrators", "reslrb:stack,ptracer"],
                ["doctor"],
            ],
            id="long",
            marks=pytest.mark.long,
        ),
    ],
)
def test_no_command_runs_code_from_its_folders(trap, commands):
    trap.write("").write_text(SCENE.format("").replace('perspective"/>', f'perspective">{SMALL}</sensor>'))
    (trap.folder / "c.yaml").write_text(CONFIG)
    script = (
        "from reslrb_cli.cli import main\n"
        f"for command in {commands!r}:\n"
        "    try: main.main(command)\n"
        "    except SystemExit as end: print('ended', end.code)\n"
    )
    done = run(trap, script)
    ends = [line for line in done.stdout.splitlines() if line.startswith("ended")]
    assert ends == ["ended 0"] * len(commands), done.stdout + done.stderr
    assert not trap.is_sprung


def test_modules_of_the_working_folder_are_not_imported(trap):
    done = run(trap, "import json, yaml, numpy\nprint(numpy.__file__)")
    assert str(trap.folder) not in done.stdout
    assert not trap.is_sprung
    subprocess.run([sys.executable, "-c", "import json"], cwd=trap.folder / "work", check=True)
    assert trap.is_sprung, "what Python does by itself"


def test_registered_plugins_are_known():
    assert installation.is_known("prb")
    assert not installation.is_known("mine")
    mi.register_texture("mine", lambda props: mi.Texture(props))
    assert installation.is_known("mine")
    assert not installation.is_known("blender")
