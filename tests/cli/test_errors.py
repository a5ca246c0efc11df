"""Errors of commands are one line with a specific exit code. Sizes that no machine can hold are refused at once."""

from __future__ import annotations

import errno
import json
import subprocess
import sys
import time
from pathlib import Path

import click
import pytest
from cli import tiny
from cli.tiny import SCENE, write_experiment

from reslrb_cli.cli import _Main, main
from reslrb_cli.cli.options import exit_code
from reslrb_cli.cli.terminal import tell
from reslrb_cli.config.loader import load
from reslrb_cli.config.schema import Config
from reslrb_cli.errors import (
    BackendError,
    ConfigError,
    ExitCode,
    MachineError,
    NonFinite,
    OutOfMemory,
    UnsupportedScene,
)
from reslrb_cli.optimization import memory as room
from reslrb_cli.optimization.assemble import assemble_scene
from reslrb_cli.records.measurements import BenchStatus
from reslrb_cli.scene import load as scene_load

# Every error that a user can cause ends in one line and its exit code. `--help` works without delay.

COMMANDS = main.list_commands(click.Context(main))


@pytest.fixture
def raising(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make every command raise the error that a test puts into `failing`."""

    @click.command("failing")
    def command() -> None:
        raise failing[0]

    monkeypatch.setattr(_Main, "get_command", lambda *_args: command)


failing: list[BaseException] = []


@pytest.mark.usefixtures("raising")
@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (ConfigError("a.yaml", "run.spp", "must be\n positive"), 2, "a.yaml: run.spp: must be positive"),
        (UnsupportedScene("media are not supported"), 2, "media are not supported"),
        (BackendError("no libLLVM"), 3, "no libLLVM"),
        (OutOfMemory("out of memory"), 4, "out of memory"),
        (NonFinite("loss is nan"), 5, "loss is nan"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (click.BadParameter("not a number"), 2, "not a number"),
        (click.FileError("x.yaml", "gone"), 2, "x.yaml"),
        (MemoryError(), 4, "out of memory (host)"),
        (RuntimeError("jit_malloc(): out of memory! Could not\nallocate"), 4, "Could not allocate"),
        (RuntimeError("jit_free(): unknown address <0xffffffffffffffff>!"), 4, "out of memory"),
        (RuntimeError("CUDA_ERROR_OUT_OF_MEMORY"), 4, "out of memory"),
        (PermissionError(13, "Permission denied", "runs/x"), 2, "runs/x: Permission denied"),
        (MachineError("runs/x: the disk is full"), 6, "runs/x: the disk is full"),
        (OSError(errno.ENOSPC, "No space left on device", "x.json"), 6, "x.json: No space left on device"),
        (OSError(errno.EIO, "Input/output error"), 6, "Input/output error"),
        (RuntimeError('cuda_check(): API error 0700 (CUDA_ERROR_ILLEGAL_ADDRESS): "x"\n in a.cpp'), 6, "0700"),
        (RuntimeError("jit_llvm_compile(): could not add module: x"), 6, "the driver or its compiler failed: jit_llvm"),
        (RuntimeError("jit_llvm_compile(): could not allocate 5 bytes of memory!"), 4, "out of memory"),
    ],
)
def test_exit_codes(error: BaseException, code: int, line: str) -> None:
    failing[:] = [error]
    found, out, err = tiny.outcome("failing")
    assert (found, out, len(err.strip().splitlines())) == (code, "", 1)
    assert line in err


@pytest.mark.usefixtures("raising")
@pytest.mark.parametrize("by", ["option", "variable"])
def test_debug_shows_the_traceback(monkeypatch: pytest.MonkeyPatch, by: str) -> None:
    failing[:] = [ConfigError("a.yaml", "run.spp", "must be positive")]
    if by == "variable":
        monkeypatch.setenv("RESLRB_DEBUG", "1")
    code, _, err = tiny.outcome(*(["--debug"] if by == "option" else []), "failing")
    assert (code, "Traceback" in err) == (ExitCode.USAGE, True)
    monkeypatch.delenv("RESLRB_DEBUG", raising=False)
    assert "Traceback" not in tiny.outcome("failing")[2]


@pytest.mark.usefixtures("raising")
def test_an_internal_error_keeps_its_traceback() -> None:
    failing[:] = [ZeroDivisionError("ours")]
    with pytest.raises(ZeroDivisionError, match="ours"):
        main(["failing"])


@pytest.mark.parametrize(
    ("interrupted", "done", "states", "code"),
    [
        (True, True, {BenchStatus.OK}, ExitCode.INTERRUPTED),
        (False, True, {BenchStatus.OK, BenchStatus.OUT_OF_MEMORY}, ExitCode.DONE),
        (False, True, {BenchStatus.OUT_OF_MEMORY}, ExitCode.DONE),
        (False, False, {BenchStatus.OUT_OF_MEMORY}, ExitCode.OUT_OF_MEMORY),
        (False, False, {BenchStatus.FAILED, BenchStatus.OUT_OF_MEMORY}, ExitCode.CHECK_FAILED),
        (False, False, set(), ExitCode.CHECK_FAILED),
    ],
)
def test_the_exit_code_of_a_comparison(interrupted: bool, done: bool, states: set[BenchStatus], code: ExitCode) -> None:
    assert exit_code(interrupted, done, states) is code


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command(command: str) -> None:
    assert tiny.done(command, "--help").stdout.startswith(f"Usage: reslrb {command}")


def test_help_loads_nothing_heavy() -> None:
    """Modules that take a tenth of a second to import are imported where they are used. The list of commands also loads
    no command. On failure, the first command with a module loaded it.
    """
    script = (
        "import contextlib, json, sys\nfrom reslrb_cli.cli import main\nfound = {}\n"
        "heavy = {'mitsuba', 'drjit', 'numpy', 'scipy', 'matplotlib'}\n"
        "for name in sys.argv[1:]:\n"
        "    with contextlib.suppress(SystemExit): main([*name.split(), '--help'], prog_name='reslrb')\n"
        "    found[name] = sorted(({'pydantic', *heavy} if not name else heavy) & set(sys.modules))\n"
        "print(json.dumps(found))"
    )
    done = subprocess.run([sys.executable, "-c", script, "", *COMMANDS], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout.splitlines()[-1]) == {command: [] for command in ("", *COMMANDS)}


def test_doctor_prints_the_backends_and_packages(llvm: str) -> None:
    told = tiny.done("doctor").stdout
    found = dict(line.split(maxsplit=1) for line in told.splitlines() if not line.startswith(" "))
    assert found["variant"].startswith("auto is ")
    assert {"llvm_ad_rgb", "cuda_ad_rgb", "python", "mitsuba", "drjit"} <= set(found)


# Sizes that no machine can hold are refused at once, in one located line with the reason. Merely large sizes are
# accepted.

#: Processor seconds until a refusal.
SECONDS = 5.0
TRAJECTORY = "{type: trajectory, max_depth: 70000}"
#: Overrides, and the start of the error line: the place, the error, the reason and a value that works.
REFUSED = {
    "film": (["scene.size=[100000, 100000]"], "scene.size: must have at most 134217728 pixels, not 10000000000"),
    "samples": (
        ["scene.size=[256, 256]", "run.spp=1000000000"],
        "run.spp: 1000000000 makes 17174036480 light paths in one pass, above the limit of 4294967295; set "
        "integrator.samples_per_pass to at most 65535, or lower run.spp",
    ),
    "passes": (
        ["scene.size=[8, 8]", "run.spp=1000000000", "integrator.samples_per_pass=1000"],
        "run.spp: 1000000000 makes 250000 passes of a step, above the limit of 65536; raise "
        "integrator.samples_per_pass, or lower run.spp",
    ),
    "capacity": (
        ["integrator={estimator: reservoir, capacity: 1000000}"],
        "integrator.capacity: must be at most 1024, not 1000000",
    ),
    "depth": (
        ["integrator.max_depth=1000000"],
        "integrator.max_depth: must be at most 65535, not 1000000",
    ),
    "record": (
        [f"integrator={TRAJECTORY}"],
        "integrator.max_depth: must be at most 65535, not 70000",
    ),
}


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    write_experiment(tmp_path)
    return tmp_path


def refused(folder: Path, *sets: str) -> tuple[str, float]:
    """Run `optimize`, check for exit code 2, and return the single error line and the processor time in seconds."""
    before = time.process_time()
    code, out, err = tiny.outcome("optimize", "tiny.yaml", "--quiet", *tiny.settings(*sets))
    seconds = time.process_time() - before
    assert (code, out) == (2, ""), err
    [line] = err.splitlines()
    assert not (folder / "runs").exists()
    return line, seconds


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize("case", REFUSED)
def test_refused_before_mitsuba_is_loaded(case: str, experiment: Path) -> None:
    sets, said = REFUSED[case]
    with pytest.raises(ConfigError) as error:
        load(experiment / "tiny.yaml", sets)
    assert said in str(error.value)


@pytest.mark.usefixtures("llvm")
def test_refused_within_seconds(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The size of the film is in the scene file, so the scene is loaded before the refusal. This case is the
    slowest.
    """
    monkeypatch.chdir(experiment)
    (experiment / "scene.xml").write_text(SCENE.replace('name="width" value="8"', 'name="width" value="65536"'))
    line, seconds = refused(experiment, "run.spp=1000000")
    assert line.startswith("tiny.yaml: run.spp: 1000000 makes ")
    assert line.endswith("set integrator.samples_per_pass to at most 8191, or lower run.spp")
    assert seconds < SECONDS
    (experiment / "scene.xml").write_text(SCENE.replace('value="8"', 'value="60000"'))
    line, seconds = refused(experiment)
    assert line.startswith("tiny.yaml: scene.file: a film of 60000x60000 pixels: a step takes at least ")
    assert seconds < SECONDS


def obstacle(folder: Path, *sets: str) -> str:
    with pytest.raises(ConfigError) as error:
        assemble_scene(load(folder / "tiny.yaml", sets))
    return str(error.value)


@pytest.fixture
def little(monkeypatch: pytest.MonkeyPatch) -> int:
    """Free bytes of a simulated machine with little memory."""
    free = 2**30
    monkeypatch.setattr(room, "free_bytes", lambda variant: free)
    return free


@pytest.mark.usefixtures("llvm")
def test_requirements_beyond_the_free_memory(experiment: Path, little: int) -> None:
    advice = "and 1 GiB are free; use a smaller film or coarser textures"
    line = obstacle(experiment, "scene.size=[6000, 4000]")
    assert line.endswith(advice)
    assert "scene.size: a film of 6000x4000 pixels: a step takes at least " in line
    line = obstacle(experiment, "parameters[0].resolution=[10000, 10000]")
    assert line.endswith(advice)
    assert "parameters[0].resolution: a film of 8x8 pixels and 10000x10000 texels: a step takes at least " in line
    (experiment / "scene.xml").write_text(SCENE.replace('value="8"', 'value="5000"'))
    assert "scene.file: a film of 5000x5000 pixels: a step takes at least " in obstacle(experiment)


@pytest.mark.usefixtures("llvm")
def test_a_step_beyond_the_free_memory(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def find(*sets: str) -> None:
        room.check_step(assemble_scene(load(experiment / "tiny.yaml", ["scene.size=[512, 512]", "run.spp=64", *sets])))

    monkeypatch.setattr(room, "SMALL", 0)
    naive = "integrator={type: ptracer, max_depth: 3}"
    # Free memory in MiB. The first two cases differ because the scene file does not state the number of channels of the
    # texture.
    for free, sets, said in (
        (40, ["parameters[0].resolution=[512, 512]"], "scene.size: a film of 512x512 pixels and 512x512 texels: "
                                                      "a step takes at least 48 MiB, and 40 MiB are free; "),
        (64, ["parameters[0].resolution=[512, 512]"], "scene.file: a step takes at least "),
        (32, ["run.adjoint=correlated"], "run.spp: a step takes at least "),
        (32, [naive], "run.spp: ptracer stores the state of all 4194304 light paths of a pass, at least 192 MiB, and "),
    ):  # fmt: skip
        monkeypatch.setattr(room, "free_bytes", lambda variant, free=free: free * 2**20)
        with pytest.raises(ConfigError) as error:
            find(*sets)
        assert said in str(error.value)
    monkeypatch.setattr(room, "free_bytes", lambda variant: 2**28)
    for sets in (["parameters[0].resolution=[512, 512]"], [naive]):
        find(*sets)


@pytest.fixture
def unbuilt(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the building of a scene fail. The program must print its message before it builds the scene."""

    def never(*args: object) -> None:
        raise AssertionError("the scene is built")

    monkeypatch.setattr(scene_load, "build", never)


@pytest.mark.usefixtures("llvm")
def test_the_film_size_is_known_before_the_scene_is_built(
    experiment: Path, monkeypatch: pytest.MonkeyPatch, unbuilt: None
) -> None:
    monkeypatch.setattr(room, "free_bytes", lambda variant: 2**34)
    sides = SCENE.replace('value="8"', 'value="11500"', 1).replace('value="8"', 'value="11500"', 1)
    (experiment / "scene.xml").write_text(sides)
    line = obstacle(experiment, "parameters[0].resolution=[8000, 8000]")
    said = "scene.file: a film of 11500x11500 pixels and 8000x8000 texels: a step takes at least 22.4 GiB, and "
    assert line.endswith(f"{said}16 GiB are free; use a smaller film or coarser textures")
    assert obstacle(experiment, "run.spp=1000000").endswith(
        "set integrator.samples_per_pass to at most 32, or lower run.spp"
    )
    window = '<integer name="crop_width" value="100"/> <integer name="crop_height" value="50"/> <rfilter'
    for scene, sets in (
        (sides.replace("<rfilter", window), []),
        (sides, ["integrator={type: prb, max_depth: 3}"]),
        (SCENE.replace("</scene>", sides[sides.index("<sensor") : sides.index("<bsdf")] + "</scene>"), []),
        (SCENE.replace(SCENE[SCENE.index("<film") : SCENE.index("</film>") + 7], ""), []),
    ):
        (experiment / "scene.xml").write_text(scene)
        with pytest.raises(AssertionError, match="the scene is built"):
            assemble_scene(load(experiment / "tiny.yaml", sets))


@pytest.mark.usefixtures("llvm")
def test_a_record_too_large_for_a_thread(experiment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def find(*sets: str) -> None:
        room.check_step(assemble_scene(load(experiment / "tiny.yaml", sets)))

    monkeypatch.setattr(room, "local_bytes", lambda: 2**19)
    find("integrator={type: trajectory, max_depth: 8000}")
    with pytest.raises(ConfigError, match=r"integrator\.max_depth: the record of 9000 segments does not fit "):
        find("integrator={type: trajectory, max_depth: 9000}")


@pytest.mark.usefixtures("llvm")
@pytest.mark.parametrize(
    "sets",
    [
        ["scene.size=[256, 256]", "run.spp=1000000000", "integrator.samples_per_pass=62500"],
        ["scene.size=[11000, 11000]"],
        ["run.iterations=2000000000", "run.final_spp=1000000"],
    ],
)
def test_large_but_fitting_sizes_are_accepted(sets: list[str], experiment: Path) -> None:
    assert isinstance(load(experiment / "tiny.yaml", sets), Config)


@pytest.mark.parametrize(("text", "said"), [("no file.", "no file."), ("no file", "no file."), ("why?", "why?")])
def test_a_usage_error_ends_with_one_mark(text: str, said: str) -> None:
    assert tell(click.UsageError(text)) == (f"reslrb: {said} See `reslrb --help`.", ExitCode.USAGE)
