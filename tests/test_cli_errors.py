"""Every error that a user can cause ends in one line and its exit code; `--help` works, and at once."""

from __future__ import annotations

import errno
import subprocess
import sys
import time

import click
import pytest

from reslrb_cli.cli import _Main, main
from reslrb_cli.errors import (
    BackendError,
    ConfigError,
    ExitCode,
    MachineError,
    NonFinite,
    OutOfMemory,
    UnsupportedScene,
)

COMMANDS = main.list_commands(click.Context(main))


def call(*args: str) -> int:
    """Runs the command line in this process and returns its exit code."""
    with pytest.raises(SystemExit) as ended:
        main(list(args), prog_name="reslrb")
    assert isinstance(ended.value.code, int)
    return int(ended.value.code)


@pytest.fixture
def raising(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes every command raise the error that a test puts into `failing.error`."""

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
def test_exit_codes(capsys: pytest.CaptureFixture[str], error: BaseException, code: int, line: str) -> None:
    failing[:] = [error]
    assert call("failing") == code
    told = capsys.readouterr()
    assert line in told.err
    assert len(told.err.strip().splitlines()) == 1
    assert told.out == ""


@pytest.mark.usefixtures("raising")
@pytest.mark.parametrize("by", ["option", "variable"])
def test_debug_shows_the_traceback(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    failing[:] = [ConfigError("a.yaml", "run.spp", "must be positive")]
    if by == "variable":
        monkeypatch.setenv("RESLRB_DEBUG", "1")
    assert call(*(["--debug"] if by == "option" else []), "failing") == ExitCode.USAGE
    assert "Traceback" in capsys.readouterr().err
    monkeypatch.delenv("RESLRB_DEBUG", raising=False)
    call("failing")
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.usefixtures("raising")
def test_a_fault_of_ours_keeps_its_traceback() -> None:
    failing[:] = [ZeroDivisionError("ours")]
    with pytest.raises(ZeroDivisionError, match="ours"):
        main(["failing"])


@pytest.mark.parametrize(
    ("args", "line"),
    [
        ([], "reslrb: Missing command"),
        (["optimise"], "reslrb: No such command"),
        (["--nope"], "reslrb: No such option"),
        (["doctor", "--nope"], "reslrb doctor: No such option"),
    ],
)
def test_usage_errors_are_one_line(capsys: pytest.CaptureFixture[str], args: list[str], line: str) -> None:
    assert call(*args) == ExitCode.USAGE
    told = capsys.readouterr().err.strip()
    assert told.startswith(line)
    assert len(told.splitlines()) == 1


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(command, "--help") == ExitCode.DONE
    assert capsys.readouterr().out.startswith(f"Usage: reslrb {command}")


def test_help_is_fast_and_loads_no_command() -> None:
    script = (
        "import sys\nfrom reslrb_cli.cli import main\n"
        "try: main(['--help'], prog_name='reslrb')\n"
        "finally: assert not {'mitsuba', 'drjit', 'numpy', 'pydantic'} & set(sys.modules)"
    )
    times = []
    for _ in range(3):
        start = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
        times.append(time.perf_counter() - start)
    assert all(name in done.stdout for name in COMMANDS)
    assert min(times) < 1


def test_doctor_reports_as_json(llvm: str) -> None:
    import json

    script = "from reslrb_cli.cli import main; main(['doctor', '--json'])"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    report = json.loads(done.stdout)
    assert report["variant"] in ("llvm_ad_rgb", "cuda_ad_rgb")
    assert report["packages"]["mitsuba"]
    assert {backend["variant"] for backend in report["backends"]} == {"llvm_ad_rgb", "cuda_ad_rgb"}
